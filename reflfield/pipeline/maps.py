"""Stage "maps": frames as images in texture space, and the mesh with its mean texture."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.encoding import encode_srgb
from reflfield.capture.image_writing import write_exr
from reflfield.export.gltf import colour_material, filled_texture, write_glb
from reflfield.field.file import open_field
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.metrics.held_out_photographs import mean_sample
from reflfield.observations.store import ObservationStore
from reflfield.pipeline import results
from reflfield.pipeline.context import Context
from reflfield.report.pictures import texture

# Memory of one such sample: RGB as half and as float, whether it is observed, twice.
SAMPLE_BYTES = 24
AVERAGES = "averages.npz"


def write_maps(context: Context, folder: Path) -> dict[str, Any]:
    """Write images in texture space, and the mesh with its mean texture."""
    context = context.refined
    field = open_field(results.field_file(context))
    _write_maps(context, field, folder)
    average = average_samples(context, folder)
    np.savez_compressed(folder / AVERAGES, average=average)
    _write_mesh(context, average, folder)
    return {"texels with samples": int(np.isfinite(average).all(axis=1).sum())}


def _write_maps(context: Context, field: ReflectanceField, folder: Path) -> None:
    texel_of_pixel = results.texels(context).texel_of_pixel
    frames = field.local_from_world
    for name, row in (("normals", 2), ("tangents", 0)):
        image = texture(frames[:, row], texel_of_pixel, nothing=0.0)
        write_exr(folder / f"{name}.exr", image.astype(np.float32))


def average_samples(context: Context, folder: Path) -> NDArray[np.float32]:
    """Mean observed sample of every texel, (n_texels, 3); NaN where there is none."""
    store = results.base_reader(context).store
    each = SAMPLE_BYTES * len(store.observed.pairs)
    step = int(np.clip(context.resources.block_bytes // each, 1, store.texels_per_chunk))
    parts = context.blocks(folder).map(
        "mean samples",
        partial(averages_block, step=step),
        store,
        results.base_reader(context).blocks_of(np.arange(store.n_texels)),
    )
    return parts.joined("averages")


def averages_block(
    store: ObservationStore, texels: NDArray[np.intp], *, step: int
) -> dict[str, Any]:
    """Mean observed sample of some adjacent texels, so many at a time."""
    parts = []
    observed = store.observed
    for first in range(texels[0], texels[-1] + 1, step):
        part = slice(first, min(first + step, texels[-1] + 1))
        parts.append(mean_sample(store.read(part), observed.of_texels(part)) * store.unit)
    return {"averages": np.concatenate(parts).astype(np.float32)}


def _write_mesh(context: Context, average: NDArray[np.float32], folder: Path) -> None:
    """Write the mesh with UVs and the mean texture, bright enough to look at."""
    known = np.nan_to_num(average)
    white = np.percentile(known.max(axis=1), 99) or 1.0
    texels = results.texels(context).texel_of_pixel
    colours = np.rint(encode_srgb(np.clip(known / white, 0, 1)) * 255).astype(np.uint8)
    material = colour_material(filled_texture(texels, colours))
    up = context.capture.up
    write_glb(folder / "atlas.glb", results.atlas(context), material, up=up)
