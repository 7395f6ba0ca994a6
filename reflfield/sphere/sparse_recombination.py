r"""One sparse matrix times many vectors that lie in rows of memory: recombined coefficients.

A product of SciPy's takes the vectors in columns, and so copies them before and after, each
time through memory. Here some vectors at a time are transposed into columns that stay in the
cache, multiplied a few rows of the matrix at a time, and transposed back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

# Vectors side by side: with 4,096 coefficients they fill half a megabyte.
LANES = 32
# Rows of the matrix between two writes, and coefficients between two reads.
TILE, LINE = 64, 16


@dataclass(frozen=True, eq=False)
class Recombination:
    """Sparse matrix whose results come in parts.

    Parameters
    ----------
    row_start : (n_rows + 1,) int64
        First entry of each row.
    columns : (n_entries,) uint16
        Of 65,536 at most, which two band limits of 16 have.
    values : (n_entries,) float
    part_start : (n_parts + 1,) int64
        First row of each part.
    """

    row_start: NDArray[np.int64]
    columns: NDArray[np.uint16]
    values: NDArray[np.floating]
    part_start: NDArray[np.int64]

    def __call__(self, vectors: NDArray[np.floating]) -> list[NDArray[np.floating]]:
        """Products with all vectors.

        Parameters
        ----------
        vectors : (n, n_columns) float
            In the dtype of the values.

        Returns
        -------
        list of (n, rows of the part) float arrays
            Each contiguous.
        """
        n, starts = len(vectors), self.part_start
        out = np.zeros(n * starts[-1], vectors.dtype)
        entries = (self.row_start, self.columns, self.values)
        _multiply(np.ascontiguousarray(vectors), entries, starts, LANES, out)
        parts = zip(np.split(out, n * starts[1:-1]), np.diff(starts), strict=True)
        return [part.reshape(n, size) for part, size in parts]


def recombination(matrix: csr_array, parts: list[int], dtype: str) -> Recombination:
    """The matrix as the kernel takes it; `parts` are their numbers of rows.

    Examples
    --------
    >>> double = recombination(csr_array(2.0 * np.eye(3)), [1, 2], "float32")
    >>> [part.tolist() for part in double(np.ones((1, 3), np.float32))]
    [[[2.0]], [[2.0, 2.0]]]
    """
    return Recombination(
        matrix.indptr.astype(np.int64),
        matrix.indices.astype(np.uint16),
        matrix.data.astype(dtype),
        np.cumsum([0, *parts]),
    )


Entries = tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.floating]]


@numba.njit(cache=True, nogil=True)
def _into_columns(
    vectors: NDArray[np.floating], first: int, count: int, columns: NDArray[np.floating]
) -> None:
    for begin in range(0, vectors.shape[1], LINE):
        end = min(begin + LINE, vectors.shape[1])
        for lane in range(count):
            for i in range(begin, end):
                columns[i, lane] = vectors[first + lane, i]


@numba.njit(cache=True, nogil=True)
def _multiply_row(
    entries: Entries,
    row: int,
    count: int,
    columns: NDArray[np.floating],
    k: int,
    out: NDArray[np.floating],
) -> None:
    """One row of the matrix times `count` columns, into row k of `out`."""
    row_start, index, value = entries
    e, last = row_start[row], row_start[row + 1]
    for lane in range(count):
        out[k, lane] = 0
    # Four at a time: a quarter of the reads and writes of the sums.
    while e + 4 <= last:
        a, b, c, d = value[e], value[e + 1], value[e + 2], value[e + 3]
        i, j, m, n = index[e], index[e + 1], index[e + 2], index[e + 3]
        for lane in range(count):
            out[k, lane] += (
                a * columns[i, lane]
                + b * columns[j, lane]
                + c * columns[m, lane]
                + d * columns[n, lane]
            )
        e += 4
    while e < last:
        a, i = value[e], index[e]
        for lane in range(count):
            out[k, lane] += a * columns[i, lane]
        e += 1


@numba.njit(cache=True, nogil=True)
def _multiply_part(
    entries: Entries,
    rows: tuple[int, int],
    span: tuple[int, int],
    columns: NDArray[np.floating],
    tile: NDArray[np.floating],
    out: NDArray[np.floating],
) -> None:
    """Rows ``rows[0] .. rows[1]`` times all columns; `out` has those of all vectors."""
    size, (first, count) = rows[1] - rows[0], span
    for begin in range(0, size, TILE):
        some = min(TILE, size - begin)
        for k in range(some):
            _multiply_row(entries, rows[0] + begin + k, count, columns, k, tile)
        for lane in range(count):
            offset = (first + lane) * size + begin
            for k in range(some):
                out[offset + k] = tile[k, lane]


@numba.njit(cache=True, nogil=True)
def _multiply(
    vectors: NDArray[np.floating],
    entries: Entries,
    part_start: NDArray[np.int64],
    lanes: int,
    out: NDArray[np.floating],
) -> None:
    # `lanes` is an argument: loops of a known length are unrolled, not made vector ones.
    n, n_columns = vectors.shape
    columns = np.zeros((n_columns, lanes), vectors.dtype)
    tile = np.zeros((TILE, lanes), vectors.dtype)
    for first in range(0, n, lanes):
        span = (first, min(lanes, n - first))
        _into_columns(vectors, span[0], span[1], columns)
        for p in range(part_start.shape[0] - 1):
            rows = (part_start[p], part_start[p + 1])
            _multiply_part(entries, rows, span, columns, tile, out[n * rows[0] : n * rows[1]])
