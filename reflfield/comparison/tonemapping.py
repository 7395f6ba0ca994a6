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
