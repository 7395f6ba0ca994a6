"""Texels around points of the texture, and how they blend there."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.field.reflectance_field import ReflectanceField
from reflfield.util.validation import check_shape

# Narrower transitions are steps.
NARROWEST = 1e-6


def texel_taps(
    field: ReflectanceField, uv: ArrayLike, transition: ArrayLike = 1.0
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Texels around texture coordinates and their bilinear weights.

    Parameters
    ----------
    field : ReflectanceField
        Field whose texture is read.
    uv : (n, 2) float
        Texture coordinates, v up; pixel centres at (column + 1/2) / width and
        1 - (row + 1/2) / height. Outside [0, 1] the border is read.
    transition : float or (n,) float
        Width in texels, 0 to 1, over which neighbouring texels blend: 1 is bilinear, 0
        takes the nearest. Where texels are no larger than pixels the average over a pixel's
        rays blends already, and bilinear taps would blur a second time; see
        `FieldSurface.transitions`.

    Returns
    -------
    texels : (n, 4) int32
        Texels of the four nearest pixels, -1 where a pixel has none.
    weights : (n, 4) float32
        Bilinear weights over the texels that exist; they sum to 1, or to 0
        where none of the four exists.

    Raises
    ------
    ShapeError
        If `uv` is not (n, 2).

    Notes
    -----
    The *samples* of the four texels are to be blended, not their frames or
    coefficients: neighbours may belong to different clusters.
    """
    coordinates = np.ascontiguousarray(uv, dtype=np.float64)
    check_shape("uv", coordinates, (None, 2))
    texels = np.zeros((len(coordinates), 4), np.int32)
    weights = np.zeros((len(coordinates), 4), np.float32)
    widths = np.broadcast_to(np.asarray(transition, np.float64), len(coordinates))
    _take_taps(field.texel_of_pixel, coordinates, widths.copy(), texels, weights)
    return texels, weights


@numba.njit(cache=True, nogil=True)
def _take_taps(texel_of_pixel: Any, uv: Any, widths: Any, texels: Any, weights: Any) -> None:
    height, width = texel_of_pixel.shape
    for n in range(len(uv)):
        left, right, s = _taps_along(uv[n, 0] * width - 0.5, width, widths[n])
        top, bottom, t = _taps_along((1.0 - uv[n, 1]) * height - 0.5, height, widths[n])
        texels[n, 0], texels[n, 1] = texel_of_pixel[top, left], texel_of_pixel[top, right]
        texels[n, 2], texels[n, 3] = texel_of_pixel[bottom, left], texel_of_pixel[bottom, right]
        total = 0.0
        for k in range(4):
            share = (t if k >= 2 else 1.0 - t) * (s if k % 2 else 1.0 - s)
            total += share if texels[n, k] >= 0 else 0.0
        for k in range(4):
            share = (t if k >= 2 else 1.0 - t) * (s if k % 2 else 1.0 - s)
            known = texels[n, k] >= 0 and total > 0.0
            weights[n, k] = share / total if known else 0.0


@numba.njit(cache=True, nogil=True, inline="always")
def _taps_along(position: float, size: int, transition: float) -> Any:
    """Two neighbouring pixels along an axis, clamped to the image, and the second's share."""
    inside = min(max(position, 0.0), size - 1.0)
    lower = min(int(inside), max(size - 2, 0))
    share = (inside - lower - 0.5) / max(transition, NARROWEST) + 0.5
    return lower, min(lower + 1, size - 1), min(max(share, 0.0), 1.0)
