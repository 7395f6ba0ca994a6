"""From linear radiance to displayed values: one exposure for all images that are compared.

The lights are known, so nothing is rescaled per image: every photograph and every rendered
image is multiplied by the same exposure,

    e = 1 / (99.5th percentile of the luminance over the object pixels of all images),

where *object pixels* are those whose coverage is at least one half, eroded by two pixels, so
that neither the backdrop nor the anti-aliased rim counts.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_erosion

from reflfield.capture.color_spaces import luminance
from reflfield.capture.encoding import encode_srgb
from reflfield.errors import InputError

COVERAGE_OF_OBJECT = 0.5
EROSION_PX = 2
EXPOSURE_PERCENTILE = 99.5

# Rows of an image that are encoded together: double precision of a whole photograph takes ten
# times its memory.
ROWS_AT_ONCE = 64
# What is not finite is shown in neutral grey.
UNKNOWN_CODE = 128


def object_pixels(silhouette: ArrayLike) -> NDArray[np.bool_]:
    """Pixels that count: coverage >= 0.5, eroded by a disk of radius 2 pixels.

    Beyond the border of the image nothing is known to be object, so the two
    outermost pixels never count.

    Parameters
    ----------
    silhouette : (h, w) array_like
        Coverage, 0 to 1.

    Returns
    -------
    (h, w) bool
        True where the pixel counts.

    Examples
    --------
    >>> object_pixels(np.ones((7, 6))).sum(axis=1).tolist()
    [0, 0, 2, 2, 2, 0, 0]
    """
    covered = np.asarray(silhouette) >= COVERAGE_OF_OBJECT
    # Two rounds of the 4-neighbour cross remove exactly the disk of radius 2.
    return binary_erosion(covered, iterations=EROSION_PX)


class ExposureMeter:
    """Common exposure of images that are added one by one.

    Exact up to `ThinnedValues.most` object pixels, of an even part of them beyond.

    Examples
    --------
    >>> meter = ExposureMeter()
    >>> meter.add(np.full((9, 9, 3), 0.25), np.ones((9, 9)))
    >>> round(meter.exposure, 6)
    4.0
    """

    def __init__(self) -> None:
        self._luminances = ThinnedValues()

    def add(self, image: ArrayLike, silhouette: ArrayLike) -> None:
        """Count an image.

        Parameters
        ----------
        image : (..., 3) array_like
            Linear radiance.
        silhouette : (h, w) float or (...) bool
            Coverage by the object; or True for the pixels that count. Those that are not
            finite never do.
        """
        pixels: NDArray[np.generic] = np.asarray(silhouette)
        counted = pixels if pixels.dtype == np.bool_ else object_pixels(pixels)
        values = luminance(np.asarray(image)[counted])
        self._luminances.add(values[np.isfinite(values)])

    @property
    def is_empty(self) -> bool:
        """True if no pixel has counted yet."""
        return not self._luminances.values.size

    @property
    def exposure(self) -> float:
        """The exposure; NaN if the percentile is not positive, as of black images."""
        if self.is_empty:
            return math.nan
        white = float(np.percentile(self._luminances.values, EXPOSURE_PERCENTILE))
        return 1.0 / white if white > 0.0 else math.nan

    @property
    def exposure_or_one(self) -> float:
        """The exposure; 1 where none is defined."""
        exposure = self.exposure
        return 1.0 if math.isnan(exposure) else exposure


def display(image: ArrayLike, exposure: float) -> NDArray[np.float64]:
    """Displayed value of linear radiance: ``sRGB(clip(exposure * image, 0, 1))``.

    Parameters
    ----------
    image : (...) array_like
        Linear radiance.
    exposure : float
        Factor applied before clipping.

    Returns
    -------
    (...) float64
        Encoded values in [0, 1].

    Examples
    --------
    >>> display([-1.0, 0.00155, 0.5, 7.0], exposure=2.0).round(4)
    array([0.    , 0.0401, 1.    , 1.    ])
    """
    exposed = np.asarray(image, dtype=np.float64) * exposure
    return np.asarray(encode_srgb(exposed), dtype=np.float64)


def encoded_picture(image: ArrayLike, exposure: float) -> NDArray[np.uint8]:
    """8-bit sRGB image of linear radiance times an exposure.

    Parameters
    ----------
    image : (h, w, 3) array_like
        Linear radiance; pixels that are not finite become neutral grey.
    exposure : float
        Common to all images that are shown side by side.

    Returns
    -------
    (h, w, 3) uint8

    Raises
    ------
    InputError
        If the exposure is not positive and finite.

    Examples
    --------
    >>> encoded_picture([[[0.0, 0.5, 2.0], [np.nan, 0, 0]]], 1.0).tolist()
    [[[0, 188, 255], [128, 128, 128]]]
    """
    if not (np.isfinite(exposure) and exposure > 0):
        raise InputError(f"exposure: expected a positive number, received {exposure}")
    linear = np.asarray(image)
    encoded = np.full(linear.shape, UNKNOWN_CODE, np.uint8)
    for first in range(0, len(linear), ROWS_AT_ONCE):
        rows = np.asarray(linear[first : first + ROWS_AT_ONCE], np.float64)
        finite = np.isfinite(rows).all(axis=-1, keepdims=True)
        codes = np.rint(display(np.where(finite, rows, 0.0), exposure) * 255).astype(np.uint8)
        np.copyto(encoded[first : first + ROWS_AT_ONCE], codes, where=finite)
    return encoded


class ThinnedValues:
    """Numbers for a percentile: all of them, or every second, fourth, ... if they are many.

    Parameters
    ----------
    most : int
        Numbers kept at most.

    Examples
    --------
    >>> kept = ThinnedValues(most=4)
    >>> for first in (0, 5):
    ...     kept.add(np.arange(first, first + 5.0))
    >>> kept.values
    array([0., 4., 8.])
    """

    def __init__(self, most: int = 1 << 23) -> None:
        self.most = most
        self.values = np.zeros(0)
        self._step = 1
        self._next = 0  # of the numbers to come, the first that is kept

    def add(self, values: NDArray[np.floating]) -> None:
        """Add some more numbers."""
        chosen = np.asarray(values, np.float64)[self._next :: self._step]
        self._next += len(chosen) * self._step - len(values)
        self.values = np.concatenate([self.values, chosen])
        while len(self.values) > self.most:
            # The next number of the thinner set, seen from the end of those added.
            self._next += self._step * (len(self.values) % 2)
            self.values = self.values[::2]
            self._step *= 2
