"""Stage "alignment": one local frame for each texel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment import RefinementOptions, SampleSet
from reflfield.alignment.align_texels import checked_options, frames_of
from reflfield.alignment.alignment_model import AlignmentModel
from reflfield.alignment.model_arrays import arrays_of_model, model_of_arrays
from reflfield.alignment.model_fit import FitOptions, fit_model
from reflfield.alignment.photometric_normals import frames_towards, photometric_normals
from reflfield.alignment.sample_sources import GriddedSamples, ScatteredSource
from reflfield.capture.color_spaces import LUMINANCE
from reflfield.observations.texel_reading import TexelReader, luminance_of
from reflfield.observations.texel_samples import inverse_transform
from reflfield.pipeline import results
from reflfield.pipeline.context import Context
from reflfield.sphere.harmonic_projection import safe_band_limit
from reflfield.sphere.hemisphere import HemisphereGrid, softened_cosine
from reflfield.util.blocks import Blocks

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

# On raw samples: a few rounds, the targets on texels enough for grids of this side.
REFINEMENT = RefinementOptions(
    side=25, rounds=4, texels_per_cluster=8192, samples_per_pair=64.0
)
# Texels whose normals are found together.
TEXELS_AT_ONCE = 4096
ENTRIES = ("local_from_base", "cluster", "score", "margin")


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


def write_alignment(context: Context, folder: Path) -> dict[str, Any]:
    """One local frame per texel."""
    n = results.base_reader(context).n_texels
    frames = np.tile(np.eye(3), (n, 1, 1))
    arrays: dict[str, Any] = {
        "aligned": np.zeros(n, bool),
        "cluster": np.zeros(n, np.int32),
        "score": np.zeros(n),
        "margin": np.zeros(n),
        "history": np.zeros(0),
    }
    keep = np.zeros(len(results.measured_texels(context)), bool)
    if context.options.alignment.enabled and max(context.grid_sides) > 1:
        align = photometric if context.photometric else aligned
        entries = align(context, context.blocks(folder))
        seen = results.measured_texels(context)
        keep = entries["margin"] >= context.options.alignment.least_margin
        arrays["aligned"][seen[keep]] = True
        frames[seen[keep]] = entries["local_from_base"][keep]
        for name in ("cluster", "score", "margin"):
            arrays[name][seen] = entries[name]
        arrays["history"] = entries["history"]
    np.savez(folder / "alignment.npz", local_from_base=frames, **arrays)
    n_aligned = int(keep.sum())
    moved = np.degrees(np.arccos(np.clip(frames[:, 2, 2], -1, 1)))
    return {
        "texels aligned": n_aligned,
        "texels that keep the base frame": len(results.measured_texels(context)) - n_aligned,
        "mean tilt from the base normal, degrees": float(
            moved[results.measured_texels(context)].mean()
        ),
        "rotation determined (margin > .01)": int((arrays["margin"] > 0.01).sum()),
    }


def aligned_frames(context: Context) -> AlignedFrames:
    """What the alignment has found."""
    stored = results.arrays(context, "alignment", "alignment.npz")
    return AlignedFrames(stored["local_from_base"], np.flatnonzero(stored["aligned"]))


def local_frames(context: Context, local_from_base: NDArray[np.float64]) -> Floats:
    """Frames of the texels in the world, from their turns against the base frames."""
    return (local_from_base @ results.texels(context).local_from_world).astype(np.float32)


def aligned(context: Context, blocks: Blocks) -> dict[str, NDArray[Any]]:
    """Alignment of the texels that have samples: a model of all, then frames by blocks."""
    seen, reader = results.measured_texels(context), results.base_reader(context)
    gridded = completed_luminance(context)
    raw: ScatteredSource = gridded
    if context.options.alignment.refine:
        raw = RawLuminance(reader, seen, context.resources.block_bytes)
    options = fit_options(context, gridded)
    model = blocks.once(
        "alignment model", lambda: arrays_of_model(fit_model(gridded, raw, options))
    )
    rows = [np.searchsorted(seen, some) for some in reader.blocks_of(seen)]
    shared = Aligning(model_of_arrays(model), gridded, raw)
    parts = blocks.map("frames of all texels", aligned_block, shared, rows)
    return {name: parts.joined(name) for name in ENTRIES} | {"history": model["history"]}


def photometric(context: Context, blocks: Blocks) -> dict[str, NDArray[Any]]:
    """Frames of the texels of one view, from their normals by photometric stereo."""
    reader = results.base_reader(context)
    texels = results.measured_texels(context)
    parts = blocks.map("normals of all texels", normals_block, reader, reader.blocks_of(texels))
    entries = {name: parts.joined(name) for name in ENTRIES}
    return entries | {"history": np.zeros(0)}


def normals_block(reader: TexelReader, texels: Indices) -> dict[str, NDArray[Any]]:
    """Frames of some texels from their normals, the view in the plane of x and z."""
    base = reader.local_from_world[texels]
    parts = []
    for first in range(0, len(texels), TEXELS_AT_ONCE):
        some = texels[first : first + TEXELS_AT_ONCE]
        samples = reader.measured(some)
        lights = np.ascontiguousarray(samples.lights[:, samples.pairs.light])
        cosines = np.einsum("njd,nd->nj", samples.lights, reader.local_from_world[some, 2])
        values = luminance_of(samples, np.maximum(cosines, 0)) * np.float32(samples.unit)
        values = np.where(samples.seen, values, np.float32(np.nan))
        normals, trust = photometric_normals(
            values, lights, samples.views[:, 0], reader.local_from_world[some, 2]
        )
        parts.append((frames_towards(normals, samples.views[:, 0]), trust))
    frames, scores = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    n = len(texels)
    return {
        "local_from_base": (frames @ np.swapaxes(base, 1, 2)).astype(np.float64),
        "cluster": np.zeros(n, np.int32),
        "score": scores.astype(np.float64),
        "margin": np.ones(n),
    }


@dataclass(frozen=True, eq=False)
class Aligning:
    """What all blocks of texels that are aligned share.

    Parameters
    ----------
    model : AlignmentModel
    gridded : GriddedSamples
    raw : ScatteredSource
    """

    model: AlignmentModel
    gridded: GriddedSamples
    raw: ScatteredSource


def aligned_block(shared: Aligning, rows: Indices) -> dict[str, NDArray[Any]]:
    """Frames of some texels."""
    frames = frames_of(shared.model, shared.gridded, shared.raw, rows)
    return {name: getattr(frames, name) for name in ENTRIES}


def fit_options(context: Context, gridded: GriddedSamples) -> FitOptions:
    """Options of the model, with band limits that the grids support."""
    options = context.options.alignment
    spread = np.radians(options.spread_deg)
    limits = (_band_limit(options.band_limit, d) for d in (gridded.views, gridded.lights))
    return checked_options(
        gridded,
        FitOptions(
            band_limits=(next(limits), next(limits)),
            iterations=options.iterations,
            n_clusters=options.n_clusters,
            refinement=replace(REFINEMENT, spread=spread) if options.refine else None,
            seed=context.options.seed,
            max_tilt=np.radians(options.max_tilt_deg),
            n_threads=context.resources.workers,
        ),
    )


def completed_luminance(context: Context) -> GriddedSamples:
    """Completed texels that have samples, at the nodes of the grids."""
    stored = results.arrays(context, "completion", "completion.npz")
    source = CompletedLuminance(
        mean=stored["mean"],
        basis=stored["basis"],
        coefficients=stored["coefficients"][results.measured_texels(context)],
        sides=context.grid_sides,
        domain=context.options.resampling.domain,
    )
    view, light = (HemisphereGrid(side).directions for side in context.grid_sides)
    return GriddedSamples.checked(source, view, light)


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
        values = inverse_transform(nodes, self.domain) @ LUMINANCE
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
        step = max(1, self.block_bytes // self.reader.product_bytes_per_texel)
        parts = [
            self.reader.luminance(self.texels[rows[first : first + step]])
            for first in range(0, len(rows), step)
        ]
        return SampleSet(
            samples=np.concatenate([part.samples for part in parts]),
            views=np.concatenate([part.views for part in parts]),
            lights=np.concatenate([part.lights for part in parts]),
        )


def _band_limit(wanted: int, directions: NDArray[np.float64]) -> int:
    return min(wanted, safe_band_limit(int((directions[:, 2] > 0).sum())))
