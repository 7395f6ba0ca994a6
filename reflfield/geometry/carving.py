"""Carving: the smallest signed distance over all views, on a grid refined from coarse cells."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import GeometryError
from reflfield.geometry.cones import View
from reflfield.util.blas_threads import thread_pool
from reflfield.util.even_order import even_order

Array = NDArray[np.float64]
Number = TypeVar("Number", bound=np.generic)

# Allowance on the slope of the signed distance, for its error far from the outline.
_SLOPE_ALLOWANCE = 1.1

# Coarsest cells along the longest side. Fewer would only add levels, more cost time.
_COARSE_CELLS = 12

# Signed distance, voxels, beyond which only the side is known.
FARTHEST = 2.0

_BLOCK_POINTS = 1 << 16
# Up to so many views that may undercut a distance the lowest distances are kept sorted; of more
# views all distances of a block of points are looked through.
_MOST_SORTED, _PARTITIONED_POINTS = 4, 1 << 13


@dataclass(frozen=True, eq=False)
class Grid:
    """Cubic voxels that cover the box of the object with a border of empty ones."""

    origin: Array
    spacing: float
    shape: tuple[int, int, int]
    n_levels: int

    @classmethod
    def around(cls, low: Array, high: Array, resolution: int) -> Grid:
        """Grid around a box, with so many voxels along its longest side."""
        spacing = float((high - low).max()) / resolution
        n_levels = max(0, int(np.log2(resolution / _COARSE_CELLS)))
        block = 1 << n_levels
        # Two empty voxels on each side, then whole coarse cells.
        blocks = np.ceil(((high - low) / spacing + 4.0) / block - 1e-9).astype(int)
        nx, ny, nz = (int(n) * block for n in blocks)
        origin = 0.5 * (low + high) - 0.5 * spacing * np.array([nx, ny, nz])
        return cls(origin, spacing, (nx, ny, nz), n_levels)


def carve(
    views: Sequence[View], grid: Grid, tolerance: int, workers: int = 1
) -> tuple[NDArray[np.float32], int]:
    """Signed distances at the corners of all voxels, exact near the surface.

    Parameters
    ----------
    views : sequence of View
    grid : Grid
    tolerance : int
        Views that may disagree at a point without carving it away.
    workers : int
        Threads; the volume does not depend on their number.

    Returns
    -------
    volume : (nx + 1, ny + 1, nz + 1) float32
        In voxels, clipped to `FARTHEST`; negative on the border of the grid.
    n_evaluated : int
    """
    state = np.zeros([n >> grid.n_levels for n in grid.shape], dtype=np.int8)
    slope = _SLOPE_ALLOWANCE * max(view.steepest for view in views)
    n_evaluated = 0
    # Of the finest cells the corners are evaluated anyway: centres stop one level above.
    for level in range(grid.n_levels, 0, -1):
        undecided = np.argwhere(state == 0)
        centres = grid.origin + (undecided + 0.5) * (grid.spacing * (1 << level))
        band = slope * 0.5 * np.sqrt(3.0) * grid.spacing * (1 << level)
        values = smallest_distance(views, centres, tolerance, band, workers)
        n_evaluated += len(centres)
        if not (values > -band).any() and not (state > 0).any():
            refuse_empty(views[first_emptying(views, centres, tolerance, band)])
        decided = np.where(values > band, 1, np.where(values < -band, -1, 0))
        state[tuple(undecided.T)] = decided
        state = _halved(state)
    return _corner_values(views, grid, state, tolerance, n_evaluated, workers)


def _halved(state: NDArray[np.int8]) -> NDArray[np.int8]:
    """Each cell becomes eight of the same state."""
    for axis in range(3):
        state = np.repeat(state, 2, axis=axis)
    return state


def _corner_values(
    views: Sequence[View],
    grid: Grid,
    state: NDArray[np.int8],
    tolerance: int,
    n_evaluated: int,
    workers: int,
) -> tuple[NDArray[np.float32], int]:
    """Evaluate the corners of undecided voxels; the others only have a sign."""
    volume = np.where(_at_corners(state > 0), np.float32(FARTHEST), np.float32(-FARTHEST))
    corners = np.argwhere(_at_corners(state == 0))
    points = grid.origin + corners * grid.spacing
    cutoff = FARTHEST * grid.spacing
    values = smallest_distance(views, points, tolerance, cutoff, workers)
    if not ((values > 0.0).any() or (state > 0).any()):
        refuse_empty(views[first_emptying(views, points, tolerance, 0.0)])
    in_voxels = np.clip(values / grid.spacing, -FARTHEST, FARTHEST)
    # A value of exactly zero would make triangles without area.
    in_voxels[np.abs(in_voxels) < 1e-3] = 1e-3
    volume[tuple(corners.T)] = in_voxels
    # The outermost layer is empty, so that the surface closes inside the grid.
    for axis in range(3):
        for side in (0, -1):
            layer = np.moveaxis(volume, axis, 0)[side]
            np.minimum(layer, -1e-3, out=layer)
    return volume, n_evaluated + len(corners)


def _at_corners(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """True at the eight corners of each voxel that is True."""
    corners = np.pad(voxels, ((0, 1),) * 3)
    for axis in range(3):
        moved = np.moveaxis(corners, axis, 0)
        moved[1:] |= moved[:-1].copy()
    return corners


def smallest_distance(
    views: Sequence[View], points: Array, tolerance: int, cutoff: float, workers: int = 1
) -> Array:
    """Signed distance (n,) that only `tolerance` views undercut, metres.

    Points found below ``-cutoff`` are not followed further: their value is some number
    below ``-cutoff``.
    """
    with thread_pool(workers) as pool:
        if tolerance <= _MOST_SORTED:
            return _sorted_distance(views, points, tolerance, cutoff, pool)

        def of_part(part: Array) -> Array:
            return _partitioned_distance(views, part, tolerance, cutoff)

        return np.concatenate(list(pool.map(of_part, _parts(points, _PARTITIONED_POINTS))))


def _parts(points: NDArray[Number], size: int) -> list[NDArray[Number]]:
    """Views of a list by so many at a time; at least one."""
    return [points[begin : begin + size] for begin in range(0, max(len(points), 1), size)]


def _sorted_distance(
    views: Sequence[View],
    points: Array,
    tolerance: int,
    cutoff: float,
    pool: ThreadPoolExecutor,
) -> Array:
    """`smallest_distance` by lists of the lowest values, one view after the other.

    Their distances may be in files.
    """
    lowest = np.full((tolerance + 1, len(points)), np.inf)
    alive = np.arange(len(points))
    for view in views:

        def insert(some: NDArray[np.intp], view: View = view) -> None:
            _insert(lowest, some, view.distance(points[some]))

        list(pool.map(insert, _parts(alive, _BLOCK_POINTS)))
        alive = alive[lowest[-1, alive] >= -cutoff]
    values: Array = lowest[-1]
    return values


def _partitioned_distance(
    views: Sequence[View], points: Array, tolerance: int, cutoff: float
) -> Array:
    """`smallest_distance` of many views; infinite without enough of them."""
    if tolerance >= len(views):
        return np.full(len(points), np.inf)
    of_views = np.full((len(points), len(views)), np.inf)
    alive, n_below = np.arange(len(points)), np.zeros(len(points), np.intp)
    # Neighbours see alike: views from all sides end the pursuit of an empty point sooner.
    for number in even_order(len(views)):
        distance = views[number].distance(points[alive])
        of_views[alive, number] = distance
        n_below[alive] += distance < -cutoff
        alive = alive[n_below[alive] <= tolerance]
        if not len(alive):
            break
    return np.asarray(np.partition(of_views, tolerance, axis=1)[:, tolerance])


def _insert(lowest: Array, columns: NDArray[np.intp], values: Array) -> None:
    """Put new values into the sorted lists of lowest ones, ascending along axis 0."""
    for row in lowest:
        held = row[columns]
        row[columns] = np.minimum(held, values)
        values = np.maximum(held, values)


def first_emptying(views: Sequence[View], points: Array, tolerance: int, cutoff: float) -> int:
    """Index of the view after which no point is left above ``-cutoff``."""
    lowest = np.full((tolerance + 1, len(points)), np.inf)
    columns = np.arange(len(points))
    for number, view in enumerate(views):
        _insert(lowest, columns, view.distance(points))
        if not (lowest[-1] > -cutoff).any():
            return number
    return len(views) - 1


def refuse_empty(view: View) -> None:
    """Name the first view, in their order, that leaves nothing."""
    raise GeometryError(
        f"hull: expected silhouettes of one object, received contradicting ones: in the order "
        f"of the views, {view.camera.id!r} is the first that leaves nothing; check its camera "
        "and silhouette, leave the view out, or raise hull.tolerance or hull.resolution"
    )
