"""What points of a coarse hull look like in every photograph, and what its light should do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.capture.color_spaces import LUMINANCE
from reflfield.capture.lights import DIRECTIONAL, POINT, SPOT, Light
from reflfield.checking.photograph_statistics import (
    PhotographSet,
    PhotographStatistics,
)
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.ray_scene import RayScene

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

N_POINTS = 1200
# Cosines to the camera below which a surface is seen too obliquely, and share of the diagonal
# by which rays start above it.
LEAST_COSINE, ABOVE = 0.35, 5e-3


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points of a surface, and their luminance in photographs.

    Parameters
    ----------
    points, normals : (n, 3) float64
    places : (n_views, n, 2) float32
        Where views see the points, in shares of the image's width and height.
    seen : (n_views, n) bool
        Where they do, and not too obliquely.
    luminance : dict of int to (n,) float32
        By photograph; NaN where a point is not seen, or saturated.
    irradiance : (n_lights, n) float64
        Luminance of the irradiance of the points, cosine and cast shadows of the coarse
        surface included; NaN for lights whose place is unknown.
    cosine : (n_lights, n) float64
        To each light, negative on the side that faces away; NaN likewise.
    """

    points: Array
    normals: Array
    places: Float32
    seen: Bool
    luminance: Mapping[int, Float32]
    irradiance: Array
    cosine: Array

    def look_up(self, statistics: PhotographStatistics, view: int, turn: int = 0) -> Float32:
        """Luminance (n,) of the points in a photograph as if a view had taken it.

        Parameters
        ----------
        statistics : PhotographStatistics
        view : int
        turn : int
            How the photograph is turned first: of `turned`.
        """
        bright = turned(statistics.luminance, turn)
        clipped = turned(statistics.saturated, turn).astype(np.float32)
        size = np.array(bright.shape[1::-1], np.float32)
        x, y = (np.clip(self.places[view], -9, 9) * size - np.float32(0.5)).T
        value, share = (
            cv2.remap(
                np.ascontiguousarray(image), x.copy(), y.copy(), cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            ).ravel()
            for image in (bright, clipped)
        )  # fmt: skip
        return np.where(self.seen[view] & (share < 1), value, np.nan).astype(np.float32)


def turned(image: NDArray[Any], turn: int) -> NDArray[Any]:
    """An image turned by quarters to the left (turn 0 to 3), or mirrored before (4 to 7).

    Examples
    --------
    >>> turned(np.array([[1, 2], [3, 4]]), 2).tolist(), turned(np.array([[1, 2]]), 4).tolist()
    ([[4, 3], [2, 1]], [[2, 1]])
    """
    return np.rot90(image[:, ::-1] if turn >= 4 else image, turn % 4)


def sample_surface(
    capture: Capture, mesh: Mesh, photographs: PhotographSet, views: Sequence[int]
) -> SurfaceSamples:
    """Sample a coarse surface in all photographs of some views."""
    points, normals = _spread_points(mesh, N_POINTS)
    scene = RayScene(mesh)
    raised = points + ABOVE * scene.diagonal * normals
    places = np.zeros((capture.n_views, len(points), 2), np.float32)
    seen = np.zeros((capture.n_views, len(points)), bool)
    for view in views:
        camera = capture.cameras[view]
        pixels = np.nan_to_num(camera.project(points)[0], nan=-1.0)
        seen[view] = camera.contains(pixels) & _visible(scene, camera, raised, normals)
        places[view] = pixels / (camera.width, camera.height)
    cosine = np.array([_cosine(light, points, normals) for light in capture.lights])
    irradiance = np.array(
        [
            _irradiance(light, scene, raised, points, c)
            for light, c in zip(capture.lights, cosine, strict=True)
        ]
    )
    samples = SurfaceSamples(points, normals, places, seen, {}, irradiance, cosine)
    return with_luminance(samples, capture, photographs, views)


def with_luminance(
    samples: SurfaceSamples,
    capture: Capture,
    photographs: PhotographSet,
    views: Sequence[int],
) -> SurfaceSamples:
    """The samples with the luminance of the points in all photographs of some views."""
    luminance = {
        index: samples.look_up(statistics, capture.photographs[index].camera)
        for index, statistics in photographs.of.items()
        if capture.photographs[index].camera in set(views)
    }
    return replace(samples, luminance=luminance)


def _spread_points(mesh: Mesh, count: int) -> tuple[Array, Array]:
    """Points spread evenly by area, and the normals of their triangles."""
    rng = np.random.default_rng(0)
    corners = mesh.vertices[mesh.faces]
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    share = np.cumsum(areas) / areas.sum()
    faces = np.searchsorted(share, (np.arange(count) + 0.5) / count)
    weights = rng.dirichlet(np.ones(3), size=count)
    return (weights[..., None] * corners[faces]).sum(axis=1), mesh.face_normals[faces]


def _visible(scene: RayScene, camera: Camera, raised: Array, normals: Array) -> Bool:
    towards = camera.view_directions(raised)
    facing = (towards * normals).sum(axis=1) > LEAST_COSINE
    return facing & ~scene.occluded(raised, towards)


def _cosine(light: Light, points: Array, normals: Array) -> Array:
    if light.kind not in (POINT, SPOT, DIRECTIONAL):
        return np.full(len(points), np.nan)
    cosine: Array = (light.directions(points) * normals).sum(axis=1)
    return cosine


def _irradiance(
    light: Light, scene: RayScene, raised: Array, points: Array, cosine: Array
) -> Array:
    if np.isnan(cosine).all():
        return cosine
    strength: Array = light.irradiance(points) @ LUMINANCE
    shadowed = scene.occluded(
        raised,
        light.directions(raised),
        light.distances(raised),
    )
    return np.where(shadowed, 0.0, strength * np.maximum(cosine, 0))
