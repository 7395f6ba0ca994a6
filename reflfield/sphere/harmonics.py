r"""Real spherical harmonics.

Orthonormal on the sphere, built from complex harmonics with the
Condon-Shortley phase:

.. math::

    y_{\ell m} = \sqrt2\,(-1)^m\,\mathrm{Re}\,Y_\ell^m, \qquad
    y_{\ell,-m} = \sqrt2\,(-1)^m\,\mathrm{Im}\,Y_\ell^m \qquad (m > 0),

so degree 1 is proportional to (y, z, x). Coefficients are stored flat, index
``ell * ell + ell + m``. A band limit `L` is exclusive: degrees 0 .. L - 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.errors import InputError
from reflfield.util.validation import unit_directions

MAX_BAND_LIMIT = 257


def n_coefficients(band_limit: int) -> int:
    """Number of coefficients of degrees 0 .. `band_limit` - 1.

    Examples
    --------
    >>> n_coefficients(8)
    64
    """
    return band_limit**2


def check_band_limit(name: str, band_limit: int, lowest: int = 1, highest: int = 16) -> None:
    """Demand a band limit in a range.

    Raises
    ------
    InputError
        If it is not an integer or lies outside ``lowest .. highest``.

    Examples
    --------
    >>> check_band_limit("band_limit", 8)
    """
    whole = isinstance(band_limit, (int, np.integer)) and not isinstance(band_limit, bool)
    if not whole or not lowest <= band_limit <= highest:
        raise InputError(
            f"{name}: expected an integer from {lowest} to {highest}, received {band_limit!r}"
        )


def real_harmonics(directions: ArrayLike, band_limit: int) -> NDArray[np.float64]:
    r"""Values of all real harmonics below a band limit.

    Parameters
    ----------
    directions : (n, 3) array_like
        Unit vectors.
    band_limit : int
        Degrees 0 .. `band_limit` - 1, from 1 to 257.

    Returns
    -------
    (n, band_limit**2) float64

    Raises
    ------
    ShapeError
        If the shape is not (n, 3).
    InputError
        If a direction is not of unit length or the band limit is out of range.

    Notes
    -----
    Legendre functions are normalised before the recursion and freed of
    ``sin(theta)**m``, which multiplies the azimuth as a polynomial of (x, y):
    nothing overflows and the poles are not special.

    Examples
    --------
    Degree 1 is the direction itself, up to :math:`\sqrt{3 / 4\pi}`:

    >>> y = real_harmonics([[0.6, 0.0, 0.8]], 2)[0]
    >>> (y[1:] / np.sqrt(3 / (4 * np.pi))).round(12)
    array([0. , 0.8, 0.6])
    """
    check_band_limit("band_limit", band_limit, highest=MAX_BAND_LIMIT)
    x, y, z = unit_directions("directions", directions).T
    values = np.zeros((len(z), n_coefficients(band_limit)))
    cosine, sine = np.ones_like(z), np.zeros_like(z)
    diagonal = np.sqrt(1.0 / (4.0 * np.pi))
    for m in range(band_limit):
        if m > 0:
            # (x + i y)^m = sin(theta)^m exp(i m phi)
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
            diagonal *= np.sqrt((2.0 * m + 1.0) / (2.0 * m))
        scale = 1.0 if m == 0 else np.sqrt(2.0)
        for ell, legendre in enumerate(_reduced_legendre(z, m, band_limit, diagonal), start=m):
            values[:, ell * ell + ell + m] = scale * legendre * cosine
            if m > 0:
                values[:, ell * ell + ell - m] = scale * legendre * sine
    return values


def _reduced_legendre(
    z: NDArray[np.float64], m: int, band_limit: int, diagonal: float
) -> list[NDArray[np.float64]]:
    """Normalised Legendre functions of order m over sin(theta)^m, degrees m .. L - 1."""
    rows = [np.full_like(z, diagonal)]
    if m + 1 < band_limit:
        rows.append(np.sqrt(2.0 * m + 3.0) * z * diagonal)
    for ell in range(m + 2, band_limit):
        a = np.sqrt((4.0 * ell * ell - 1.0) / (ell * ell - m * m))
        b = np.sqrt(((ell - 1.0) ** 2 - m * m) / (4.0 * (ell - 1.0) ** 2 - 1.0))
        rows.append(a * (z * rows[-1] - b * rows[-2]))
    return rows
