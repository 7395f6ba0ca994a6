"""Direct light that points of the surface reflect, for many lights at once."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from capture_sim.arrival import LightArrays
from capture_sim.effects import near_lights, shadows, simulated
from capture_sim.model import Scene
from capture_sim.rays import RayTracer
from capture_sim.surface import SurfacePoints
from capture_sim.visibility import TracedLights, lit_pairs

Floats = NDArray[np.floating[Any]]

# Temporaries of a pair of point and light: 140 with compiled BRDFs, measured tables take most.
BYTES_PER_PAIR = 800


def direct_light(
    scene: Scene,
    tracer: RayTracer,
    points: SurfacePoints,
    views: NDArray[np.float64],
    lights: LightArrays,
    traced: TracedLights | None = None,
) -> tuple[Floats, Floats]:
    """BRDF and irradiance of every light at every point.

    Parameters
    ----------
    scene : Scene
        Gives the material and decides on shadows.
    tracer : RayTracer
        Of the scene's mesh.
    points : SurfacePoints
        n points.
    views : (n, 3) float64
        Unit directions to the viewer, world.
    lights : LightArrays
    traced : TracedLights, optional
        Visibility of these lights, if known.

    Returns
    -------
    values : (n, 3, n_lights) float32 or float64
        BRDF in 1/sr, as precise as the material asks for; anything, even NaN, where
        `strength` is 0.
    strength : (n, n_lights) like `values`
        Times the light's `colour`: irradiance. 0 where the light is below the shading
        horizon or hidden, or the viewer is below the shading horizon. The reflected
        radiance is ``values * strength[:, None] * colour.T``.
    """
    precision = scene.material.precision
    local_views = np.einsum("nij,nj->ni", points.shading_from_world, views)
    with scene.costs.measure(near_lights.NAME):
        frames = points.shading_from_world
        directions, strength = lights.arrive(points.position, frames, precision)
    cosine = directions[:, 2]
    seen = local_views[:, 2] > 0.0
    if simulated(scene, shadows):
        with scene.costs.measure(shadows.NAME):
            lit = lit_pairs(tracer, points, seen, cosine, lights, traced)
    else:
        lit = (cosine > 0.0) & seen[:, None]
    strength *= np.where(lit, cosine, 0)
    local_views = local_views.astype(precision)
    return scene.material.evaluate_lights(local_views, directions, lit, points.uv), strength


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_direct_light(
    values: NDArray[Any],
    strength: NDArray[Any],
    colour: NDArray[Any],
    row: NDArray[Any],
    weight: NDArray[Any],
    radiance: NDArray[Any],
) -> None:
    """Add the light of points to rows of `radiance`, such as pixels or starts of paths.

    Parameters
    ----------
    values : (n, 3, n_lights) float
        BRDF, see `direct_light`; of lights that do not count anything, even NaN.
    strength : (n, n_lights) float
        Irradiance but for the colour; lights of zero do not count.
    colour : (3, n_lights) float
    row : (n,) int
        Where each point's light goes.
    weight : (n, 3) float
        What it is multiplied by.
    radiance : (n_rows, 3, n_lights) float
        Changed in place.
    """
    number = radiance.dtype.type
    for n in range(len(values)):
        for c in range(3):
            for k in range(strength.shape[1]):
                if strength[n, k] > 0.0:
                    shining = number(values[n, c, k] * strength[n, k])
                    radiance[row[n], c, k] += weight[n, c] * colour[c, k] * shining
