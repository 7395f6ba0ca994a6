"""Photographs of several views under common lights, reduced and side by side in memory.

What a point of a matt surface shows under each light, in shadow or not, is the same from every
side: a vector of as many colours as there are lights. `geometry.depth_search` compares these.
Lenses are undone, so that rays are straight in every reduced view.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from reflfield.capture.cameras import OPENCV, ORTHOGRAPHIC, Camera

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

# Coverage from which a pixel of a silhouette shows the object alone.
FULLY_COVERED = 0.99
# Pixels beside the outline that are left out: they mix object and backdrop.
RIM_PX = 1
# What stands for a value that was not measured.
MISSING = np.float32(-1)


@dataclass(frozen=True, eq=False)
class ReducedView:
    """One view without its lens's distortion, reduced to a window around the object.

    Parameters
    ----------
    camera : Camera
        Of the reduced view.
    covered : (h, w) bool
        Pixels that show the object alone.
    values : (h, w, n_lights, 3) float32
        Cube roots of linear radiance; `MISSING` where nothing was measured.
    """

    camera: Camera
    covered: NDArray[np.bool_]
    values: Floats


def reduced_view(
    camera: Camera,
    silhouette: NDArray[np.floating],
    photographs: Iterable[NDArray[np.float32] | None],
    factor: int,
) -> ReducedView:
    """Reduce the photographs of one view by an integer factor.

    Parameters
    ----------
    camera : Camera
    silhouette : (height, width) float
        Coverage in [0, 1]; some of it must be covered.
    photographs : iterable of (height, width, 3) float32, or None
        Under each of the common lights, linear; None where there is none.
    factor : int
        Pixels that become one along each axis, at least 1.

    Returns
    -------
    ReducedView
    """
    window = _Window.around(camera, np.asarray(silhouette), factor)
    coverage = window.of(np.asarray(silhouette, np.float32))
    inside = np.ones((2 * RIM_PX + 1,) * 2, np.bool_)
    covered = binary_erosion(coverage >= FULLY_COVERED, inside)
    layers = []
    for photograph in photographs:
        if photograph is None:
            layers.append(np.full((*coverage.shape, 3), MISSING))
            continue
        layer = np.cbrt(np.maximum(window.of(photograph), 0))
        layers.append(np.where(np.isfinite(layer), layer, MISSING).astype(np.float32))
    return ReducedView(window.camera, covered, np.ascontiguousarray(np.stack(layers, axis=2)))


@dataclass(frozen=True, eq=False)
class _Window:
    """Where the pixels of a reduced view lie in the photographs.

    Parameters
    ----------
    camera : Camera
        Of the reduced view.
    factor : int
    pixels : (h, w, 2) float32, optional
        Their centres in photographs reduced by the factor, where a lens bends rays.
    corner : (2,) int
        First column and row in photographs reduced by the factor, otherwise.
    """

    camera: Camera
    factor: int
    pixels: Floats | None
    corner: tuple[int, int]

    @classmethod
    def around(cls, camera: Camera, silhouette: NDArray[np.floating], factor: int) -> _Window:
        """Window around what a silhouette covers, and two pixels more."""
        row, column = np.nonzero(silhouette >= 0.5)
        low = np.array([column.min(), row.min()]) / factor
        high = np.array([column.max() + 1, row.max() + 1]) / factor
        straight = _straightened(camera, factor)
        if not camera.keeps_lines_straight:
            origins, rays = camera.rays(np.stack([column, row], axis=1) + 0.5)
            seen = straight.project(origins + rays)[0]
            low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
        most = np.array([straight.width, straight.height])
        corner = np.clip(np.floor(low) - 2, 0, most - 1).astype(int)
        end = np.clip(np.ceil(high) + 2, corner + 1, most).astype(int)
        size = end - corner
        reduced = Camera(
            camera.id,
            straight.kind,
            int(size[0]),
            int(size[1]),
            straight.fl_x,
            straight.fl_y,
            straight.cx - corner[0],
            straight.cy - corner[1],
            camera.camera_from_world,
            (),
            straight.skew,
        )
        pixels = None
        if not camera.keeps_lines_straight:
            origins, rays = reduced.rays(pixel_centres(reduced).reshape(-1, 2))
            bent = camera.project(origins + rays)[0] / factor
            pixels = bent.reshape(size[1], size[0], 2).astype(np.float32)
        return cls(reduced, factor, pixels, (int(corner[0]), int(corner[1])))

    def of(self, image: Floats) -> Floats:
        """Reduced image, (h, w) or (h, w, 3)."""
        if self.factor > 1:
            rows, columns = (n // self.factor * self.factor for n in image.shape[:2])
            size = columns // self.factor, rows // self.factor
            image = cv2.resize(image[:rows, :columns], size, interpolation=cv2.INTER_AREA)
        if self.pixels is None:
            x, y = self.corner
            return image[y : y + self.camera.height, x : x + self.camera.width]
        across, down = (np.ascontiguousarray(self.pixels[..., i] - 0.5) for i in (0, 1))
        bent = cv2.remap(image, across, down, cv2.INTER_LINEAR, borderValue=(0, 0, 0, 0))
        return np.asarray(bent, np.float32)


def _straightened(camera: Camera, factor: int) -> Camera:
    """The camera without distortion, its image reduced."""
    kind = ORTHOGRAPHIC if camera.kind == ORTHOGRAPHIC else OPENCV
    return Camera(
        camera.id,
        kind,
        max(camera.width // factor, 1),
        max(camera.height // factor, 1),
        camera.fl_x / factor,
        camera.fl_y / factor,
        camera.cx / factor,
        camera.cy / factor,
        camera.camera_from_world,
        (),
        camera.skew / factor,
    )


def pixel_centres(camera: Camera) -> Array:
    """Centres of all pixels, (height, width, 2)."""
    x, y = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    return np.stack(np.meshgrid(x, y), axis=2)


def projection_matrix(camera: Camera) -> Array:
    """(3, 4) matrix that takes world points to homogeneous pixels.

    Examples
    --------
    >>> camera = Camera("v", "opencv", 4, 4, 2.0, 2.0, 2.0, 2.0, np.eye(4))
    >>> x, y, w = projection_matrix(camera) @ [1.0, 0.0, 4.0, 1.0]
    >>> float(x / w), float(y / w)
    (2.5, 2.0)
    """
    pose = camera.camera_from_world[:3].copy()
    if camera.kind == ORTHOGRAPHIC:
        pose[2] = [0.0, 0.0, 0.0, 1.0]
    return np.asarray(camera.matrix @ pose)
