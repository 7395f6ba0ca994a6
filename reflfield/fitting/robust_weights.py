"""Weights of residuals: by what a display shows, and bounded for outliers."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from reflfield.field.half_vector import FAST

# Weighted residuals beyond these count in proportion (Huber): of coefficients, of tables.
HUBER, TABLE_HUBER = np.float32(0.1), np.float32(0.15)
# Added to values, so that black weighs what the slope of the sRGB curve is there, 12.92.
DARKEST = np.float32(0.003)


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def is_evidence(value: Any, at_least: Any, predicted: Any) -> Any:
    """Whether a value says something against a prediction: not one that is unknown (NaN).

    One that is a bound from below (`at_least`) says nothing against what is above it.
    """
    return not np.isnan(value) and not (at_least and predicted >= value)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def display_weight(value: Any) -> Any:
    """Weight of a residual at a value in units of white.

    About the slope of the sRGB curve, which is bounded in the dark, and falling above white.
    """
    y = max(value, np.float32(0.0))
    weight = np.float32(0.45) / (y + DARKEST) ** np.float32(0.58)
    if y > np.float32(1.0):
        weight /= y ** np.float32(0.7)
    return weight


@numba.njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def squared_weight(observed: Any, predicted: Any, huber: Any) -> Any:
    """Weight of the squared residual of an observed and a predicted value."""
    weight = display_weight(np.float32(0.5) * (observed + predicted))
    size = abs(weight * (observed - predicted))
    squared = weight * weight
    return squared * huber / size if size > huber else squared
