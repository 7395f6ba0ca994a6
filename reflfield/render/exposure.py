"""From linear radiance to pictures: one exposure for all frames of a set."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.encoding import encode_srgb
from reflfield.errors import InputError

# Rec.709 luminance of linear Rec.709 primaries.
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])

# Share of the object's pixels that is not clipped to white.
PERCENTILE = 99.5

# Rows of a picture that are encoded together.
ROWS_AT_ONCE = 64
# Luminances kept of each frame: enough for a percentile, little to hold.
SAMPLES_PER_FRAME = 4096


def luminance(radiance: NDArray[np.floating]) -> NDArray[np.float64]:
    """Rec.709 luminance of (..., 3) linear colours.

    Examples
    --------
    >>> float(luminance(np.array([1.0, 1.0, 1.0])).round(12))
    1.0
    """
    return np.asarray(radiance, np.float64) @ LUMINANCE


def covered_luminances(
    image: NDArray[np.floating], coverage: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Luminances of the pixels that the object fills, thinned to SAMPLES_PER_FRAME.

    Parameters
    ----------
    image : (h, w, 3) float
        Linear radiance.
    coverage : (h, w) float
        Share of each pixel that the object covers.

    Returns
    -------
    (n,) float64
    """
    filled = np.flatnonzero(np.asarray(coverage).ravel() > 0.99)
    chosen = filled[:: max(len(filled) // SAMPLES_PER_FRAME, 1)]
    return luminance(np.asarray(image).reshape(-1, 3)[chosen])


def common_exposure(luminances: Iterable[NDArray[np.float64]]) -> float:
    """Exposure at which PERCENTILE of all luminances stay below white.

    Parameters
    ----------
    luminances : iterable of (n,) float64
        As `covered_luminances` returns, one array a frame.

    Returns
    -------
    float
        1 / percentile; 1 where there is nothing to see.

    Examples
    --------
    >>> common_exposure([np.full(10, 4.0), np.full(10, 4.0)])
    0.25
    """
    pooled = np.concatenate([np.zeros(0), *luminances])
    white = float(np.percentile(pooled, PERCENTILE)) if len(pooled) else 0.0
    return 1.0 / white if white > 0 else 1.0


def encoded_picture(image: NDArray[np.floating], exposure: float) -> NDArray[np.uint8]:
    """8-bit sRGB picture of linear radiance times an exposure.

    Raises
    ------
    InputError
        If the exposure is not positive and finite.

    Examples
    --------
    >>> encoded_picture(np.array([[[0.0, 0.5, 2.0]]]), 1.0)
    array([[[  0, 188, 255]]], dtype=uint8)
    """
    if not (np.isfinite(exposure) and exposure > 0):
        raise InputError(f"exposure: expected a positive number, received {exposure}")
    linear = np.asarray(image)
    picture = np.zeros(linear.shape, np.uint8)
    # Strip by strip: double precision of a whole photograph takes ten times its memory.
    for first in range(0, len(linear), ROWS_AT_ONCE):
        rows = np.asarray(linear[first : first + ROWS_AT_ONCE], np.float64)
        picture[first : first + ROWS_AT_ONCE] = np.rint(encode_srgb(rows * exposure) * 255)
    return picture
