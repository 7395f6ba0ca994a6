"""Fits of clustered models to texels in their aligned frames, on grids and on samples."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import partial
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
from reflfield.pipeline import results
from reflfield.pipeline.alignment import local_frames
from reflfield.pipeline.context import Context
from reflfield.pipeline.quantisation_search import FieldMaker
from reflfield.pipeline.resampling import Resampled
from reflfield.util.blocks import BlockFunction, Blocks

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

# Standard deviations by which a texel's coefficients may differ from what its samples give to
# keep it within its bounds: a basis of the grids, which nothing smooths, leads farther astray
# between observed directions than one of the samples.
GRID_DEVIATION = 6.0
# Texels whose samples say how large the errors of a model of the grids are.
TEXELS_FOR_NOISE = 512


def fitted_model(
    maker: FieldMaker, resampled: Resampled, blocks: Blocks
) -> tuple[ClusteredModel, TexelReader]:
    """Return clusters, mean, basis and coefficients, and the reader of their frames."""
    context = maker.context
    reader = results.base_reader(context).rotated(
        local_frames(context, resampled.frames.local_from_base)
    )
    model, reader = _selected_fit(_Fitting(context, resampled, reader, blocks), maker)
    positions, measured = results.texels(context).position, results.measured_texels(context)
    return fill_unobserved(model, positions, measured), reader


@dataclass(frozen=True, eq=False)
class _Fitting:
    """Models of one run in the same frames, of different size.

    Parameters
    ----------
    context : Context
    resampled : Resampled
    reader : TexelReader
        In its frames.
    blocks : Blocks
    """

    context: Context
    resampled: Resampled
    reader: TexelReader
    blocks: Blocks

    def on_grid(self, options: CompressionOptions) -> ClusteredModel:
        """Model of the resampled columns."""
        return cluster_completed(
            self.resampled.completion,
            self.resampled.coefficients,
            results.measured_texels(self.context),
            (self.reader.sides[0] ** 2, self.reader.sides[1] ** 2),
            options,
            self.context.options.seed,
        )

    def fits_samples(self, options: CompressionOptions) -> bool:
        """Whether the model is then fitted to the samples."""
        context = self.context
        return options.fits_samples(
            results.observed(context).count() / len(results.measured_texels(context))
        )

    def fitted(
        self, options: CompressionOptions, name: str = ""
    ) -> tuple[ClusteredModel, TexelReader]:
        """Model, and the reader in frames that were improved on the way; `name` is its own."""
        model = self.on_grid(options)
        if not self.fits_samples(options):
            bounded = _within_bounds(self.context, model, self.reader, self.blocks, name)
            return bounded, self.reader
        aligned = self.resampled.frames.free
        model = of_usual_size(model)
        return _fitted_to_samples(self.context, model, self.reader, aligned, self.blocks, name)


def _selected_fit(fitting: _Fitting, maker: FieldMaker) -> tuple[ClusteredModel, TexelReader]:
    """Return the model of the clusters and components that the options or the search name."""
    options = maker.options
    if not maker.searches:
        return fitting.fitted(options)
    frames = fitting.reader.local_from_world
    if not (options.psnr and fitting.fits_samples(options)):
        return fitting.fitted(maker.ranked(fitting.on_grid, frames, 0.0)[0])
    # What the fit to the samples gains is measured once. Candidates are fitted in the order of
    # their expected sizes until one reaches the quality; the smallest field that does is used.
    usual = fitting.fitted(options, " for the quality")
    quality = maker.quality_of(*usual)
    fits = [(quality, usual)]
    gain = quality - maker.quality_of(fitting.on_grid(options), fitting.reader)
    for candidate in maker.ranked(fitting.on_grid, frames, gain):
        name = f" for the quality, {candidate.n_clusters} x {candidate.n_components}"
        fit = fitting.fitted(candidate, name)
        fits.append((maker.quality_of(*fit), fit))
        if fits[-1][0] >= options.psnr:
            break
    sufficient = [fit for quality, fit in fits if quality >= options.psnr]
    if not sufficient:
        return max(fits, key=lambda fit: fit[0])[1]
    return min(sufficient, key=lambda fit: maker.size_of(*fit))


def _fitted_to_samples(
    context: Context,
    model: ClusteredModel,
    reader: TexelReader,
    aligned: Indices,
    blocks: Blocks,
    name: str = "",
) -> tuple[ClusteredModel, TexelReader]:
    """Fit to the samples; half way, aligned frames are refined and the grid as well."""
    options = context.options.compression.samples
    first, second = options.halves()
    model = replace(model, residuals=())
    model = _fitted_once(context, model, reader, first, blocks, f"{name}, part 1")
    spread = np.radians(options.frame_spread_deg)
    if len(aligned) and spread > 0:
        refined = blocks.map(
            f"frames against the model{name}",
            partial(frames_block, spread=float(spread)),
            (reader, model),
            reader.product_blocks_of(aligned),
        )
        frames = reader.local_from_world.copy()
        frames[aligned] = refined.joined("frames")
        reader = reader.rotated(frames)
    n_functions = len(model.table) * (model.coefficients.shape[1] + 1)
    sides = refined_sides(reader.sides, n_functions, options.grid_refinement)
    model, reader = on_refined_grid(model, sides), replace(reader, sides=sides)
    return _fitted_once(context, model, reader, second, blocks, f"{name}, part 2"), reader


def _fitted_once(
    context: Context,
    model: ClusteredModel,
    reader: TexelReader,
    options: SampleFitOptions,
    blocks: Blocks,
    part: str,
) -> ClusteredModel:
    """Fit the basis to samples of some texels, then the coefficients of all, by blocks."""
    measured = results.measured_texels(context)

    def basis() -> dict[str, NDArray[Any]]:
        fit = fit_basis(
            reader.transformed,
            model,
            measured,
            reader.product_bytes_per_texel,
            options,
            workers=context.resources.workers,
            seed=context.options.seed,
        )
        return {entry.name: np.asarray(getattr(fit, entry.name)) for entry in fields(fit)}

    stored: dict[str, Any] = blocks.once(f"basis on the samples{part}", basis)
    model = ClusteredModel(**{**stored, "residuals": tuple(stored["residuals"].tolist())})
    work = f"coefficients on the samples{part}"
    return _with_coefficients(model, reader, measured, coefficients_block, blocks, work)


def _within_bounds(
    context: Context, model: ClusteredModel, reader: TexelReader, blocks: Blocks, name: str
) -> ClusteredModel:
    """Model of the grids whose texels are bounded where they were not observed.

    Those that are brighter there than their samples and their clusters allow are solved for
    on their samples, with as strong a prior as holds them.
    """
    measured = results.measured_texels(context)
    suspects = beyond_clusters(model, measured)
    if not len(suspects):
        return model
    noise = blocks.once(
        f"errors of the samples{name}", lambda: {"noise": _noise(context, model, reader)}
    )["noise"]
    model = normalised(model, float(noise), measured)
    work = f"coefficients within bounds{name}"
    return _with_coefficients(model, reader, suspects, bounded_block, blocks, work)


def _with_coefficients(
    model: ClusteredModel,
    reader: TexelReader,
    texels: Indices,
    solve: BlockFunction,
    blocks: Blocks,
    work: str,
) -> ClusteredModel:
    """Model whose coefficients of some texels are solved for, by blocks of the named work."""
    parts = blocks.map(work, solve, (reader, model), reader.product_blocks_of(texels))
    coefficients = model.coefficients.copy()
    coefficients[texels] = parts.joined("coefficients")
    return replace(model, coefficients=coefficients)


def frames_block(
    shared: tuple[TexelReader, ClusteredModel], texels: Indices, *, spread: float
) -> dict[str, Floats]:
    """Return frames of some texels, refined against the model; `spread` in radians."""
    reader, model = shared
    return {"frames": refined_frames(reader, model, texels, spread)}


def coefficients_block(
    shared: tuple[TexelReader, ClusteredModel], texels: Indices
) -> dict[str, Floats]:
    """Return coefficients of some texels in the basis of the model."""
    reader, model = shared
    with ThreadPoolExecutor(1) as pool:
        coefficients, _ = solve_coefficients(
            reader.transformed(texels), model.cluster[texels], model, pool, bounded=True
        )
    return {"coefficients": coefficients}


def _noise(context: Context, model: ClusteredModel, reader: TexelReader) -> NDArray[np.float64]:
    """Variance of samples about the model of the grids, from some texels."""
    measured = results.measured_texels(context)
    options = context.options
    most = max(1, options.compression.samples.max_bytes // reader.product_bytes_per_texel)
    count = min(len(measured), TEXELS_FOR_NOISE, most)
    some = np.sort(np.random.default_rng(options.seed).choice(measured, count, replace=False))
    usual = normalised(model, model.residuals[-1] ** 2, measured)
    with ThreadPoolExecutor(1) as pool:
        _, squares = solve_coefficients(
            reader.transformed(some), usual.cluster[some], usual, pool
        )
    return np.asarray(squares[:, 0].sum() / max(squares[:, 1].sum(), 1e-30))


def bounded_block(
    shared: tuple[TexelReader, ClusteredModel], texels: Indices
) -> dict[str, Floats]:
    """Return coefficients of some texels; of those beyond their bounds, ones within."""
    reader, model = shared
    samples = reader.transformed(texels)
    cluster, coefficients = model.cluster[texels], model.coefficients[texels]
    beyond = beyond_bounds(samples, cluster, coefficients, probes(model.table))
    if beyond.any():
        with ThreadPoolExecutor(1) as pool:
            bounded, _ = solve_coefficients(
                samples, cluster, model, pool, bounded=True, deviation=GRID_DEVIATION
            )
        coefficients[beyond] = bounded[beyond]
    return {"coefficients": coefficients}
