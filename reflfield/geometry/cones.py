"""One camera's silhouette as a cone: signed distances of points in space to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.errors import InputError
from reflfield.geometry.silhouette_distance import SignedDistance, signed_distance
from reflfield.util.blas_threads import thread_pool
from reflfield.util.progress import track

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class View:
    """One camera with the distance to its silhouette's outline."""

    camera: Camera
    outline: SignedDistance

    def distance(self, points: Array) -> Array:
        """Signed distance (n,) to the silhouette's cone, metres; positive inside."""
        return self.distance_and_pixel(points)[0]

    def distance_and_pixel(self, points: Array) -> tuple[Array, Array]:
        """Signed distance (n,) to the silhouette's cone, and width of a pixel there, metres."""
        pixels, depth = self.camera.project(points)
        perspective = self.camera.kind != "orthographic"
        imaged = np.isfinite(pixels[:, 0]) & np.isfinite(pixels[:, 1])
        if perspective:
            imaged &= depth > 0.0
        # What a camera cannot image is empty, unless it does not see the whole object.
        distance = np.full(len(points), np.inf if self.outline.leaves_image else -np.inf)
        focal = 0.5 * (self.camera.fl_x + self.camera.fl_y)
        metres = (
            np.maximum(depth, 0.0) / focal if perspective else np.full_like(depth, 1 / focal)
        )
        if imaged.all():
            return self.outline.at(pixels) * metres, metres
        distance[imaged] = self.outline.at(pixels[imaged]) * metres[imaged]
        return distance, metres

    def covered_pixels(self, most: int) -> Array:
        """Centres of at most so many pixels that the object covers, evenly spread, (n, 2)."""
        covered = np.flatnonzero(self.outline.values > 0.0)
        n_some = min(most, len(covered))
        some = np.unique(np.linspace(0, len(covered) - 1, n_some).astype(int))
        row, col = np.divmod(covered[some], self.camera.width)
        return np.stack([col, row], axis=1) + 0.5

    @property
    def steepest(self) -> float:
        """Largest change of the distance per metre: 1 / cos(angle off the optical axis)."""
        if self.camera.kind == "orthographic":
            return 1.0
        tangent = np.linalg.norm(normalised(self.camera, self.outline.outline), axis=1).max()
        return float(np.hypot(1.0, tangent))


def measured_views(
    cameras: Sequence[Camera],
    silhouettes: Sequence[NDArray[np.floating]],
    scratch: Path | None = None,
    workers: int = 1,
) -> list[View]:
    """Check and measure the silhouettes; with a folder, distances are kept in files there."""
    if len(cameras) != len(silhouettes) or not cameras:
        raise InputError(
            f"silhouettes: expected one for each of {len(cameras)} cameras (at least one), "
            f"received {len(silhouettes)}"
        )

    def measured(number: int) -> View:
        camera, silhouette = cameras[number], silhouettes[number]
        if np.shape(silhouette) != (camera.height, camera.width):
            raise InputError(
                f"silhouette of view {camera.id!r}: expected {camera.height} rows x "
                f"{camera.width} columns as its camera says, received {np.shape(silhouette)}"
            )
        outline = signed_distance(silhouette, f"silhouette of view {camera.id!r}")
        if scratch is not None:
            outline = outline.moved_to(scratch / f"distances{number}.npy")
        return View(camera, outline)

    n = len(cameras)
    with thread_pool(workers) as pool:
        return list(track(pool.map(measured, range(n)), n, "silhouettes"))


def normalised(camera: Camera, pixels: Array) -> Array:
    """Undistorted image coordinates X/Z, Y/Z (orthographic: X, Y) of pixels (n, 2)."""
    origins, directions = camera.rays(pixels)
    if camera.kind == "orthographic":
        return (origins @ camera.rotation.T + camera.camera_from_world[:3, 3])[:, :2]
    in_camera = directions @ camera.rotation.T
    return in_camera[:, :2] / in_camera[:, 2:]
