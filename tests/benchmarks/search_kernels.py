"""Kernels of the searches for rotations and depths, and their operations.

Operations are counted by hand from the source, by the rules of `roofline`.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from benchmarks.roofline import DIVISION, ROOT, Kernel, size
from scipy.spatial.transform import Rotation

from reflfield.alignment.newton_ascent import follow
from reflfield.geometry.patch_costs import (
    LARGE_STEP,
    LEAST_SHARE,
    NOISE,
    REACH,
    SMALL_STEP,
    OwnImage,
    PackedImages,
    Sweep,
    aggregated,
    patch_costs,
)
from reflfield.sphere.wigner import block_offsets, degree_tables
from tests.alignment.references import turn_matrix

# Degrees of a correlation of functions of two directions with band limit 8.
N_DEGREES = 15
# Pixels along the side of a view of stereo, views that one is compared with, surfaces.
N_OTHERS, N_SURFACES, N_PATHS = 6, 8, 64
FOCAL = 1.5
# Differences of the reference's values, radians.
TURN = 2e-5


# --- correlation over SO(3) -------------------------------------------------------------------


def correlation(n_rotations, seed):
    """Value, gradient and Hessian of a correlation; item: rotation."""
    rng = np.random.default_rng(seed)
    series = rng.standard_normal((1, block_offsets(N_DEGREES)[-1])).astype(np.float32)
    rotations = Rotation.random(n_rotations, rng=rng).as_matrix()
    rows, tables = np.zeros(n_rotations, np.int64), degree_tables(N_DEGREES)
    width = tables.edge.shape[1]
    entries = [width * N_DEGREES * (N_DEGREES + more) // 2 for more in (1, -1)]
    # Entries of the tables' rows, which are padded to whole vectors. Each: the series times the
    # phase 6, neighbours by the ladder 8, orders 2, and the ten sums 2 or 3 each, in all 21;
    # below the last row of its degree, 5 for the recursion. Phases 6, last rows 2. Steps and
    # Euler angles, some hundred, are left out.
    return Kernel(
        item="rotation",
        precision="float32",
        n_items=n_rotations,
        operations=37 * entries[0] + 5 * entries[1] + 8 * width * N_DEGREES,
        bytes_read=size(series, rotations, rows, tables.recursion, tables.edge, tables.ladder),
        bytes_written=rotations.nbytes + 11 * 8 * n_rotations,
        work=lambda: (follow(series, rows, rotations, 0)[1][:, :4],),
        reference=lambda: (np.array([by_harmonics(series[0], r) for r in rotations]),),
    )


def by_harmonics(series, rotation):
    """Value and gradient from matrices that are fitted to values of real harmonics."""
    ends = block_offsets(N_DEGREES)

    def value(turned):
        matrix = turn_matrix(turned, N_DEGREES)
        blocks = [matrix[j * j : (j + 1) ** 2, j * j : (j + 1) ** 2] for j in range(N_DEGREES)]
        parts = [series[a:b] for a, b in pairwise(ends)]
        return sum(a @ b.ravel() for a, b in zip(parts, blocks, strict=True))

    steps = Rotation.from_rotvec(TURN * np.concatenate([np.eye(3), -np.eye(3)])).as_matrix()
    around = [value(rotation @ step) for step in steps]
    gradient = [(around[i] - around[i + 3]) / (2 * TURN) for i in range(3)]
    return [value(rotation), *gradient]


# --- stereo -----------------------------------------------------------------------------------


def stereo(side, seed):
    """Costs of patches; item: pixel, surface and other view."""
    rng = np.random.default_rng(seed)
    grey = rng.uniform(0.5, 1.5, (N_OTHERS + 1, side, side)).astype(np.float32)
    images = PackedImages(
        values=grey[1:].ravel(),
        first=np.arange(N_OTHERS) * side**2,
        sizes=np.full((N_OTHERS, 2), side),
        matrices=matrices(rng.uniform(-0.1, 0.1, (N_OTHERS, 2)), side),
    )
    sweep = planes(side)
    own = OwnImage(grey[0] - grey[0].mean(), np.ones((side, side), np.bool_))
    others = np.arange(N_OTHERS)
    # Shown: the point 7, the projection 18, its middle 2, two divisions; shares and their
    # complements 4, three times 3. Products 5; six sums over the height of a patch, and over
    # its width. What means are multiplied by 1 and a division, means 2, two variances of 5; the
    # cost 5, a division and a root; the two least 3.
    sums = 5 + 2 * 6 * 2 * REACH
    shown, cost = 7 + 18 + 2 + 2 * DIVISION + 4 + 9, 1 + 2 + 2 * 5 + 5 + 3 + 2 * DIVISION + ROOT
    passes = N_SURFACES * N_OTHERS
    # A pass reads the geometry, the own image, what it covers twice, and the other image; it
    # writes and reads what is shown, six sums and the two least costs.
    written = (1 + 6 + 2) * 4 * side**2
    read = size(sweep.origins, sweep.rays, sweep.front, own.grey, own.covered, own.covered)
    return Kernel(
        item="pixel, surface and view",
        precision="float32",
        n_items=passes * side**2,
        operations=shown + sums + cost,
        bytes_read=passes * (read + 4 * side**2 + written),
        bytes_written=passes * written,
        work=lambda: (patch_costs(images, sweep, own, others),),
        reference=lambda: (compared(images, sweep, own, side),),
    )


def matrices(shifts, side):
    """Projections (n, 3, 4) of cameras moved sideways, in pixels."""
    focal, middle = FOCAL * side, side / 2
    moved = np.tile(np.eye(3, 4), (len(shifts), 1, 1))
    moved[:, :2, 3] = shifts
    return np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]]) @ moved


def planes(side):
    """Planes about depth 2 through the rays of all pixels."""
    v, u = (np.indices((side, side)) + 0.5 - side / 2) / (FOCAL * side)
    rays = np.stack([u, v, np.ones_like(u)], axis=2)
    low = np.zeros((side, side), np.int64)
    offsets = np.linspace(-0.2, 0.2, N_SURFACES)
    front = np.full((side, side), 2.0)
    return Sweep(np.zeros_like(rays), rays, front, offsets, low, low + N_SURFACES - 1)


def compared(images, sweep, own, side):
    """The same by windows over whole images."""
    values = images.values.reshape(-1, side, side).astype(np.float64)
    costs = np.zeros((N_SURFACES, N_OTHERS, side, side))
    for k, offset in enumerate(sweep.offsets):
        points = sweep.origins + (sweep.front + offset)[..., None] * sweep.rays
        for j, matrix in enumerate(images.matrices):
            costs[k, j] = correlated(own.grey, bilinear(values[j], points, matrix))
    return np.moveaxis(np.sort(costs, axis=1)[:, :2].mean(axis=1), 0, 2)


def bilinear(image, points, matrix):
    """Image where a camera sees points; NaN outside."""
    u, v, w = np.moveaxis(points @ matrix[:, :3].T + matrix[:, 3], 2, 0)
    u, v, last = u / w - 0.5, v / w - 0.5, len(image) - 1
    inside = (u >= 0) & (v >= 0) & (u < last) & (v < last)
    u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
    x, y = u.astype(int), v.astype(int)
    s, t = u - x, v - y
    above = (1 - s) * image[y, x] + s * image[y, x + 1]
    below = (1 - s) * image[y + 1, x] + s * image[y + 1, x + 1]
    return np.where(inside, (1 - t) * above + t * below, np.nan)


def correlated(grey, shown):
    """1 less the correlation of patches; 1 where too little of one is shown."""
    known = np.isfinite(shown)
    a, b = np.where(known, grey.astype(np.float64), 0), np.where(known, shown, 0)
    summed = [np.pad(x, REACH) for x in (known * 1.0, a, b, a * a, b * b, a * b)]
    windows = np.lib.stride_tricks.sliding_window_view(summed, (2 * REACH + 1,) * 2, (1, 2))
    n, a, b, aa, bb, ab = windows.sum(axis=(3, 4))
    enough, n = n >= LEAST_SHARE * (2 * REACH + 1) ** 2, np.maximum(n, 1)
    own, other = aa / n - (a / n) ** 2 + NOISE**2, bb / n - (b / n) ** 2 + NOISE**2
    cost = 1 - (ab / n - a * b / n**2) / np.sqrt(own * other)
    return np.where(enough, np.minimum(cost, 1), 1)


def paths(side, seed):
    """Least costs over paths of eight directions; item: pixel and surface."""
    costs = np.random.default_rng(seed).random((side, side, N_PATHS), np.float32)
    low = np.zeros((side, side), np.int64)
    high = low + N_PATHS - 1
    # For each direction: the least before 1, a large step 1 (its sum is that of all), a step
    # from either side 2 each, the path 2, the total 1. Each reads costs and total, and writes
    # the total; what it keeps of one row of pixels stays in the cache.
    return Kernel(
        item="pixel and surface",
        precision="float32",
        n_items=costs.size,
        operations=8 * (1 + 1 + 2 + 2 + 2 + 1),
        bytes_read=8 * size(costs, costs, low, high),
        bytes_written=8 * costs.nbytes,
        work=lambda: (aggregated(costs, low, high),),
        reference=lambda: (along_paths(costs.astype(np.float64)),),
    )


def along_paths(costs):
    """The same, pixel by pixel."""
    total = np.zeros_like(costs)
    shape = costs.shape[:2]
    for step in np.argwhere(np.ones((3, 3))) - 1:
        path = {}
        order = np.ndindex(shape) if tuple(step) > (0, 0) else reversed([*np.ndindex(shape)])
        for at in order if step.any() else ():
            before = path.get(tuple(at - step))
            path[at] = costs[at] + (0 if before is None else continued(before))
            total[at] += path[at]
    return total


def continued(before):
    """What a path adds to its next pixel's costs, less the least."""
    least = before.min()
    padded = np.pad(before, 1, constant_values=np.inf)
    aside = np.minimum(padded[:-2], padded[2:]) + float(SMALL_STEP)
    return np.minimum(np.minimum(before, aside), least + float(LARGE_STEP)) - least
