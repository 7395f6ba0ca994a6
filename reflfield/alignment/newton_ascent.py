"""Newton ascent on SO(3): from a rotation nearby to the maximum of the correlation."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.correlation import (
    ComplexSeries,
    DegreeArrays,
    complex_spectrum,
    degree_arrays,
    degrees_of,
    derivatives,
    empty_series,
)
from reflfield.alignment.rotation_steps import (
    copy_matrix,
    copy_vector,
    rotate_right,
    scale_vector,
)

SHORTEST_STEP = 1e-4
FIRST_TRUST_RADIUS = 0.25
# The second-order expansion predicts the height of a maximum this near, but for the rise
# times so many times the distance.
RELIABLE_STEP = 0.25
ALLOWANCE = 3.0


class AscentLimits(NamedTuple):
    """Where a Newton ascent stops.

    Parameters
    ----------
    n_steps : int
        Evaluations after the first at most.
    short : float
        Length of a step that is taken without an evaluation and ends the ascent.
    lowest_z : float
        Least `R[2, 2]`; steps are cut there.
    pruned_below : float
        The ascent is pruned once its maximum cannot reach this value.
    """

    n_steps: int
    short: float
    lowest_z: float
    pruned_below: float


@numba.njit(cache=True, nogil=True)
def _newton_step(
    f: NDArray[np.float64], radius: float, step: NDArray[np.float64]
) -> tuple[float, float]:
    """Uphill step of at most `radius`: Newton's where concave, else damped.

    Its length and, where the function is not concave, the most that its second-order
    expansion rises within the first trust radius; else 0.
    """
    xx, yy, zz, xy, xz, yz = -f[4], -f[5], -f[6], -f[7], -f[8], -f[9]
    # Lowest eigenvalue of the symmetric 3x3 matrix, by its trigonometric solution.
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    lowest = mean
    if spread > 0.0:
        det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
        ratio = min(max(det / (2.0 * spread**3), -1.0), 1.0)
        lowest = mean + 2.0 * spread * np.cos(np.arccos(ratio) / 3.0 + 2.0 * np.pi / 3.0)
    gradient = np.sqrt(f[1] ** 2 + f[2] ** 2 + f[3] ** 2)
    # Damping that makes the matrix positive and keeps the step inside the radius.
    floor = 1e-6 * (abs(mean) + spread) + 1e-300
    damping = max(0.0, floor - lowest, gradient / radius - lowest if lowest < floor else 0.0)
    xx, yy, zz = xx + damping, yy + damping, zz + damping
    c0, c1, c2 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    det = xx * c0 + xy * c1 + xz * c2
    if not det > 0.0:
        scale_vector(step, 3, 0.0)
        return 0.0, 0.0
    step[0] = (c0 * f[1] + c1 * f[2] + c2 * f[3]) / det
    step[1] = (c1 * f[1] + (xx * zz - xz * xz) * f[2] + (xy * xz - xx * yz) * f[3]) / det
    step[2] = (c2 * f[1] + (xy * xz - xx * yz) * f[2] + (xx * yy - xy * xy) * f[3]) / det
    length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    if length > radius:
        scale_vector(step, 3, radius / length)
        length = radius
    if damping == 0.0:
        return length, 0.0
    return length, FIRST_TRUST_RADIUS * (gradient - 0.5 * FIRST_TRUST_RADIUS * lowest)


@numba.njit(cache=True, nogil=True)
def _try_step(
    rotation: NDArray[np.float64],
    step: NDArray[np.float64],
    length: float,
    lowest_z: float,
    trial: NDArray[np.float64],
) -> float:
    """Take the step, halved until the tilt is allowed; its length."""
    rotate_right(rotation, step, trial)
    while trial[2, 2] < lowest_z and length > SHORTEST_STEP:
        scale_vector(step, 3, 0.5)
        length *= 0.5
        rotate_right(rotation, step, trial)
    return length


@numba.njit(cache=True, nogil=True)
def _predicted(f: NDArray[np.float64], step: NDArray[np.float64]) -> float:
    """Value of the second-order expansion after a step."""
    x, y, z = step[0], step[1], step[2]
    gain = f[1] * x + f[2] * y + f[3] * z
    gain += 0.5 * (f[4] * x * x + f[5] * y * y + f[6] * z * z)
    return f[0] + gain + f[7] * x * y + f[8] * x * z + f[9] * y * z


@numba.njit(cache=True, nogil=True)
def ascend(
    rotation: NDArray[np.float64],
    series: ComplexSeries,
    limits: AscentLimits,
    maximum: NDArray[np.float64],
) -> None:
    """Move one rotation uphill in place; its derivatives go to `maximum` (11,).

    The first entry of `maximum` is the value at the end (to second order where the last step
    was not evaluated), the last one the length of the last step.
    """
    n_steps, short, lowest_z, pruned_below = limits
    f, trial, step = np.zeros(10), np.zeros((3, 3)), np.zeros(3)
    radius, length, value = FIRST_TRUST_RADIUS, 0.0, -np.inf
    copy_matrix(rotation, trial)
    for _ in range(n_steps + 1):
        derivatives(trial, series, f)
        if f[0] > value:
            if length > 0.9 * radius:
                radius = min(2.0 * radius, 0.5)
            copy_matrix(trial, rotation)
            value = f[0]
            copy_vector(f, maximum)
        else:
            radius = 0.25 * length
        length, rise = _newton_step(maximum, radius, step)
        length = _try_step(rotation, step, length, lowest_z, trial)
        if length < short:
            # Too short to be worth an evaluation, but free to take.
            if trial[2, 2] >= lowest_z:
                copy_matrix(trial, rotation)
                maximum[0] = max(value, _predicted(maximum, step))
            break
        # A short step predicts the maximum only where the function is concave: from a saddle,
        # where the approach with few degrees often ends, most of the rise is still to come.
        if length < RELIABLE_STEP:
            gain = _predicted(maximum, step) - value
            if value + max(gain * (1.0 + ALLOWANCE * length), rise) < pruned_below:
                maximum[0] = value + gain
                break
    maximum[10] = length


@numba.njit(cache=True, nogil=True)
def _ascend_all(
    series: NDArray[np.floating],
    rows: NDArray[np.int64],
    rotations: NDArray[np.float64],
    limits: AscentLimits,
    tables: DegreeArrays,
    maxima: NDArray[np.float64],
) -> None:
    """Move each rotation uphill in place; see `ascend`.

    Rotation i ascends on the series ``rows[i]``; equal rows are best kept together.
    """
    own = empty_series(tables, series)
    for i in range(rows.shape[0]):
        if i == 0 or rows[i] != rows[i - 1]:
            complex_spectrum(series[rows[i]], own)
        ascend(rotations[i], own, limits, maxima[i])


def follow(
    series: NDArray[np.floating],
    rows: NDArray[np.int64],
    rotations: NDArray[np.float64],
    n_steps: int,
    max_tilt: float | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Newton ascent from each rotation with all degrees.

    Parameters
    ----------
    series : (n, k) float
        See `reflfield.alignment.correlation.spectrum`.
    rows : (c,) int64
        Series that each rotation ascends on.
    rotations : (c, 3, 3) float64
        Where to begin.
    n_steps : int
        0: evaluate only.
    max_tilt : float, optional
        Radians.

    Returns
    -------
    rotations : (c, 3, 3) float64
    maxima : (c, 11) float64
        Value, gradient, Hessian (xx, yy, zz, xy, xz, yz), length of the last step.
    """
    moved = np.ascontiguousarray(rotations, dtype=np.float64).copy()
    maxima = np.zeros((len(moved), 11))
    short = SHORTEST_STEP if n_steps > 0 else 0.0
    limits = AscentLimits(n_steps, short, lowest_z_of(max_tilt), -np.inf)
    rows = np.ascontiguousarray(rows, dtype=np.int64)
    tables = degree_arrays(degrees_of(series), str(series.dtype))
    _ascend_all(series, rows, moved, limits, tables, maxima)
    return moved, maxima


def lowest_z_of(max_tilt: float | None) -> float:
    """Least allowed `R[2, 2]`; below -1 if every tilt is allowed."""
    return -2.0 if max_tilt is None else float(np.cos(max_tilt))
