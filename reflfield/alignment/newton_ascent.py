"""Newton steps on SO(3): from a rotation nearby to the peak of the correlation."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.correlation import complex_spectrum, derivatives
from reflfield.sphere.wigner import block_offsets, degree_tables

# Two rotations closer than this are the same peak.
PEAK_DISTANCE = np.deg2rad(15.0)
# Before all degrees are used, each peak is approached with those below this.
APPROACH_DEGREES = 8
APPROACH_STEPS = 3
# Half a coarse spacing is gone after a step this short.
APPROACHED_STEP = 0.1
CLIMBING_STEPS = 12
# A step of Newton's this short leaves an error of a few of its squares: .01 degrees.
CONVERGED_STEP = 6e-3
SHORTEST_STEP = 1e-4
FIRST_TRUST_RADIUS = 0.25
# Peaks that rise less than this share of the highest above the mean are given up.
HOPEFUL = 0.8
# The second-order expansion foretells the height of a peak this near, but for the rise times
# so many times the distance.
RELIABLE_STEP = 0.25
ALLOWANCE = 3.0
EQUAL_SHARE = 1e-3
# Cosine of an angle within which two candidates begin at the same rotation.
SAME_START = np.cos(1e-3)


DegreeArrays = tuple[
    NDArray[np.int64], NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]
]


# Loops in place of array expressions: those compile seconds of shape checks and messages.
@numba.njit(cache=True, nogil=True)
def copy_matrix(source: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Entries of a 3x3 matrix into another."""
    for i in range(3):
        for k in range(3):
            out[i, k] = source[i, k]


@numba.njit(cache=True, nogil=True)
def half_turn_about_z(rotation: NDArray[np.float64]) -> None:
    """Turn a rotation of the target by half a turn about z, in place."""
    for i in range(3):
        rotation[i, 0], rotation[i, 1] = -rotation[i, 0], -rotation[i, 1]


@numba.njit(cache=True, nogil=True)
def scale(vector: NDArray[np.float64], n: int, factor: float) -> None:
    """Multiply the first n entries in place."""
    for i in range(n):
        vector[i] *= factor


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
        scale(step, 3, 0.0)
        return 0.0, 0.0
    step[0] = (c0 * f[1] + c1 * f[2] + c2 * f[3]) / det
    step[1] = (c1 * f[1] + (xx * zz - xz * xz) * f[2] + (xy * xz - xx * yz) * f[3]) / det
    step[2] = (c2 * f[1] + (xy * xz - xx * yz) * f[2] + (xx * yy - xy * xy) * f[3]) / det
    length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    if length > radius:
        scale(step, 3, radius / length)
        length = radius
    if damping == 0.0:
        return length, 0.0
    return length, FIRST_TRUST_RADIUS * (gradient - 0.5 * FIRST_TRUST_RADIUS * lowest)


@numba.njit(cache=True, nogil=True)
def turned(r: NDArray[np.float64], w: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """``r @ exp(w)`` for a small rotation vector, through its quaternion."""
    angle = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    scale = 0.5 - angle * angle / 48.0 if angle < 1e-3 else np.sin(0.5 * angle) / angle
    q0, q1, q2, q3 = np.cos(0.5 * angle), w[0] * scale, w[1] * scale, w[2] * scale
    xx, xy, xz = 1.0 - 2.0 * (q2 * q2 + q3 * q3), q1 * q2 - q0 * q3, q1 * q3 + q0 * q2
    yx, yy, yz = q1 * q2 + q0 * q3, 1.0 - 2.0 * (q1 * q1 + q3 * q3), q2 * q3 - q0 * q1
    zx, zy, zz = q1 * q3 - q0 * q2, q2 * q3 + q0 * q1, 1.0 - 2.0 * (q1 * q1 + q2 * q2)
    for i in range(3):
        x, y, z = r[i, 0], r[i, 1], r[i, 2]
        out[i, 0] = x * xx + 2.0 * (y * yx + z * zx)
        out[i, 1] = y * yy + 2.0 * (x * xy + z * zy)
        out[i, 2] = z * zz + 2.0 * (x * xz + y * yz)


@numba.njit(cache=True, nogil=True)
def _try_step(
    rotation: NDArray[np.float64],
    step: NDArray[np.float64],
    length: float,
    lowest_z: float,
    trial: NDArray[np.float64],
) -> float:
    """Take the step, halved until the tilt is allowed; its length."""
    turned(rotation, step, trial)
    while trial[2, 2] < lowest_z and length > SHORTEST_STEP:
        scale(step, 3, 0.5)
        length *= 0.5
        turned(rotation, step, trial)
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
    re: NDArray[np.floating],
    im: NDArray[np.floating],
    tables: DegreeArrays,
    scratch: tuple[NDArray[np.floating], NDArray[np.floating]],
    limits: tuple[int, float, float, float],
    found: NDArray[np.float64],
) -> None:
    """Move one rotation uphill in place; its derivatives go to `found` (11,).

    `limits`: evaluations after the first at most; length of a step that is taken without
    one and ends the climb; least `R[2, 2]`, where steps are cut; value that must stay
    within reach, or the climb is given up. The first entry of `found` is the value
    at the end (to second order where the last step was not evaluated), the last one the length
    of the last step.
    """
    n_steps, short, lowest_z, hoped = limits
    f, trial, step = np.zeros(10), np.zeros((3, 3)), np.zeros(3)
    radius, length, value = FIRST_TRUST_RADIUS, 0.0, -np.inf
    copy_matrix(rotation, trial)
    for _ in range(n_steps + 1):
        derivatives(trial, re, im, *tables, *scratch, f)
        if f[0] > value:
            if length > 0.9 * radius:
                radius = min(2.0 * radius, 0.5)
            copy_matrix(trial, rotation)
            value = f[0]
            found[:10] = f
        else:
            radius = 0.25 * length
        length, rise = _newton_step(found, radius, step)
        length = _try_step(rotation, step, length, lowest_z, trial)
        if length < short:
            # Too short to be worth an evaluation, but free to take.
            if trial[2, 2] >= lowest_z:
                copy_matrix(trial, rotation)
                found[0] = max(value, _predicted(found, step))
            break
        # A short step foretells the peak only where the function is concave: from a saddle,
        # where the approach with few degrees often ends, most of the rise is still to come.
        if length < RELIABLE_STEP:
            gain = _predicted(found, step) - value
            if value + max(gain * (1.0 + ALLOWANCE * length), rise) < hoped:
                found[0] = value + gain
                break
    found[10] = length


@numba.njit(cache=True, nogil=True)
def climb(
    series: NDArray[np.floating],
    rows: NDArray[np.int64],
    rotations: NDArray[np.float64],
    limits: tuple[int, float, float, float],
    tables: DegreeArrays,
    found: NDArray[np.float64],
) -> None:
    """Move each rotation uphill in place; see `ascend`.

    Rotation i climbs on the series ``rows[i]``; equal rows are best kept together.
    """
    like, n_entries = series.dtype, tables[1].shape[1]
    re, im = np.zeros(n_entries, like), np.zeros(n_entries, like)
    scratch = (np.zeros(n_entries, like), np.zeros((2, tables[2].size), like))
    for i in range(rows.shape[0]):
        if i == 0 or rows[i] != rows[i - 1]:
            complex_spectrum(series[rows[i]], tables[0], re, im)
        ascend(rotations[i], re, im, tables, scratch, limits, found[i])


@numba.njit(cache=True, nogil=True)
def _cosine_between(a: NDArray[np.float64], b: NDArray[np.float64], half_turn: bool) -> float:
    """Cosine of the angle between two rotations, or, if larger, with b half turned about z."""
    x, y, z = 0.0, 0.0, 0.0
    for i in range(3):
        x += a[i, 0] * b[i, 0]
        y += a[i, 1] * b[i, 1]
        z += a[i, 2] * b[i, 2]
    nearest = max(x + y + z, z - x - y) if half_turn else x + y + z
    return 0.5 * (nearest - 1.0)


@numba.njit(cache=True, nogil=True)
def _next_hopeful(
    hopes: NDArray[np.float64], done: NDArray[np.bool_], mean: float, best: float
) -> int:
    """Most promising candidate not yet done, -1 if none comes near the best."""
    choice = -1
    for c in range(hopes.shape[0]):
        if not done[c] and (choice < 0 or hopes[c] > hopes[choice]):
            choice = c
    hopeful = choice >= 0 and hopes[choice] - mean >= HOPEFUL * (best - mean)
    return choice if hopeful or not np.any(done) else -1


@numba.njit(cache=True, nogil=True)
def _already_there(
    rotations: NDArray[np.float64],
    done: NDArray[np.bool_],
    values: NDArray[np.float64],
    c: int,
    symmetric: bool,
) -> bool:
    """Whether a climbed candidate ended where this one heads; takes over its value then.

    A symmetric series is the same where a candidate is half turned about z.
    """
    near = np.cos(0.5 * PEAK_DISTANCE)
    for other in range(len(values)):
        if done[other] and _cosine_between(rotations[c], rotations[other], symmetric) > near:
            _copy_nearest(rotations[other], symmetric, rotations[c])
            values[c] = values[other]
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _copy_nearest(
    source: NDArray[np.float64], half_turn: bool, out: NDArray[np.float64]
) -> None:
    """A rotation, or it half turned about z if that is nearer, into `out`."""
    x, y = 0.0, 0.0
    for i in range(3):
        x += source[i, 0] * out[i, 0]
        y += source[i, 1] * out[i, 1]
    copy_matrix(source, out)
    if half_turn and x + y < 0.0:
        half_turn_about_z(out)


@numba.njit(cache=True, nogil=True)
def _partner(starts: NDArray[np.float64], c: int) -> int:
    """Earlier candidate that begins where this one does, but for a half turn about z; or -1."""
    for other in range(c):
        if _cosine_between(starts[c], starts[other], True) > SAME_START:
            return other
    return -1


@numba.njit(cache=True, nogil=True)
def _highest_elsewhere(
    rotations: NDArray[np.float64],
    values: NDArray[np.float64],
    best: NDArray[np.float64],
    half_turn: bool,
) -> float:
    """Highest value of the candidates that ended at another peak than the best."""
    highest = -np.inf
    for c in range(len(values)):
        if _cosine_between(rotations[c], best, half_turn) < np.cos(PEAK_DISTANCE):
            highest = max(highest, values[c])
    return highest


# What `ascend` climbs on: the complex series, tables of its degrees, scratch.
Climbed = tuple[
    NDArray[np.floating],
    NDArray[np.floating],
    DegreeArrays,
    tuple[NDArray[np.floating], NDArray[np.floating]],
]


@numba.njit(cache=True, nogil=True, inline="always")
def _approach(
    on: Climbed,
    mean: float,
    lowest_z: float,
    symmetric: bool,
    mine: NDArray[np.float64],
    values: NDArray[np.float64],
) -> float:
    """Move the candidates towards their peaks; the value of the highest."""
    re, im, tables, scratch = on
    starts = mine.copy() if symmetric else mine
    at, top = np.zeros(11), -np.inf
    for c in range(len(mine)):
        partner = _partner(starts, c) if symmetric else -1
        if partner >= 0:
            _copy_nearest(mine[partner], True, mine[c])
            values[c] = values[partner]
            continue
        hoped = mean + HOPEFUL * (top - mean)
        limits = (APPROACH_STEPS, APPROACHED_STEP, lowest_z, hoped)
        ascend(mine[c], re, im, tables, scratch, limits, at)
        values[c] = at[0]
        top = max(top, at[0])
    return top


@numba.njit(cache=True, nogil=True, inline="always")
def _climb_hopeful(
    on: Climbed,
    levels: tuple[float, float],
    lowest_z: float,
    symmetric: bool,
    mine: NDArray[np.float64],
    values: NDArray[np.float64],
    best: NDArray[np.float64],
    found: NDArray[np.float64],
) -> None:
    """Climb candidates, from the most promising on, while they may still be the best.

    `levels`: the mean of the series, and the highest value so far.
    """
    re, im, tables, scratch = on
    mean, top = levels
    hopes, done, at = values.copy(), np.zeros(len(mine), np.bool_), np.zeros(11)
    found[0] = -np.inf
    while True:
        c = _next_hopeful(hopes, done, mean, top)
        if c < 0:
            break
        if not _already_there(mine, done, values, c, symmetric):
            # A peak that is equal but for rounding, as symmetry makes them, is no better.
            hoped = found[0] + EQUAL_SHARE * (found[0] - mean)
            limits = (CLIMBING_STEPS, CONVERGED_STEP, lowest_z, hoped)
            ascend(mine[c], re, im, tables, scratch, limits, at)
            values[c] = at[0]
            if at[0] > hoped:
                found[:] = at
                copy_matrix(mine[c], best)
        done[c] = True


@numba.njit(cache=True, nogil=True, inline="always")
def _look_at_other_side(
    on: Climbed,
    lowest_z: float,
    mine: NDArray[np.float64],
    values: NDArray[np.float64],
    best: NDArray[np.float64],
    found: NDArray[np.float64],
) -> None:
    """Climb from the best half turned about z; what little the sides differ by decides."""
    re, im, tables, scratch = on
    at, other = np.zeros(11), best.copy()
    half_turn_about_z(other)
    begun = other.copy()
    limits = (CLIMBING_STEPS, CONVERGED_STEP, lowest_z, found[0])
    ascend(other, re, im, tables, scratch, limits, at)
    for c in range(len(mine)):
        if _cosine_between(mine[c], begun, False) > np.cos(0.5 * PEAK_DISTANCE):
            values[c] = at[0]
    if at[0] > found[0]:
        found[:] = at
        copy_matrix(other, best)


@numba.njit(cache=True, nogil=True)
def climb_best(
    series: NDArray[np.floating],
    rows: NDArray[np.int64],
    first: NDArray[np.int64],
    rotations: NDArray[np.float64],
    lowest_z: float,
    half_turns: tuple[bool, bool],
    low: DegreeArrays,
    full: DegreeArrays,
    best: NDArray[np.float64],
    found: NDArray[np.float64],
    rival: NDArray[np.float64],
) -> None:
    """Best peak of each series, from candidates of which only the hopeful are climbed.

    Candidates ``first[i] .. first[i + 1]`` belong to the series ``rows[i]``. All are
    approached with the low degrees; then, from the most promising on, climbed with
    all degrees while they may still be the best. `best` (k, 3, 3) receives the rotations,
    `found` (k, 11) their derivatives, and `rival` (k,) the highest value that ended elsewhere.

    `half_turns`: whether rotations that differ by a half turn about z count as one in
    `rival`; and whether the series hardly change with it: of two such candidates only one is
    climbed, and both sides of the best are looked at in the end.
    """
    half_turn, symmetric = half_turns
    like, n_entries, n_low = series.dtype, full[1].shape[1], low[1].shape[1]
    re, im = np.zeros(n_entries, like), np.zeros(n_entries, like)
    re_low, im_low = np.zeros(n_low, like), np.zeros(n_low, like)
    scratch = (np.zeros(n_entries, like), np.zeros((2, full[2].size), like))
    scratch_low = (np.zeros(n_low, like), np.zeros((2, low[2].size), like))
    on, on_low = (re, im, full, scratch), (re_low, im_low, low, scratch_low)
    for i in range(rows.shape[0]):
        mine = rotations[first[i] : first[i + 1]]
        values, mean = np.zeros(len(mine)), float(series[rows[i], 0])
        complex_spectrum(series[rows[i]], low[0], re_low, im_low)
        top = _approach(on_low, mean, lowest_z, symmetric, mine, values)
        complex_spectrum(series[rows[i]], full[0], re, im)
        levels = (mean, top)
        _climb_hopeful(on, levels, lowest_z, symmetric, mine, values, best[i], found[i])
        if symmetric:
            _look_at_other_side(on, lowest_z, mine, values, best[i], found[i])
        rival[i] = _highest_elsewhere(mine, values, best[i], half_turn)


def degree_arrays(n_degrees: int, dtype: str) -> DegreeArrays:
    """Tables of the recursion as the kernels take them."""
    tables = degree_tables(n_degrees, dtype)
    return tables.row_start, tables.recursion, tables.edge, tables.ladder


def follow(
    series: NDArray[np.floating],
    rows: NDArray[np.int64],
    rotations: NDArray[np.float64],
    n_steps: int,
    max_tilt: float | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Climb from each rotation with all degrees.

    Parameters
    ----------
    series : (n, k) float
        See `reflfield.alignment.correlation.spectrum`.
    rows : (c,) int64
        Series that each rotation climbs on.
    rotations : (c, 3, 3) float64
        Where to begin.
    n_steps : int
        0: evaluate only.
    max_tilt : float, optional
        Radians.

    Returns
    -------
    rotations : (c, 3, 3) float64
    found : (c, 11) float64
        Value, gradient, Hessian (xx, yy, zz, xy, xz, yz), length of the last step.
    """
    moved = np.ascontiguousarray(rotations, dtype=np.float64).copy()
    found = np.zeros((len(moved), 11))
    short = SHORTEST_STEP if n_steps > 0 else 0.0
    limits = (n_steps, short, lowest_z_of(max_tilt), -np.inf)
    rows = np.ascontiguousarray(rows, dtype=np.int64)
    tables = degree_arrays(degrees_of(series), str(series.dtype))
    climb(series, rows, moved, limits, tables, found)
    return moved, found


def degrees_of(series: NDArray[np.floating]) -> int:
    """Total degrees of a series, from its length."""
    return int(np.searchsorted(block_offsets(64), series.shape[1]))


def lowest_z_of(max_tilt: float | None) -> float:
    """Least allowed `R[2, 2]`; below -1 if every tilt is allowed."""
    return -2.0 if max_tilt is None else float(np.cos(max_tilt))
