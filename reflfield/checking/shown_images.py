"""Pictures that show what findings speak of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.encoding import encode_srgb
from reflfield.report.pictures import enlarged, silhouettes_overlay

Encoded = NDArray[np.uint8]

LEAST_SIDE = 240


def shown(radiance: NDArray[np.float32], least_side: int = LEAST_SIDE) -> Encoded:
    """A linear image as sRGB, its brightest percent white; small ones enlarged.

    Examples
    --------
    >>> shown(np.ones((1, 2, 3), np.float32), 4).shape
    (2, 4, 3)
    """
    white = float(np.quantile(radiance.max(axis=2), 0.99)) or 1.0
    encoded = np.rint(255 * encode_srgb(np.clip(radiance / np.float32(white), 0, 1)))
    return np.asarray(enlarged(encoded.astype(np.uint8), _factor(encoded.shape, least_side)))


def with_outlines(
    radiance: NDArray[np.float32],
    silhouette: NDArray[np.float32],
    expected: NDArray[np.bool_],
) -> Encoded:
    """An image with the outline of its silhouette and of what others say."""
    factor = _factor(radiance.shape, LEAST_SIDE)
    return np.asarray(
        silhouettes_overlay(
            shown(radiance),
            enlarged(silhouette, factor),
            enlarged(expected.astype(np.float32), factor),
        )
    )


def _factor(shape: tuple[int, ...], least_side: int) -> int:
    return max(1, least_side // max(shape[:2]))
