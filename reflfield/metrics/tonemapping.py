"""From linear radiance to displayed values: one exposure for all pictures.

The lights are known, so nothing is rescaled per picture: every photograph and
every relit picture of a comparison is multiplied by the same exposure.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.capture.encoding import encode_srgb

# Rec. 709: the weights of the colour space that all radiance is stored in.
LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)


def luminance(image: ArrayLike) -> NDArray[np.float64]:
    """Relative luminance of linear Rec. 709 colours.

    Parameters
    ----------
    image : (..., 3) array_like
        Linear radiance.

    Returns
    -------
    (...) float64

    Examples
    --------
    >>> float(luminance([1.0, 0.0, 0.0]))
    0.2126
    """
    return np.asarray(image, dtype=np.float64) @ np.array(LUMINANCE_WEIGHTS)


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
