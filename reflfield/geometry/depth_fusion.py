"""Depths of several views as one signed distance in the grid of the visual hull.

A view says of a point how far it lies before the surface that it sees. Near a surface these
distances are averaged, as in volumetric fusion [1]_; a point counts as empty where more views
look through it than see a surface near it. A mean over both would eat the rims of thin parts
away, as one view that is wrong there outweighs many that are right to a fraction of a voxel.

References
----------
.. [1] B. Curless and M. Levoy, "A volumetric method for building complex models from range
   images", SIGGRAPH 1996.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, minimum_filter

from reflfield.geometry.carving import FARTHEST, Grid
from reflfield.geometry.light_stack import projection_matrix
from reflfield.geometry.patch_stereo import SeenSurface
from reflfield.util.blas_threads import thread_pool

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

# Distance to a surface up to which it is near, voxels.
BAND = 4.0
# Pixels around one through which a view must look as well: depths are blurred by patches.
GUARD = 3
# Weight of depths that no other view confirms.
UNCONFIRMED = 0.1
# Standard deviation of a blur of sums, voxels, and the weight below which they say nothing.
BLUR, LEAST_WEIGHT = 1.0, 0.3
# Slices of the grid that are worked on together.
SLICES_AT_ONCE = 16


class _DepthMaps(NamedTuple):
    """Depths of all views in one array, the least around, and weights; matrices (n, 3, 4).

    `axes` (n, 4) take a point to its depth.
    """

    depth: Floats
    nearest: Floats
    weight: Floats
    first: NDArray[np.int64]
    sizes: NDArray[np.int64]
    matrices: Array
    axes: Array


def carved_by_depths(
    volume: Floats, grid: Grid, seen: Sequence[SeenSurface], workers: int = 1
) -> Floats:
    """Signed distances, in voxels, of what views leave of a body, at most `BAND`.

    Parameters
    ----------
    volume : (nx, ny, nz) float32
        Signed distances of the body at the corners of the grid, voxels, above 0 inside.
    grid : Grid
    seen : sequence of SeenSurface
        Surfaces inside of it.
    workers : int
        Threads.

    Returns
    -------
    (nx, ny, nz) float32
        The same where no view sees anything, up to `BAND`; nowhere larger.
    """
    maps = _depth_maps(seen)
    total, weight = np.zeros((2, *volume.shape), np.float32)

    def vote(first: int) -> None:
        some = volume[first : first + SLICES_AT_ONCE]
        corners = np.argwhere(some > -FARTHEST)
        points = grid.origin + (corners + np.array([first, 0, 0])) * grid.spacing
        at = (corners[:, 0] + first, corners[:, 1], corners[:, 2])
        total[at], weight[at] = _votes(points, maps, BAND * grid.spacing)

    with thread_pool(workers) as pool:
        list(pool.map(vote, range(0, len(volume), SLICES_AT_ONCE)))
    sums, weights = (gaussian_filter(field, BLUR, mode="nearest") for field in (total, weight))
    before = np.where(weights > LEAST_WEIGHT, sums / np.maximum(weights, LEAST_WEIGHT), -1.0)
    return np.minimum(volume, -BAND * before).astype(np.float32)


def _depth_maps(seen: Sequence[SeenSurface]) -> _DepthMaps:
    known = [np.where(np.isfinite(each.depth), each.depth, -np.inf) for each in seen]
    near = [minimum_filter(depth, 2 * GUARD + 1, mode="nearest") for depth in known]
    weights = [np.where(each.confirmed, 1.0, UNCONFIRMED) for each in seen]
    lengths = np.array([depth.size for depth in known], np.int64)
    forward = np.stack([each.camera.forward for each in seen])
    centres = np.stack([each.camera.centre for each in seen])
    return _DepthMaps(
        _flat(known),
        _flat(near),
        _flat(weights),
        np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64),
        np.array([depth.shape for depth in known], np.int64),
        np.stack([projection_matrix(each.camera) for each in seen]),
        np.column_stack([forward, -(forward * centres).sum(axis=1)]),
    )


def _flat(maps: Sequence[Array]) -> Floats:
    return np.concatenate([values.reshape(-1) for values in maps]).astype(np.float32)


@numba.njit(cache=True, nogil=True)
def _votes(points: Array, maps: _DepthMaps, band: float) -> tuple[Array, Array]:
    """Sums of weighted distances before the surface, in bands, and of weights."""
    sums, weights = np.zeros(len(points)), np.zeros(len(points))
    for i in range(len(points)):
        near, total, through = 0.0, 0.0, 0.0
        for j in range(len(maps.first)):
            at = points[i, 0], points[i, 1], points[i, 2]
            before, nearest, weight = _before(at, maps, j)
            if -band <= before <= band:
                total += weight * before / band
                near += weight
            elif nearest >= band:
                through += weight
        sums[i], weights[i] = (through, through) if through > near else (total, near)
    return sums, weights


@numba.njit(cache=True, nogil=True)
def _before(
    point: tuple[float, float, float], maps: _DepthMaps, j: int
) -> tuple[float, float, float]:
    """How far a point lies before the surface that view j sees, and before the nearest around.

    Infinitely far behind what is not seen. Last the weight of that.
    """
    x, y, z = point
    # Single numbers: a slice for each point and view would take ten times as long.
    m, axes = maps.matrices, maps.axes
    w = m[j, 2, 0] * x + m[j, 2, 1] * y + m[j, 2, 2] * z + m[j, 2, 3]
    if not w > 0.0:
        return -np.inf, -np.inf, 0.0
    u = (m[j, 0, 0] * x + m[j, 0, 1] * y + m[j, 0, 2] * z + m[j, 0, 3]) / w
    v = (m[j, 1, 0] * x + m[j, 1, 1] * y + m[j, 1, 2] * z + m[j, 1, 3]) / w
    rows, columns = maps.sizes[j, 0], maps.sizes[j, 1]
    if not (0.0 <= u < columns and 0.0 <= v < rows):
        return -np.inf, -np.inf, 0.0
    p = maps.first[j] + int(v) * columns + int(u)
    depth = axes[j, 0] * x + axes[j, 1] * y + axes[j, 2] * z + axes[j, 3]
    return maps.depth[p] - depth, maps.nearest[p] - depth, maps.weight[p]
