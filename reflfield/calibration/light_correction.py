"""Lights of a capture, corrected by what the object looks like, and what that gained."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.calibration.camera_correction import small_views
from reflfield.calibration.light_adjustment import (
    FEWEST_SAMPLES,
    LitPoints,
    adjust_lights,
)
from reflfield.capture.capture import PLANE, Capture
from reflfield.capture.color_spaces import LUMINANCE
from reflfield.capture.inspect import spread_evenly
from reflfield.capture.lights import POINT, Light
from reflfield.checking.photograph_statistics import read_photographs
from reflfield.checking.shading_fit import nanmedian
from reflfield.checking.surface_samples import SurfaceSamples, sample_surface
from reflfield.errors import InputError
from reflfield.geometry.visual_hull import HullOptions, visual_hull

Array = NDArray[np.float64]

# Photographs that are read, at most; voxels of the hull.
MOST_PHOTOGRAPHS, HULL_VOXELS = 2000, 128
# Cosine to the light from which on a point is lit well, and lights that a point needs.
LEAST_COSINE, FEWEST_LIGHTS = 0.25, 4
# One point of so many is kept from the fit, and tells whether it gained.
KEPT_FROM_FIT = 5
# Share of its misfit that the fit must take away for corrected positions to be kept.
LEAST_GAIN = 0.02


@dataclass(frozen=True)
class MovedLight:
    """By how much a light was moved, in the unit of the capture, and how bright it seems.

    Parameters
    ----------
    light : str
    shift : float
    angle_deg : float
        That its direction from the object changes by.
    gain : float
        Brightness over the described one, as the fit has it; not applied.
    """

    light: str
    shift: float
    angle_deg: float
    gain: float


@dataclass(frozen=True, eq=False)
class LightCorrection:
    """Corrected lights.

    Parameters
    ----------
    lights : tuple of Light
        Those of the capture where nothing was gained.
    moved : tuple of MovedLight
    misfit_before, misfit_after : float
        Median difference of points that the fit did not use from a matt surface, as a share
        of the luminance.
    is_kept : bool
        Whether the corrected positions took away `LEAST_GAIN` of it.
    """

    lights: tuple[Light, ...]
    moved: tuple[MovedLight, ...]
    misfit_before: float
    misfit_after: float
    is_kept: bool

    def lines(self) -> list[str]:
        """What was changed and gained, in words."""
        misfit = (
            f"difference from a matt surface: {100 * self.misfit_before:.2f} -> "
            f"{100 * self.misfit_after:.2f} % (median, points kept from the fit)"
        )
        if not self.is_kept:
            return ["lights: as described; corrected positions would gain nothing", misfit]
        shifts = np.array([moved.shift for moved in self.moved])
        angles = np.array([moved.angle_deg for moved in self.moved])
        return [
            f"lights: {len(self.moved)} moved, by up to {shifts.max():.3g} (median "
            f"{np.median(shifts):.3g}) and {angles.max():.2f} degrees (median "
            f"{np.median(angles):.2f}) as seen from the object",
            misfit,
        ]

    def entry(self) -> dict[str, Any]:
        """The same for a JSON file."""
        return {
            "kept": self.is_kept,
            "misfit_before": self.misfit_before,
            "misfit_after": self.misfit_after,
            "moved": [vars(moved) for moved in self.moved],
        }


def correct_lights(capture: Capture) -> LightCorrection:
    """Correct the positions of the lights of a capture by its photographs.

    The object should be matt for the most part. Distances and intensities stay, and so does
    what one linear map of all lights does, of which a matt surface tells nothing.

    Raises
    ------
    InputError
        If the capture is flat, or has lights that are no points or do not fall off, or the
        object does not show enough points lit well by several lights.
    GeometryError
        If the silhouettes have no common hull.
    """
    if capture.base_geometry == PLANE:
        raise InputError("lights: expected silhouettes of an object, received a flat sample")
    others = [light for light in capture.lights if light.kind != POINT or not light.falls_off]
    if others:
        raise InputError(
            f"lights: expected point lights, received {others[0].id!r} of type "
            f"{others[0].kind!r}"
            f"{'' if others[0].falls_off else ' with a constant irradiance'}"
        )
    lit = _lit_points(capture)
    positions = np.array([light.position for light in capture.lights])
    kept = np.arange(len(lit.points)) % KEPT_FROM_FIT == 0
    corrected, gains = adjust_lights(lit.some(~kept), positions)
    told = lit.some(kept)
    before, after = told.misfit(positions), told.misfit(corrected)
    is_kept = after < (1 - LEAST_GAIN) * before
    lights = tuple(
        replace(light, position=position)
        for light, position in zip(capture.lights, corrected, strict=True)
    )
    return LightCorrection(
        lights if is_kept else capture.lights,
        _moved(capture, corrected, gains, lit.points.mean(axis=0)) if is_kept else (),
        before,
        after,
        is_kept,
    )


def _lit_points(capture: Capture) -> LitPoints:
    """Points of the hull that several lights light well."""
    views, silhouettes = small_views(capture)
    options = HullOptions(resolution=HULL_VOXELS)
    mesh = visual_hull([view.camera for view in views], silhouettes, options)[0]
    some = spread_evenly(len(capture.photographs), MOST_PHOTOGRAPHS)
    samples = sample_surface(
        capture, mesh, read_photographs(capture, some), range(capture.n_views)
    )
    luminance = _luminance(capture, samples)
    used = np.isfinite(luminance).sum(axis=0) >= FEWEST_LIGHTS
    if used.sum() < KEPT_FROM_FIT * FEWEST_SAMPLES:
        raise InputError(
            f"lights: expected at least {KEPT_FROM_FIT * FEWEST_SAMPLES} of "
            f"{len(used)} points of the surface lit well by {FEWEST_LIGHTS} lights, received "
            f"{used.sum()}; run `check` on the capture, or correct the lights by other means"
        )
    strength = np.array([light.intensity @ LUMINANCE for light in capture.lights])
    return LitPoints(samples.points[used], samples.normals[used], luminance[:, used], strength)


def _luminance(capture: Capture, samples: SurfaceSamples) -> Array:
    """Median luminance (n_lights, n) over views, which see highlights in other places."""
    of_light: dict[int, list[Array]] = {}
    for index, luminance in samples.luminance.items():
        light = capture.photographs[index].light
        of_light.setdefault(light, []).append(luminance.astype(np.float64))
    luminance = np.full((capture.n_lights, len(samples.points)), np.nan)
    for light, photographs in of_light.items():
        luminance[light] = nanmedian(np.array(photographs), axis=0)
    lit = (samples.cosine > LEAST_COSINE) & (samples.irradiance > 0) & (luminance > 0)
    return np.where(lit, luminance, np.nan)


def _moved(
    capture: Capture, corrected: Array, gains: Array, centre: Array
) -> tuple[MovedLight, ...]:
    moved = []
    for light, position, gain in zip(capture.lights, corrected, gains, strict=True):
        one, other = light.position - centre, position - centre
        cosine = one @ other / (np.linalg.norm(one) * np.linalg.norm(other))
        shift = float(np.linalg.norm(position - light.position))
        angle = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        moved.append(MovedLight(light.id, shift, angle, float(gain)))
    return tuple(moved)
