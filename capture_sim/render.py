r"""Photographs of the true mesh by exact direct lighting.

The value of a pixel is the mean over its rays of

.. math:: L = \sum_{\text{rays}} w\, f(v, l)\, \max(n \cdot l, 0)\, V(l)\, E(l),

with the BRDF `f` and the normal of the shading frame, `E` the irradiance of a
surface that faces the light and `V` 1 where nothing hides the light. Rays from
the camera are traced once per view and shared by all lights.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from capture_sim.effects import antialiasing, near_lights, shadows, simulated
from capture_sim.materials import Material
from capture_sim.model import Scene
from capture_sim.rays import RayTracer, camera_rays, towards_camera
from capture_sim.surface import SurfacePoints, surface_points

Table = Mapping[str, Any]
Array = NDArray[np.float64]

# Pairs of point and light shaded at once: temporaries stay near 50 MB.
PAIRS_PER_BLOCK = 1 << 16
# Values of all photographs of one view held at once, before they are written.
VALUES_PER_BATCH = 1 << 25
# Rays searched for outlines at once.
RAYS_PER_BLOCK = 1 << 21
# A jump along the ray within a pixel above this part of the object's radius is an edge.
EDGE_STEP = 0.04


@dataclass(frozen=True)
class ViewSamples:
    """Shaded points of one view and what they contribute to.

    Attributes
    ----------
    camera : dict
    points : SurfacePoints
        Sorted by pixel; n of them.
    pixel_from_point : (h * w, n) sparse float64
        Weights; rows sum to the coverage of the pixel.
    coverage : (h, w) float32
        Part of each pixel that the object takes, in [0, 1].
    """

    camera: Table
    points: SurfacePoints
    pixel_from_point: csr_array
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
    """
    per_side, per_side_at_edges = rays_per_side(scene)
    coverage, edge = _coverage(scene, tracer, camera, per_side_at_edges)
    inside = np.flatnonzero((coverage > 0.0) & ~edge)
    hits = [
        _sub_pixel_hits(tracer, camera, inside, per_side),
        _sub_pixel_hits(tracer, camera, np.flatnonzero(edge), per_side_at_edges),
    ]
    pixel, weight, face, barycentric = (
        np.concatenate(part) for part in zip(*hits, strict=True)
    )
    order = np.argsort(pixel, kind="stable")
    points = surface_points(scene.mesh, scene.material, face[order], barycentric[order])
    shape = (int(camera["h"]), int(camera["w"]))
    entries = (weight[order], (pixel[order], np.arange(len(order))))
    return ViewSamples(
        camera=camera,
        points=points,
        pixel_from_point=csr_array(entries, shape=(shape[0] * shape[1], len(order))),
        coverage=coverage.reshape(shape).astype(np.float32),
    )


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


def _coverage(
    scene: Scene, tracer: RayTracer, camera: Table, per_side: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Covered part of each pixel and whether an outline crosses it, both (h * w,)."""
    n_pixels = int(camera["h"]) * int(camera["w"])
    step = EDGE_STEP * scene.mesh.radius
    coverage, edge = np.zeros(n_pixels), np.zeros(n_pixels, dtype=bool)
    rows = max(1, RAYS_PER_BLOCK // per_side**2)
    for first in range(0, n_pixels, rows):
        block = np.arange(first, min(first + rows, n_pixels))
        hits = tracer.first_hits(*_sub_pixel_rays(camera, block, per_side))
        face = hits.face.reshape(len(block), -1)
        coverage[block] = (face >= 0).mean(axis=1)
        distance = hits.distance.reshape(face.shape)
        edge[block] = antialiasing.crossed_by_outline(face, distance, step)
    return coverage, edge


def _sub_pixel_rays(
    camera: Table, pixels: NDArray[np.intp], per_side: int
) -> tuple[Array, Array]:
    """Rays through a regular grid in each pixel; pixel by pixel."""
    row, column = np.divmod(pixels, int(camera["w"]))
    corners = np.stack([column, row], axis=1).astype(np.float64)
    grid = antialiasing.sub_pixel_grid(per_side)
    return camera_rays(camera, (corners[:, None] + grid).reshape(-1, 2))


def _sub_pixel_hits(
    tracer: RayTracer, camera: Table, pixels: NDArray[np.intp], per_side: int
) -> tuple[NDArray[np.intp], Array, NDArray[np.int64], Array]:
    """Pixel, weight, face and barycentric position of all hits in some pixels."""
    hits = tracer.first_hits(*_sub_pixel_rays(camera, pixels, per_side))
    pixel = np.repeat(pixels, per_side**2)[hits.hit]
    weight = np.full(len(pixel), 1.0 / per_side**2)
    return pixel, weight, hits.face[hits.hit], hits.barycentric[hits.hit]


def apparent_reflectance(
    scene: Scene,
    tracer: RayTracer,
    points: SurfacePoints,
    views: Array,
    arriving: near_lights.Illumination,
) -> NDArray[np.float32]:
    """BRDF times cosine times visibility of the light, for every light.

    Parameters
    ----------
    scene : Scene
        Gives the material and decides on shadows.
    tracer : RayTracer
        Of the scene's mesh.
    points : SurfacePoints
        Where; n of them.
    views : (n, 3) float64
        Unit directions to the viewer, world.
    arriving : Illumination
        Light at the points.

    Returns
    -------
    (n, n_lights, 3) float32
        1/sr. Zero where the light is below the shading horizon or hidden, or
        the viewer is below the shading horizon.
    """
    seen = np.einsum("nj,nj->n", points.shading_from_world[:, 2], views) > 0.0
    lit, cosine = lit_pairs(scene, tracer, points, arriving, seen)
    return reflectance_of_pairs(scene.material, points, views, arriving.directions, lit, cosine)


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
    scene: Scene, tracer: RayTracer, view: ViewSamples, lights: tuple[Table, ...]
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

    Returns
    -------
    (n_lights, h, w, 3) float32
        Linear radiance; the background is black.
    """
    height, width = view.coverage.shape
    total: Array = np.zeros((height * width, len(lights) * 3))
    step = max(1, PAIRS_PER_BLOCK // len(lights))
    for first in range(0, len(view.points), step):
        block = slice(first, first + step)
        points = view.points[block]
        arriving = arriving_light(scene, lights, points.position)
        views = towards_camera(view.camera, points.position)
        reflectance = apparent_reflectance(scene, tracer, points, views, arriving)
        radiance = (reflectance * arriving.irradiance).reshape(len(points), -1)
        rows, weights = _weights_of_block(view.pixel_from_point, block)
        total[rows] += weights @ radiance
    by_light = np.moveaxis(total.reshape(height, width, len(lights), 3), 2, 0)
    return np.ascontiguousarray(by_light, dtype=np.float32)


def _weights_of_block(pixel_from_point: csr_array, block: slice) -> tuple[slice, csr_array]:
    """Rows that a block of points (sorted by pixel) touches, and their weights."""
    columns = pixel_from_point[:, block]
    touched = np.flatnonzero(np.diff(columns.indptr))
    rows = slice(int(touched[0]), int(touched[-1]) + 1)
    return rows, columns[rows]


def render_view(
    scene: Scene, tracer: RayTracer, view: ViewSamples
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

    Yields
    ------
    light : int
        Index of the light.
    photograph : (h, w, 3) float32
        Linear radiance without noise.
    """
    step = max(1, VALUES_PER_BATCH // (3 * view.coverage.size))
    for first in range(0, len(scene.lights), step):
        images = shade(scene, tracer, view, scene.lights[first : first + step])
        yield from enumerate(images, start=first)
