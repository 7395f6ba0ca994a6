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

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.sphere.coupling import Coupled
from reflfield.sphere.wigner import (
    Turn,
    block_offsets,
    degree_tables,
    euler_turns,
    fill_wigner_d,
)


class DegreeArrays(NamedTuple):
    """Tables of the Wigner-d recursion as the kernels take them; see `DegreeTables`."""

    row_start: NDArray[np.int64]
    recursion: NDArray[np.floating]
    edge: NDArray[np.floating]
    ladder: NDArray[np.floating]


class ComplexSeries(NamedTuple):
    """Rows m >= 0 of one complex series, tables of its degrees, and scratch.

    Parameters
    ----------
    re, im : (n_entries,) float
        See `complex_spectrum`.
    tables : DegreeArrays
    d : (n_entries,) float
        Wigner-d elements; zero at first.
    phases : (2, size of `edge`) float
    """

    re: NDArray[np.floating]
    im: NDArray[np.floating]
    tables: DegreeArrays
    d: NDArray[np.floating]
    phases: NDArray[np.floating]


def degree_arrays(n_degrees: int, dtype: str) -> DegreeArrays:
    """Tables of the recursion for degrees below `n_degrees`."""
    tables = degree_tables(n_degrees, dtype)
    return DegreeArrays(tables.row_start, tables.recursion, tables.edge, tables.ladder)


def degrees_of(series: NDArray[np.floating]) -> int:
    """Total degrees of a real series, from its length."""
    return int(np.searchsorted(block_offsets(64), series.shape[1]))


@numba.njit(cache=True, nogil=True)
def empty_series(tables: DegreeArrays, like: NDArray[np.floating]) -> ComplexSeries:
    """Zeros for a series of the degrees of the tables, in the type of `like`."""
    n_entries, kind = tables.recursion.shape[1], like.dtype
    return ComplexSeries(
        np.zeros(n_entries, kind),
        np.zeros(n_entries, kind),
        tables,
        np.zeros(n_entries, kind),
        np.zeros((2, tables.edge.size), kind),
    )


def spectrum(
    source: Coupled, target: Coupled, factors: NDArray[np.float64] | None = None
) -> NDArray[np.floating]:
    r"""Series of the correlation of many functions with one target.

    Parameters
    ----------
    source : Coupled
        n functions.
    target : Coupled
        One function.
    factors : (n,) float64, optional
        What each series is multiplied with.

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
    times = np.ones(len(source)) if factors is None else factors
    column = times.astype(source.dtype)[:, None]
    for j, (a, b) in enumerate(zip(source.blocks, target.blocks, strict=True)):
        product = a.reshape(-1, a.shape[2]) @ b[0].T.astype(a.dtype)
        part = out[:, offsets[j] : offsets[j + 1]]
        np.multiply(product.reshape(len(source), -1), column, out=part)
    return out


@numba.njit(cache=True, nogil=True)
def complex_spectrum(series: NDArray[np.floating], out: ComplexSeries) -> None:
    """Rows m >= 0 of the complex series of a real one, those of m > 0 doubled.

    As many degrees as the tables of `out` have; the real series may have more.
    """
    row_start, re, im = out.tables.row_start, out.re, out.im
    offset, width = 0, row_start[1] - row_start[0]
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
def _fill_plane(alpha: Turn, gamma: Turn, width: int, phases: NDArray[np.floating]) -> None:
    """Cos and sin of m alpha + n gamma for all m >= 0 and n, rows as in `DegreeTables`."""
    # By multiplication: rounding of float64 grows with the order, far below float32's.
    re, im = 1.0, 0.0
    for n in range(width // 2):
        phases[0, width // 2 + n], phases[1, width // 2 + n] = re, im
        phases[0, width // 2 - n], phases[1, width // 2 - n] = re, -im
        re, im = re * gamma[0] - im * gamma[1], re * gamma[1] + im * gamma[0]
    a, b = phases[0, :width], phases[1, :width]
    re, im = alpha
    for begin in range(width, phases.shape[1], width):
        c, s = phases.dtype.type(re), phases.dtype.type(im)
        cosine, sine = phases[0, begin : begin + width], phases[1, begin : begin + width]
        for k in range(width):
            cosine[k] = c * a[k] - s * b[k]
            sine[k] = s * a[k] + c * b[k]
        re, im = re * alpha[0] - im * alpha[1], re * alpha[1] + im * alpha[0]


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
    cosine, sine = phases[0, :n_entries], phases[1, :n_entries]
    # c-(n) = c+(n - 1): what is read again costs less than a table of its own.
    order, up, above_up = (
        ladder[0, first:last],
        ladder[1, first:last],
        ladder[1, first + 1 : last + 1],
    )
    down, below_down = ladder[1, first - 1 : last], ladder[1, first - 2 : last]
    below2, below, here = d[first - 2 : last], d[first - 1 : last], d[first:last]
    above, above2 = d[first + 1 : last + 1], d[first + 2 : last + 2]
    for k in range(n_entries):
        re = re_part[k] * cosine[k] + im_part[k] * sine[k]
        im = im_part[k] * cosine[k] - re_part[k] * sine[k]
        u, v = up[k] * above[k], down[k] * below[k]
        p, q = (up[k] * above_up[k]) * above2[k], (down[k] * below_down[k]) * below2[k]
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
    rotation: NDArray[np.float64], series: ComplexSeries, out: NDArray[np.float64]
) -> None:
    """Value, gradient (x, y, z) and Hessian (xx, yy, zz, xy, xz, yz) of C(R exp w)."""
    re, im, d, phases = series.re, series.im, series.d, series.phases
    row_start, edge, ladder = series.tables.row_start, series.tables.edge, series.tables.ladder
    alpha, beta, gamma = euler_turns(rotation)
    fill_wigner_d(beta, row_start, series.tables.recursion, edge, d)
    _fill_plane(alpha, gamma, edge.shape[1], phases)
    for i in range(10):
        out[i] = 0.0
    for j in range(row_start.shape[0] - 1):
        first, last = row_start[j], row_start[j + 1]
        _add_degree(re, im, phases, d, ladder, first, last, j * (j + 1.0), out)
    # From axes rotated by gamma, in which the sums are taken, to the body's own.
    c, s = gamma
    x, y, xx, yy, xy, xz, yz = out[1], out[2], out[4], out[5], out[7], out[8], out[9]
    out[1], out[2] = c * x + s * y, c * y - s * x
    out[4] = c * c * xx + s * s * yy + 2.0 * c * s * xy
    out[5] = s * s * xx + c * c * yy - 2.0 * c * s * xy
    out[7] = c * s * (yy - xx) + (c * c - s * s) * xy
    out[8], out[9] = c * xz + s * yz, c * yz - s * xz
