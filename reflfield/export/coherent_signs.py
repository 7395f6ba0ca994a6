"""Signs of lines, chosen so that what lies between two texels is a line between theirs.

A highlight's stretch has no sign, but textures hold it as a vector, and viewers blend the
vectors of neighbours: opposite ones to nothing, which shows as a thin line.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import (
    breadth_first_order,
    connected_components,
    minimum_spanning_tree,
)

Doubles = NDArray[np.float64]
# Least length of an edge of the graph, which keeps parallel neighbours in it.
_LEAST_LENGTH = 1e-6


def coherent_signs(lines: Doubles, texel_of_pixel: NDArray[np.integer]) -> Doubles:
    """Signs that turn the lines of neighbouring texels to the same side, where they can.

    Along a tree of neighbours that prefers those that are most nearly parallel; around a point
    where lines wind by half a turn, one opposite pair of neighbours remains.

    Parameters
    ----------
    lines : (n_texels, k) float64
        Unit vectors, or zero.
    texel_of_pixel : (height, width) int
        Texels of the texture; -1 where there is none.

    Returns
    -------
    (n_texels,) float64
        1 or -1.

    Examples
    --------
    >>> lines = np.array([[1.0, 0.0], [-1.0, 0.0], [0.6, -0.8]])
    >>> coherent_signs(lines, np.array([[0, 1, 2]])).tolist()
    [1.0, -1.0, 1.0]
    """
    n = len(lines)
    first, second = _neighbours(texel_of_pixel)
    cosine = np.einsum("nk,nk->n", lines[first], lines[second])
    length = 1.0 - np.abs(cosine) + _LEAST_LENGTH
    tree = minimum_spanning_tree(coo_matrix((length, (first, second)), shape=(n, n)).tocsr())
    before = _predecessors(tree, n)
    signs = np.where(np.einsum("nk,nk->n", lines, lines[before]) < 0.0, -1.0, 1.0)
    # Products along the way to the root, of twice as many steps each time.
    while (before != before[before]).any():
        signs = signs * np.where(before == np.arange(n), 1.0, signs[before])
        before = before[before]
    return np.where(before == np.arange(n), 1.0, signs * signs[before])


def _neighbours(texel_of_pixel: NDArray[np.integer]) -> tuple[NDArray[np.intp], ...]:
    """Texels that are side by side or one above the other, in pairs."""
    t = np.asarray(texel_of_pixel)
    pairs = np.concatenate(
        [
            np.stack([t[:, :-1].ravel(), t[:, 1:].ravel()], axis=1),
            np.stack([t[:-1].ravel(), t[1:].ravel()], axis=1),
        ]
    )
    first, second = pairs[(pairs >= 0).all(axis=1)].astype(np.intp).T
    return first, second


def _predecessors(tree: coo_matrix, n: int) -> NDArray[np.intp]:
    """Of each node the one before it on the way from its component's first; its own if none."""
    _, component = connected_components(tree, directed=False)
    _, roots = np.unique(component, return_index=True)
    # One more node, beside all first ones, so that a single search reaches all.
    edges = tree.tocoo()
    rows = np.concatenate([edges.row, np.full(len(roots), n)])
    columns = np.concatenate([edges.col, roots])
    joined = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(n + 1, n + 1)).tocsr()
    _, before = breadth_first_order(joined, n, directed=False)
    return np.where(before[:n] == n, np.arange(n), before[:n]).astype(np.intp)
