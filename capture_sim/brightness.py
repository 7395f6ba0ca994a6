"""How bright a scene's photographs are, measured on a few of them.

Bounds on effects are parts of a photograph's 99th percentile; this is where that comes
from before anything has been rendered in earnest.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import antialiasing, near_lights, shadows
from capture_sim.effects.effect_registry import decided
from capture_sim.effects.sensor import dark_noise
from capture_sim.model import Brightness, Scene, Table
from capture_sim.rays import RayTracer
from capture_sim.render import shade
from capture_sim.view_samples import sample_view

# Enough to meet near and far sides of the object, few enough to take no time.
SAMPLE_VIEWS = 8
SAMPLE_LIGHTS = 8
# Pixels along the larger side of the images that are tried.
SAMPLE_SIDE = 96
# Photographs that were not tried may be brighter, darker or more glaring by this factor.
SAFETY = 4.0


def spread(count: int, wanted: int) -> list[int]:
    """Up to `wanted` indices spread over ``range(count)``.

    Examples
    --------
    >>> spread(9, 3)
    [0, 4, 8]
    """
    return sorted({int(i) for i in np.linspace(0, count - 1, min(wanted, count))})


def photograph_scale(photograph: NDArray[np.floating]) -> float:
    """The 99th percentile of the values of a photograph that are not black.

    Parameters
    ----------
    photograph : (h, w, 3) float

    Returns
    -------
    float
        0 for a photograph that is all black.

    Examples
    --------
    >>> image = np.zeros((10, 10, 3))
    >>> image[:5] = 2.0
    >>> photograph_scale(image)
    2.0
    """
    values = photograph[photograph > 0.0]
    return float(np.percentile(values, 99.0)) if values.size else 0.0


def relative_change(photograph: NDArray[np.floating], changed: NDArray[np.floating]) -> float:
    """Largest difference of two photographs as a part of the first one's scale.

    Parameters
    ----------
    photograph, changed : (h, w, 3) float

    Returns
    -------
    float
        0 if both are the same; infinite if only the first is black.
    """
    difference = float(np.abs(photograph.astype(np.float64) - changed).max(initial=0.0))
    scale = photograph_scale(photograph)
    if difference == 0.0:
        return 0.0
    return difference / scale if scale > 0.0 else float("inf")


def measured(scene: Scene, tracer: RayTracer) -> Scene:
    """The scene with its brightness measured and the choice of effects made.

    Parameters
    ----------
    scene : Scene
    tracer : RayTracer
        Of the scene's mesh.

    Returns
    -------
    Scene
        With `brightness` and ``effects.active`` set.
    """
    return decided(replace(scene, brightness=_brightness(scene, tracer)))


def _brightness(scene: Scene, tracer: RayTracer) -> Brightness:
    """From photographs by direct light with not too many pixels."""
    basic = {near_lights.NAME, antialiasing.NAME}
    basic |= set() if scene.mesh.convex else {shadows.NAME}
    plain = replace(scene, effects=replace(scene.effects, active=frozenset(basic)))
    lights = tuple(scene.lights[i] for i in spread(len(scene.lights), SAMPLE_LIGHTS))
    scales, peaks = [], []
    for index in spread(len(scene.cameras), SAMPLE_VIEWS):
        view = sample_view(plain, tracer, coarser(scene.cameras[index]))
        for image in shade(plain, tracer, view, lights):
            scales.append(photograph_scale(image))
            peaks.append(float(image.max()))
    return _summary(np.array(scales), np.array(peaks), dark_noise(scene))


def coarser(camera: Table, side: int = SAMPLE_SIDE) -> Table:
    """The same camera with larger pixels, if it has more than so many along its larger side.

    Parameters
    ----------
    camera : dict
        Camera of the native capture format.
    side : int
        Pixels.

    Returns
    -------
    dict
    """
    factor = max(1.0, max(camera["w"], camera["h"]) / side)
    scaled = {key: camera[key] / factor for key in ("fl_x", "fl_y", "cx", "cy")}
    size = {key: max(1, int(camera[key] / factor)) for key in ("w", "h")}
    return {**camera, **scaled, **size}


def _summary(
    scales: NDArray[np.float64], peaks: NDArray[np.float64], noise: float
) -> Brightness:
    lit = scales > 0.0
    if not lit.any():
        return Brightness()
    return Brightness(
        percentile99=float(scales[lit].min()) / SAFETY,
        headroom=float((peaks[lit] / scales[lit]).max()) * SAFETY,
        brightest=float(peaks.max()) * SAFETY,
        noise=noise / float(scales.max()),
    )
