"""Fits of clustered models to texels in their aligned frames, on grids and on samples."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.field.bounds import beyond_bounds, beyond_clusters, probes
from reflfield.field.clustered_model import (
    ClusteredModel,
    normalised,
    of_usual_size,
    on_refined_grid,
    refined_sides,
)
from reflfield.field.clustered_pca import CompressionOptions, cluster_completed, fill_unobserved
from reflfield.field.coefficients import solve_coefficients
from reflfield.field.frame_refinement import refined_frames
from reflfield.field.sample_fit import SampleFitOptions, fit_basis
from reflfield.observations.texel_reading import TexelReader
from reflfield.pipeline.alignment import local_frames
from reflfield.pipeline.context import Job
from reflfield.pipeline.quantisation_search import FieldMaker
from reflfield.pipeline.resampling import Resampled
from reflfield.util.blocks import Blocks

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

# Standard deviations by which a texel's coefficients may differ from what its samples give to
# keep it within its bounds: a basis of the grids, which nothing smooths, leads farther astray
# between observed directions than one of the samples.
GRID_DEVIATION = 6.0
# Texels whose samples say how large the errors of a model of the grids are.
TEXELS_FOR_NOISE = 512


def fitted_model(
    maker: FieldMaker, found: Resampled, blocks: Blocks
) -> tuple[ClusteredModel, TexelReader]:
    """Clusters, mean, basis and coefficients, and the reader of the frames they stand in."""
    job = maker.job
    reader = job.base_reader.rotated(local_frames(job, found.frames.local_from_base))
    model, reader = _chosen_fit(_Fitting(job, found, reader, blocks), maker)
    return fill_unobserved(model, job.texels.position, job.seen_texels), reader


@dataclass(frozen=True, eq=False)
class _Fitting:
    """Models of one run in the same frames, of different size.

    Parameters
    ----------
    job : Job
    found : Resampled
    reader : TexelReader
        In its frames.
    blocks : Blocks
    """

    job: Job
    found: Resampled
    reader: TexelReader
    blocks: Blocks

    def on_grid(self, options: CompressionOptions) -> ClusteredModel:
        """Model of the resampled columns."""
        return cluster_completed(
            self.found.completion,
            self.found.coefficients,
            self.job.seen_texels,
            (self.reader.sides[0] ** 2, self.reader.sides[1] ** 2),
            options,
            self.job.options.seed,
        )

    def fits_samples(self, options: CompressionOptions) -> bool:
        """Whether the model is then fitted to the samples."""
        job = self.job
        return options.fits_samples(job.observed.count() / len(job.seen_texels))

    def fitted(
        self, options: CompressionOptions, name: str = ""
    ) -> tuple[ClusteredModel, TexelReader]:
        """Model, and the reader in frames that were improved on the way; `name` is its own."""
        model = self.on_grid(options)
        if not self.fits_samples(options):
            return _within_bounds(self.job, model, self.reader, self.blocks, name), self.reader
        free = self.found.frames.free
        model = of_usual_size(model)
        return _fitted_to_samples(self.job, model, self.reader, free, self.blocks, name)


def _chosen_fit(fitting: _Fitting, maker: FieldMaker) -> tuple[ClusteredModel, TexelReader]:
    """Model with the clusters and components asked for, or that a size or quality needs."""
    options = maker.options
    if not maker.searches:
        return fitting.fitted(options)
    frames = fitting.reader.local_from_world
    if not (options.psnr and fitting.fits_samples(options)):
        return fitting.fitted(maker.ranked(fitting.on_grid, frames, 0.0)[0])
    # What the fit to the samples brings is measured once. The least that then promises to
    # reach the quality is tried first, and the smallest field of those that do is taken.
    usual = fitting.fitted(options, " for the quality")
    reached = maker.quality_of(*usual)
    tried = [(reached, usual)]
    gain = reached - maker.quality_of(fitting.on_grid(options), fitting.reader)
    for choice in maker.ranked(fitting.on_grid, frames, gain):
        name = f" for the quality, {choice.n_clusters} x {choice.n_components}"
        found = fitting.fitted(choice, name)
        tried.append((maker.quality_of(*found), found))
        if tried[-1][0] >= options.psnr:
            break
    good = [found for reached, found in tried if reached >= options.psnr]
    if not good:
        return max(tried, key=lambda one: one[0])[1]
    return min(good, key=lambda found: maker.size_of(*found))


def _fitted_to_samples(
    job: Job,
    model: ClusteredModel,
    reader: TexelReader,
    free: Indices,
    blocks: Blocks,
    name: str = "",
) -> tuple[ClusteredModel, TexelReader]:
    """Fit to the samples; half way, frames that are free are improved and nodes made finer."""
    options = job.options.compression.samples
    first, second = options.halves()
    model = replace(model, residuals=())
    model = _fitted_once(job, model, reader, first, blocks, f"{name}, part 1")
    spread = np.radians(options.frame_spread_deg)
    if len(free) and spread > 0:
        better = blocks.map(
            f"frames against the model{name}",
            turned_block,
            SampleFit(reader, model, spread),
            reader.blocks_of(free),
        )
        frames = reader.local_from_world.copy()
        frames[free] = better.joined("frames")
        reader = reader.rotated(frames)
    n_functions = len(model.table) * (model.coefficients.shape[1] + 1)
    sides = refined_sides(reader.sides, n_functions, options.fineness)
    model, reader = on_refined_grid(model, sides), replace(reader, sides=sides)
    return _fitted_once(job, model, reader, second, blocks, f"{name}, part 2"), reader


def _fitted_once(
    job: Job,
    model: ClusteredModel,
    reader: TexelReader,
    options: SampleFitOptions,
    blocks: Blocks,
    part: str,
) -> ClusteredModel:
    """Basis of some texels, then coefficients of all: all samples by blocks."""

    def basis() -> dict[str, NDArray[Any]]:
        found = fit_basis(
            reader.transformed,
            model,
            job.seen_texels,
            reader.sample_bytes_per_texel,
            options,
            workers=job.resources.workers,
            seed=job.options.seed,
        )
        return {entry.name: np.asarray(getattr(found, entry.name)) for entry in fields(found)}

    stored: dict[str, Any] = blocks.once(f"basis on the samples{part}", basis)
    found = ClusteredModel(**{**stored, "residuals": tuple(stored["residuals"].tolist())})
    parts = blocks.map(
        f"coefficients on the samples{part}",
        coefficients_block,
        SampleFit(reader, found, 0.0),
        reader.blocks_of(job.seen_texels),
    )
    coefficients = found.coefficients.copy()
    coefficients[job.seen_texels] = parts.joined("coefficients")
    return replace(found, coefficients=coefficients)


def _within_bounds(
    job: Job, model: ClusteredModel, reader: TexelReader, blocks: Blocks, name: str
) -> ClusteredModel:
    """Model of the grids whose texels are bounded where they were not observed.

    Those that are brighter there than their samples and their clusters allow are solved for
    on their samples, with as strong a prior as holds them.
    """
    suspects = beyond_clusters(model, job.seen_texels)
    if not len(suspects):
        return model
    noise = blocks.once(
        f"errors of the samples{name}", lambda: {"noise": _noise(job, model, reader)}
    )["noise"]
    model = normalised(model, float(noise), job.seen_texels)
    parts = blocks.map(
        f"coefficients within bounds{name}",
        bounded_block,
        SampleFit(reader, model, 0.0),
        reader.blocks_of(suspects),
    )
    coefficients = model.coefficients.copy()
    coefficients[suspects] = parts.joined("coefficients")
    return replace(model, coefficients=coefficients)


@dataclass(frozen=True, eq=False)
class SampleFit:
    """What all blocks of texels share that are fitted to their samples.

    Parameters
    ----------
    reader : TexelReader
    model : ClusteredModel
    spread : float
        Of the frames, radians.
    """

    reader: TexelReader
    model: ClusteredModel
    spread: float


def turned_block(context: SampleFit, texels: Indices) -> dict[str, Floats]:
    """Frames of some texels, improved against the model."""
    return {"frames": refined_frames(context.reader, context.model, texels, context.spread)}


def coefficients_block(context: SampleFit, texels: Indices) -> dict[str, Floats]:
    """Coefficients of some texels in the basis of the model."""
    with ThreadPoolExecutor(1) as pool:
        found, _ = solve_coefficients(
            context.reader.transformed(texels),
            context.model.cluster[texels],
            context.model,
            pool,
            bounded=True,
        )
    return {"coefficients": found}


def _noise(job: Job, model: ClusteredModel, reader: TexelReader) -> NDArray[np.float64]:
    """Variance of samples about the model of the grids, from some texels."""
    seen, most = job.seen_texels, job.options.compression.samples.max_bytes
    count = min(len(seen), TEXELS_FOR_NOISE, max(1, most // reader.sample_bytes_per_texel))
    some = np.sort(np.random.default_rng(job.options.seed).choice(seen, count, replace=False))
    usual = normalised(model, model.residuals[-1] ** 2, seen)
    with ThreadPoolExecutor(1) as pool:
        _, squares = solve_coefficients(
            reader.transformed(some), usual.cluster[some], usual, pool
        )
    return np.asarray(squares[:, 0].sum() / max(squares[:, 1].sum(), 1e-30))


def bounded_block(context: SampleFit, texels: Indices) -> dict[str, Floats]:
    """Coefficients of some texels; of those beyond their bounds, ones within."""
    model, samples = context.model, context.reader.transformed(texels)
    cluster, coefficients = model.cluster[texels], model.coefficients[texels]
    beyond = beyond_bounds(samples, cluster, coefficients, probes(model.table))
    if beyond.any():
        with ThreadPoolExecutor(1) as pool:
            found, _ = solve_coefficients(
                samples, cluster, model, pool, bounded=True, deviation=GRID_DEVIATION
            )
        coefficients[beyond] = found[beyond]
    return {"coefficients": coefficients}
