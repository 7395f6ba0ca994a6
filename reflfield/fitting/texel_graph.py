"""Neighbours of texels on the surface, and differences between them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

# Neighbours of a texel that are looked for, and how far away they may be, in median distances
# to the nearest: across the seams of charts they lie irregularly.
N_NEIGHBOURS, REACH = 6, 3.0
# Least cosine between normals of neighbours: texels of a thin part's other side are none.
LEAST_COSINE = 0.3


@dataclass(frozen=True, eq=False)
class TexelGraph:
    """Pairs of neighbouring texels.

    Parameters
    ----------
    n_texels : int
    pairs : (n_pairs, 2) int
        Each once, the lower number first.
    """

    n_texels: int
    pairs: NDArray[np.intp]

    def laplacian(self, weights: NDArray[Any] | None = None) -> csr_array:
        """Sum over neighbours of weight times difference, as a matrix."""
        w = np.ones(len(self.pairs)) if weights is None else np.asarray(weights, np.float64)
        i, j = self.pairs.T
        shape = (self.n_texels, self.n_texels)
        half = coo_array((w, (i, j)), shape=shape)
        both = csr_array(half + half.T)
        return csr_array(diags_array(np.asarray(both.sum(axis=1)).ravel()) - both)

    @cached_property
    def adjacency(self) -> csr_array:
        """1 for each neighbour."""
        i, j = self.pairs.T
        half = coo_array((np.ones(len(i)), (i, j)), shape=(self.n_texels, self.n_texels))
        return csr_array(half + half.T)

    def all_around(self, true: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Where something is True of a texel and of all its neighbours; columns apart."""
        columns = true.reshape(len(true), -1)
        bits = np.packbits(columns, axis=1)
        around = bits.copy()
        _and_over_pairs(self.pairs, bits, around)
        unpacked = np.unpackbits(around, axis=1, count=columns.shape[1])
        return unpacked.astype(np.bool_).reshape(true.shape)


def texel_graph(positions: NDArray[np.floating], normals: NDArray[np.floating]) -> TexelGraph:
    """Graph of the nearest texels that face the same way.

    Parameters
    ----------
    positions : (n, 3) float
        Metres.
    normals : (n, 3) float

    Returns
    -------
    TexelGraph

    Examples
    --------
    Three texels in a row; the one far away has no neighbour:

    >>> points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [50, 0, 0]])
    >>> texel_graph(points, np.tile([0.0, 0, 1], (4, 1))).pairs.tolist()
    [[0, 1], [0, 2], [1, 2]]
    """
    n = len(positions)
    count = min(N_NEIGHBOURS + 1, n)
    distance, index = cKDTree(positions).query(positions, k=range(1, count + 1))
    reach = REACH * np.median(distance[:, min(1, count - 1)])
    texel = np.repeat(np.arange(n), count)
    other, near = index.ravel(), distance.ravel() <= reach
    alike = np.einsum("nd,nd->n", normals[texel], normals[other]) > LEAST_COSINE
    kept = near & alike & (texel != other)
    low, high = np.minimum(texel, other)[kept], np.maximum(texel, other)[kept]
    # One number for each pair: rows of two take many times as long to sort.
    pairs = np.stack(np.divmod(np.unique(low * n + high), n), axis=1)
    return TexelGraph(n, pairs)


@numba.njit(cache=True, nogil=True)
def _and_over_pairs(pairs: Any, bits: Any, around: Any) -> None:
    """Clear bits (n_texels, n_bytes) of `around` that are not set of a neighbour, too."""
    for p in range(len(pairs)):
        i, j = pairs[p, 0], pairs[p, 1]
        for k in range(bits.shape[1]):
            around[i, k] &= bits[j, k]
            around[j, k] &= bits[i, k]
