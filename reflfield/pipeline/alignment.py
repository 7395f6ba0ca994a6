"""Stage "alignment": one local frame for each texel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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
from reflfield.observations.texel_reading import LUMINANCE, TexelReader
from reflfield.observations.texel_samples import unroot
from reflfield.pipeline.context import Job
from reflfield.sphere.harmonic_projection import safe_band_limit
from reflfield.sphere.hemisphere import HemisphereGrid, softened_cosine
from reflfield.util.blocks import Blocks

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

# On raw samples: a few rounds, the targets on texels enough for grids of this side.
REFINEMENT = RefinementOptions(side=25, rounds=4, texels_per_cluster=8192)


@dataclass(frozen=True, eq=False)
class AlignedFrames:
    """Frames that a field is fitted in.

    Parameters
    ----------
    local_from_base : (n_texels, 3, 3) float64
    free : (k,) int
        Texels whose frames were found, and may be improved while the field is fitted.
    """

    local_from_base: NDArray[np.float64]
    free: Indices


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


def aligned_frames(job: Job) -> AlignedFrames:
    """What the alignment has found."""
    stored = job.result("alignment", "alignment.npz")
    return AlignedFrames(stored["local_from_base"], np.flatnonzero(stored["aligned"]))


def local_frames(job: Job, local_from_base: NDArray[np.float64]) -> Floats:
    """Frames of the texels in the world, from their turns against the base frames."""
    return (local_from_base @ job.texels.local_from_world).astype(np.float32)


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


def refined_block(context: Refining, rows: Indices) -> dict[str, NDArray[Any]]:
    """Frames of some texels, refined on their samples."""
    frames = improved_block(
        context.source.read(rows), context.frames[rows], context.cluster[rows], context.sharp
    )
    return {"frames": frames}


def _band_limit(wanted: int, directions: NDArray[np.float64]) -> int:
    return min(wanted, safe_band_limit(int((directions[:, 2] > 0).sum())))
