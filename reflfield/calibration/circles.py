"""Circles in photographs: the outlines of spheres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError

Float32 = NDArray[np.float32]

# Longer side of the image in which circles are sought, and in which they are refined, pixels.
SEARCH_PIXELS, FINE_PIXELS = 256, 1024
# Radii, as shares of the shorter side.
SMALLEST, LARGEST = 0.04, 0.6
# Points on a circle at which its edge is measured.
N_POINTS = 180
CANDIDATES = 12
# Halves of the widths over which an edge is measured, in radii, one after the other.
WIDTHS = (0.02, 0.007, 0.0025)
# Share of a circle that must lie in the image.
LEAST_INSIDE = 0.85


@dataclass(frozen=True)
class Circle:
    """A circle in an image.

    Parameters
    ----------
    x, y : float
        Centre, pixels; (0.5, 0.5) is the centre of the top-left pixel.
    radius : float
        Pixels.
    """

    x: float
    y: float
    radius: float

    def scaled(self, factor: float) -> Circle:
        """The circle in an image that is so many times as large."""
        return Circle(self.x * factor, self.y * factor, self.radius * factor)

    def check_within(self, width: int, height: int) -> None:
        """Demand a circle that holds pixels of an image and is no larger than it.

        Raises
        ------
        InputError
        """
        nearest = [
            np.clip(np.floor(place) + 0.5, 0.5, size - 0.5)
            for place, size in ((self.x, width), (self.y, height))
        ]
        off = np.hypot(nearest[0] - self.x, nearest[1] - self.y)
        if not (off < self.radius <= max(width, height)):
            raise InputError(
                f"sphere: expected a circle in the image of {width} x {height} pixels, "
                f"received {self.x:g},{self.y:g},{self.radius:g}"
            )


def parse_circle(text: str) -> Circle:
    """A circle from ``x,y,r``.

    Raises
    ------
    InputError
        If there are not three numbers, or the radius is not positive.

    Examples
    --------
    >>> parse_circle("536.9,522,421.1")
    Circle(x=536.9, y=522.0, radius=421.1)
    """
    try:
        x, y, radius = (float(word) for word in text.split(","))
    except ValueError:
        raise InputError(
            f"sphere: expected x,y,r in pixels or 'auto', received {text!r}"
        ) from None
    if not (np.isfinite([x, y, radius]).all() and radius > 0):
        raise InputError(
            f"sphere: expected finite numbers and a radius above 0, received {text!r}"
        )
    return Circle(x, y, radius)


def find_circles(images: Sequence[Float32], count: int) -> list[Circle]:
    """The most distinct circles in photographs of one view.

    Candidates of Hough's transform are moved to where the brightness changes most across the
    circle, all around it (Daugman's integro-differential operator).

    Parameters
    ----------
    images : sequence of (h, w) float32
        Luminance, of one size.
    count : int
        Spheres; from left to right in the answer.

    Raises
    ------
    InputError
        If there are fewer circles.
    """
    mean = _flat_contrast(np.mean([np.sqrt(np.maximum(i, 0)) for i in images], axis=0))
    fine, factor = _shrunk(mean, FINE_PIXELS)
    candidates = [c.scaled(factor) for c in _candidates(mean)]
    refined = [_refined(fine, candidate) for candidate in candidates]
    scored = sorted(((edge_strength(fine, c), c) for c in refined), key=lambda e: -e[0])
    chosen: list[Circle] = []
    for _, circle in scored:
        apart = all(
            np.hypot(circle.x - other.x, circle.y - other.y) > max(circle.radius, other.radius)
            for other in chosen
        )
        if apart and _is_inside(circle, fine.shape):
            chosen.append(circle)
    if len(chosen) < count:
        raise InputError(
            f"sphere: expected {count} circles in the photographs, found {len(chosen)}; "
            "give each as x,y,r in pixels"
        )
    best = [circle.scaled(1 / factor) for circle in chosen[:count]]
    return sorted(best, key=lambda circle: circle.x)


def _flat_contrast(mean: NDArray[np.floating]) -> Float32:
    """Brightness in [0, 1], local contrast evened, so that dark outlines count too."""
    top = float(np.quantile(mean, 0.995)) or 1.0
    levels = np.clip(255 * mean / top, 0, 255).astype(np.uint8)
    even = cv2.createCLAHE(clipLimit=4.0, tileGridSize=(4, 4)).apply(levels)
    return even.astype(np.float32) / np.float32(255)


def _shrunk(image: Float32, longest: int) -> tuple[Float32, float]:
    factor = min(1.0, longest / max(image.shape))
    size = round(image.shape[1] * factor), round(image.shape[0] * factor)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA)), factor


def _candidates(mean: Float32) -> list[Circle]:
    """Circles by Hough's transform, in pixels of the image."""
    small, factor = _shrunk(mean, SEARCH_PIXELS)
    levels = cv2.GaussianBlur((255 * small).astype(np.uint8), (0, 0), 1.5)
    shorter = min(small.shape)
    candidates: list[Circle] = []
    for votes in (40, 25, 15):
        circles = cv2.HoughCircles(
            levels,
            cv2.HOUGH_GRADIENT,
            dp=1.5,
            minDist=max(4, shorter // 12),
            param1=60,
            param2=votes,
            minRadius=max(4, round(SMALLEST * shorter)),
            maxRadius=round(LARGEST * shorter),
        )
        if circles is not None:
            rows = circles.reshape(-1, circles.shape[-1])[:CANDIDATES]
            candidates += [Circle(*map(float, row[:3])).scaled(1 / factor) for row in rows]
    return candidates


def edge_strength(image: Float32, circle: Circle, width: float = 0.02) -> float:
    """Change of brightness across a circle: the median over its parts inside the image.

    It is measured over twice `width` radii, and so the same wherever an edge lies within.
    """
    width = max(1.0, width * circle.radius)
    inner, outer = (_ring(image, circle, circle.radius + s * width) for s in (-1, 1))
    change = np.abs(outer - inner)
    known = np.isfinite(change)
    return float(np.median(change[known])) if known.mean() > 0.5 else 0.0


def _ring(image: Float32, circle: Circle, radius: float) -> NDArray[np.float64]:
    """Brightness along a circle; NaN outside of the image."""
    angle = 2 * np.pi * np.arange(N_POINTS) / N_POINTS
    x = circle.x + radius * np.cos(angle) - 0.5
    y = circle.y + radius * np.sin(angle) - 0.5
    value = cv2.remap(
        image, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR
    ).ravel()
    height, width = image.shape
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return np.where(inside, value, np.nan)


def _refined(image: Float32, circle: Circle) -> Circle:
    """The circle moved to the strongest edge beside it, in ever smaller steps."""
    for width in WIDTHS:
        circle = _climbed(image, circle, width)
    return circle


def _climbed(image: Float32, best: Circle, width: float) -> Circle:
    strength = edge_strength(image, best, width)
    step = max(0.5, 2 * width * best.radius)
    while step > 0.05:
        moved = False
        for dx, dy, dr in _STEPS:
            other = Circle(best.x + dx * step, best.y + dy * step, best.radius + dr * step)
            value = edge_strength(image, other, width) if other.radius > 3 else 0.0
            if value > strength:
                best, strength, moved = other, value, True
        step = step if moved else step / 2
    return best


_STEPS = tuple(
    (dx, dy, dr)
    for dx in (-1, 0, 1)
    for dy in (-1, 0, 1)
    for dr in (-1, 0, 1)
    if (dx, dy, dr) != (0, 0, 0)
)


def _is_inside(circle: Circle, shape: tuple[int, ...]) -> bool:
    angle = 2 * np.pi * np.arange(N_POINTS) / N_POINTS
    x, y = circle.x + circle.radius * np.cos(angle), circle.y + circle.radius * np.sin(angle)
    return bool(np.mean((x >= 0) & (x <= shape[1]) & (y >= 0) & (y <= shape[0])) > LEAST_INSIDE)
