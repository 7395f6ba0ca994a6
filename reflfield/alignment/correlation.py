r"""Correlation of coupled coefficients over all rotations: the series and its derivatives.

With :math:`M^j = A_j^\top B_j` the correlation is
:math:`C(R) = \sum_j \langle M^j, \Delta^j(R)\rangle`. Derivatives are taken of
:math:`C(R \exp w)` at w = 0, so no rotation is special:

.. math::

    \partial_k C = \mathrm{Re} \sum_j \mathrm{tr}\, \bar M^{j\top} D^j(-iJ_k), \qquad
    \partial_k\partial_l C = -\tfrac12\, \mathrm{Re} \sum_j
        \mathrm{tr}\, \bar M^{j\top} D^j \{J_k, J_l\},

and the angular momenta J couple orders at most two apart.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.sphere.coupling import Coupled
from reflfield.sphere.wigner import block_offsets, euler_from_matrix, fill_phases, fill_wigner_d


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


@numba.njit(cache=True, nogil=True)
def complex_spectrum(
    series: NDArray[np.floating],
    row_start: NDArray[np.int64],
    re: NDArray[np.floating],
    im: NDArray[np.floating],
) -> None:
    """Rows m >= 0 of the complex series of a real one, those of m > 0 doubled.

    As many degrees as `row_start` (see `DegreeTables`) has; the series may have more.
    """
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


# Reordering of sums only.
@numba.njit(cache=True, nogil=True, fastmath=True)
def _add_degree(
    re_all: NDArray[np.floating],
    im_all: NDArray[np.floating],
    phases: NDArray[np.floating],
    d: NDArray[np.floating],
    ladder: NDArray[np.floating],
    first: int,
    last: int,
    casimir: float,
    out: NDArray[np.float64],
) -> None:
    """Add entries first .. last of one degree to the sums of `derivatives`.

    With the phases of alpha and gamma multiplied to the series, what is left of D is d,
    and the ladder operators reach its neighbours in n.
    """
    zero = d.dtype.type(0.0)
    value, gx, gy, gz, zz = zero, zero, zero, zero, zero
    minus, xy, xz, yz = zero, zero, zero, zero
    # Shifted slices: no index can be negative, so the loop becomes vector instructions.
    n_entries = last - first
    re_part, im_part = re_all[first:last], im_all[first:last]
    cosine, sine = phases[0, 2 : 2 + n_entries], phases[1, 2 : 2 + n_entries]
    order, up, down = ladder[0, first:last], ladder[1, first:last], ladder[2, first:last]
    up2, down2 = ladder[3, first:last], ladder[4, first:last]
    below2, below, here = d[first - 2 : last], d[first - 1 : last], d[first:last]
    above, above2 = d[first + 1 : last + 1], d[first + 2 : last + 2]
    for k in range(n_entries):
        re = re_part[k] * cosine[k] + im_part[k] * sine[k]
        im = im_part[k] * cosine[k] - re_part[k] * sine[k]
        u, v = up[k] * above[k], down[k] * below[k]
        p, q = up2[k] * above2[k], down2[k] * below2[k]
        both, difference = u + v, u - v
        n_re, n_im = order[k] * re, order[k] * im
        value += re * here[k]
        gz += n_im * here[k]
        zz += order[k] * (n_re * here[k])
        gx += im * both
        gy += re * difference
        minus += re * (p + q)
        xy += im * (p - q)
        xz += n_re * both
        yz += n_im * difference
    plus = casimir * value - zz
    out[0] += value
    out[1] += 0.5 * gx
    out[2] -= 0.5 * gy
    out[3] += gz
    out[4] -= 0.5 * (plus + 0.5 * minus)
    out[5] -= 0.5 * (plus - 0.5 * minus)
    out[6] -= zz
    out[7] -= 0.25 * xy
    out[8] -= 0.25 * (2.0 * xz + gy)
    out[9] -= 0.25 * (2.0 * yz + gx)


@numba.njit(cache=True, nogil=True)
def derivatives(
    rotation: NDArray[np.float64],
    re: NDArray[np.floating],
    im: NDArray[np.floating],
    row_start: NDArray[np.int64],
    recursion: NDArray[np.floating],
    edge: NDArray[np.floating],
    ladder: NDArray[np.floating],
    d: NDArray[np.floating],
    phases: NDArray[np.floating],
    out: NDArray[np.float64],
) -> None:
    """Value, gradient (x, y, z) and Hessian (xx, yy, zz, xy, xz, yz) of C(R exp w).

    `re` and `im` are from `complex_spectrum`, `d` (zero at first) and `phases` are scratch.
    """
    width, n_degrees = row_start[1], row_start.shape[0] - 1
    left, right = np.zeros((2, n_degrees), d.dtype), np.zeros((2, width), d.dtype)
    alpha, beta, gamma = euler_from_matrix(rotation)
    fill_wigner_d(beta, row_start, recursion, edge, d)
    _fill_plane(alpha, gamma, left, right, phases)
    f = np.zeros(10)
    for j in range(n_degrees):
        # Two entries less at each end: the margins of the rows are zero.
        first, last = row_start[j] + 2, row_start[j + 1] - 2
        _add_degree(re, im, phases, d, ladder, first, last, j * (j + 1.0), f)
    # From axes turned by gamma, in which the sums are taken, to the body's own.
    c, s = np.cos(gamma), np.sin(gamma)
    out[0], out[3], out[6] = f[0], f[3], f[6]
    out[1], out[2] = c * f[1] + s * f[2], c * f[2] - s * f[1]
    out[4] = c * c * f[4] + s * s * f[5] + 2.0 * c * s * f[7]
    out[5] = s * s * f[4] + c * c * f[5] - 2.0 * c * s * f[7]
    out[7] = c * s * (f[5] - f[4]) + (c * c - s * s) * f[7]
    out[8], out[9] = c * f[8] + s * f[9], c * f[9] - s * f[8]
