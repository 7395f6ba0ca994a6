"""How much a run has to do, in numbers that are known before it begins."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reflfield.capture.capture import Capture
from reflfield.field.clustered_pca import CLUSTERED, HALF_VECTOR
from reflfield.fitting.texel_sample_fit import MOST_SAMPLES as MOST_FITTED
from reflfield.geometry.stereo_carving import MOST_VIEWS
from reflfield.options import HoldOut, Resources
from reflfield.pipeline.atlas import TYPICAL_USE
from reflfield.pipeline.cache import StageFolder
from reflfield.pipeline.compared_photographs import compared_photographs
from reflfield.pipeline.context import AUTO, Context
from reflfield.pipeline.hollows import (
    GLANCE_LIGHTS,
    STEREO_PX,
    has_common_lights,
    is_searched,
)
from reflfield.pipeline.model_selection import can_fit_samples, least_samples
from reflfield.pipeline.pipeline_options import SMALLEST_TEXTURE, PipelineOptions
from reflfield.pipeline.pixel_shares import MOST_PIXELS

# Silhouettes that are looked at, and for how long: making them from photographs takes time.
SAMPLED_VIEWS, SAMPLING_SECONDS = 6, 2.0
# Area of a hull over four times its mean outline, which is 1 of a convex body (Cauchy).
HULL_EXCESS = 1.1
# Share of a texture that charts cover: of a large one, what less of a small one, and at least.
LARGEST_USE, PADDING_SIDE, LEAST_USE = 0.62, 40.0, 0.2
# Of the pairs of views and lights, which a texel of a solid object sees: half a sphere each,
# less what is too grazing or in shadow.
SEEN_VIEWS, SEEN_LIGHTS = 0.42, 0.42
# Share of a square around its outline that an object covers.
STEREO_SHARE = 0.45


@dataclass(frozen=True)
class WorkCounts:
    """Counts of one run with known options.

    Parameters
    ----------
    n_views, n_lights, n_photographs : int
        That make the field.
    view_pixels : int
        Of all these views together.
    photograph_pixels : int
        Of all these photographs together, each of which is decoded.
    largest_pixels : int
        Of the largest photograph.
    covered_values : float
        Pixels of the object in all photographs together.
    covered_pixels : float
        Pixels of the object in all views together.
    n_texels : float
    texture_side : float
        Texels along the texture's side.
    n_samples : float
        Texels times photographs, seen or not.
    n_nodes : int
        Of the common grid of directions.
    compared_pixels : int
        Of the photographs that the field is compared with.
    n_made : int
        Silhouettes that are made from photographs.
    model : {"half_vector", "clustered"}
    n_fits : int
        Fields that are fitted: two where their fits are compared.
    is_plane : bool
        Whether the base surface is the image plane.
    shades : bool
        Whether light in shadows is fitted.
    one_view : bool
        Whether the frames are those of photometric stereo, of one view under known lights.
    patches : bool
        Whether patches of neighbouring views are compared, under too few lights.
    """

    n_views: int
    n_lights: int
    n_photographs: int
    view_pixels: int
    photograph_pixels: int
    largest_pixels: int
    covered_values: float
    covered_pixels: float
    n_texels: float
    texture_side: float
    n_samples: float
    n_nodes: int
    compared_pixels: int
    n_made: int
    model: str
    n_fits: int
    is_plane: bool
    shades: bool
    one_view: bool
    patches: bool

    @property
    def fitted_photographs(self) -> float:
        """Photographs whose samples of a texel are fitted to; of many those of some."""
        return min(self.n_photographs, MOST_FITTED / (SEEN_VIEWS * SEEN_LIGHTS))

    @property
    def fitted_values(self) -> float:
        """Pixels of the object in all photographs that are fitted to."""
        return min(self.covered_values, MOST_PIXELS)

    @property
    def patch_pixels(self) -> float:
        """Pixels whose patches are compared with other views."""
        if not self.patches:
            return 0.0
        of_view = min(self.covered_pixels / self.n_views, STEREO_SHARE * STEREO_PX**2)
        return min(self.n_views, MOST_VIEWS) * of_view

    @property
    def glanced_pixels(self) -> float:
        """Pixels of the photographs that are searched for hollows; most objects have none."""
        if self.is_plane or self.n_views == 1:
            return 0.0
        if self.patches:
            return self.photograph_pixels
        of_views = min(MOST_VIEWS / self.n_views, 1.0)
        of_lights = min(GLANCE_LIGHTS / max(self.n_lights, 1), 1.0)
        return of_views * of_lights * self.photograph_pixels


def planned_context(
    capture: Capture,
    options: PipelineOptions,
    hold_out: HoldOut | None = None,
    resources: Resources | None = None,
) -> Context:
    """Return the context of a run that is not begun; it writes nothing.

    Raises
    ------
    InputError
        If nothing would be left to make the field of.
    """
    held, limits = hold_out or HoldOut(), resources or Resources()
    nowhere = StageFolder(Path("stages"))
    return Context(capture, Path(), options, held, limits, nowhere)


def covered_share(capture: Capture) -> float:
    """Mean share of the views' pixels that the object covers, from a few of them.

    Raises
    ------
    CaptureError
        If a silhouette cannot be used.
    """
    started, shares = time.perf_counter(), []
    n = min(capture.n_views, SAMPLED_VIEWS)
    for view in np.linspace(0, capture.n_views - 1, n).round().astype(int):
        shares.append(float((capture.read_silhouette(int(view)) > 0.5).mean()))
        if time.perf_counter() - started > SAMPLING_SECONDS:
            break
    return float(np.mean(shares))


def counts_of(context: Context, share: float | None = None) -> WorkCounts:
    """Count what a run has to do.

    Parameters
    ----------
    context : Context
        See `planned_context`.
    share : float, optional
        See `covered_share`, which is called without it.

    Returns
    -------
    WorkCounts
    """
    training = context.training
    share = covered_share(training) if share is None else share
    of_views = [camera.width * camera.height for camera in training.cameras]
    of_photographs = [of_views[photograph.camera] for photograph in training.photographs]
    side, n_texels = texture_of(context, share * float(np.mean(of_views)))
    compared = [_pixels(photographs) for photographs in compared_photographs(context).values()]
    model = planned_model(context)
    view_side, light_side = context.grid_sides
    return WorkCounts(
        n_views=training.n_views,
        n_lights=training.n_lights,
        n_photographs=len(training.photographs),
        view_pixels=sum(of_views),
        photograph_pixels=sum(of_photographs),
        largest_pixels=max(of_views),
        covered_values=share * sum(of_photographs),
        covered_pixels=share * sum(of_views),
        n_texels=n_texels,
        texture_side=side,
        n_samples=n_texels * len(training.photographs),
        n_nodes=view_side**2 * light_side**2,
        compared_pixels=sum(map(sum, compared)),
        n_made=0 if context.is_plane else _n_made(training),
        model=model,
        n_fits=_n_fits(context, model),
        is_plane=context.is_plane,
        shades=context.options.indirect.enabled and _factors_shadows(context),
        one_view=context.photometric,
        patches=is_searched(context) and not has_common_lights(context),
    )


def _pixels(photographs: Capture) -> list[int]:
    sizes = [camera.width * camera.height for camera in photographs.cameras]
    return [sizes[photograph.camera] for photograph in photographs.photographs]


def _n_made(training: Capture) -> int:
    """Silhouettes made from photographs: all without a file, if the first is."""
    without = [view for view, path in enumerate(training.silhouettes) if path is None]
    made = bool(without) and training.silhouette_origin(without[0]) == "photographs"
    return len(without) if made else 0


def _factors_shadows(context: Context) -> bool:
    """Whether shadows are traced; where that is selected, as is usual."""
    return context.casts_shadows and context.options.resampling.visibility != "kept"


def texture_of(context: Context, covered: float) -> tuple[float, float]:
    """Side of the texture and number of texels, from the pixels that a view's outline covers.

    A convex body has four times the area of its mean outline, over all directions (Cauchy).
    """
    options = context.options
    if context.is_plane:
        return float(np.sqrt(covered)), covered
    texels = 4 * HULL_EXCESS * covered * options.texture.texels_per_pixel**2
    side = float(
        np.clip(np.sqrt(texels / TYPICAL_USE), SMALLEST_TEXTURE, options.texture.largest)
    )
    side = float(options.atlas.resolution or side)
    # Padding between charts takes the more of a texture the smaller it is.
    use = max(LARGEST_USE * (1 - PADDING_SIDE / side), LEAST_USE)
    return side, use * side**2


def samples_of_texel(context: Context) -> float:
    """Samples of a texel that count, on average, as far as they can be foreseen."""
    n = len(context.training.photographs)
    if context.is_plane:
        return float(n)
    return n * SEEN_VIEWS * (SEEN_LIGHTS if _factors_shadows(context) else 1.0)


def planned_model(context: Context) -> str:
    """The model asked for, or the one that will be selected, as far as it can be foreseen."""
    options = context.options
    if options.compression.model != AUTO:
        return options.compression.model
    clusters = options.comparison.without_alignment or options.compression.fit != AUTO
    if clusters or not _factors_shadows(context):
        return CLUSTERED
    n = samples_of_texel(context)
    return HALF_VECTOR if n >= least_samples(context) else CLUSTERED


def _n_fits(context: Context, model: str) -> int:
    """Fits that are compared on held-out photographs."""
    automatic = model == CLUSTERED and context.options.compression.fit == AUTO
    compared = len(context.held_out.photographs) > 0 and not context.photometric
    n = samples_of_texel(context)
    return 2 if automatic and compared and can_fit_samples(context, n) else 1
