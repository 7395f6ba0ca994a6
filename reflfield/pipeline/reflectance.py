"""Stages that find the reflectance: observations, completion, alignment, compression."""

from __future__ import annotations

import logging
from dataclasses import dataclass, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment import RefinementOptions, align
from reflfield.alignment.refinement import SampleSet
from reflfield.alignment.scattered import (
    SharpTargets,
    improved_block,
    in_gauge_of,
    sharp_targets,
)
from reflfield.alignment.splines import NodeTargets
from reflfield.errors import InputError
from reflfield.factorization import Completion, complete
from reflfield.field.clustered_model import ClusteredModel
from reflfield.field.clustered_pca import (
    CompressionOptions,
)
from reflfield.field.file import open_field, write_field
from reflfield.metrics.sample_residual import sample_error
from reflfield.observations.image_projection import (
    VALUE_KINDS,
    LookedInto,
    Projection,
    project_photographs,
)
from reflfield.observations.light_agreement import looks_at, other_light_axes
from reflfield.observations.store import open_samples
from reflfield.observations.texel_reading import LUMINANCE, TexelReader
from reflfield.observations.texel_samples import unroot
from reflfield.options import Resources
from reflfield.pipeline.cache import WARNINGS, plain
from reflfield.pipeline.clipped_values import check_measured, clipping_lines, write_measured
from reflfield.pipeline.context import ELSEWHERE, Job
from reflfield.pipeline.fitting import AlignedFrames, Resampled, fitted_model, local_frames
from reflfield.pipeline.memory import columns_at_once, writers_at_once
from reflfield.pipeline.pipeline_options import AlignmentOptions
from reflfield.pipeline.quantising import FieldMaker
from reflfield.pipeline.texel_columns import Inference, Resampling, half_columns, inferred
from reflfield.sphere.harmonic_projection import safe_band_limit
from reflfield.sphere.hemisphere import HemisphereGrid, softened_cosine
from reflfield.util.blocks import Blocks

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

logger = logging.getLogger(__name__)

# Share of the memory that the columns of a completion may take while it is fitted.
COLUMNS_SHARE = 1 / 3
# In the results of the resampling: coefficients of all texels, beside those of the completion.
ALL_COEFFICIENTS = "all_coefficients"
# On raw samples: a few rounds, the targets on texels enough for grids of this side.
REFINEMENT = RefinementOptions(side=25, rounds=4, texels_per_cluster=8192)


def write_observations(job: Job, folder: Path) -> dict[str, Any]:
    """Apparent BRDF samples of all texels, on disk; what of them was not measured is told."""
    location = job.new_samples_location(folder)
    projection = Projection(
        job.training, job.texels.position, job.view_seen, location, job.resources.block_bytes
    )
    found = project_photographs(projection, job.blocks(folder), writers_at_once(job))
    check_measured(job.training, found)
    write_measured(folder, found.measured)
    for line in clipping_lines(job.training, found):
        logger.warning("%s", line)
    n_samples = job.view_seen.size * job.training.n_lights
    return {
        "photographs": found.photographs,
        "samples": n_samples,
        "raw bytes": n_samples * 6,
        **{f"values {kind}": found.count(kind) for kind in VALUE_KINDS},
        WARNINGS: misread_lights(job, found.looked_into),
    }


def misread_lights(job: Job, samples: LookedInto) -> list[str]:
    """A warning where the lights are plainly in other axes than the cameras."""
    if job.is_plane:  # all its points face one way
        return []
    looks = looks_at(
        job.training,
        samples.photograph,
        job.texels.position[samples.texel],
        job.texels.normal[samples.texel],
        samples.brightness(),
    )
    words = other_light_axes(list(looks))
    return [words] if words else []


def lost_observations(job: Job, folder: Path) -> str:
    """What is wrong with the samples in a store elsewhere; empty if nothing is.

    Its chunks are verified as they are read.
    """
    if not (folder / ELSEWHERE).is_file():
        return ""
    try:
        open_samples((folder / ELSEWHERE).read_text(), "r")
    except InputError as error:
        return str(error).partition("; ")[0]
    return ""


def write_completion(job: Job, folder: Path) -> dict[str, Any]:
    """Texels resampled in their base frames, and what was not observed of them filled."""
    options = job.options.completion
    chosen = job.training_texels(options.training_texels)
    found, coefficients = completed(
        job.base_reader,
        chosen,
        job.seen_texels,
        rank=options.rank,
        passes=options.passes,
        method=options.method,
        seed=job.options.seed,
        resources=job.resources,
        blocks=job.blocks(folder),
    )
    write_completion_arrays(folder / "completion.npz", found, coefficients)
    return {
        "texels that shape the basis": len(chosen),
        "texels completed": len(job.seen_texels),
        "texels without samples": job.base_reader.n_texels - len(job.seen_texels),
        "samples observed": job.observed.count(),
        "share of nodes observed": float(found.coverage.mean()),
        "residual": float(found.residuals[-1]),
    }


def completed(
    reader: TexelReader,
    chosen: Indices,
    seen: Indices,
    *,
    rank: int,
    resources: Resources,
    blocks: Blocks,
    passes: int = 4,
    method: Literal["map", "brand"] = "map",
    seed: int = 0,
) -> tuple[Completion, Floats]:
    """Completion shaped by the chosen texels, and coefficients of all.

    The columns of the chosen texels are kept in memory, or in a temporary folder where they
    are too many; the result depends on neither.

    Returns
    -------
    completion : Completion
    coefficients : (n_texels, rank) float32
        Zero (the mean) for texels without samples.
    """
    context = Resampling(reader, resources.block_bytes)

    def basis() -> dict[str, NDArray[Any]]:
        blocks.folder.mkdir(exist_ok=True)
        with TemporaryDirectory(dir=blocks.folder, prefix="columns.") as folder:
            columns = half_columns(
                blocks, context, chosen, int(resources.max_memory * COLUMNS_SHARE), Path(folder)
            )
            found = complete(
                columns,
                rank=rank,
                passes=passes,
                method=method,
                n_channels=3 // reader.weight_channels,
                seed=seed,
            )
        return arrays_of(found)

    found = completion_of(blocks.once("basis", basis))
    coefficients = np.zeros((reader.n_texels, found.rank), np.float32)
    coefficients[chosen] = found.coefficients
    others = np.setdiff1d(seen, chosen)
    if len(others):
        parts = blocks.map(
            "completing all texels",
            inferred,
            Inference(found, context),
            reader.blocks_of(others),
            at_once=columns_at_once(resources, reader.n_pairs),
        )
        coefficients[others] = parts.joined("coefficients")
    return found, coefficients


def arrays_of(found: Completion) -> dict[str, NDArray[Any]]:
    """Entries of a completion as arrays."""
    return {entry.name: np.asarray(getattr(found, entry.name)) for entry in fields(found)}


def completion_of(stored: dict[str, Any]) -> Completion:
    """Completion from its entries as arrays."""
    numbers: dict[str, Any] = {
        "noise": float(stored["noise"]),
        "residuals": tuple(stored["residuals"].tolist()),
        "restarts": int(stored["restarts"]),
    }
    return Completion(**{**stored, **numbers})


def write_completion_arrays(path: Path, found: Completion, coefficients: Floats) -> None:
    """Store what later stages need of a completion."""
    np.savez(
        path,
        basis=found.basis.astype(np.float32),
        mean=found.mean.astype(np.float32),
        coefficients=coefficients,
        noise=np.array(found.noise),
        residuals=np.array(found.residuals),
    )


@dataclass(frozen=True, eq=False)
class CompletedLuminance:
    """Completed texels as alignment correlates them: luminance, linear, with the cosine.

    Parameters
    ----------
    mean, basis, coefficients : ndarray
        Of the completion; coefficients of the texels to align.
    sides : (int, int)
        Sides of the grids.
    domain : str
    cosine : bool
        Whether the light's cosine is to be multiplied back.
    """

    mean: Floats
    basis: Floats
    coefficients: Floats
    sides: tuple[int, int]
    domain: str

    @property
    def shape(self) -> tuple[int, int, int]:
        """(n_texels, n_view_nodes, n_light_nodes)."""
        return len(self.coefficients), self.sides[0] ** 2, self.sides[1] ** 2

    def read(self, rows: NDArray[np.int64]) -> Floats:
        """Samples at the nodes, (k, n_view_nodes, n_light_nodes)."""
        columns = self.mean + self.coefficients[rows] @ self.basis.T
        nodes = columns.reshape(len(rows), *self.shape[1:], 3)
        values = unroot(nodes, self.domain) @ LUMINANCE
        if self.sides[1] > 1:
            z = HemisphereGrid(self.sides[1]).directions[:, 2]
            values = values * softened_cosine(z).astype(np.float32)
        return np.maximum(values, 0).astype(np.float32)


def write_alignment(job: Job, folder: Path) -> dict[str, Any]:
    """One local frame per texel."""
    n = job.base_reader.n_texels
    frames = np.tile(np.eye(3), (n, 1, 1))
    arrays: dict[str, Any] = {
        "aligned": np.zeros(n, bool),
        "cluster": np.zeros(n, np.int32),
        "score": np.zeros(n),
        "margin": np.zeros(n),
        "history": np.zeros(0),
    }
    keep = np.zeros(len(job.seen_texels), bool)
    if job.options.alignment.enabled and max(job.sides) > 1:
        blocks = job.blocks(folder)
        found = blocks.once("harmonic search", lambda: aligned(job))
        seen = job.seen_texels
        keep = found["margin"] >= job.options.alignment.least_margin
        arrays["aligned"][seen[keep]] = True
        local_from_base = found["local_from_base"]
        if job.options.alignment.refine:
            local_from_base = refined(job, local_from_base, found["cluster"], blocks)
        frames[seen[keep]] = local_from_base[keep]
        for name in ("cluster", "score", "margin"):
            arrays[name][seen] = found[name]
        arrays["history"] = found["history"]
    np.savez(folder / "alignment.npz", local_from_base=frames, **arrays)
    n_aligned = int(keep.sum())
    moved = np.degrees(np.arccos(np.clip(frames[:, 2, 2], -1, 1)))
    return {
        "texels aligned": n_aligned,
        "texels that keep the base frame": len(job.seen_texels) - n_aligned,
        "mean tilt from the base normal, degrees": float(moved[job.seen_texels].mean()),
        "rotation determined (margin > .01)": int((arrays["margin"] > 0.01).sum()),
    }


def aligned(job: Job) -> dict[str, NDArray[Any]]:
    """Alignment of the completed texels that have samples: the arrays of `Alignment`."""
    options = job.options.alignment
    stored = job.result("completion", "completion.npz")
    source = CompletedLuminance(
        mean=stored["mean"],
        basis=stored["basis"],
        coefficients=stored["coefficients"][job.seen_texels],
        sides=job.sides,
        domain=job.options.resampling.domain,
    )
    view, light = (HemisphereGrid(side).directions for side in job.sides)
    limits = tuple(_band_limit(options.band_limit, d) for d in (view, light))
    found = align(
        source,
        view,
        light,
        band_limit=(limits[0], limits[1]),
        iterations=options.iterations,
        n_clusters=options.n_clusters,
        refine=False,
        seed=job.options.seed,
        max_tilt=np.radians(options.max_tilt_deg),
        n_threads=job.resources.workers,
    )
    names = ("local_from_base", "cluster", "score", "margin", "history")
    return {name: getattr(found, name) for name in names}


@dataclass(frozen=True, eq=False)
class RawLuminance:
    """Raw samples of some texels in their base frames, as the refinement takes them.

    Parameters
    ----------
    reader : TexelReader
        Of the base frames.
    texels : (n,) int
    block_bytes : int
        Working memory; the frames do not depend on it.
    """

    reader: TexelReader
    texels: Indices
    block_bytes: int

    @property
    def shape(self) -> tuple[int, int, int]:
        """(n_texels, n_views, n_lights); 1 for directions that do not vary."""
        counts = (self.reader.capture.n_views, self.reader.capture.n_lights)
        views, lights = (
            1 if side == 1 else count
            for side, count in zip(self.reader.sides, counts, strict=True)
        )
        return len(self.texels), views, lights

    def read(self, rows: NDArray[np.int64]) -> SampleSet:
        """Samples of some texels, read some at a time."""
        step = max(1, self.block_bytes // self.reader.sample_bytes_per_texel)
        parts = [
            self.reader.luminance(self.texels[rows[first : first + step]])
            for first in range(0, len(rows), step)
        ]
        return SampleSet(
            samples=np.concatenate([part.samples for part in parts]),
            views=np.concatenate([part.views for part in parts]),
            lights=np.concatenate([part.lights for part in parts]),
        )


@dataclass(frozen=True, eq=False)
class Refining:
    """What all blocks of texels whose frames are refined share.

    Parameters
    ----------
    source : RawLuminance
    frames : (n, 3, 3) float64
        Of the harmonic search.
    cluster : (n,) int32
    sharp : SharpTargets
    """

    source: RawLuminance
    frames: NDArray[np.float64]
    cluster: NDArray[np.int32]
    sharp: SharpTargets


def refined_block(context: Refining, rows: Indices) -> dict[str, NDArray[Any]]:
    """Frames of some texels, refined on their samples."""
    frames = improved_block(
        context.source.read(rows), context.frames[rows], context.cluster[rows], context.sharp
    )
    return {"frames": frames}


def refined(
    job: Job,
    frames: NDArray[np.float64],
    cluster: NDArray[np.int32],
    blocks: Blocks,
) -> NDArray[np.float64]:
    """Frames of the texels that have samples: `refine_scattered` by blocks."""
    seen = job.seen_texels
    source = RawLuminance(job.base_reader, seen, job.resources.block_bytes)
    options = replace(REFINEMENT, spread=np.radians(job.options.alignment.spread_deg))

    def targets() -> dict[str, NDArray[Any]]:
        found = sharp_targets(
            source,
            frames,
            cluster,
            options,
            seed=job.options.seed,
            n_threads=job.resources.workers,
        )
        return {
            "values": found.targets.values,
            "sides": np.array(found.targets.sides),
            "side": np.array(found.options.side),
        }

    found = blocks.once("sharp targets", targets)
    view_side, light_side = (int(side) for side in found["sides"])
    sharp = SharpTargets(
        NodeTargets(found["values"], view_side, light_side),
        replace(options, side=int(found["side"])),
    )
    rows = [np.searchsorted(seen, some) for some in job.base_reader.blocks_of(seen)]
    parts = blocks.map(
        "frames on the samples", refined_block, Refining(source, frames, cluster, sharp), rows
    )
    return in_gauge_of(frames, parts.joined("frames"), cluster)


def _band_limit(wanted: int, directions: NDArray[np.float64]) -> int:
    return min(wanted, safe_band_limit(int((directions[:, 2] > 0).sum())))


def write_resampling(job: Job, folder: Path) -> dict[str, Any]:
    """Raw samples in the aligned frames on the grids, and what was not observed filled."""
    found = resampled(job, aligned_frames(job), job.options.compression, job.blocks(folder))
    arrays: dict[str, Any] = arrays_of(found.completion)
    np.savez(folder / "resampling.npz", **{**arrays, ALL_COEFFICIENTS: found.coefficients})
    return {
        "texels that shape the basis": len(found.completion.coefficients),
        "residual": float(found.completion.residuals[-1]),
    }


def write_compression(job: Job, folder: Path) -> dict[str, Any]:
    """Clusters, mean, basis and coefficients of the aligned texels -> field."""
    stored = job.result("resampling", "resampling.npz")
    coefficients = stored.pop(ALL_COEFFICIENTS)
    found = Resampled(aligned_frames(job), completion_of(stored), coefficients)
    maker = FieldMaker(job, job.options.compression, plain(job.options))
    return write_compressed(found, maker, folder)


def write_without_alignment(job: Job, folder: Path) -> dict[str, Any]:
    """The same in the base frames: as many clusters and components, and a file as large."""
    base = np.tile(np.eye(3), (job.base_reader.n_texels, 1, 1))
    frames = AlignedFrames(base, np.zeros(0, np.intp))
    made_with = plain(replace(job.options, alignment=AlignmentOptions(enabled=False)))
    del made_with["completion"]
    aligned_field = open_field(job.stages.root / "compression" / "field.rfld")
    alike = replace(
        job.options.compression,
        n_clusters=aligned_field.n_clusters,
        n_components=aligned_field.n_components,
        size=(job.stages.root / "compression" / "field.rfld").stat().st_size,
        psnr=0.0,
    )
    found = resampled(job, frames, alike, job.blocks(folder))
    return write_compressed(found, FieldMaker(job, alike, made_with), folder)


def aligned_frames(job: Job) -> AlignedFrames:
    """What the alignment has found."""
    stored = job.result("alignment", "alignment.npz")
    return AlignedFrames(stored["local_from_base"], np.flatnonzero(stored["aligned"]))


def resampled(
    job: Job, frames: AlignedFrames, options: CompressionOptions, blocks: Blocks
) -> Resampled:
    """Resample all texels from their raw samples in the given frames, and complete them."""
    reader = job.base_reader.rotated(local_frames(job, frames.local_from_base))
    found, coefficients = completed(
        reader,
        job.training_texels(options.training_texels),
        job.seen_texels,
        rank=options.rank,
        seed=job.options.seed,
        resources=job.resources,
        blocks=blocks,
    )
    return Resampled(frames, found, coefficients)


def write_compressed(found: Resampled, maker: FieldMaker, folder: Path) -> dict[str, Any]:
    """Fit a field in the given frames, write it, and measure it on the samples."""
    job = maker.job
    model, reader = fitted_model(maker, found, job.blocks(folder))
    made = maker.made(model, reader.local_from_world)
    write_field(folder / "field.rfld", made)
    write_model(folder / "model.npz", model, reader.local_from_world)
    size = (folder / "field.rfld").stat().st_size
    raw = int(np.prod(job.observed.views.shape)) * job.training.n_lights * 6
    error = sample_error(made, job.base_reader, job.seen_texels)
    n_fitted = len(job.seen_texels)
    counted = reader.count_fitted(np.flatnonzero(job.sampled.any(axis=1)))
    return {
        "texels fitted": n_fitted,
        "texels that repeat another": made.n_texels - n_fitted,
        "samples fitted": counted.fitted,
        "samples not measured": counted.unmeasured,
        "clusters": made.n_clusters,
        "components": made.n_components,
        "field bytes": size,
        "raw bytes": raw,
        "compression ratio": raw / size,
        "residual in the domain": float(model.residuals[-1]),
        "relative error of the samples": error.linear,
        "relative error of their cube roots": error.cube_root,
        "LDR PSNR of the samples, dB": error.psnr_ldr,
        "samples measured": error.n_samples,
    }


def write_model(path: Path, model: ClusteredModel, frames: Floats) -> None:
    """Store a model before it is quantised, and its frames."""
    arrays: dict[str, Any] = {
        entry.name: np.asarray(getattr(model, entry.name)) for entry in fields(model)
    }
    np.savez(path, local_from_world=frames, **arrays)
