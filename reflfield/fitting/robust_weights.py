"""Weights of residuals: by what a display shows, and bounded for outliers."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from reflfield.util.single_precision import FAST, exponential, logarithm

# Weighted residuals beyond these count in proportion (Huber): of coefficients, of tables.
HUBER, TABLE_HUBER = np.float32(0.1), np.float32(0.15)
# Added to values, so that black weighs what the slope of the sRGB curve is there, 12.92.
DARKEST = np.float32(0.003)
# Of the squared weight: at 1, the exponents of y, and of y above white.
_SCALE, _SLOPE, _BEYOND = np.float32(0.45**2), np.float32(-2 * 0.58), np.float32(-2 * 0.7)


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def is_evidence(value: Any, at_least: Any, predicted: Any) -> Any:
    """Whether a value says something against a prediction: not one that is unknown (NaN).

    One that is a bound from below (`at_least`) says nothing against what is above it.
    """
    return not np.isnan(value) and not (at_least and predicted >= value)


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def squared_display_weight(value: Any) -> Any:
    """Square of the weight of a residual at a value in units of white.

    About the slope of the sRGB curve, .45 (y + .003)^-.58, which is bounded in the dark, and
    times y^-.7 above white.
    """
    y = max(value, np.float32(0.0))
    falling = _SLOPE * logarithm(y + DARKEST) + _BEYOND * logarithm(max(y, np.float32(1.0)))
    return _SCALE * exponential(falling)


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def squared_weight(observed: Any, predicted: Any, huber: Any) -> Any:
    """Weight of the squared residual of an observed and a predicted value."""
    squared = squared_display_weight(np.float32(0.5) * (observed + predicted))
    size = np.sqrt(squared) * abs(observed - predicted)
    return squared * huber / max(size, huber)
