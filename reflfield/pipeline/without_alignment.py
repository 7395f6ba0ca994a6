"""Stage "without_alignment": the same field in the base frames, to compare with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from reflfield.field.evaluation import clustered
from reflfield.field.file import open_field
from reflfield.pipeline import results
from reflfield.pipeline.alignment import AlignedFrames
from reflfield.pipeline.cache import plain
from reflfield.pipeline.compression import write_compressed
from reflfield.pipeline.context import Context
from reflfield.pipeline.pipeline_options import AlignmentOptions
from reflfield.pipeline.quantisation_search import FieldMaker
from reflfield.pipeline.resampling import resampled


def write_without_alignment(context: Context, folder: Path) -> dict[str, Any]:
    """Fit the same in the base frames: as many clusters and components, and a file as large."""
    base = np.tile(np.eye(3), (results.base_reader(context).n_texels, 1, 1))
    frames = AlignedFrames(base, np.zeros(0, np.intp))
    made_with = plain(replace(context.options, alignment=AlignmentOptions(enabled=False)))
    del made_with["completion"]
    aligned_field = clustered(open_field(results.field_file(context)))
    alike = replace(
        context.options.compression,
        n_clusters=aligned_field.n_clusters,
        n_components=aligned_field.n_components,
        size=results.field_file(context).stat().st_size,
        psnr=0.0,
    )
    texels = resampled(context, frames, alike, context.blocks(folder))
    return write_compressed(texels, FieldMaker(context, alike, made_with), folder)
