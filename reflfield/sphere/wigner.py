r"""Wigner-d functions, and the matrices that rotate real harmonic coefficients.

Complex convention: :math:`D^j_{mn}(R) = e^{-im\alpha} d^j_{mn}(\beta) e^{-in\gamma}` with
``R = Rz(alpha) @ Ry(beta) @ Rz(gamma)``; the coefficients of the rotated
function :math:`f(R^T\omega)` are :math:`D(R)` times those of :math:`f`. The same
holds for the real matrices :math:`\Delta^j(R)` of this module and the real harmonics of
`reflfield.sphere.harmonics`: :math:`\Delta^1(R)` is `R` in the order (y, z, x) and
:math:`\Delta(R_1 R_2) = \Delta(R_1)\Delta(R_2)`.

Recursion: degree upwards at fixed orders from ``j = max(|m|, |n|)``, which is
the stable direction (Kostelec and Rockmore, "FFTs on the rotation group",
Journal of Fourier Analysis and Applications 2008).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.errors import InputError
from reflfield.util.validation import check_shape

# Rows of stored d are whole cache lines of single precision, for vector instructions.
LINE = 16

# Cosine and sine of an angle.
Turn = tuple[float, float]


def block_offsets(degree_limit: int) -> NDArray[np.int64]:
    """Where each degree's (2j+1, 2j+1) block starts in a flat list of blocks.

    Examples
    --------
    >>> block_offsets(3)
    array([ 0,  1, 10, 35])
    """
    sizes = (2 * np.arange(degree_limit, dtype=np.int64) + 1) ** 2
    return np.concatenate([[0], np.cumsum(sizes)])


@dataclass(frozen=True, eq=False)
class DegreeTables:
    """Constants of the recursion for degrees 0 .. `degree_limit` - 1, flat by rows.

    Only rows m >= 0 are kept: those of negative order follow by symmetry. The
    row of (j, m) begins at ``row_start[j] + m * width``, and order n stands ``width // 2 + n``
    farther, for all degrees alike: so loops run over whole degrees, and rows are whole cache
    lines. What no order -j .. j fills is zero. Orders n - 2 .. n + 2 can be read without a
    test: what is read of the next row meets a zero of the ladder, and a line of zeros stands
    before the first row and after the last.

    Parameters
    ----------
    degree_limit : int
        Degrees 0 .. `degree_limit` - 1.
    row_start : (degree_limit + 1,) int64
        First entry of each degree.
    recursion : (3, n) float
        d^j = (recursion[0] * cos(beta) - recursion[1]) d^{j-1} - recursion[2] d^{j-2}.
    edge : (degree_limit, width) float
        Factors of the last row of each degree.
    ladder : (2, n) float
        Order n; c+, the matrix element of the generator from n to n + 1, which is c- of n + 1.
    """

    degree_limit: int
    row_start: NDArray[np.int64]
    recursion: NDArray[np.floating]
    edge: NDArray[np.floating]
    ladder: NDArray[np.floating]


@lru_cache(maxsize=16)
def degree_tables(degree_limit: int, dtype: str = "float32") -> DegreeTables:
    """Constants of the recursion; kept in memory once built.

    Examples
    --------
    >>> degree_tables(3).row_start
    array([ 16,  32,  64, 112])
    """
    degrees = np.arange(degree_limit + 1, dtype=np.int64)
    width = row_width(degree_limit)
    start = LINE + width * (degrees * (degrees + 1) // 2)
    recursion = np.zeros((3, start[-1] + LINE))
    ladder = np.zeros((2, start[-1] + LINE))
    edge = np.zeros((degree_limit, width))
    for j in range(degree_limit):
        part = slice(start[j], start[j + 1])
        recursion[:, part] = _recursion_of_degree(j, width).reshape(3, -1)
        ladder[:, part] = _ladder_of_degree(j, width).reshape(2, -1)
        n = np.arange(-j + 1, j)
        growth = np.sqrt(2.0 * j * (2.0 * j - 1.0) / ((j + n) * (j - n)))
        edge[j, n + width // 2] = growth
    aligned = (_on_cache_lines(table.astype(dtype)) for table in (recursion, edge, ladder))
    return DegreeTables(degree_limit, start, *aligned)


def _on_cache_lines(array: NDArray[np.floating]) -> NDArray[np.floating]:
    """A copy that begins where a cache line does."""
    line = LINE * 4
    buffer = np.zeros(array.nbytes + line, np.uint8)
    first = -buffer.ctypes.data % line
    out = buffer[first : first + array.nbytes].view(array.dtype).reshape(array.shape)
    out[...] = array
    return out


def row_width(degree_limit: int) -> int:
    """Entries of one row of `DegreeTables`.

    Examples
    --------
    >>> row_width(8), row_width(9)
    (16, 32)
    """
    return -(-2 * degree_limit // LINE) * LINE


def _recursion_of_degree(j: int, width: int) -> NDArray[np.float64]:
    """(3, j + 1, width) factors that give degree j from j - 1 and j - 2."""
    out = np.zeros((3, j + 1, width))
    i = j - 1
    if j == 0:
        return out
    m = np.arange(j, dtype=np.float64)[:, None]
    n = np.arange(-i, i + 1, dtype=np.float64)[None, :]
    columns = slice(width // 2 - i, width // 2 + j)
    if i == 0:
        out[0, 0, columns] = 1.0
        return out
    below = i * np.sqrt((j**2 - m**2) * (j**2 - n**2))
    last = np.maximum(i**2 - m**2, 0.0) * np.maximum(i**2 - n**2, 0.0)
    out[0, :j, columns] = (2 * i + 1) * i * j / below
    out[1, :j, columns] = (2 * i + 1) * m * n / below
    out[2, :j, columns] = j * np.sqrt(last) / below
    return out


def _ladder_of_degree(j: int, width: int) -> NDArray[np.float64]:
    """(2, j + 1, width) orders and generator elements of degree j, the same for every row."""
    n = np.arange(-j, j + 1, dtype=np.float64)
    out = np.zeros((2, j + 1, width))
    columns = slice(width // 2 - j, width // 2 + j + 1)
    out[:, :, columns] = np.stack([n, np.sqrt((j - n) * (j + n + 1))])[:, None]
    return out


@numba.njit(cache=True, nogil=True, fastmath=True)
def _recur(
    a: NDArray[np.floating],
    b: NDArray[np.floating],
    c: NDArray[np.floating],
    cosine: float,
    newer: NDArray[np.floating],
    older: NDArray[np.floating],
    out: NDArray[np.floating],
) -> None:
    """Degree j from j - 1 and j - 2; c is 0 where the latter has no entry."""
    for k in range(out.shape[0]):
        out[k] = (a[k] * cosine - b[k]) * newer[k] - c[k] * older[k]


@numba.njit(cache=True, nogil=True, fastmath=True)
def fill_wigner_d(
    beta: Turn,
    row_start: NDArray[np.int64],
    recursion: NDArray[np.floating],
    edge: NDArray[np.floating],
    d: NDArray[np.floating],
) -> None:
    """All d^j_{mn}(beta), m >= 0, into the flat rows of `DegreeTables`; d is zero at first."""
    width, first = edge.shape[1], row_start[0]
    centre = width // 2
    one = d.dtype.type(1.0)
    cosine, half_sine = d.dtype.type(beta[0]), d.dtype.type(-0.5 * beta[1])
    cosine2, sine2 = d.dtype.type(0.5 + 0.5 * beta[0]), d.dtype.type(0.5 - 0.5 * beta[0])
    top, bottom = one, one
    d[first + centre] = one
    for j in range(1, row_start.shape[0] - 1):
        start, before, size = row_start[j], row_start[j - 1], j * width
        # Rows m < j, orders |n| < j. Slices let the compiler see that no index is
        # negative, and so use vector instructions.
        twice = row_start[j - 2] if j > 1 else first
        _recur(
            recursion[0, start : start + size],
            recursion[1, start : start + size],
            recursion[2, start : start + size],
            cosine,
            d[before : before + size],
            d[twice : twice + size],
            d[start : start + size],
        )
        # Row m = j, then the columns n = -j and j of the others by symmetry.
        top *= cosine2
        bottom *= sine2
        row = d[start + size : start + size + width]
        last = d[before + size - width : before + size]
        for k in range(width):
            row[k] = last[k] * edge[j, k] * half_sine
        row[centre - j] = bottom
        row[centre + j] = top
        sign = one if j % 2 == 0 else -one
        entry = start + centre
        for m in range(j):
            d[entry + j] = sign * row[centre + m]
            d[entry - j] = row[centre - m]
            entry += width
            sign = -sign


@numba.njit(cache=True, nogil=True)
def _turn(cosine: float, sine: float) -> Turn:
    length = np.hypot(cosine, sine)
    return (cosine / length, sine / length) if length > 0.0 else (1.0, 0.0)


@numba.njit(cache=True, nogil=True)
def euler_turns(r: NDArray[np.float64]) -> tuple[Turn, Turn, Turn]:
    """Cosine and sine of alpha, beta, gamma (zyz) of one rotation; gamma = 0 at the poles."""
    sine = np.hypot(r[0, 2], r[1, 2])
    beta = _turn(r[2, 2], sine)
    if sine > 1e-14:
        return _turn(r[0, 2], r[1, 2]), beta, _turn(-r[2, 0], r[2, 1])
    # At a pole only alpha +- gamma is determined.
    up = 1.0 if r[2, 2] > 0.0 else -1.0
    return _turn(up * r[0, 0], up * r[1, 0]), beta, (1.0, 0.0)


@numba.njit(cache=True, nogil=True)
def fill_phases(turn: Turn, phases: NDArray[np.floating]) -> None:
    """cos(m * angle) and sin(m * angle), m = 0, 1, ..., into the rows of `phases`."""
    # By multiplication: rounding of float64 grows with the order, far below float32's.
    re, im = 1.0, 0.0
    for k in range(phases.shape[1]):
        phases[0, k], phases[1, k] = re, im
        re, im = re * turn[0] - im * turn[1], re * turn[1] + im * turn[0]


@numba.njit(cache=True, nogil=True)
def _real_block(
    j: int,
    left: NDArray[np.floating],
    right: NDArray[np.floating],
    rows: NDArray[np.floating],
    out: NDArray[np.floating],
) -> None:
    """Real (2j+1, 2j+1) matrix from the rows m >= 0 of d^j and the phases of alpha, gamma."""
    root, centre = np.sqrt(0.5), rows.shape[1] // 2
    for m in range(j + 1):
        row_scale = (1.0 if m % 2 == 0 else -1.0) * (1.0 if m > 0 else root)
        for n in range(j + 1):
            plus = rows[m, centre + n] * (1.0 if n % 2 == 0 else -1.0)
            minus = rows[m, centre - n]
            scale = row_scale * (1.0 if n > 0 else root)
            even, odd = scale * (plus + minus), scale * (plus - minus)
            out[j + m, j + n] = even * left[0, m] * right[0, n] - odd * left[1, m] * right[1, n]
            if n > 0:
                out[j + m, j - n] = (
                    -odd * left[1, m] * right[0, n] - even * left[0, m] * right[1, n]
                )
            if m > 0:
                out[j - m, j + n] = (
                    even * left[1, m] * right[0, n] + odd * left[0, m] * right[1, n]
                )
            if m > 0 and n > 0:
                out[j - m, j - n] = (
                    odd * left[0, m] * right[0, n] - even * left[1, m] * right[1, n]
                )


@numba.njit(cache=True, nogil=True)
def _real_blocks(
    rotations: NDArray[np.float64],
    row_start: NDArray[np.int64],
    recursion: NDArray[np.floating],
    edge: NDArray[np.floating],
    out: NDArray[np.floating],
) -> None:
    d = np.zeros(recursion.shape[1], recursion.dtype)
    left = np.zeros((2, row_start.shape[0] - 1), recursion.dtype)
    right = np.zeros((2, row_start.shape[0] - 1), recursion.dtype)
    for i in range(rotations.shape[0]):
        alpha, beta, gamma = euler_turns(rotations[i])
        fill_wigner_d(beta, row_start, recursion, edge, d)
        fill_phases(alpha, left)
        fill_phases(gamma, right)
        offset = 0
        for j in range(row_start.shape[0] - 1):
            size = 2 * j + 1
            rows = d[row_start[j] : row_start[j + 1]].reshape(j + 1, edge.shape[1])
            block = out[i, offset : offset + size * size].reshape(size, size)
            _real_block(j, left, right, rows, block)
            offset += size * size


def rotation_blocks(
    rotations: ArrayLike, degree_limit: int, dtype: str = "float64"
) -> NDArray[np.floating]:
    r"""Real matrices :math:`\Delta^j(R)` of many rotations, all degrees, flat.

    Parameters
    ----------
    rotations : (n, 3, 3) array_like
        Proper rotations, active.
    degree_limit : int
        Degrees 0 .. `degree_limit` - 1, at most 64.
    dtype : {"float64", "float32"}
        Of the result and of the recursion.

    Returns
    -------
    (n, block_offsets(degree_limit)[-1]) floating
        Row-major (2j+1, 2j+1) blocks, one degree after the other.

    Raises
    ------
    ShapeError
        If the shape is not (n, 3, 3).
    InputError
        If the degree limit is out of range.

    Examples
    --------
    Degree 1 is the rotation itself, in the order (y, z, x):

    >>> quarter_turn = np.array([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]])
    >>> rotation_blocks(quarter_turn, 2)[0, 1:].reshape(3, 3).round(12) + 0.0
    array([[ 0.,  0.,  1.],
           [ 0.,  1.,  0.],
           [-1.,  0.,  0.]])
    """
    if not 1 <= degree_limit <= 64:
        raise InputError(f"degree_limit: expected 1 to 64, received {degree_limit}")
    matrices = np.ascontiguousarray(rotations, dtype=np.float64)
    check_shape("rotations", matrices, (None, 3, 3))
    tables = degree_tables(degree_limit, dtype)
    out = np.zeros((len(matrices), int(block_offsets(degree_limit)[-1])), dtype)
    _real_blocks(matrices, tables.row_start, tables.recursion, tables.edge, out)
    return out
