"""Functions of a clustered model on finer nodes.

Texels of one cluster see one reflectance in frames of their own, so together they sample it
more densely than the cameras and lights of the dome do, which the grid of the resampling
follows. The fit to the samples begins on that grid and ends on a finer one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import ShapeError
from reflfield.field.clustered_model import ClusteredModel

# Functions of all clusters on the finer nodes, in float32: a fit holds about fourteen copies.
MOST_BYTES = 32 << 20


def finer_sides(sides: tuple[int, int], n_functions: int, fineness: float) -> tuple[int, int]:
    """Sides with up to `fineness` times as many intervals between nodes.

    Fewer where the functions would take more than `MOST_BYTES`. Odd sides stay odd, so that
    the zenith stays a node.

    Parameters
    ----------
    sides : (int, int)
        Of the view and light grids; 1 where the direction does not vary, which stays.
    n_functions : int
        Of three channels, over all clusters.
    fineness : float

    Returns
    -------
    (int, int)
        Not below `sides`.

    Examples
    --------
    >>> finer_sides((7, 7), 8 * 7, 4 / 3), finer_sides((13, 13), 16 * 11, 4 / 3)
    ((9, 9), (13, 13))
    >>> finer_sides((1, 13), 8 * 7, 2)
    (1, 25)
    """
    intervals = np.array(sides) - 1
    longest = int(intervals.max(initial=0))
    for wanted in range(int(fineness * longest), longest, -1):
        finer = intervals * wanted // longest
        # An even number of intervals stays even.
        finer -= (finer - intervals) % 2
        view, light = (int(side) for side in np.maximum(finer, intervals) + 1)
        if 12 * n_functions * view**2 * light**2 <= MOST_BYTES:
            return view, light
    return sides


def on_finer_nodes(model: ClusteredModel, sides: tuple[int, int]) -> ClusteredModel:
    """Model whose mean and basis are interpolated between their nodes onto finer ones.

    The same functions where every old node is a new one.

    Parameters
    ----------
    model : ClusteredModel
    sides : (int, int)
        Of the new view and light grids.

    Returns
    -------
    ClusteredModel

    Raises
    ------
    ShapeError
        If a direction varies on one of the grids only.
    """
    n_views, n_lights = model.table.shape[1:3]
    view, light = _between(n_views, sides[0]), _between(n_lights, sides[1])
    table = np.einsum("vi,lj,cijk->cvlk", view, light, model.table, optimize=True)
    return replace(model, table=np.ascontiguousarray(table, np.float32))


def _between(n_nodes: int, side: int) -> NDArray[np.float32]:
    """(side**2, n_nodes) weights of the old nodes at the new ones."""
    old = round(n_nodes**0.5)
    if (old == 1) != (side == 1):
        raise ShapeError(f"sides: expected {old} where a direction does not vary, got {side}")
    if old == 1:
        return np.ones((1, 1), np.float32)
    places = np.linspace(0.0, old - 1.0, side)
    line = np.maximum(1.0 - np.abs(places[:, None] - np.arange(old)), 0.0)
    return np.kron(line, line).astype(np.float32)
