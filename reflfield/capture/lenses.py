r"""Lens models: ideal image coordinates to those behind the lens, and back.

Coordinates are normalised: ``(x, y) = (X/Z, Y/Z)`` before the lens, pixels less the principal
point over the focal length behind it. Coefficients come in OpenCV's order,
``k1, k2, p1, p2, k3, k4, k5, k6``. With ``r^2 = x^2 + y^2`` its perspective model is::

    g  = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
    x' = x g + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y g + p1 (r^2 + 2 y^2) + 2 p2 x y

and its fisheye model, with ``theta = atan(r)`` and no other coefficients than k1 .. k4::

    x' = x/r (theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9),  y' likewise
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from reflfield.util.late_import import LateImport

cv2: Any = LateImport("cv2")  # of fisheye lenses alone

Array = NDArray[np.float64]
Coefficients = tuple[float, ...]

NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

# Newton's method doubles the digits with every step: lenses in use converge in 5 steps.
NEWTON_STEPS = 30
# Residual, in normalised image coordinates, at which a pixel counts as inverted.
NEWTON_TOLERANCE = 1e-9
# Leading coefficients below this change nothing within any field of view, but upset the
# search for roots.
NEGLIGIBLE = 1e-14


def distort(ideal: Array, distortion: Coefficients) -> Array:
    """Apply the perspective lens model to normalised coordinates (n, 2).

    Examples
    --------
    Barrel distortion k1 = -0.1 at r = 1 pulls the point in by a tenth:

    >>> distort(np.array([[1.0, 0.0]]), (-0.1, 0, 0, 0, 0, 0))
    array([[0.9, 0. ]])
    """
    _, _, p1, p2, *_ = padded(distortion)
    numerator, denominator = _radial_polynomials(distortion)
    x, y = ideal.T
    r2 = x * x + y * y
    gain = numerator(r2) / denominator(r2)
    return np.stack(
        [
            x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * gain + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )


def undistort(distorted: Array, distortion: Coefficients) -> Array:
    """Invert `distort` by Newton's method; NaN where it has no inverse.

    Parameters
    ----------
    distorted : (n, 2) float
        Normalised coordinates behind the lens.
    distortion : tuple of up to 8 float
        Coefficients; those left out are 0.

    Returns
    -------
    (n, 2) float64
        Normalised coordinates before the lens, on the branch that contains the axis.

    Examples
    --------
    >>> undistort(np.array([[0.9, 0.0]]), (-0.1, 0, 0, 0, 0, 0)).round(12)
    array([[1., 0.]])
    """
    limit = largest_radius(distortion)
    converged = 4 * np.finfo(np.float64).eps * max(1.0, float(np.abs(distorted).max(initial=0)))
    with np.errstate(all="ignore"):
        ideal = distorted * np.minimum(1.0, 0.9 * limit / _radii(distorted))[:, None]
        for _ in range(NEWTON_STEPS):
            residual = distort(ideal, distortion) - distorted
            if np.max(np.abs(residual), initial=0.0) <= converged:
                break
            ideal = ideal - _solve_2x2(_jacobian(ideal, distortion), residual)
            # A step over the fold would land on the wrong branch.
            ideal = ideal * np.minimum(1.0, limit / _radii(ideal))[:, None]
        residual = np.abs(distort(ideal, distortion) - distorted).max(axis=1, initial=0.0)
        failed = ~(residual <= NEWTON_TOLERANCE * np.maximum(1.0, _radii(distorted)))
    ideal[failed] = np.nan
    return ideal


def largest_radius(distortion: Coefficients) -> float:
    """Radius up to which the radial part of `distort` grows, hence can be inverted.

    The first positive root of ``d(r g(r))/dr``, or the pole of `g`; inf if there is none.

    Examples
    --------
    ``r - r^3/3`` grows until r = 1:

    >>> largest_radius((-1 / 3, 0, 0, 0, 0, 0))
    1.0
    """
    numerator, denominator = _radial_polynomials(distortion)
    square = Polynomial([0.0, 1.0])
    slope = (numerator + 2 * square * numerator.deriv()) * denominator
    slope = slope - 2 * square * numerator * denominator.deriv()
    return float(np.sqrt(min(_first_root(slope), _first_root(denominator))))


def distort_fisheye(ideal: Array, distortion: Coefficients) -> Array:
    """Apply the fisheye lens model to normalised coordinates (n, 2).

    Examples
    --------
    At 45 degrees an equidistant lens has its image at pi / 4:

    >>> distort_fisheye(np.array([[1.0, 0.0]]), ()).round(6)
    array([[0.785398, 0.      ]])
    """
    if not len(ideal):
        return ideal.copy()
    points = np.ascontiguousarray(ideal, dtype=np.float64)[:, None]
    bent = cv2.fisheye.distortPoints(points, np.eye(3), _fisheye_coefficients(distortion))
    # OpenCV leaves infinite points without an answer of their own.
    return np.where(np.isfinite(ideal), bent[:, 0], np.nan)


def undistort_fisheye(distorted: Array, distortion: Coefficients) -> Array:
    """Invert `distort_fisheye`; NaN from 90 degrees off the axis on.

    Parameters
    ----------
    distorted : (n, 2) float
        Normalised coordinates behind the lens.
    distortion : tuple of up to 8 float
        Coefficients; those left out are 0.

    Returns
    -------
    (n, 2) float64
        Normalised coordinates before the lens.

    Examples
    --------
    >>> undistort_fisheye(np.array([[np.pi / 4, 0.0]]), ()).round(12)
    array([[1., 0.]])
    """
    if not len(distorted):
        return distorted.copy()
    points = np.ascontiguousarray(distorted, dtype=np.float64)[:, None]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, NEWTON_STEPS, 1e-15)
    ideal = cv2.fisheye.undistortPoints(
        points, np.eye(3), _fisheye_coefficients(distortion), criteria=criteria
    )[:, 0]
    # OpenCV clamps what has no inverse: an answer counts if it leads back.
    limit = largest_fisheye_radius(distortion)
    with np.errstate(all="ignore"):
        residual = np.abs(distort_fisheye(ideal, distortion) - distorted).max(axis=1)
        solved = (residual <= NEWTON_TOLERANCE) & (np.hypot(*ideal.T) < limit)
    return np.where(solved[:, None], ideal, np.nan)


def largest_fisheye_radius(distortion: Coefficients) -> float:
    """Radius ``tan(theta)`` up to which the fisheye model can be inverted; inf at 90 degrees.

    Examples
    --------
    ``theta - theta^3/3`` grows until theta = 1:

    >>> bool(abs(largest_fisheye_radius((-1 / 3,)) - np.tan(1.0)) < 1e-12)
    True
    """
    k1, k2, k3, k4 = _fisheye_coefficients(distortion)
    slope = Polynomial([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4])
    theta = float(np.sqrt(_first_root(slope)))
    return float(np.tan(theta)) if theta < np.pi / 2 else float("inf")


def padded(distortion: Coefficients) -> Coefficients:
    """All eight coefficients; those left out are 0."""
    return (*distortion, *(0.0,) * (len(NAMES) - len(distortion)))


def _radial_polynomials(distortion: Coefficients) -> tuple[Polynomial, Polynomial]:
    """Numerator and denominator of the gain `g`, as polynomials of r^2."""
    k1, k2, _, _, k3, k4, k5, k6 = padded(distortion)
    return Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, k4, k5, k6])


def _fisheye_coefficients(distortion: Coefficients) -> Array:
    k1, k2, _, _, k3, k4, _, _ = padded(distortion)
    return np.array([k1, k2, k3, k4])


def _first_root(polynomial: Polynomial) -> float:
    """Smallest positive real root; inf if there is none."""
    roots = polynomial.trim(NEGLIGIBLE).roots()
    real = roots[np.abs(roots.imag) < 1e-9 * np.abs(roots)].real
    return float(real[real > 0].min(initial=np.inf))


def _radii(image: Array) -> Array:
    return np.maximum(np.hypot(image[:, 0], image[:, 1]), np.finfo(np.float64).tiny)


def _jacobian(ideal: Array, distortion: Coefficients) -> Array:
    """(n, 2, 2) derivatives of `distort`."""
    _, _, p1, p2, *_ = padded(distortion)
    numerator, denominator = _radial_polynomials(distortion)
    x, y = ideal.T
    r2 = x * x + y * y
    gain = numerator(r2) / denominator(r2)
    # d gain / d r^2
    slope = (numerator.deriv()(r2) - gain * denominator.deriv()(r2)) / denominator(r2)
    cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    jacobian = np.zeros((len(ideal), 2, 2))
    jacobian[:, 0, 0] = gain + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    jacobian[:, 1, 1] = gain + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    jacobian[:, 0, 1] = jacobian[:, 1, 0] = cross
    return jacobian


def _solve_2x2(matrices: Array, right: Array) -> Array:
    """Cramer's rule; a singular matrix gives inf or NaN instead of an exception."""
    a, b = matrices[:, 0, 0], matrices[:, 0, 1]
    c, d = matrices[:, 1, 0], matrices[:, 1, 1]
    determinant = a * d - b * c
    x = (d * right[:, 0] - b * right[:, 1]) / determinant
    y = (a * right[:, 1] - c * right[:, 0]) / determinant
    return np.stack([x, y], axis=1)
