"""Values of images between their pixels, and of what kind each such value is."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.util.validation import check_shape

Floats = NDArray[np.float32]
Kinds = NDArray[np.uint8]
# A pixel of less weight in a bilinear sample changes it by less than a half float's rounding
# of eleven bits: what such a pixel is does not matter.
LEAST_WEIGHT = 2.0**-11


@numba.njit(cache=True, nogil=True)
def _sample_bilinear(images: Floats, pixels: NDArray[np.float64], out: Floats) -> None:
    n_images, height, width, _ = images.shape
    for i in range(len(pixels)):
        # Pixel centres lie at half-integers; samples beyond the rim read the rim.
        x = min(max(pixels[i, 0] - 0.5, 0.0), width - 1.0)
        y = min(max(pixels[i, 1] - 0.5, 0.0), height - 1.0)
        column, row = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
        s, t = np.float32(x - column), np.float32(y - row)
        right, below = min(column + 1, width - 1), min(row + 1, height - 1)
        for j in range(n_images):
            for c in range(3):
                upper = (1 - s) * images[j, row, column, c] + s * images[j, row, right, c]
                lower = (1 - s) * images[j, below, column, c] + s * images[j, below, right, c]
                out[i, j, c] = (1 - t) * upper + t * lower


def sample_bilinear(images: Floats, pixels: NDArray[np.float64]) -> Floats:
    """Values of images at pixel positions.

    Parameters
    ----------
    images : (n_images, h, w, 3) float32
        Linear radiance.
    pixels : (n, 2) float64
        x and y; the centre of the top-left pixel is (0.5, 0.5). Beyond the image, the rim.

    Returns
    -------
    (n, n_images, 3) float32

    Raises
    ------
    ShapeError
        If a shape is wrong.
    InputError
        If a pixel is NaN: the camera does not image that point.

    Examples
    --------
    >>> ramp = np.zeros((1, 1, 3, 3), np.float32)
    >>> ramp[0, 0] = [[0.0], [1.0], [2.0]]
    >>> float(sample_bilinear(ramp, np.array([[1.25, 0.5]]))[0, 0, 0])
    0.75
    """
    check_shape("images", images, (None, None, None, 3))
    check_shape("pixels", pixels, (None, 2))
    absent = np.isnan(pixels).any(axis=1)
    if absent.any():
        raise InputError(
            f"pixels: expected numbers, received NaN in row {int(absent.argmax())}; "
            "leave out points that the camera does not image"
        )
    out = np.zeros((len(pixels), len(images), 3), np.float32)
    _sample_bilinear(
        np.ascontiguousarray(images, np.float32), np.ascontiguousarray(pixels, np.float64), out
    )
    return out


@numba.njit(cache=True, nogil=True)
def _mark_kinds(
    kinds: Kinds, pixels: NDArray[np.float64], least_weight: float, out: Kinds
) -> None:
    height, width, _ = kinds.shape
    for i in range(len(pixels)):
        x = min(max(pixels[i, 0] - 0.5, 0.0), width - 1.0)
        y = min(max(pixels[i, 1] - 0.5, 0.0), height - 1.0)
        column, row = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
        s, t = x - column, y - row
        for c in range(3):
            most = least_weight
            for corner in range(4):
                right, below = corner & 1, corner >> 1
                weight = (s if right else 1 - s) * (t if below else 1 - t)
                kind = kinds[min(row + below, height - 1), min(column + right, width - 1), c]
                if kind != 0 and weight > most:
                    most, out[i, c] = weight, kind


def mark_kinds(kinds: Kinds, pixels: NDArray[np.float64], out: Kinds) -> None:
    """Write the kind of each sampled value: that of its heaviest pixel that is no measurement.

    Parameters
    ----------
    kinds : (h, w, 3) uint8
        Of the pixels; 0 is a measurement.
    pixels : (n, 2) float64
        As in `sample_bilinear`; not NaN.
    out : (n, 3) uint8
        Stays as it is where every pixel of at least `LEAST_WEIGHT` is a measurement.

    Examples
    --------
    >>> kinds = np.zeros((1, 2, 3), np.uint8)
    >>> kinds[0, 1] = 2
    >>> out = np.zeros((2, 3), np.uint8)
    >>> mark_kinds(kinds, np.array([[0.5, 0.5], [0.75, 0.5]]), out)
    >>> out[:, 0].tolist()
    [0, 2]
    """
    _mark_kinds(kinds, pixels, LEAST_WEIGHT, out)
