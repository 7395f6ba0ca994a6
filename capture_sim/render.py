r"""Photographs of the true mesh by exact direct lighting.

The value of a pixel is the mean over its rays of

.. math:: L = \sum_{\text{rays}} w\, f(v, l)\, \max(n \cdot l, 0)\, V(l)\, E(l),

with the BRDF `f` and the normal of the shading frame, `E` the irradiance of a
surface that faces the light and `V` 1 where nothing hides the light. Rays from
the camera are traced once per view and shared by all lights, shadow rays once per
light and shared by all views where that is exact enough (`capture_sim.visibility`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from functools import reduce
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from capture_sim.arrival import LightArrays
from capture_sim.effects import (
    antialiasing,
    interreflection,
    light_extent,
    near_lights,
    shadows,
    simulated,
    subsurface,
)
from capture_sim.materials import Material
from capture_sim.model import Scene
from capture_sim.rays import BYTES_PER_RAY, RayTracer, camera_rays, towards_camera
from capture_sim.shading import BYTES_PER_PAIR, direct_light
from capture_sim.surface import SurfacePoints, surface_points
from capture_sim.visibility import Nodes, TracedLights, trace_lights, worth_tracing

Table = Mapping[str, Any]
Array = NDArray[np.float64]

# Bytes of a value of a photograph while it is gathered, and once more light by light.
BYTES_PER_VALUE = 8
# A jump along the ray within a pixel above this part of the object's radius is an edge.
EDGE_STEP = 0.04
# What light does between parts of the object, beyond shining on it.
TRANSPORT_EFFECTS = (interreflection, subsurface)


@dataclass(frozen=True)
class ViewSamples:
    """Shaded points of one view and what they contribute to.

    Attributes
    ----------
    camera : dict
    points : SurfacePoints
        Sorted by pixel; n of them.
    pixel : (n,) int64
        Index ``row * w + column`` of the pixel that each point is part of.
    weight : (n,) float64
        Part of the pixel; the sum over a pixel is its coverage.
    coverage : (h, w) float32
        Part of each pixel that the object takes, in [0, 1].
    """

    camera: Table
    points: SurfacePoints
    pixel: NDArray[np.int64]
    weight: Array
    coverage: NDArray[np.float32]


def sample_view(scene: Scene, tracer: RayTracer, camera: Table) -> ViewSamples:
    """Trace the camera's rays and gather the points to be shaded.

    Parameters
    ----------
    scene : Scene
        Gives mesh, material and rays per pixel.
    tracer : RayTracer
        Of the scene's mesh.
    camera : dict
        Camera of the native capture format.

    Returns
    -------
    ViewSamples

    Notes
    -----
    Pixels are searched with the rays that shade them, at least two by two. Those
    whose neighbourhood these rays find on both sides of an outline are sampled again
    with the finer grid. What is smaller than the distance between rays in every pixel
    about it is missed.
    """
    per_side, per_side_at_edges = rays_per_side(scene)
    step = EDGE_STEP * scene.mesh.radius
    n_pixels = int(camera["h"]) * int(camera["w"])
    search = per_side if per_side == per_side_at_edges else max(per_side, 2)
    rays = scene.blocks.items(BYTES_PER_RAY)
    found = _trace_pixels(tracer, camera, np.arange(n_pixels), search, rays)
    covered, edge = found.coverage, np.zeros(n_pixels, dtype=bool)
    samples = found.samples
    if per_side_at_edges > per_side:
        with scene.costs.measure(antialiasing.NAME):
            near = np.flatnonzero(_near_outline(found, int(camera["w"]), step))
            finer = _trace_pixels(tracer, camera, near, per_side_at_edges, rays)
        covered[near], edge[near] = finer.coverage, finer.crossed(step)
        if search != per_side:
            inside = np.flatnonzero((covered > 0.0) & ~edge)
            samples = _trace_pixels(tracer, camera, inside, per_side, rays).samples
        samples = samples.where(~edge[samples.pixel]).joined(
            finer.samples.where(edge[finer.samples.pixel])
        )
    return _view_samples(scene, camera, samples, covered)


def _view_samples(
    scene: Scene, camera: Table, samples: PixelSamples, covered: Array
) -> ViewSamples:
    ordered = samples.where(np.argsort(samples.pixel, kind="stable"))
    shape = (int(camera["h"]), int(camera["w"]))
    return ViewSamples(
        camera=camera,
        points=surface_points(scene.mesh, scene.material, ordered.face, ordered.barycentric),
        pixel=ordered.pixel,
        weight=ordered.weight,
        coverage=covered.reshape(shape).astype(np.float32),
    )


@dataclass(frozen=True)
class PixelSamples:
    """Hits of rays through pixels.

    Attributes
    ----------
    pixel : (n,) int64
    weight : (n,) float64
        Part of the pixel that the ray stands for.
    face : (n,) int64
        Triangle.
    barycentric : (n, 3) float64
    """

    pixel: NDArray[np.int64]
    weight: Array
    face: NDArray[np.int64]
    barycentric: Array

    def where(self, chosen: NDArray[Any]) -> PixelSamples:
        """Samples chosen by an index array or a boolean array."""
        return PixelSamples(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def joined(self, other: PixelSamples) -> PixelSamples:
        """These samples and others."""
        names = [field.name for field in fields(self)]
        pairs = ((getattr(self, name), getattr(other, name)) for name in names)
        return PixelSamples(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True)
class TracedPixels:
    """What a regular grid of rays through each of some pixels met.

    Attributes
    ----------
    coverage : (n_pixels,) float64
        Part of the rays that hit.
    nearest, farthest : (n_pixels,) float32
        Distances along the rays, metres; infinite and 0 where none hit.
    samples : PixelSamples
        All hits, pixel by pixel.
    """

    coverage: Array
    nearest: NDArray[np.float32]
    farthest: NDArray[np.float32]
    samples: PixelSamples

    def crossed(self, step: float) -> NDArray[np.bool_]:
        """True for pixels whose rays hit and miss, or reach depths `step` apart."""
        partly = (self.coverage > 0.0) & (self.coverage < 1.0)
        return partly | ((self.coverage == 1.0) & (self.farthest - self.nearest > step))


def _trace_pixels(
    tracer: RayTracer, camera: Table, pixels: NDArray[np.intp], per_side: int, rays: int
) -> TracedPixels:
    """Trace a grid of rays through each of some pixels, so many rays at once."""
    rows = max(1, rays // per_side**2)
    starts = range(0, max(len(pixels), 1), rows)
    parts = [
        _trace_block(tracer, camera, pixels[first : first + rows], per_side) for first in starts
    ]
    return TracedPixels(
        coverage=np.concatenate([part.coverage for part in parts]),
        nearest=np.concatenate([part.nearest for part in parts]),
        farthest=np.concatenate([part.farthest for part in parts]),
        samples=reduce(PixelSamples.joined, (part.samples for part in parts)),
    )


def _trace_block(
    tracer: RayTracer, camera: Table, pixels: NDArray[np.intp], per_side: int
) -> TracedPixels:
    hits = tracer.first_hits(*_sub_pixel_rays(camera, pixels, per_side))
    distance = hits.distance.reshape(len(pixels), per_side**2)
    hit = hits.hit.reshape(distance.shape)
    pixel = np.repeat(pixels, per_side**2)[hits.hit]
    weight = np.full(len(pixel), 1.0 / per_side**2)
    return TracedPixels(
        coverage=hit.mean(axis=1),
        nearest=distance.min(axis=1, initial=np.inf),
        farthest=np.where(hit, distance, 0.0).max(axis=1, initial=0.0),
        samples=PixelSamples(pixel, weight, hits.face[hits.hit], hits.barycentric[hits.hit]),
    )


def _near_outline(found: TracedPixels, width: int, step: float) -> NDArray[np.bool_]:
    """Pixels with rays on both sides of an outline among theirs and their neighbours'."""

    def around(values: NDArray[Any], extreme: Any) -> NDArray[Any]:
        return np.asarray(extreme(values.reshape(-1, width), size=3)).ravel()

    any_hit = around(found.coverage > 0.0, maximum_filter)
    all_hit = around(found.coverage == 1.0, minimum_filter)
    nearest = around(found.nearest, minimum_filter)
    farthest = around(found.farthest, maximum_filter)
    jumps = np.zeros(len(nearest), dtype=bool)
    np.greater(farthest - nearest, step, out=jumps, where=all_hit)
    return (any_hit & ~all_hit) | jumps


def rays_per_side(scene: Scene) -> tuple[int, int]:
    """Rays along each side of a pixel inside the object, and where an outline crosses it."""
    return antialiasing.apply(scene) if simulated(scene, antialiasing) else (1, 1)


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


def _sub_pixel_rays(
    camera: Table, pixels: NDArray[np.intp], per_side: int
) -> tuple[Array, Array]:
    """Rays through a regular grid in each pixel; pixel by pixel."""
    row, column = np.divmod(pixels, int(camera["w"]))
    corners = np.stack([column, row], axis=1).astype(np.float64)
    grid = antialiasing.sub_pixel_grid(per_side)
    return camera_rays(camera, (corners[:, None] + grid).reshape(-1, 2))


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
        _gather(values, strength, colour, row[block], weight, radiance)
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
def _gather(
    values: _Values,
    strength: _Values,
    colour: _Values,
    row: _Values,
    weight: _Values,
    radiance: _Values,
) -> None:
    """Add the points' light (n, 3, n_lights) to that of their pixels."""
    number = radiance.dtype.type
    for n in range(len(values)):
        for c in range(3):
            for k in range(strength.shape[1]):
                # Values of lights that do not count may be anything, even NaN.
                if strength[n, k] > 0.0:
                    shining = number(values[n, c, k] * strength[n, k])
                    radiance[row[n], c, k] += weight[n] * colour[c, k] * shining


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
