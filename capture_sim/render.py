r"""Photographs of the true mesh by exact direct lighting.

The value of a pixel is the mean over its rays of

.. math:: L = \sum_{\text{rays}} w\, f(v, l)\, \max(n \cdot l, 0)\, V(l)\, E(l),

with the BRDF `f` and the normal of the shading frame, `E` the irradiance of a
surface that faces the light and `V` 1 where nothing hides the light. Rays from
the camera are traced once per view and shared by all lights, shadow rays once per
light and shared by all views where that is exact enough (`capture_sim.visibility`).
Which rays a view has is in `capture_sim.view_samples`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from capture_sim.arrival import LightArrays
from capture_sim.effects import (
    interreflection,
    light_extent,
    near_lights,
    shadows,
    simulated,
    subsurface,
)
from capture_sim.materials import Material
from capture_sim.model import Scene
from capture_sim.rays import RayTracer, towards_camera
from capture_sim.shading import BYTES_PER_PAIR, add_direct_light, direct_light
from capture_sim.surface import SurfacePoints
from capture_sim.view_samples import ViewSamples
from capture_sim.visibility import Nodes, TracedLights, trace_lights, worth_tracing

Table = Mapping[str, Any]
Array = NDArray[np.float64]

# Bytes of a value of a photograph while it is gathered, and once more light by light.
BYTES_PER_VALUE = 8
# What light does between parts of the object, beyond shining on it.
TRANSPORT_EFFECTS = (interreflection, subsurface)


def arriving_light(
    scene: Scene, lights: tuple[Table, ...], points: Array
) -> near_lights.Illumination:
    """Direction and facing irradiance of every light at every point, without shadows.

    Parameters
    ----------
    scene : Scene
        Decides whether lights are at a finite distance.
    lights : tuple of dict
        Lights of the native capture format.
    points : (n, 3) float64
        World, metres.

    Returns
    -------
    Illumination
    """
    if simulated(scene, near_lights):
        return near_lights.apply(lights, points)
    return near_lights.far_field(lights, scene.mesh.centre, points)


def reflectance_of_pairs(
    material: Material,
    points: SurfacePoints,
    views: Array,
    lights: Array,
    lit: NDArray[np.bool_],
    cosine: Array,
) -> NDArray[np.float32]:
    """BRDF times cosine where lit, zero elsewhere.

    Parameters
    ----------
    material : Material
    points : SurfacePoints
        n points.
    views : (n, 3) float64
        Unit directions to the viewer, world.
    lights : (n, n_lights, 3) float64
        Unit directions to the lights, world.
    lit : (n, n_lights) bool
        True where the light counts.
    cosine : (n, n_lights) float64
        Of the lights to the shading normals.

    Returns
    -------
    (n, n_lights, 3) float32
        1/sr.
    """
    point, light = np.nonzero(lit)
    local_views = np.einsum("nij,nj->ni", points.shading_from_world, views)
    frames = points.shading_from_world[point]
    local_lights = np.einsum("nij,nj->ni", frames, lights[point, light])
    values = material.evaluate(local_views[point], local_lights, points.uv[point])
    result = np.zeros((*lit.shape, 3), dtype=np.float32)
    result[point, light] = values * cosine[point, light, None]
    return result


def lit_pairs(
    scene: Scene,
    tracer: RayTracer,
    points: SurfacePoints,
    arriving: near_lights.Illumination,
    seen: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.bool_], Array]:
    """Which lights reach which points, and under what cosine.

    Parameters
    ----------
    scene : Scene
        Decides on shadows.
    tracer : RayTracer
        Of the scene's mesh.
    points : SurfacePoints
        n points.
    arriving : Illumination
        Light at the points.
    seen : (n,) bool, optional
        Points that matter; pairs of others count as unlit. All by default.

    Returns
    -------
    lit : (n, n_lights) bool
        True where the light is above the shading horizon and not hidden.
    cosine : (n, n_lights) float64
        Of the light to the shading normal.
    """
    cosine = np.einsum("nlj,nj->nl", arriving.directions, points.shading_from_world[:, 2])
    lit = cosine > 0.0
    if seen is not None:
        lit &= seen[:, None]
    if simulated(scene, shadows):
        point, light = np.nonzero(lit)
        targets = arriving.targets[point, light]
        lit[point, light] = shadows.apply(tracer, points, point, targets)
    return lit, cosine


def shade(
    scene: Scene,
    tracer: RayTracer,
    view: ViewSamples,
    lights: tuple[Table, ...],
    traced: TracedLights | None = None,
) -> NDArray[np.float32]:
    """Photographs of one view under some lights.

    Parameters
    ----------
    scene : Scene
        Gives the material and the effects.
    tracer : RayTracer
        Of the scene's mesh.
    view : ViewSamples
        From `sample_view`.
    lights : tuple of dict
        Lights of the native capture format.
    traced : TracedLights, optional
        Visibility of these lights, from `traced_lights`.

    Returns
    -------
    (n_lights, h, w, 3) float32
        Linear radiance; the background is black.
    """
    pixels, radiance = _lit_pixels(scene, tracer, view, lights, traced)
    photographs = np.zeros((len(lights), view.coverage.size, 3), dtype=np.float32)
    photographs[:, pixels] = radiance
    return photographs.reshape(len(lights), *view.coverage.shape, 3)


def _lit_pixels(
    scene: Scene,
    tracer: RayTracer,
    view: ViewSamples,
    lights: tuple[Table, ...],
    traced: TracedLights | None,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Pixels that show the object (n,), and their radiance (n_lights, n, 3)."""
    arrays = LightArrays.of(scene, lights)
    colour = arrays.colour.T.astype(np.float32)
    between = [effect for effect in TRANSPORT_EFFECTS if simulated(scene, effect)]
    pixels, row = np.unique(view.pixel, return_inverse=True)
    radiance = np.zeros((len(pixels), 3, len(lights)), dtype=np.float32)
    step = scene.blocks.items(len(lights) * BYTES_PER_PAIR)
    for first in range(0, len(view.points), step):
        block = slice(first, first + step)
        points, weight = view.points[block], view.weight[block].astype(np.float32)
        views = towards_camera(view.camera, points.position)
        values, strength = direct_light(scene, tracer, points, views, arrays, traced)
        weights = np.repeat(weight[:, None], 3, axis=1)
        add_direct_light(values, strength, colour, row[block], weights, radiance)
        for effect in between:
            with scene.costs.measure(effect.NAME):
                more = effect.apply(scene, tracer, points, views, arrays, traced)
                _add(more, row[block], weight, radiance)
    by_light = np.zeros((len(lights), len(pixels), 3), dtype=np.float32)
    _by_light(radiance, by_light)
    return pixels, by_light


_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
_Values = NDArray[Any]


@_compiled
def _add(more: _Values, row: _Values, weight: _Values, radiance: _Values) -> None:
    """Add radiance of points (n, 3, n_lights) to that of their pixels."""
    for n in range(len(more)):
        for c in range(3):
            for k in range(more.shape[2]):
                radiance[row[n], c, k] += weight[n] * more[n, c, k]


@_compiled
def _by_light(radiance: _Values, by_light: _Values) -> None:
    """Carry (n, 3, n_lights) over to (n_lights, n, 3)."""
    block = 32  # rows that stay in the cache while all lights take their part
    for first in range(0, len(radiance), block):
        stop = min(first + block, len(radiance))
        for k in range(radiance.shape[2]):
            for n in range(first, stop):
                for c in range(3):
                    by_light[k, n, c] = radiance[n, c, k]


def traced_lights(
    scene: Scene, tracer: RayTracer, lights: NDArray[np.intp] | None = None
) -> TracedLights | None:
    """Visibility of the scene's lights all over the object, where that saves work.

    Parameters
    ----------
    scene : Scene
    tracer : RayTracer
        Of the scene's mesh.
    lights : (n,) int, optional
        Indices of those that are wanted; all by default.

    Returns
    -------
    TracedLights or None
        None if shadows are off, lamps have an area, or views are so few that every ray of
        theirs is traced.
    """
    nodes = lookup_nodes(scene)
    if nodes is None:
        return None
    with scene.costs.measure(shadows.NAME):
        return trace_lights(scene, tracer, nodes, lights)


def lookup_nodes(scene: Scene) -> Nodes | None:
    """Where visibility is traced beforehand, if anywhere.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    Nodes or None
    """
    if simulated(scene, light_extent):
        return None  # each lamp is many, of one photograph only
    paths = scene.effects.get(interreflection.Options).paths
    return worth_tracing(scene, 1 + paths * simulated(scene, interreflection))


def render_view(
    scene: Scene, tracer: RayTracer, view: ViewSamples, traced: TracedLights | None = None
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """All photographs of one view, a bounded number held in memory at a time.

    Parameters
    ----------
    scene : Scene
        Gives material, lights and effects.
    tracer : RayTracer
        Of the scene's mesh.
    view : ViewSamples
        From `sample_view`.
    traced : TracedLights, optional
        From `traced_lights`.

    Yields
    ------
    light : int
        Index of the light.
    photograph : (h, w, 3) float32
        Linear radiance without noise.
    """
    step = max(1, scene.blocks.images // (3 * BYTES_PER_VALUE * view.coverage.size))
    for first in range(0, len(scene.lights), step):
        lights = scene.lights[first : first + step]
        chosen = np.arange(first, first + len(lights))
        known = None if traced is None else traced.some(chosen)
        pixels, by_light = _lit_pixels(scene, tracer, view, lights, known)
        for light, radiance in enumerate(by_light, start=first):
            photograph = np.zeros((view.coverage.size, 3), dtype=np.float32)
            photograph[pixels] = radiance
            yield light, photograph.reshape(*view.coverage.shape, 3)
