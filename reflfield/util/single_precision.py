"""Elementary functions of single precision for kernels, as polynomials.

The compiler can turn loops over them into vector instructions, which it cannot where a loop
calls a library. Coefficients are those of Chebyshev's series, fitted when this module is
imported; results err by two units in the last place, at most, of the largest value (of the
angle 90 degrees, of the logarithm what its exponent is, of the exponential itself).
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.polynomial import Chebyshev, Polynomial
from numpy.typing import NDArray

# What the compiler may do to sums; NaN, which marks values not measured, stays NaN.
FAST = {"reassoc", "contract", "arcp", "nsz"}

_QUARTER_TURN = np.float32(np.pi / 2)
_LN_2, _PER_LN_2 = np.float32(np.log(2.0)), np.float32(1.0 / np.log(2.0))
# Bits of a mantissa; those of the least one, the root of a half; of 1, by its exponent.
_MANTISSA_BITS, _MANTISSA = np.int32(23), np.int32((1 << 23) - 1)
_LEAST_MANTISSA = np.float32(0.5**0.5).view(np.int32)
_BIAS, _LEAST_EXPONENT = np.int32(127), np.int32(-126)
_ONE, _HALF = np.float32(1.0), np.float32(0.5)


def _series(x: NDArray[np.float64], y: NDArray[np.float64], degree: int) -> tuple[Any, ...]:
    """Coefficients in single precision of a polynomial, of ascending degree."""
    fitted = Chebyshev.fit(x, y, degree).convert(kind=Polynomial)
    return tuple(np.float32(c) for c in fitted.coef)


def _arcsine_series() -> tuple[Any, ...]:
    """Of (arcsin x - x) / x^3 in x^2, to the sine of 45 degrees."""
    square = np.maximum(0.25 * (1.0 + np.cos(np.linspace(0.0, np.pi, 999))), 1e-4)
    x = np.sqrt(square)
    return _series(square, (np.arcsin(x) - x) / x**3, 6)


def _logarithm_series() -> tuple[Any, ...]:
    """Of log(1 + z) / z between the root of a half and that of two."""
    z = np.linspace(np.sqrt(0.5), np.sqrt(2.0), 1000) - 1.0
    return _series(z, np.log1p(z) / z, 8)


def _exponential_series() -> tuple[Any, ...]:
    """Of exp(x) within half of the logarithm of two."""
    x = np.linspace(-0.5, 0.5, 1000) * np.log(2.0)
    return _series(x, np.exp(x), 6)


_A0, _A1, _A2, _A3, _A4, _A5, _A6 = _arcsine_series()
_L0, _L1, _L2, _L3, _L4, _L5, _L6, _L7, _L8 = _logarithm_series()
_E0, _E1, _E2, _E3, _E4, _E5, _E6 = _exponential_series()

# Typed by numba; to mypy their scalars are Any.


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def angle_of(sine: Any, cosine: Any) -> Any:
    """Angle between 0 and 90 degrees with this sine and cosine, radians.

    Examples
    --------
    >>> sine, cosine = np.float32(0.5), np.float32(0.75**0.5)
    >>> round(float(np.degrees(angle_of(sine, cosine))), 3)
    30.0
    """
    x = min(sine, cosine)
    q = x * x
    p = (((((_A6 * q + _A5) * q + _A4) * q + _A3) * q + _A2) * q + _A1) * q + _A0
    angle = x + x * q * p
    return angle if sine < cosine else _QUARTER_TURN - angle


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def logarithm(x: Any) -> Any:
    """Natural logarithm of a normal number above zero."""
    bits = np.float32(x).view(np.int32) - _LEAST_MANTISSA
    exponent = np.float32(bits >> _MANTISSA_BITS)
    z = np.int32((bits & _MANTISSA) + _LEAST_MANTISSA).view(np.float32) - _ONE
    p = (((_L8 * z + _L7) * z + _L6) * z + _L5) * z + _L4
    p = (((p * z + _L3) * z + _L2) * z + _L1) * z + _L0
    return exponent * _LN_2 + z * p


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def exponential(x: Any) -> Any:
    """Exponential; not below the least normal number, nor above half of the largest."""
    whole = np.floor(x * _PER_LN_2 + _HALF)
    exponent = min(max(np.int32(whole), _LEAST_EXPONENT), _BIAS - np.int32(1))
    rest = x - whole * _LN_2
    p = (((((_E6 * rest + _E5) * rest + _E4) * rest + _E3) * rest + _E2) * rest + _E1) * rest
    return (p + _E0) * np.int32((exponent + _BIAS) << _MANTISSA_BITS).view(np.float32)
