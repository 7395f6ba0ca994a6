r"""Correlation of coupled coefficients over all rotations, and its maxima.

With :math:`M^j = A_j^\top B_j` the correlation is
:math:`C(R) = \sum_j \langle M^j, \Delta^j(R)\rangle`. The search has three steps: all
rotations of a coarse grid from the low degrees (one matrix product for many ABRDFs); the
highest few local maxima; Newton steps of all degrees from each. Derivatives are taken of
:math:`C(R \exp w)` at w = 0, so no rotation is special:

.. math::

    \partial_k C = \mathrm{Re} \sum_j \mathrm{tr}\, \bar M^{j\top} D^j(-iJ_k), \qquad
    \partial_k\partial_l C = -\tfrac12\, \mathrm{Re} \sum_j
        \mathrm{tr}\, \bar M^{j\top} D^j \{J_k, J_l\},

and the angular momenta J couple orders at most two apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from reflfield.errors import InputError
from reflfield.sphere.coupling import Coupled
from reflfield.sphere.wigner import (
    block_offsets,
    euler_from_matrix,
    fill_phases,
    fill_wigner_d,
    rotation_blocks,
)

# Degrees 0 .. 5 vary over about 70 degrees; 2,000 rotations lie 20 degrees apart.
COARSE_DEGREES = 6
COARSE_ROTATIONS = 2000
# Two rotations closer than this are the same peak.
PEAK_DISTANCE = np.deg2rad(15.0)
# The first step of each peak uses the degrees up to this.
SCREENING_DEGREE = 8
SCREENING_STEPS = 2
POLISHING_STEPS = 12
# A step this short moves the peak by less than a hundredth of a degree.
CONVERGED_STEP = 1e-4
FIRST_TRUST_RADIUS = 0.25


def spectrum(source: Coupled, target: Coupled) -> NDArray[np.floating]:
    r"""Series of the correlation of many functions with one target.

    Parameters
    ----------
    source : Coupled
        n functions.
    target : Coupled
        One function.

    Returns
    -------
    (n, block_offsets(n_degrees)[-1]) float
        :math:`M^j` row-major, one degree after the other.

    Raises
    ------
    InputError
        If band limits differ or the target is not one function.
    """
    if source.band_limits != target.band_limits or len(target) != 1:
        raise InputError(
            f"target: expected one function with band limits {source.band_limits}, "
            f"received {len(target)} with {target.band_limits}"
        )
    offsets = block_offsets(source.n_degrees)
    out = np.zeros((len(source), offsets[-1]), source.dtype)
    for j, (a, b) in enumerate(zip(source.blocks, target.blocks, strict=True)):
        product = a.reshape(-1, a.shape[2]) @ b[0].T.astype(a.dtype)
        out[:, offsets[j] : offsets[j + 1]] = product.reshape(len(source), -1)
    return out


@dataclass(frozen=True, eq=False)
class CoarseGrid:
    """Nearly uniform rotations with what the coarse step needs of them.

    Parameters
    ----------
    rotations : (n, 3, 3) float64
    blocks : (n, k) float
        Real Wigner matrices of the low degrees.
    neighbours : (n, 14) int32
        Nearest other rotations.
    """

    rotations: NDArray[np.float64]
    blocks: NDArray[np.floating]
    neighbours: NDArray[np.int32]


@lru_cache(maxsize=8)
def coarse_grid(
    n_degrees: int, n_rotations: int, max_tilt: float | None, dtype: str
) -> CoarseGrid:
    """Super-Fibonacci rotations, optionally those that tilt z by at most `max_tilt`.

    References
    ----------
    M. Alexa, "Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3)", CVPR 2022.

    Examples
    --------
    >>> coarse_grid(3, 500, None, "float32").blocks.shape
    (500, 35)
    """
    s = np.arange(n_rotations) + 0.5
    r, big_r = np.sqrt(s / n_rotations), np.sqrt(1.0 - s / n_rotations)
    alpha, beta = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168755204288118041
    parts = [r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)]
    q = np.stack(parts, axis=1)
    if max_tilt is not None:
        upright = Rotation.from_quat(q).as_matrix()[:, 2, 2] >= np.cos(max_tilt)
        q = np.concatenate([q[upright], [[0.0, 0.0, 0.0, 1.0]]])
    rotations = Rotation.from_quat(q).as_matrix()
    # q and -q are one rotation: look among both.
    tree = cKDTree(np.concatenate([q, -q]))
    nearest = tree.query(q, k=min(15, len(q)))[1][:, 1:] % len(q)
    blocks = rotation_blocks(rotations, n_degrees, dtype)
    return CoarseGrid(rotations, blocks, np.ascontiguousarray(nearest, dtype=np.int32))


@numba.njit(cache=True, nogil=True)
def _is_maximum(row: NDArray[np.floating], g: int, neighbours: NDArray[np.int32]) -> bool:
    """Whether no neighbour is higher; of equal ones the first counts."""
    for other in neighbours:
        if row[other] > row[g] or (row[other] == row[g] and other < g):
            return False
    return True


@numba.njit(cache=True, nogil=True)
def highest_maxima(
    values: NDArray[np.floating],
    neighbours: NDArray[np.int32],
    found: NDArray[np.int32],
) -> None:
    """The highest local maxima of each row, best first; -1 where there are fewer."""
    n_peaks = found.shape[1]
    for i in range(values.shape[0]):
        row = values[i]
        for p in range(n_peaks):
            found[i, p] = -1
        for g in range(row.shape[0]):
            v = row[g]
            last = found[i, n_peaks - 1]
            if last >= 0 and v <= row[last]:
                continue
            if not _is_maximum(row, g, neighbours[g]):
                continue
            p = n_peaks - 1
            while p > 0 and (found[i, p - 1] < 0 or row[found[i, p - 1]] < v):
                found[i, p] = found[i, p - 1]
                p -= 1
            found[i, p] = g


@numba.njit(cache=True, nogil=True)
def _complex_spectrum(
    series: NDArray[np.floating],
    row_start: NDArray[np.int64],
    re: NDArray[np.floating],
    im: NDArray[np.floating],
) -> None:
    """Rows m >= 0 of the complex series of a real one, those of m > 0 doubled."""
    offset, width = 0, row_start[1]
    zero, one = series.dtype.type(0.0), series.dtype.type(1.0)
    root = series.dtype.type(np.sqrt(0.5))
    for j in range(row_start.shape[0] - 1):
        size = 2 * j + 1
        block = series[offset : offset + size * size].reshape(size, size)
        for m in range(j + 1):
            row = row_start[j] + m * width + width // 2
            lead = one if m % 2 == 0 else -one
            if m == 0:
                re[row] = block[j, j]
            else:
                re[row] = 2 * lead * root * block[j + m, j]
                im[row] = 2 * lead * root * block[j - m, j]
            positive, negative = block[j + m, j:], block[j + m, : j + 1]
            positive2, negative2 = block[j - m, j:], block[j - m, : j + 1]
            up_re, up_im = re[row : row + j + 1], im[row : row + j + 1]
            down_re, down_im = re[row - j : row + 1], im[row - j : row + 1]
            sign, scale = one, (root if m == 0 else lead)
            for n in range(1, j + 1):
                sign = -sign
                same, cross, same2, cross2 = positive[n], negative[j - n], zero, zero
                if m > 0:
                    same2, cross2 = negative2[j - n], positive2[n]
                up_re[n], up_im[n] = (
                    scale * sign * (same + same2),
                    scale * sign * (cross2 - cross),
                )
                down_re[j - n], down_im[j - n] = (
                    scale * (same - same2),
                    scale * (cross2 + cross),
                )
        offset += size * size


@numba.njit(cache=True, nogil=True, fastmath=True)
def _turn_series(
    re: NDArray[np.floating],
    im: NDArray[np.floating],
    phases: NDArray[np.floating],
    row_start: NDArray[np.int64],
    q_re: NDArray[np.floating],
    q_im: NDArray[np.floating],
) -> None:
    """Series times exp(-i (m alpha + n gamma)), the phases of all (m, n)."""
    for j in range(row_start.shape[0] - 1):
        first, last = row_start[j], row_start[j + 1]
        a, b = re[first:last], im[first:last]
        c, s = phases[0, : last - first], phases[1, : last - first]
        out_re, out_im = q_re[first:last], q_im[first:last]
        for k in range(a.shape[0]):
            out_re[k] = a[k] * c[k] + b[k] * s[k]
            out_im[k] = b[k] * c[k] - a[k] * s[k]


@numba.njit(cache=True, nogil=True)
def _fill_plane(
    alpha: float,
    gamma: float,
    left: NDArray[np.floating],
    right: NDArray[np.floating],
    phases: NDArray[np.floating],
) -> None:
    """Cos and sin of m alpha + n gamma for all m >= 0 and n, rows as in `DegreeTables`."""
    width = right.shape[1]
    fill_phases(alpha, 0, left)
    fill_phases(gamma, width // 2, right)
    for m in range(left.shape[1]):
        c, s = left[0, m], left[1, m]
        a, b = right[0], right[1]
        cosine = phases[0, m * width : (m + 1) * width]
        sine = phases[1, m * width : (m + 1) * width]
        for k in range(width):
            cosine[k] = c * a[k] - s * b[k]
            sine[k] = s * a[k] + c * b[k]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _sum_derivatives(
    q_re: NDArray[np.floating],
    q_im: NDArray[np.floating],
    d: NDArray[np.floating],
    ladder: NDArray[np.floating],
    out: NDArray[np.float64],
) -> None:
    """Value, gradient (x, y, z) and Hessian (xx, yy, zz, xy, xz, yz) of C(R exp w)."""
    zero = d.dtype.type(0.0)
    one = d.dtype.type(1.0)
    value, gx, gy, gz, zz = zero, zero, zero, zero, zero
    plus, minus, xy, xz, yz = zero, zero, zero, zero, zero
    # Shifted slices: no index can be negative, so the loop becomes vector instructions.
    n_entries = d.shape[0] - 4
    order, up, down = ladder[0, 2:], ladder[1, 2:], ladder[2, 2:]
    up2, down2, rest = ladder[3, 2:], ladder[4, 2:], ladder[5, 2:]
    d0, above, below, above2 = d[2:], d[3:], d[1:], d[4:]
    re_part, im_part = q_re[2:], q_im[2:]
    for k in range(n_entries):
        re, im, n = re_part[k], im_part[k], order[k]
        u, v = up[k] * above[k], down[k] * below[k]
        p, q = up2[k] * above2[k], down2[k] * d[k]
        here = re * d0[k]
        value += here
        zz += here * n * n
        plus += here * rest[k]
        gz += im * n * d0[k]
        gx += im * (u + v)
        gy += re * (u - v)
        minus += re * (p + q)
        xy += im * (p - q)
        both, difference = (n + n) * (u + v) + (u - v), (n + n) * (u - v) + (u + v)
        xz += re * both
        yz += im * difference
    half = one / 2
    out[0] = value
    out[1], out[2], out[3] = half * gx, -half * gy, gz
    out[4] = -half * (plus + half * minus)
    out[5] = -half * (plus - half * minus)
    out[6] = -zz
    out[7], out[8], out[9] = -half * half * xy, -half * half * xz, -half * half * yz


# Loops in place of array expressions: those compile seconds of shape checks and messages.
@numba.njit(cache=True, nogil=True)
def copy_matrix(source: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Entries of a 3x3 matrix into another."""
    for i in range(3):
        for k in range(3):
            out[i, k] = source[i, k]


@numba.njit(cache=True, nogil=True)
def scale(vector: NDArray[np.float64], n: int, factor: float) -> None:
    """Multiply the first n entries in place."""
    for i in range(n):
        vector[i] *= factor


@numba.njit(cache=True, nogil=True)
def _newton_step(f: NDArray[np.float64], radius: float, step: NDArray[np.float64]) -> float:
    """Uphill step of at most `radius`: Newton's where concave, else damped; its length."""
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
        return 0.0
    step[0] = (c0 * f[1] + c1 * f[2] + c2 * f[3]) / det
    step[1] = (c1 * f[1] + (xx * zz - xz * xz) * f[2] + (xy * xz - xx * yz) * f[3]) / det
    step[2] = (c2 * f[1] + (xy * xz - xx * yz) * f[2] + (xx * yy - xy * xy) * f[3]) / det
    length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    if length > radius:
        scale(step, 3, radius / length)
        length = radius
    return length


@numba.njit(cache=True, nogil=True)
def turned(r: NDArray[np.float64], w: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """``r @ exp(w)`` for a small rotation vector, through its quaternion."""
    angle = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    scale = 0.5 - angle * angle / 48.0 if angle < 1e-3 else np.sin(0.5 * angle) / angle
    q0, q1, q2, q3 = np.cos(0.5 * angle), w[0] * scale, w[1] * scale, w[2] * scale
    e = np.zeros((3, 3))
    e[0, 0], e[1, 1] = 1.0 - 2.0 * (q2 * q2 + q3 * q3), 1.0 - 2.0 * (q1 * q1 + q3 * q3)
    e[2, 2] = 1.0 - 2.0 * (q1 * q1 + q2 * q2)
    e[0, 1], e[1, 0] = 2.0 * (q1 * q2 - q0 * q3), 2.0 * (q1 * q2 + q0 * q3)
    e[0, 2], e[2, 0] = 2.0 * (q1 * q3 + q0 * q2), 2.0 * (q1 * q3 - q0 * q2)
    e[1, 2], e[2, 1] = 2.0 * (q2 * q3 - q0 * q1), 2.0 * (q2 * q3 + q0 * q1)
    for i in range(3):
        for k in range(3):
            out[i, k] = r[i, 0] * e[0, k] + r[i, 1] * e[1, k] + r[i, 2] * e[2, k]


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
    while trial[2, 2] < lowest_z and length > CONVERGED_STEP:
        scale(step, 3, 0.5)
        length *= 0.5
        turned(rotation, step, trial)
    return length


@numba.njit(cache=True, nogil=True)
def climb(
    series: NDArray[np.floating],
    rows: NDArray[np.int64],
    rotations: NDArray[np.float64],
    n_steps: int,
    lowest_z: float,
    row_start: NDArray[np.int64],
    recursion: NDArray[np.floating],
    edge: NDArray[np.floating],
    ladder: NDArray[np.floating],
    found: NDArray[np.float64],
) -> None:
    """Move each rotation uphill in place; its derivatives go to `found` (n, 11).

    Rotation i climbs on the series ``rows[i]``; equal rows are best kept together.
    The last column is the length of the step that Newton would take next.
    Steps that would bring ``R[2, 2]`` below `lowest_z` are cut.
    """
    n_entries = row_start[-1]
    n_degrees, width = row_start.shape[0] - 1, row_start[1]
    like = series.dtype
    re, im = np.zeros(n_entries, like), np.zeros(n_entries, like)
    q_re, q_im = np.zeros(n_entries, like), np.zeros(n_entries, like)
    d = np.zeros(n_entries, like)
    left, right = np.zeros((2, n_degrees), like), np.zeros((2, width), like)
    phases = np.zeros((2, n_degrees * width), like)
    f, trial, step = np.zeros(10), np.zeros((3, 3)), np.zeros(3)
    for i in range(rows.shape[0]):
        if i == 0 or rows[i] != rows[i - 1]:
            _complex_spectrum(series[rows[i]], row_start, re, im)
        radius = FIRST_TRUST_RADIUS
        length = 0.0
        found[i, 0] = -np.inf
        copy_matrix(rotations[i], trial)
        for _ in range(n_steps + 1):
            alpha, beta, gamma = euler_from_matrix(trial)
            fill_wigner_d(beta, row_start, recursion, edge, d)
            _fill_plane(alpha, gamma, left, right, phases)
            _turn_series(re, im, phases, row_start, q_re, q_im)
            _sum_derivatives(q_re, q_im, d, ladder, f)
            if f[0] > found[i, 0]:
                if length > 0.9 * radius:
                    radius = min(2.0 * radius, 0.5)
                copy_matrix(trial, rotations[i])
                # From axes turned by gamma, in which the sums are taken, to the body's own.
                _to_body(f, gamma, found[i])
            else:
                radius = 0.25 * length
            length = _newton_step(found[i], radius, step)
            length = _try_step(rotations[i], step, length, lowest_z, trial)
            if length < CONVERGED_STEP:
                # Too short to be worth an evaluation, but free to take.
                if trial[2, 2] >= lowest_z:
                    copy_matrix(trial, rotations[i])
                break
        found[i, 10] = length


@numba.njit(cache=True, nogil=True)
def _to_body(f: NDArray[np.float64], gamma: float, out: NDArray[np.float64]) -> None:
    """Derivatives in the axes w from those in Rz(gamma) w."""
    c, s = np.cos(gamma), np.sin(gamma)
    out[0], out[3], out[6] = f[0], f[3], f[6]
    out[1], out[2] = c * f[1] + s * f[2], c * f[2] - s * f[1]
    out[4] = c * c * f[4] + s * s * f[5] + 2.0 * c * s * f[7]
    out[5] = s * s * f[4] + c * c * f[5] - 2.0 * c * s * f[7]
    out[7] = c * s * (f[5] - f[4]) + (c * c - s * s) * f[7]
    out[8], out[9] = c * f[8] + s * f[9], c * f[9] - s * f[8]
