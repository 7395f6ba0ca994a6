"""Functions of a direction that stay as they are where directions were observed.

Between observed directions a function is interpolated and may be trusted; beyond them a
fitted one, such as a sum of harmonics, takes any value. Here it is tabulated over the
sphere: as it is inside the triangles of neighbouring observed directions, and outside as
a mean of what it is at the nearest of them, so that it leaves their range nowhere.

The triangles are the faces of the convex hull of the directions, which is their Delaunay
triangulation on the sphere. Those in whose circle no light stands for more than
`LARGEST_GAP` to all sides, such as the ones that close a dome from below, count as gaps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.util.late_import import LateImport
from reflfield.util.validation import unit_directions

spatial: Any = LateImport("scipy.spatial")

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]

# Radius of the largest circle without an observed direction that is interpolated across.
LARGEST_GAP = np.radians(40.0)
# Rows (poles included) and columns of the table: 2 degrees between its nodes.
ROWS, COLUMNS = 91, 180
# Directions inside the triangles that gaps are filled from, beside the observed ones: 6
# degrees apart.
N_SAMPLES = 1024
# Reach of the mean over the nearest directions: at least this, and a share of the distance
# to the nearest one, so that what is far off varies slowly.
LEAST_REACH, REACH_SHARE = np.radians(2.0), 0.25
NODES_AT_ONCE = 2048
# Directions this much outside a triangle, as a share of its corners, count as inside.
BORDER = 1e-6


# Directions of lights that a field states: all that differ by six degrees are fewer.
MOST_OBSERVED = 2048


def distinct_directions(directions: ArrayLike) -> Array:
    """Directions that differ by half a degree, or by six if there are many.

    Parameters
    ----------
    directions : (n, 3) array_like
        Unit vectors.

    Returns
    -------
    (m, 3) float64
        Coordinates rounded to two decimals or to one; at most `MOST_OBSERVED`.

    Examples
    --------
    >>> distinct_directions([[0, 0, 1], [0, 0.001, 1]])
    array([[0., 0., 1.]])
    """
    vectors = unit_directions("directions", np.asarray(directions, np.float64))
    rounded = np.unique(np.round(vectors, 2) + 0.0, axis=0)
    if len(rounded) > MOST_OBSERVED:
        rounded = np.unique(np.round(vectors, 1) + 0.0, axis=0)
    return np.asarray(rounded)


def covered(directions: ArrayLike, observed: ArrayLike) -> Bools:
    """Whether directions lie between observed ones.

    Parameters
    ----------
    directions : (n, 3) array_like
        Unit vectors.
    observed : (m, 3) array_like
        Unit vectors.

    Returns
    -------
    (n,) bool

    Examples
    --------
    >>> tripod = np.array([[6, 0, 8], [-6, 0, 8], [0, 6, 8], [0, -6, 8]]) / 10
    >>> covered([[0, 0, 1], [0, 0, -1]], tripod)
    array([ True, False])
    """
    towards = np.asarray(directions, np.float64)
    inside = np.zeros(len(towards), np.bool_)
    for corners in _triangles(np.asarray(observed, np.float64)):
        inside |= (np.linalg.solve(corners.T, towards.T) >= -BORDER).all(axis=0)
    return inside


def bounded_table(values_at: Callable[[Array], Floats], observed: ArrayLike) -> Floats:
    """Tabulate functions of direction; beyond the observed ones they repeat the nearest.

    Parameters
    ----------
    values_at : callable
        From (n, 3) unit vectors to values (n, n_functions).
    observed : (m, 3) array_like
        Unit vectors, at least one.

    Returns
    -------
    (ROWS, COLUMNS, n_functions) float32
        For `interpolate`.

    Notes
    -----
    Cost O(n_triangles ROWS COLUMNS) and, for the gaps, O(ROWS COLUMNS N_SAMPLES).
    """
    lights = np.asarray(observed, np.float64)
    nodes = table_directions().reshape(-1, 3)
    inside = covered(nodes, lights)
    samples = fibonacci_directions(N_SAMPLES)
    sources = np.concatenate([lights, samples[covered(samples, lights)]])
    at_sources = np.asarray(values_at(sources), np.float64)
    table = np.asarray(values_at(nodes), np.float32)
    gaps = np.flatnonzero(~inside)
    for first in range(0, len(gaps), NODES_AT_ONCE):
        some = gaps[first : first + NODES_AT_ONCE]
        table[some] = _mean_of_nearest(nodes[some], sources, at_sources)
    return table.reshape(ROWS, COLUMNS, -1)


def table_directions() -> Array:
    """(ROWS, COLUMNS, 3) unit vectors of the nodes; rows from +Z to -Z."""
    theta = np.pi * np.arange(ROWS)[:, None] / (ROWS - 1)
    phi = 2 * np.pi * np.arange(COLUMNS) / COLUMNS
    ring = np.sin(theta)
    return np.stack(
        np.broadcast_arrays(ring * np.cos(phi), ring * np.sin(phi), np.cos(theta)), axis=-1
    )


def interpolate(table: Floats, directions: ArrayLike) -> Floats:
    """Values of a table of `bounded_table`, bilinear between nodes, (n, n_functions)."""
    towards = np.ascontiguousarray(directions, np.float32)
    out = np.zeros((len(towards), table.shape[2]), np.float32)
    _interpolate(table, towards, out)
    return out


@numba.njit(cache=True, nogil=True)
def _interpolate(table: Any, directions: Any, out: Any) -> None:
    n_rows, n_columns, n_functions = table.shape
    for i in range(len(directions)):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        row = np.arctan2(np.sqrt(x * x + y * y), z) / np.pi * (n_rows - 1)
        column = (np.arctan2(y, x) / (2 * np.pi) % 1.0) * n_columns
        upper = min(max(int(row), 0), n_rows - 2)
        left = int(column) % n_columns
        right = (left + 1) % n_columns
        s, t = np.float32(column - int(column)), np.float32(row - upper)
        one = np.float32(1.0)
        for k in range(n_functions):
            above = (one - s) * table[upper, left, k] + s * table[upper, right, k]
            below = (one - s) * table[upper + 1, left, k] + s * table[upper + 1, right, k]
            out[i, k] = (one - t) * above + t * below


def _triangles(observed: Array) -> list[Array]:
    """Corners (3, 3), by rows, of the triangles that are no gaps."""
    try:
        faces = (
            spatial.ConvexHull(observed).simplices
            if len(observed) > 3
            else np.zeros((0, 3), int)
        )
    except spatial.QhullError:  # all in one plane: a ring, which encloses a triangulated disk
        faces = _disk(observed)
    triangles = []
    for corners in observed[faces]:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        length = np.linalg.norm(normal)
        if length < 1e-9:
            continue
        # The circle around the corners without any light inside is on the hull's outside,
        # which faces away from the centre of all; of a ring it is the smaller one.
        outward = normal / length
        facing = outward @ (corners[0] - observed.mean(axis=0))
        outward *= np.sign(facing if abs(facing) > 1e-9 else outward @ corners[0])
        radius = np.arccos(np.clip(outward @ corners[0], -1.0, 1.0))
        if radius <= LARGEST_GAP and abs(np.linalg.det(corners)) > 1e-9:
            triangles.append(corners)
    return triangles


def _disk(observed: Array) -> NDArray[np.intp]:
    """Triangles of a ring of directions, all from its first."""
    centre = observed.mean(axis=0)
    _, _, axes = np.linalg.svd(observed - centre)
    flat = (observed - centre) @ axes[:2].T
    order = np.argsort(np.arctan2(flat[:, 1], flat[:, 0]))
    return np.stack([np.full(len(order) - 2, order[0]), order[1:-1], order[2:]], axis=1)


def fibonacci_directions(n: int) -> Array:
    """Directions spread evenly over the sphere, (n, 3)."""
    z = 1.0 - (2.0 * np.arange(n) + 1.0) / n
    phi = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(n)
    ring = np.sqrt(1.0 - z**2)
    return np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=1)


def _mean_of_nearest(nodes: Array, sources: Array, values: Array) -> Floats:
    """Values (n, n_functions) of the nearest sources, the less the farther."""
    angle = np.arccos(np.clip(nodes @ sources.T, -1.0, 1.0))
    nearest = angle.min(axis=1, keepdims=True)
    reach = LEAST_REACH + REACH_SHARE * nearest
    weights = np.exp((nearest**2 - angle**2) / (2.0 * reach**2))
    return ((weights @ values) / weights.sum(axis=1, keepdims=True)).astype(np.float32)
