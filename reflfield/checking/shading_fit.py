"""How well photographs fit to what lights should do to a surface.

The logarithm of a point's luminance is that of its albedo plus that of the photograph's gain
plus that of the irradiance which the light's place gives it. Medians over points and over
photographs separate the first two, so that highlights, shadows and single wrong lights do
little harm. What is left, the luminance over the albedo, should follow the irradiance.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.checking.light_order import LightFit
from reflfield.checking.surface_samples import SurfaceSamples

Array = NDArray[np.float64]

# Cosines to the light below which shading says little of strength.
LEAST_COSINE = 0.3
ROUNDS = 4
FEWEST_POINTS = 24
# Share of the points seen that must be lit well for a photograph's gain to be known.
LEAST_SHARE = 0.2
# Share of the median luminance that stands for what is darker.
DARKEST = 1e-4


@dataclass(frozen=True, eq=False)
class Shading:
    """Gains of photographs and albedo of points.

    Parameters
    ----------
    photographs : (n,) int
        Indices of those that show the surface.
    gains : (n,) float64
        Logarithms of brightness over what is expected; NaN where too few points are lit.
    albedo : (n_points,) float64
        Logarithms; NaN where a point is never lit.
    scatter : (n,) float64
        Robust standard deviations of the logarithms of each photograph's samples around this
        model.
    peaks : (n,) float64
        Logarithms of the brightest tenth of luminance over albedo, wherever the light stands.
    samples : SurfaceSamples
    """

    photographs: NDArray[np.int64]
    gains: Array
    albedo: Array
    scatter: Array
    peaks: Array
    samples: SurfaceSamples

    def fit_to_lights(self, luminance: NDArray[np.floating]) -> Array:
        """Correlation (n_lights,) of the luminance of the points with every light's shading."""
        known = np.isfinite(luminance) & np.isfinite(self.albedo)
        irradiance = self.samples.irradiance[:, known]
        if known.sum() < FEWEST_POINTS:
            return np.full(len(irradiance), np.nan)
        seen = np.sqrt(np.maximum(luminance[known], 0) / np.exp(self.albedo[known]))
        # Single highlights outweigh all shading.
        seen = np.minimum(seen, 2.5 * np.quantile(seen, 0.9))
        expected = np.sqrt(irradiance)
        seen = seen - seen.mean()
        expected = expected - expected.mean(axis=1, keepdims=True)
        length = np.linalg.norm(expected, axis=1) * np.linalg.norm(seen)
        with np.errstate(divide="ignore", invalid="ignore"):
            fit: Array = np.where(length > 0, expected @ seen / length, np.nan)
        return fit

    def fits(self) -> Array:
        """`fit_to_lights` (n, n_lights) of all photographs."""
        return np.array(
            [self.fit_to_lights(self.samples.luminance[int(i)]) for i in self.photographs]
        )


def shading_of(capture: Capture, samples: SurfaceSamples) -> Shading:
    """Separate albedo and gains."""
    photographs = np.array(sorted(samples.luminance), dtype=np.int64)
    lights = [capture.photographs[int(i)].light for i in photographs]
    luminance = np.array([samples.luminance[int(i)] for i in photographs], dtype=np.float64)
    irradiance, cosine = samples.irradiance[lights], samples.cosine[lights]
    usable = (cosine > LEAST_COSINE) & (irradiance > 0) & np.isfinite(luminance)
    luminance = np.maximum(luminance, DARKEST * float(nanmedian(luminance[usable], axis=0)))
    few = np.maximum(FEWEST_POINTS, LEAST_SHARE * np.isfinite(luminance).sum(axis=1))
    usable[usable.sum(axis=1) < few] = False
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(usable, np.log(luminance / irradiance), np.nan)
    gains, albedo = np.zeros(len(ratio)), np.zeros(ratio.shape[1])
    for _ in range(ROUNDS):
        albedo = nanmedian(ratio - gains[:, None], axis=0)
        gains = np.nan_to_num(nanmedian(ratio - albedo, axis=1))
    left = ratio - albedo - gains[:, None]
    scatter = 1.4826 * nanmedian(np.abs(left), axis=1)
    gains[~usable.any(axis=1)] = np.nan
    peaks = nanquantile(np.log(np.maximum(luminance, 1e-300)) - albedo, 0.9)
    return Shading(photographs, gains, albedo, scatter, peaks, samples)


def light_means(
    capture: Capture, photographs: Sequence[int] | NDArray[np.int64], fits: Array
) -> LightFit:
    """Mean fit of the photographs of each light to the places of all lights."""
    lights = np.array([capture.photographs[int(i)].light for i in photographs])
    means = np.full((capture.n_lights, capture.n_lights), np.nan)
    for light in np.unique(lights):
        means[light] = nanmean(fits[lights == light])
    return LightFit(means)


def nanmedian(values: Array, axis: int) -> Array:
    """Median of what is known; NaN, without a warning, where nothing is."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        median: Array = np.nanmedian(values, axis=axis)
    return median


def nanquantile(values: Array, share: float) -> Array:
    """Quantile of what is known of each row; NaN, without a warning, where nothing is."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        quantile: Array = np.nanquantile(values, share, axis=1)
    return quantile


def nanmean(values: Array) -> Array:
    """Mean over the first axis of what is known; NaN where nothing is."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        mean: Array = np.nanmean(values, axis=0)
    return mean


def view_and_light_gains(
    capture: Capture, photographs: NDArray[np.int64], gains: Array
) -> tuple[Array, Array, Array]:
    """Gains of views and of lights by median polish, and what is left of each photograph's.

    Returns
    -------
    of_views : (n_views,) float64
    of_lights : (n_lights,) float64
        NaN where nothing is known; their medians are 0.
    left : (n,) float64
    """
    views = np.array([capture.photographs[int(i)].camera for i in photographs], dtype=int)
    lights = np.array([capture.photographs[int(i)].light for i in photographs], dtype=int)
    of_views, of_lights = np.zeros(capture.n_views), np.zeros(capture.n_lights)
    both = len(np.unique(views)) < len(views) and len(np.unique(lights)) < len(views)
    for _ in range(ROUNDS):
        of_lights = _medians(gains - of_views[views], lights, capture.n_lights)
        of_lights -= float(nanmedian(of_lights, axis=0))
        if both:  # else the gain of a view is that of its light
            rest = gains - np.nan_to_num(of_lights)[lights]
            of_views = np.nan_to_num(_medians(rest, views, capture.n_views))
    return of_views, of_lights, gains - of_views[views] - of_lights[lights]


def _medians(values: Array, groups: NDArray[np.int64], n_groups: int) -> Array:
    return np.array([nanmedian(values[groups == g], axis=0) for g in range(n_groups)])
