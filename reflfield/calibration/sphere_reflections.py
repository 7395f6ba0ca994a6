r"""Lights from their reflections in mirror or glossy spheres.

At the highlight, the normal :math:`n` of the sphere halves the angle between the direction
:math:`v` to the camera and :math:`d` to the light: :math:`d = 2 (n \cdot v) n - v`. Two spheres
give two lines, which meet near a lamp.

Axes: x right, y up in the image, z to the camera, as of RTI's light files. Without a focal
length, all rays of the camera are parallel to z; lengths are in radii of the spheres, times
`radius`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from reflfield.calibration.circles import Circle
from reflfield.errors import InputError

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

# A highlight stands out from the sphere, and fills little of it.
LEAST_CONTRAST, LARGEST_SHARE = 2.0, 0.2
# Width, in radii, and rounds of the window in which the centre of a highlight is sought.
WINDOW, ROUNDS = 0.025, 20
# Reflections at the rim are those of what is behind.
RIM = 0.97
# Lines that meet at a smaller angle say no more than a direction, radians.
LEAST_PARALLAX = np.radians(0.5)


@dataclass(frozen=True, eq=False)
class Ray:
    """A line from a sphere's surface to a light.

    Parameters
    ----------
    start, towards : (3,) float64
    """

    start: Array
    towards: Array


def highlight(luminance: Float32, circle: Circle) -> tuple[float, float]:
    """Centre (x, y), pixels, of the brightest spot in a circle.

    Raises
    ------
    InputError
        If nothing in it stands out.
    """
    x, y, distance = _offsets(luminance.shape, circle)
    within = distance < RIM * circle.radius
    if not within.any():
        raise InputError(f"sphere: expected a circle in the image, received {circle}")
    smooth = cv2.GaussianBlur(luminance, (0, 0), max(0.7, 0.01 * circle.radius))
    inside = np.where(within, smooth, 0)
    top, usual = float(inside.max()), float(np.median(smooth[within]))
    if not top > LEAST_CONTRAST * max(usual, 1e-12):
        raise InputError(
            f"sphere: expected a highlight in the circle {circle.x:.1f},{circle.y:.1f},"
            f"{circle.radius:.1f}, received brightness of {usual:.3g} (median) to {top:.3g}"
        )
    bright = (inside > usual + 0.6 * (top - usual)).astype(np.uint8)
    count, labels = cv2.connectedComponents(bright, connectivity=8)
    sums = [0.0] + [float(inside[labels == k].sum()) for k in range(1, count)]
    spot = labels == int(np.argmax(sums))
    if spot.sum() > LARGEST_SHARE * within.sum():
        raise InputError(
            "sphere: expected a small highlight, received one that fills "
            f"{100 * spot.sum() / within.sum():.0f} % of the sphere; is it matt? Give a matt "
            "sphere as `matt_sphere`"
        )
    weight = np.where(spot, inside - usual, 0)
    centre = [float((weight * v).sum() / weight.sum()) for v in (x, y)]
    # Flare spreads to one side: the centre of what is near the brightest part counts.
    width = WINDOW * circle.radius
    for _ in range(ROUNDS):
        square = np.square(x - centre[0]) + np.square(y - centre[1])
        near = np.maximum(inside - usual, 0) * np.exp(-square / (2 * width**2))
        centre = [float((near * v).sum() / near.sum()) for v in (x, y)]
    return centre[0], centre[1]


def _offsets(shape: tuple[int, ...], circle: Circle) -> tuple[Array, Array, Array]:
    """Pixel centres x, y, and their distance from the circle's centre."""
    row, column = np.meshgrid(
        np.arange(shape[0]) + 0.5, np.arange(shape[1]) + 0.5, indexing="ij"
    )
    return column, row, np.hypot(column - circle.x, row - circle.y)


@dataclass(frozen=True)
class SphereCamera:
    """How a camera sees spheres.

    Parameters
    ----------
    width, height : int
    focal : float, optional
        Pixels; None for parallel rays.
    radius : float
        Of the spheres, in the unit of positions.
    """

    width: int
    height: int
    focal: float | None = None
    radius: float = 1.0

    def ray_to_light(self, circle: Circle, spot: tuple[float, float]) -> Ray:
        """The line from a highlight on a sphere to its light.

        Examples
        --------
        A highlight half a radius right of the centre: the normal leans by 30 degrees, the
        light by 60.

        >>> camera = SphereCamera(100, 100)
        >>> ray = camera.ray_to_light(Circle(50, 50, 20), (60, 50))
        >>> ray.towards.round(3)
        array([0.866, 0.   , 0.5  ])
        """
        centre = self.centre_of(circle)
        start, view = self._seen(circle, spot, centre)
        normal = (start - centre) / np.linalg.norm(start - centre)
        towards = 2 * (normal @ view) * normal - view
        return Ray(start, towards / np.linalg.norm(towards))

    def centre_of(self, circle: Circle) -> Array:
        """Centre of a sphere (3,).

        With parallel rays at z = 0, x and y from the middle of the image. With a focal length
        the camera is the origin; the outline is taken for a circle, which it nearly is.
        """
        x, y = circle.x - self.width / 2, self.height / 2 - circle.y
        if self.focal is None:
            return np.array([x, y, 0.0]) * (self.radius / circle.radius)
        away = np.array([x, y, -self.focal])
        sine = circle.radius / np.hypot(self.focal, circle.radius)
        distance = self.radius / sine
        return np.asarray(away / np.linalg.norm(away) * distance)

    def _seen(
        self, circle: Circle, spot: tuple[float, float], centre: Array
    ) -> tuple[Array, Array]:
        """Point of the sphere at a pixel, and the direction from it to the camera."""
        x, y = spot[0] - self.width / 2, self.height / 2 - spot[1]
        if self.focal is None:
            scale = self.radius / circle.radius
            across = np.array([x * scale, y * scale]) - centre[:2]
            depth = np.sqrt(max(self.radius**2 - float(across @ across), 0))
            return centre + np.array([*across, depth]), np.array([0.0, 0.0, 1.0])
        way = np.array([x, y, -self.focal])
        way /= np.linalg.norm(way)
        along = float(way @ centre)
        inner = along**2 - float(centre @ centre) + self.radius**2
        point = way * (along - np.sqrt(max(inner, 0)))
        return point, -way


def meeting_point(rays: Sequence[Ray]) -> Array | None:
    """The point nearest to lines (3,); None where they are nearly parallel or part.

    Examples
    --------
    >>> first = Ray(np.zeros(3), np.array([0.6, 0, 0.8]))
    >>> second = Ray(np.array([6.0, 0, 0]), np.array([-0.6, 0, 0.8]))
    >>> meeting_point([first, second]).round(6)
    array([3., 0., 4.])
    """
    ways = np.array([ray.towards for ray in rays])
    starts = np.array([ray.start for ray in rays])
    parallax = np.arccos(np.clip((ways @ ways.T).min(), -1, 1))
    if parallax < LEAST_PARALLAX:
        return None
    across = np.eye(3) - ways[:, :, None] * ways[:, None, :]
    point = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, starts))
    ahead = ((point - starts) * ways).sum(axis=1)
    return np.asarray(point) if (ahead > 0).all() else None
