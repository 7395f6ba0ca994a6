"""Fit of the half-vector model: to the samples of texels, then to the photographs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryFile
from threading import BoundedSemaphore
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from reflfield.capture.color_spaces import LUMINANCE
from reflfield.errors import InputError
from reflfield.field.build import Quantisation
from reflfield.field.file import write_field
from reflfield.field.half_vector import HalfVectorModel, HalfVectorOptions
from reflfield.field.half_vector_build import build_half_vector_field
from reflfield.field.indirect_light import IndirectLight
from reflfield.field.reflectance_field import HalfVectorField
from reflfield.field.step_search import field_as_asked
from reflfield.fitting.image_fit import ImageFit, frames_with, image_step, pixel_rows
from reflfield.fitting.lobe_count import (
    fewest_lobes,
    left_out_errors,
    rounds_of,
    views_left_out,
)
from reflfield.fitting.pixel_system import (
    LEAST_COVERAGE,
    ViewPixels,
    footprint_of,
    linearisation_shapes,
    view_pixels,
)
from reflfield.fitting.table_fit import fit_tables
from reflfield.fitting.tangents import with_tangents_along_highlights
from reflfield.fitting.texel_graph import TexelGraph, texel_graph
from reflfield.fitting.texel_sample_fit import (
    TABLE_ROWS,
    SampleBlock,
    SampleBlocks,
    fit_to_samples,
    sample_block,
    sample_rows,
    solve_coefficients,
    start_model,
    with_start_colors,
)
from reflfield.metrics.sample_residual import sample_error
from reflfield.observations.light_agreement import beside_the_view
from reflfield.pipeline import results
from reflfield.pipeline.bounce_fit import gain_counts, with_bounced_light
from reflfield.pipeline.cache import WARNINGS, plain
from reflfield.pipeline.context import Context
from reflfield.pipeline.memory import readers_at_once, working_bytes
from reflfield.pipeline.pixel_shares import (
    HULL_EFFORT,
    Shares,
    shares_within,
    some_of,
    spread_over,
)
from reflfield.pipeline.quantisation_search import SAMPLES_MEASURED, field_metadata
from reflfield.render.camera_rays import FieldSurface
from reflfield.util.blas_threads import thread_pool
from reflfield.util.progress import report

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

# Texels that shape the tables before all get coefficients.
TRAINING_TEXELS = 8192
# Texels that the number of lobes is found on, and lobes where no view can be left out.
LOBE_TEXELS, USUAL_LOBES = 1024, 3
# Times that tangents are turned along the highlights.
TANGENT_ROUNDS = 2
# Texels and quantile of their samples' luminance that is taken for white.
WHITE_TEXELS, WHITE_QUANTILE = 1024, 0.995
# Quantiles between which samples show how light comes in beside the view.
ANGLE_QUANTILES = (0.01, 0.99)
# Rows of pixels that tables are fitted to; each has several texels.
PIXEL_ROWS = TABLE_ROWS // 2
# Share of the working memory for samples kept, for pixels, and for derivatives; what is larger
# goes to files, but for pixels, of which then only some are fitted to.
SAMPLES_SHARE, PIXELS_SHARE, DERIVATIVES_SHARE = 1 / 6, 1 / 6, 1 / 3
# In the folder of the stage.
MODEL, WHITE = "model.npz", "white"
# Quantisation step of cube roots of samples over that of white, at a relative step of a half.
STEP = 1 / 64


@results.cached("atlas")
def neighbours(context: Context) -> TexelGraph:
    """Neighbours of the texels of a surface."""
    texels = results.texels(context)
    return texel_graph(texels.position, texels.normal)


@results.cached("visibility")
def lit_around(context: Context) -> NDArray[np.bool_]:
    """(n_texels, n_lights) True where a light reaches a texel and all its neighbours."""
    return neighbours(context).all_around(results.light_visible(context))


@dataclass(frozen=True, eq=False)
class HalfVectorFit:
    """A fit of the half-vector model in one run.

    Parameters
    ----------
    context : Context
    """

    context: Context

    @property
    def options(self) -> HalfVectorOptions:
        """Of the model."""
        return self.context.options.compression.half_vector

    @cached_property
    def graph(self) -> TexelGraph:
        """Neighbours of the texels."""
        return neighbours(self.context)

    @cached_property
    def reliable(self) -> NDArray[np.bool_]:
        """(n_texels, n_lights) True where no shadow's edge passes within a texel."""
        if self.context.visibility_kind == "kept":
            return np.ones_like(results.light_visible(self.context))
        return lit_around(self.context)

    @cached_property
    def white(self) -> float:
        """Sample that stands for white, 1/sr."""
        context = self.context
        seen = results.measured_texels(context)
        n = min(len(seen), WHITE_TEXELS)
        chosen = seen[np.linspace(0, len(seen) - 1, n).astype(np.intp)]
        values = [
            self._block(part, 1.0).values
            for part in results.base_reader(context).blocks_of(chosen)
        ]
        luminance = np.concatenate(values) @ LUMINANCE if values else np.zeros(0, np.float32)
        luminance = luminance[np.isfinite(luminance)]
        white = float(np.quantile(luminance, WHITE_QUANTILE)) if len(luminance) else 0.0
        return white if white > 0 else 1.0

    @cached_property
    def light_angles(self) -> tuple[float, float]:
        """Angles between view and light within which nearly all samples lie, degrees."""
        some = results.random_texels(self.context, WHITE_TEXELS)
        parts = results.base_reader(self.context).blocks_of(some)
        angles = np.concatenate([self._block(part, 1.0).light_angles() for part in parts])
        low, high = np.quantile(angles, ANGLE_QUANTILES) if len(angles) else (0.0, np.pi)
        return float(np.degrees(low)), float(np.degrees(high))

    def _block(self, texels: Indices, white: float) -> SampleBlock:
        samples = results.base_reader(self.context).measured(texels)
        return sample_block(texels, samples, self.reliable[texels], white)

    def blocks(self, texels: Indices) -> SampleBlocks:
        """Samples of some texels in units of white."""
        parts = results.base_reader(self.context).blocks_of(texels)
        budget = int(working_bytes(self.context) * SAMPLES_SHARE)
        white = self.white
        return SampleBlocks(lambda n: self._block(parts[n], white), len(parts), budget)

    def left_out_errors(self) -> dict[str, NDArray[Any]]:
        """Errors on views left out: with one lobe, two, and so on, and of nearest samples."""
        context = self.context
        some = self.blocks(results.random_texels(context, LOBE_TEXELS))
        frames = results.texels(context).local_from_world
        with thread_pool(context.resources.workers) as pool:
            errors, nearest = left_out_errors(
                *(some, frames, views_left_out(context.training.n_views), pool),
                *(self.options.smoothness, context.options.seed),
            )
        return {"errors": errors, "nearest": np.array(nearest)}

    def n_lobes(self) -> int:
        """Lobes that were asked for, or that the views left out ask for."""
        asked = self.options.n_lobes
        if asked != "auto":
            return asked
        errors = results.left_out_errors(self.context)
        return USUAL_LOBES if errors is None else fewest_lobes(errors["errors"])

    def to_samples(self, n_lobes: int) -> HalfVectorModel:
        """Model in units of white, fitted to the samples of the texels."""
        context = self.context
        with thread_pool(context.resources.workers) as pool:
            blocks = self.blocks(results.measured_texels(context))
            model = start_model(results.texels(context).local_from_world, n_lobes)
            model = with_start_colors(blocks, model, pool)
            some = self.blocks(results.random_texels(context, TRAINING_TEXELS))
            report("functions of the half vector", 0, 2 + TANGENT_ROUNDS)
            model, _ = fit_to_samples(
                *(some, model, pool, rounds_of(n_lobes)),
                *(self.options.smoothness, context.options.seed),
            )
            report("functions of the half vector", 1, 2 + TANGENT_ROUNDS)
            model, _ = solve_coefficients(blocks, model, pool)
            rows = sample_rows(some, TABLE_ROWS, context.options.seed)
            for i in range(TANGENT_ROUNDS):
                model = with_tangents_along_highlights(blocks, model, self.graph, pool)
                model = fit_tables(rows, model, pool, self.options.smoothness)
                model, _ = solve_coefficients(blocks, model, pool)
                report("functions of the half vector", 2 + i, 2 + TANGENT_ROUNDS)
        return filled(model, results.texels(context).position, results.measured_texels(context))

    def to_photographs(self, model: HalfVectorModel, folder: Path) -> ImageFit:
        """Model in units of white, fitted to the photographs."""
        context = self.context
        fit = ImageFit(model, np.zeros(model.n_texels), 0.0)
        if not self.options.image_steps:
            return fit
        with thread_pool(context.resources.workers) as pool:
            views = self.pixels(model, pool)
            rows = pixel_rows(views, PIXEL_ROWS, context.options.seed)
            allocate = self.allocator(views, model.n_lobes, folder)
            normals = results.texels(context).normal.astype(np.float64)
            for i in range(self.options.image_steps):
                report("fit to the photographs", i, self.options.image_steps)
                fit = image_step(views, model, self.graph, normals, pool, allocate)
                model = fit_tables(rows, fit.model, pool, self.options.smoothness)
                fit = replace(fit, model=model)
            report("fit to the photographs", self.options.image_steps, self.options.image_steps)
        return fit

    def pixels(self, model: HalfVectorModel, pool: ThreadPoolExecutor) -> list[ViewPixels]:
        """Pixels of views with photographs, the texels under them as the field is rendered."""
        context, texels = self.context, results.texels(self.context)
        surface = FieldSurface(self._quantised(model, 0.0, None, {}))
        shares, seed = self.shares, context.options.seed
        # As many photographs at a time as the ceiling of memory allows.
        readers = BoundedSemaphore(readers_at_once(context))

        def one(view: int) -> ViewPixels:
            camera = context.training.cameras[view]
            with readers:
                usable = results.silhouettes(context)[view] >= LEAST_COVERAGE
                if not context.is_plane:
                    usable &= ~results.depth_edges(context, view)
                drawn = some_of(usable, shares.pixels, np.random.default_rng([seed, view]))
                under = footprint_of(surface, camera, drawn, texels.position, texels.normal)
                shown = np.flatnonzero(context.training.photograph_index[view] >= 0)
                shown = spread_over(shown, shares.photographs, view)
                return view_pixels(
                    *(context.training, view, shown, under),
                    *(texels.position, self.reliable, self.white),
                )

        # Of a view without a photograph only the silhouette is used.
        photographed = np.unique(results.observed(context).pairs.view)
        return list(pool.map(one, photographed.tolist()))

    @property
    def memory_warnings(self) -> list[str]:
        """Says so where it is the ceiling of memory that leaves pixels out."""
        shares, in_time = self.shares, self._shares_in(np.inf)
        if shares.values >= in_time.values:
            return []
        return [
            f"fit to the photographs: {shares.pixels:.0%} of the pixels, drawn at random, of "
            f"{shares.photographs:.0%} of the photographs were fitted to, since all do not fit "
            "below the ceiling of memory"
        ]

    @cached_property
    def shares(self) -> Shares:
        """Shares of pixels and photographs that are fitted to."""
        return self._shares_in(working_bytes(self.context) * PIXELS_SHARE)

    def _shares_in(self, memory: float) -> Shares:
        """Shares that time, and so many bytes, allow."""
        training, silhouettes = self.context.training, results.silhouettes(self.context)
        covered = [np.count_nonzero(silhouette >= LEAST_COVERAGE) for silhouette in silhouettes]
        n_photographs = (training.photograph_index >= 0).sum(axis=1)
        n_values = max(int(np.dot(covered, n_photographs)), 1)
        moves = self.context.options.refines_surface and not self.context.on_surface
        effort = HULL_EFFORT if moves else 1.0
        return shares_within(max(int(sum(covered)), 1), n_values, memory, effort)

    def allocator(
        self, views: Sequence[ViewPixels], n_lobes: int, folder: Path
    ) -> Callable[[tuple[int, ...]], Floats]:
        """Maker of arrays for derivatives: in memory, or in files where they are too many."""
        shapes = [s for view in views for s in linearisation_shapes(view, n_lobes)]
        total = 4 * sum(int(np.prod(shape)) for shape in shapes)
        if total <= working_bytes(self.context) * DERIVATIVES_SHARE:
            return lambda shape: np.zeros(shape, np.float32)
        return partial(array_in_file, folder)

    def build(
        self, model: HalfVectorModel, step: float, indirect: IndirectLight | None = None
    ) -> HalfVectorField:
        """Quantise a model in units of white on the base surface into a field."""
        metadata = field_metadata(self.context, plain(self.context.options))
        return self._quantised(model, step, indirect, metadata)

    def _quantised(
        self,
        model: HalfVectorModel,
        step: float,
        indirect: IndirectLight | None,
        metadata: dict[str, Any],
    ) -> HalfVectorField:
        return build_half_vector_field(
            results.base_surface(self.context),
            in_samples(model, self.white),
            indirect,
            domain=self.context.options.resampling.domain,  # type: ignore[arg-type]
            visibility=self.context.visibility_kind,  # type: ignore[arg-type]
            metadata=metadata,
            quantisation=Quantisation(step),
        )

    def made(self, model: HalfVectorModel) -> HalfVectorField:
        """Field of the size, the quality or the relative step that was asked for."""
        options = self.context.options.compression
        step = self.step(options.step)
        harmonics = results.indirect_light(self.context)
        indirect = with_bounced_light(self.context, self.build(model, 0.0), harmonics)

        def build(at: float) -> HalfVectorField:
            return self.build(model, at, indirect)

        return field_as_asked(build, self.quality, step, size=options.size, least=options.psnr)

    def step(self, relative_step: float) -> float:
        """Quantisation step of cube roots of samples."""
        return float(2 * relative_step * STEP * np.cbrt(self.white))

    def quality(self, field: HalfVectorField) -> float:
        """LDR PSNR on the samples, dB."""
        context = self.context
        return sample_error(
            field,
            results.base_reader(context),
            results.measured_texels(context),
            SAMPLES_MEASURED,
        ).psnr_ldr


def array_in_file(folder: Path, shape: tuple[int, ...]) -> Floats:
    """Array of zeros in a file without a name, which goes with the array."""
    if not np.prod(shape):
        return np.zeros(shape, np.float32)
    return np.memmap(TemporaryFile(dir=folder), np.float32, "w+", shape=shape)


def in_samples(model: HalfVectorModel, white: float) -> HalfVectorModel:
    """Model in 1/sr from one in units of white."""
    unit = np.float32(white)
    return replace(model, diffuse=model.diffuse * unit, lobes=model.lobes * unit)


def filled(
    model: HalfVectorModel, positions: NDArray[np.floating], seen: Indices
) -> HalfVectorModel:
    """Model whose texels without samples have the coefficients of the nearest that has some."""
    missing = np.setdiff1d(np.arange(model.n_texels), seen)
    if not len(missing) or not len(seen):
        return model
    diffuse, weights = model.diffuse.copy(), model.weights.copy()
    nearest = seen[cKDTree(positions[seen]).query(positions[missing])[1]]
    diffuse[missing], weights[missing] = diffuse[nearest], weights[nearest]
    return replace(model, diffuse=diffuse, weights=weights)


def check_lights(context: Context) -> None:
    """Demand known lights.

    Raises
    ------
    InputError
        If they are not.
    """
    if not context.training.lights_known:
        raise InputError(
            "compression.model: 'half_vector' expected lights of known positions or "
            "directions, received unknown ones; take 'clustered'"
        )


def arrays_of(model: HalfVectorModel) -> dict[str, NDArray[Any]]:
    """Arrays of a model by name."""
    names = ("frames", "diffuse", "weights", "lobes", "skews", "diffuse_table")
    return {name: getattr(model, name) for name in names}


def write_model(path: Path, model: HalfVectorModel, white: float) -> None:
    """Store a model in units of white, and what white stands for, 1/sr."""
    arrays: dict[str, Any] = {**arrays_of(model), WHITE: np.array(white)}
    np.savez(path, **arrays)


def fitted_on_hull(fit: HalfVectorFit, folder: Path) -> ImageFit:
    """Fit from nothing: to the samples, then to the photographs."""
    check_lights(fit.context)
    blocks = fit.context.blocks(folder)
    n_lobes = fit.n_lobes()
    stored = blocks.once("fit to the samples", lambda: arrays_of(fit.to_samples(n_lobes)))
    return _to_photographs(fit, HalfVectorModel(**stored), folder)


def fitted_on_surface(fit: HalfVectorFit, folder: Path) -> ImageFit:
    """Fit that begins with that on the hull, with the normals of the new surface."""
    stored: dict[str, Any] = results.arrays(fit.context, "surface", MODEL)
    white = float(stored.pop(WHITE))
    before = in_samples(HalfVectorModel(**stored), white / fit.white)
    normals = results.texels(fit.context).normal.astype(np.float64)
    frames = frames_with(normals, before.frames[:, 0])
    return _to_photographs(fit, replace(before, frames=frames), folder)


def _to_photographs(fit: HalfVectorFit, model: HalfVectorModel, folder: Path) -> ImageFit:
    def fitted() -> dict[str, NDArray[Any]]:
        image_fit = fit.to_photographs(model, folder)
        numbers = ("information", "residual", "n_bounds", "n_unmet")
        extra = {name: np.asarray(getattr(image_fit, name)) for name in numbers}
        return arrays_of(image_fit.model) | extra

    stored: dict[str, Any] = fit.context.blocks(folder).once("fit to the photographs", fitted)
    information, residual = stored.pop("information"), float(stored.pop("residual"))
    counts = int(stored.pop("n_bounds")), int(stored.pop("n_unmet"))
    return ImageFit(HalfVectorModel(**stored), information, residual, *counts)


def stored_half_vector(context: Context) -> HalfVectorModel:
    """Model of the stage "compression" before it was quantised, in units of white."""
    stored: dict[str, Any] = results.arrays(context, "compression", MODEL)
    del stored[WHITE]
    return HalfVectorModel(**stored)


def write_half_vector_field(context: Context, folder: Path) -> dict[str, Any]:
    """Fit a half-vector model, write its field, and measure it on the samples."""
    context = context.refined
    fit = HalfVectorFit(context)
    on_hull = not context.on_surface
    fitted = (fitted_on_hull if on_hull else fitted_on_surface)(fit, folder)
    model = fitted.model
    made = fit.made(model)
    write_field(folder / "field.rfld", made)
    write_model(folder / MODEL, model, fit.white)
    size = (folder / "field.rfld").stat().st_size
    raw = results.base_reader(context).store.raw_bytes()
    error = sample_error(made, results.base_reader(context), results.measured_texels(context))
    counted = results.base_reader(context).count_fitted(
        np.flatnonzero(results.sampled(context).any(axis=1)), context.resources.workers
    )
    return {
        "texels fitted": len(results.measured_texels(context)),
        "texels that repeat another": made.n_texels - len(results.measured_texels(context)),
        "samples fitted": counted.fitted,
        "samples not measured": counted.unmeasured,
        "share of the pixels fitted to": fit.shares.pixels,
        "share of the photographs fitted to": fit.shares.photographs,
        "saturated values, fitted as bounds from below": fitted.n_bounds,
        "of them fitted darker": fitted.n_unmet,
        **made.counts,
        **gain_counts(made),
        "field bytes": size,
        "raw bytes": raw,
        "compression ratio": raw / size,
        "relative error of the samples": error.linear,
        "relative error of their cube roots": error.cube_root,
        "LDR PSNR of the samples, dB": error.psnr_ldr,
        "samples measured": error.n_samples,
        WARNINGS: [*fit.memory_warnings, *beside_the_view(*fit.light_angles)],
    }
