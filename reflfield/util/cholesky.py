"""Small symmetric positive systems inside kernels, by Cholesky's factorization.

Written out because ``numpy.linalg.solve`` in a kernel takes seconds to compile and forms an LU
factorization, twice the work; up to 150 unknowns it is also no faster. See Golub and Van
Loan, "Matrix Computations", section 4.2.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def cholesky_factor(matrix: Doubles, n: int) -> bool:
    """Lower factor L of the leading n x n block of a matrix, in its lower triangle, in place.

    The upper triangle is not read. Rows below the block become ``row @ inv(L).T``. False where
    a pivot is not positive; the matrix is then of no use.

    Examples
    --------
    >>> matrix = np.array([[4.0, 0.0], [2.0, 5.0]])
    >>> cholesky_factor(matrix, 2), matrix[0, 0], matrix[1, 0], matrix[1, 1]
    (True, np.float64(2.0), np.float64(1.0), np.float64(2.0))
    """
    for column in range(n):
        pivot = matrix[column, column]
        for k in range(column):
            pivot -= matrix[column, k] * matrix[column, k]
        if not pivot > 0.0:
            return False
        pivot = np.sqrt(pivot)
        matrix[column, column] = pivot
        for row in range(column + 1, len(matrix)):
            rest = matrix[row, column]
            for k in range(column):
                rest -= matrix[row, k] * matrix[column, k]
            matrix[row, column] = rest / pivot
    return True


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _subtract_products(shares: Doubles, rows: Doubles, out: Doubles) -> None:
    """``out -= shares @ rows``; four rows at a time, so that `out` is read less often."""
    whole = len(shares) // 4 * 4
    for j in range(0, whole, 4):
        a, b, c, d = shares[j], shares[j + 1], shares[j + 2], shares[j + 3]
        for k in range(len(out)):
            first = a * rows[j, k] + b * rows[j + 1, k]
            out[k] -= first + (c * rows[j + 2, k] + d * rows[j + 3, k])
    for j in range(whole, len(shares)):
        for k in range(len(out)):
            out[k] -= shares[j] * rows[j, k]


@numba.njit(cache=True, nogil=True)
def solve_columns(factor: Doubles, columns: Doubles) -> None:
    """Solution of ``L L^T x = columns`` (n, m), in place; L is the lower triangle of `factor`.

    The upper triangle of `factor` becomes that of ``L^T``.

    Examples
    --------
    >>> columns = np.array([[8.0], [14.0]])
    >>> solve_columns(np.array([[2.0, 0.0], [1.0, 2.0]]), columns)
    >>> columns.ravel()
    array([0.75, 2.5 ])
    """
    n, width = columns.shape
    for i in range(n):
        _subtract_products(factor[i, :i], columns[:i], columns[i])
        for k in range(width):
            columns[i, k] /= factor[i, i]
        for j in range(i):
            factor[j, i] = factor[i, j]
    for i in range(n - 1, -1, -1):
        _subtract_products(factor[i, i + 1 :], columns[i + 1 :], columns[i])
        for k in range(width):
            columns[i, k] /= factor[i, i]


@numba.njit(cache=True, nogil=True)
def solve_vector(factor: Doubles, vector: Doubles) -> None:
    """Solution of ``L L^T x = vector`` (n,), in place; see `solve_columns`."""
    n = len(vector)
    for i in range(n):
        for j in range(i):
            vector[i] -= factor[i, j] * vector[j]
        vector[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            vector[i] -= factor[j, i] * vector[j]
        vector[i] /= factor[i, i]
