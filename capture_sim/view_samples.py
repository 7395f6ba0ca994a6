"""Rays of a view through its pixels, finer where an outline crosses them, and their hits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from capture_sim.effects import antialiasing, simulated
from capture_sim.model import Scene
from capture_sim.rays import BYTES_PER_RAY, RayTracer, camera_rays
from capture_sim.surface import SurfacePoints, surface_points

Table = Mapping[str, Any]
Array = NDArray[np.float64]

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
    searched = _trace_pixels(tracer, camera, np.arange(n_pixels), search, rays)
    covered, edge = searched.coverage, np.zeros(n_pixels, dtype=bool)
    samples = searched.samples
    if per_side_at_edges > per_side:
        with scene.costs.measure(antialiasing.NAME):
            near = np.flatnonzero(_near_outline(searched, int(camera["w"]), step))
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


def _near_outline(searched: TracedPixels, width: int, step: float) -> NDArray[np.bool_]:
    """Pixels with rays on both sides of an outline among theirs and their neighbours'."""

    def around(values: NDArray[Any], extreme: Any) -> NDArray[Any]:
        return np.asarray(extreme(values.reshape(-1, width), size=3)).ravel()

    any_hit = around(searched.coverage > 0.0, maximum_filter)
    all_hit = around(searched.coverage == 1.0, minimum_filter)
    nearest = around(searched.nearest, minimum_filter)
    farthest = around(searched.farthest, maximum_filter)
    jumps = np.zeros(len(nearest), dtype=bool)
    np.greater(farthest - nearest, step, out=jumps, where=all_hit)
    return (any_hit & ~all_hit) | jumps


def rays_per_side(scene: Scene) -> tuple[int, int]:
    """Rays along each side of a pixel inside the object, and where an outline crosses it."""
    return antialiasing.apply(scene) if simulated(scene, antialiasing) else (1, 1)


def _sub_pixel_rays(
    camera: Table, pixels: NDArray[np.intp], per_side: int
) -> tuple[Array, Array]:
    """Rays through a regular grid in each pixel; pixel by pixel."""
    row, column = np.divmod(pixels, int(camera["w"]))
    corners = np.stack([column, row], axis=1).astype(np.float64)
    grid = antialiasing.sub_pixel_grid(per_side)
    return camera_rays(camera, (corners[:, None] + grid).reshape(-1, 2))
