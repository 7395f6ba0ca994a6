"""Fits of clustered models to texels in their aligned frames, on grids and on samples."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.factorization.clustering import Clusters
from reflfield.field.bounds import beyond_bounds, beyond_clusters, probes
from reflfield.field.clustered_model import (
    ClusteredModel,
    normalised,
    of_usual_size,
    on_refined_grid,
    refined_sides,
)
from reflfield.field.clustered_pca import (
    CompressionOptions,
    cluster_completed,
    clusters_of,
    completion_model,
    fill_unobserved,
    lifted_clusters,
)
from reflfield.field.coefficients import solve_coefficients
from reflfield.field.frame_refinement import refined_frames
from reflfield.field.sample_fit import SampleFitOptions, fit_basis
from reflfield.observations.texel_reading import TexelReader
from reflfield.pipeline import results
from reflfield.pipeline.alignment import local_frames
from reflfield.pipeline.context import Context
from reflfield.pipeline.one_view_fit import (
    OneViewFit,
    completed_block,
    texels_block,
    with_texels,
)
from reflfield.pipeline.quantisation_search import FieldMaker
from reflfield.pipeline.resampling import Resampled, fits_in_one_pass
from reflfield.util.blas_threads import thread_pool
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
    if fits_in_one_pass(context, maker.options):
        model, reader = _fitted_in_one_pass(_Fitting(context, resampled, reader, blocks), maker)
    else:
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
        # Normals of photometric stereo stay what they are.
        free = self.resampled.frames.free
        aligned = np.zeros(0, np.intp) if self.context.photometric else free
        model = of_usual_size(model)
        return _fitted_to_samples(self.context, model, self.reader, aligned, self.blocks, name)


def _fitted_in_one_pass(
    fitting: _Fitting, maker: FieldMaker
) -> tuple[ClusteredModel, TexelReader]:
    """Functions from the texels that shape the completion, then all texels block by block."""
    context, reader, resampled = fitting.context, fitting.reader, fitting.resampled
    chosen = results.random_texels(context, maker.options.training_texels)
    counts = (reader.sides[0] ** 2, reader.sides[1] ** 2)
    options, n_texels = maker.options, reader.n_texels
    n_functions = options.clusters * (options.components + 1)
    finer = refined_sides(reader.sides, n_functions, options.samples.grid_refinement)
    completion = completion_model(resampled.completion, counts, n_texels)
    completion = on_refined_grid(completion, finer)
    # From their samples, as all texels are told apart later.
    parts = fitting.blocks.map(
        "coefficients for the clusters",
        completed_block,
        (replace(reader, sides=finer), completion),
        reader.product_blocks_of(chosen),
    )
    local = clusters_of(parts.joined("coefficients"), options, context.options.seed)
    model = lifted_clusters(resampled.completion, local, chosen, n_texels, counts)
    first, second = options.samples.halves()
    model = replace(of_usual_size(model), residuals=())
    work = (context, chosen, fitting.blocks)
    model = _basis_fitted(*work, model, reader, first, ", part 1")
    model, reader = on_refined_grid(model, finer), replace(reader, sides=finer)
    model = _basis_fitted(*work, model, reader, second, ", part 2")
    clusters = Clusters(local.labels, local.means, local.bases, np.zeros((0, 0)))
    measured = results.measured_texels(context)
    parts = fitting.blocks.map(
        "clusters and coefficients of all texels",
        texels_block,
        OneViewFit(reader, completion, clusters, model),
        reader.product_blocks_of(measured),
    )
    cluster, coefficients = (parts.joined(name) for name in ("cluster", "coefficients"))
    return with_texels(model, measured, cluster, coefficients), reader


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
    spread = np.radians(options.frame_spread_deg)
    refines = len(aligned) > 0 and spread > 0
    work = (context, results.measured_texels(context), blocks)
    model = _basis_fitted(*work, model, reader, first, f"{name}, part 1")
    if refines:
        model = _coefficients_fitted(context, model, reader, blocks, f"{name}, part 1")
        refined = blocks.map(
            f"frames against the model{name}",
            partial(frames_block, spread=float(spread)),
            (reader, model),
            reader.product_blocks_of(aligned),
        )
        frames = reader.local_from_world.copy()
        frames[aligned] = refined.joined("frames")
        reader = reader.rotated(frames)
    model, reader = _on_finer_grid(model, reader, options.grid_refinement)
    model = _basis_fitted(*work, model, reader, second, f"{name}, part 2")
    return _coefficients_fitted(context, model, reader, blocks, f"{name}, part 2"), reader


def _on_finer_grid(
    model: ClusteredModel, reader: TexelReader, factor: float
) -> tuple[ClusteredModel, TexelReader]:
    """Model and reader on grids with up to so many times as many intervals."""
    n_functions = len(model.table) * (model.coefficients.shape[1] + 1)
    sides = refined_sides(reader.sides, n_functions, factor)
    return on_refined_grid(model, sides), replace(reader, sides=sides)


def _basis_fitted(
    context: Context,
    texels: Indices,
    blocks: Blocks,
    model: ClusteredModel,
    reader: TexelReader,
    options: SampleFitOptions,
    part: str,
) -> ClusteredModel:
    """Fit the basis to samples of some of the texels, which have coefficients in it then."""

    def basis() -> dict[str, NDArray[Any]]:
        fit = fit_basis(
            reader.transformed,
            model,
            texels,
            reader.product_bytes_per_texel,
            options,
            workers=context.resources.workers,
            seed=context.options.seed,
        )
        return {entry.name: np.asarray(getattr(fit, entry.name)) for entry in fields(fit)}

    stored: dict[str, Any] = blocks.once(f"basis on the samples{part}", basis)
    return ClusteredModel(**{**stored, "residuals": tuple(stored["residuals"].tolist())})


def _coefficients_fitted(
    context: Context, model: ClusteredModel, reader: TexelReader, blocks: Blocks, part: str
) -> ClusteredModel:
    """Fit the coefficients of all texels, by blocks."""
    measured = results.measured_texels(context)
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
    with thread_pool(1) as pool:
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
    with thread_pool(1) as pool:
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
        with thread_pool(1) as pool:
            bounded, _ = solve_coefficients(
                samples, cluster, model, pool, bounded=True, deviation=GRID_DEVIATION
            )
        coefficients[beyond] = bounded[beyond]
    return {"coefficients": coefficients}
