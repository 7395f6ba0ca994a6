r"""Strength of lights from a matt sphere or a grey card.

A matt sphere shows :math:`a \max(n \cdot d, 0)`: with the direction :math:`d` known, its
brightness over the cosine is the light's strength at the sphere; unknown, direction and
strength follow together by least squares over the lit side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reflfield.calibration.circles import Circle
from reflfield.errors import InputError

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

ROUNDS = 8
LEAST_COSINE = 0.25
FEWEST_PIXELS = 30


@dataclass(frozen=True, eq=False)
class MattLight:
    """What a matt sphere says of a light.

    Parameters
    ----------
    direction : (3,) float64
        Unit; x right, y up, z to the camera.
    strength : (3,) float64
        Of a facing surface, per channel.
    """

    direction: Array
    strength: Array


def light_on_matt_sphere(
    image: Float32, measured: NDArray[np.bool_], circle: Circle, direction: Array | None = None
) -> MattLight:
    """Direction and strength of a light, by the shading of a matt sphere.

    Parameters
    ----------
    image : (h, w, 3) float32
    measured : (h, w) bool
        False where saturated.
    circle : Circle
    direction : (3,) float64, optional
        Where it is known.

    Raises
    ------
    InputError
        If too little of the sphere is lit.
    """
    normals, inside = _normals(image.shape, circle)
    usable = inside & measured
    bright = image[usable].astype(np.float64)
    facing = normals[usable]
    if direction is None and len(bright) >= FEWEST_PIXELS:
        direction = _direction(facing, bright.mean(axis=1))
    cosine = np.zeros(len(facing)) if direction is None else facing @ direction
    lit = cosine > LEAST_COSINE
    if direction is None or lit.sum() < FEWEST_PIXELS:
        raise InputError(
            f"matt_sphere: expected a sphere lit from the front, received {int(lit.sum())} lit "
            "pixels that are not saturated; is the circle the sphere's outline?"
        )
    strength = np.median(bright[lit] / cosine[lit, None], axis=0)
    return MattLight(direction, strength)


def _direction(normals: Array, bright: Array) -> Array:
    """Unit direction by least squares over the lit side, which is found on the way."""
    lit = bright > 0.3 * np.quantile(bright, 0.95)
    vector = np.array([0.0, 0.0, 1.0])
    for _ in range(ROUNDS):
        if lit.sum() < FEWEST_PIXELS:
            break
        vector = np.linalg.lstsq(normals[lit], bright[lit], rcond=None)[0]
        expected = normals @ vector
        length = float(np.linalg.norm(vector))
        left = np.abs(bright - expected)
        # Beside the terminator, and highlights, are no part of the model.
        lit = (expected > LEAST_COSINE * length) & (left < 3 * np.median(left[lit]) + 1e-12)
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-300))


def _normals(shape: tuple[int, ...], circle: Circle) -> tuple[Array, NDArray[np.bool_]]:
    """Normals (h, w, 3) of a sphere under parallel rays, and where it is, the rim left out."""
    row, column = np.meshgrid(
        np.arange(shape[0]) + 0.5, np.arange(shape[1]) + 0.5, indexing="ij"
    )
    x, y = (column - circle.x) / circle.radius, (circle.y - row) / circle.radius
    square = x * x + y * y
    normals = np.stack([x, y, np.sqrt(np.maximum(1 - square, 0))], axis=2)
    return normals, square < 0.95**2


def card_strength(
    image: Float32, measured: NDArray[np.bool_], box: tuple[int, int, int, int]
) -> Array:
    """Mean of the measured pixels of a grey card (left, top, right, bottom), per channel."""
    left, top, right, bottom = box
    part = image[top:bottom, left:right][measured[top:bottom, left:right]]
    if len(part) < FEWEST_PIXELS:
        raise InputError(
            f"grey_card: expected at least {FEWEST_PIXELS} pixels not saturated in the "
            f"box {box}, received {len(part)}"
        )
    mean: Array = part.mean(axis=0, dtype=np.float64)
    return mean
