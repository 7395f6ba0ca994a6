"""Stage "maps": frames as images in texture space, and the mesh with its mean texture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.encoding import encode_srgb
from reflfield.capture.image_writing import write_exr
from reflfield.export.gltf import write_glb
from reflfield.field.file import open_field
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.metrics.held_out_photographs import mean_sample
from reflfield.observations.store import ObservationStore
from reflfield.pipeline.context import Job
from reflfield.report.pictures import texture

# Memory of one such sample: RGB as half and as float, whether it is observed, twice.
SAMPLE_BYTES = 24
AVERAGES = "averages.npz"


def write_maps(job: Job, folder: Path) -> dict[str, Any]:
    """Pictures in texture space, and the mesh with its mean texture."""
    job = job.refined
    field = open_field(job.stages.root / "compression" / "field.rfld")
    _write_maps(job, field, folder)
    average = average_samples(job, folder)
    np.savez_compressed(folder / AVERAGES, average=average)
    _write_mesh(job, average, folder)
    return {"texels with samples": int(np.isfinite(average).all(axis=1).sum())}


def _write_maps(job: Job, field: ReflectanceField, folder: Path) -> None:
    texel_of_pixel = job.texels.texel_of_pixel
    frames = field.local_from_world
    for name, row in (("normals", 2), ("tangents", 0)):
        image = texture(frames[:, row], texel_of_pixel, nothing=0.0)
        write_exr(folder / f"{name}.exr", image.astype(np.float32))


def average_samples(job: Job, folder: Path) -> NDArray[np.float32]:
    """Mean observed sample of every texel, (n_texels, 3); NaN where there is none."""
    store = job.base_reader.store
    each = SAMPLE_BYTES * store.observed.pairs.size
    step = int(np.clip(job.resources.block_bytes // each, 1, store.texels_per_chunk))
    found = job.blocks(folder).map(
        "mean samples",
        averages_block,
        Averaging(store, step),
        job.base_reader.blocks_of(np.arange(store.n_texels)),
    )
    return found.joined("averages")


@dataclass(frozen=True, eq=False)
class Averaging:
    """What all blocks of texels share whose samples are averaged.

    Parameters
    ----------
    store : ObservationStore
    step : int
        Texels at a time; the averages do not depend on it.
    """

    store: ObservationStore
    step: int


def averages_block(context: Averaging, texels: NDArray[np.intp]) -> dict[str, Any]:
    """Mean observed sample of some adjacent texels."""
    parts = []
    observed = context.store.observed
    for first in range(texels[0], texels[-1] + 1, context.step):
        part = slice(first, min(first + context.step, texels[-1] + 1))
        seen = observed.views[part, :, None] & observed.lights[part, None, :] & observed.pairs
        parts.append(mean_sample(context.store.read(part), seen) * context.store.unit)
    return {"averages": np.concatenate(parts).astype(np.float32)}


def _write_mesh(job: Job, average: NDArray[np.float32], folder: Path) -> None:
    """Mesh with UVs and the mean texture, bright enough to look at."""
    known = np.nan_to_num(average)
    white = np.percentile(known.max(axis=1), 99) or 1.0
    texels = job.texels.texel_of_pixel
    picture = encode_srgb(np.clip(known / white, 0, 1))[np.maximum(texels, 0)]
    picture = np.where(texels[..., None] >= 0, picture, 0)
    write_glb(folder / "atlas.glb", job.surface_atlas, np.rint(picture * 255).astype(np.uint8))
