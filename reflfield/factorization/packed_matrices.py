"""Many small symmetric matrices, stored as the rows of one array.

A symmetric (r, r) matrix is held by its r (r + 1) / 2 entries on and above
the diagonal, row by row, so that sums of outer products over samples become
one matrix product.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray


def packed_size(rank: int) -> int:
    """Entries on and above the diagonal: r (r + 1) / 2."""
    return rank * (rank + 1) // 2


@lru_cache(maxsize=32)
def _triangle(rank: int) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Row and column of every packed entry, and the packed entry of every (row, column)."""
    rows, columns = np.triu_indices(rank)
    place = np.zeros((rank, rank), dtype=np.intp)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    return rows, columns, place


def outer_products(vectors: NDArray[Any]) -> NDArray[Any]:
    """Packed v v^T of every row, (n, r) -> (n, r (r + 1) / 2).

    Examples
    --------
    >>> outer_products(np.array([[2.0, 3.0]]))
    array([[4., 6., 9.]])
    """
    rows, columns, _ = _triangle(vectors.shape[1])
    return vectors[:, rows] * vectors[:, columns]


def pack(matrices: NDArray[Any]) -> NDArray[Any]:
    """Upper triangles of (n, r, r) symmetric matrices."""
    rows, columns, _ = _triangle(matrices.shape[1])
    return matrices[:, rows, columns]


def unpack(packed: NDArray[Any], rank: int) -> NDArray[Any]:
    """(n, r, r) symmetric matrices from their upper triangles."""
    return packed[:, _triangle(rank)[2]]
