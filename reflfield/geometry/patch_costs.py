"""Kernels of stereo by patches: costs of swept surfaces, and the least ones over paths.

`geometry.patch_stereo` says what they are for.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

# Reordering of sums only.
FAST = {"reassoc", "contract", "nsz", "arcp"}
# Pixels to each side of a patch's middle, and the share of it that must be compared.
REACH, LEAST_SHARE = 3, 0.5
# Standard deviation that noise and quantisation make, over the root mean square of a view.
NOISE = 0.012
# Cost of patches that cannot be compared; and of what lies out of a pixel's range.
UNKNOWN, OUTSIDE = np.float32(1.0), np.float32(8.0)
# Cost of a step by one surface, and by more, between neighbouring pixels.
SMALL_STEP, LARGE_STEP = np.float32(0.1), np.float32(1.0)
# What stands for a brightness that a view does not show.
NOT_SEEN = np.float32(-1e9)


class PackedImages(NamedTuple):
    """Brightness of all views in one array, and their matrices (n_views, 3, 4)."""

    values: Floats
    first: Indices
    sizes: Indices
    matrices: Array


class Sweep(NamedTuple):
    """Surfaces through the rays of one view's pixels.

    Surface k has the points origins + (front + offsets[k]) * rays; a pixel may lie on those
    from `low` to `high`, -1 for none.
    """

    origins: Array
    rays: Array
    front: Array
    offsets: Array
    low: Indices
    high: Indices


class OwnImage(NamedTuple):
    """Brightness (h, w) of a view less its mean, and the pixels that count."""

    grey: Floats
    covered: NDArray[np.bool_]


def patch_costs(images: PackedImages, sweep: Sweep, own: OwnImage, others: Indices) -> Floats:
    """Costs (h, w, n_surfaces): mean of the two views that agree best with a patch."""
    shape = own.covered.shape
    costs = np.full((*shape, len(sweep.offsets)), OUTSIDE, np.float32)
    sums, shown = np.zeros((6, *shape), np.float32), np.zeros(shape, np.float32)
    for k in range(len(sweep.offsets)):
        lowest = np.full(shape, UNKNOWN)
        second = lowest.copy()
        for j in others:
            _show(images, j, sweep, k, own.covered, shown)
            _compare(own, shown, sums, lowest, second)
        within = (sweep.low <= k) & (k <= sweep.high)
        costs[within, k] = 0.5 * (lowest + second)[within]
    return costs


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _show(
    images: PackedImages,
    j: int,
    sweep: Sweep,
    k: int,
    covered: NDArray[np.bool_],
    shown: Floats,
) -> None:
    """Write what view j shows of a surface, bilinear."""
    height, width = covered.shape
    m = images.matrices[j]
    rows, columns = images.sizes[j, 0], images.sizes[j, 1]
    for y in range(height):
        for x in range(width):
            shown[y, x] = NOT_SEEN
            if not covered[y, x]:
                continue
            z = sweep.front[y, x] + sweep.offsets[k]
            a = sweep.origins[y, x, 0] + z * sweep.rays[y, x, 0]
            b = sweep.origins[y, x, 1] + z * sweep.rays[y, x, 1]
            c = sweep.origins[y, x, 2] + z * sweep.rays[y, x, 2]
            w = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
            if not w > 0.0:
                continue
            u = (m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]) / w - 0.5
            v = (m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]) / w - 0.5
            if not (u >= 0.0 and v >= 0.0 and u < columns - 1 and v < rows - 1):
                continue
            column, row = int(u), int(v)
            s, t = np.float32(u - column), np.float32(v - row)
            p = images.first[j] + row * columns + column
            q = p + columns
            above = (1 - s) * images.values[p] + s * images.values[p + 1]
            below = (1 - s) * images.values[q] + s * images.values[q + 1]
            shown[y, x] = (1 - t) * above + t * below


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _compare(
    own: OwnImage, shown: Floats, sums: Floats, lowest: Floats, second: Floats
) -> None:
    """Lower the two least costs of each pixel by those of one view."""
    height, width = shown.shape
    _sum_along_rows(own.grey, shown, sums)
    for y in range(height):
        for x in range(width):
            if not own.covered[y, x]:
                continue
            n, a, b, aa, bb, ab = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(max(y - REACH, 0), min(y + REACH + 1, height)):
                n += sums[0, i, x]
                a += sums[1, i, x]
                b += sums[2, i, x]
                aa += sums[3, i, x]
                bb += sums[4, i, x]
                ab += sums[5, i, x]
            if n < LEAST_SHARE * (2 * REACH + 1) ** 2:
                continue
            noise = NOISE**2
            mine = max(aa / n - (a / n) ** 2, 0.0) + noise
            other = max(bb / n - (b / n) ** 2, 0.0) + noise
            cost = np.float32(1.0 - (ab / n - a * b / n**2) / np.sqrt(mine * other))
            if cost < lowest[y, x]:
                second[y, x] = lowest[y, x]
                lowest[y, x] = cost
            elif cost < second[y, x]:
                second[y, x] = cost


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _sum_along_rows(grey: Floats, shown: Floats, sums: Floats) -> None:
    """Number, sums, squares and products of what is shown, over the width of a patch."""
    height, width = shown.shape
    for y in range(height):
        for x in range(width):
            n, a, b, aa, bb, ab = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(max(x - REACH, 0), min(x + REACH + 1, width)):
                other = shown[y, i]
                if other != NOT_SEEN:
                    mine = grey[y, i]
                    n += 1.0
                    a += mine
                    b += other
                    aa += mine * mine
                    bb += other * other
                    ab += mine * other
            sums[0, y, x], sums[1, y, x], sums[2, y, x] = n, a, b
            sums[3, y, x], sums[4, y, x], sums[5, y, x] = aa, bb, ab


@numba.njit(cache=True, nogil=True)
def aggregated(costs: Floats, low: Indices, high: Indices) -> Floats:
    """Sums over 8 directions of the least costs of paths that end at a pixel's surface."""
    height, width, n = costs.shape
    total = np.zeros_like(costs)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        before = np.full((width, n), OUTSIDE, np.float32)
        current = np.full((width, n), OUTSIDE, np.float32)
        for row in range(height):
            y = row if dy >= 0 else height - 1 - row
            for column in range(width):
                x = column if dx >= 0 else width - 1 - column
                current[x] = OUTSIDE
                if high[y, x] < 0:
                    continue
                last = current if dy == 0 else before
                begins = not (0 <= x - dx < width and 0 <= y - dy < height)
                begins = begins or high[y - dy, x - dx] < 0
                # Negative indices, which count from the end, are of paths that begin.
                _continue_path(
                    costs[y, x],
                    (low[y, x], high[y, x]),
                    last[x - dx if not begins else x],
                    begins,
                    current[x],
                )
                for k in range(low[y, x], high[y, x] + 1):
                    total[y, x, k] += current[x, k]
            if dy != 0:
                before, current = current, before
    return total


@numba.njit(cache=True, nogil=True)
def _continue_path(
    costs: Floats, ends: tuple[int, int], last: Floats, begins: bool, path: Floats
) -> None:
    """Write the least costs of paths that are longer by one pixel."""
    least = np.float32(0) if begins else last.min()
    for k in range(ends[0], ends[1] + 1):
        step = least
        if not begins:
            step = min(last[k], least + LARGE_STEP)
            if k > 0:
                step = min(step, last[k - 1] + SMALL_STEP)
            if k + 1 < len(last):
                step = min(step, last[k + 1] + SMALL_STEP)
        path[k] = costs[k] + step - least


@numba.njit(cache=True, nogil=True)
def least_offsets(total: Floats, offsets: Array, low: Indices, high: Indices) -> Array:
    """Offsets (h, w) of the least sums, between the surfaces by a parabola; NaN for none."""
    height, width, _ = total.shape
    least = np.full((height, width), np.nan)
    spacing = offsets[1] - offsets[0]
    for y in range(height):
        for x in range(width):
            first, last = low[y, x], high[y, x]
            if last < 0:
                continue
            best = first
            for k in range(first, last + 1):
                if total[y, x, k] < total[y, x, best]:
                    best = k
            aside = 0.0
            if first < best < last:
                before, after = total[y, x, best - 1], total[y, x, best + 1]
                bend = before + after - 2.0 * total[y, x, best]
                if bend > 0.0:
                    aside = 0.5 * (before - after) / bend
            least[y, x] = offsets[best] + aside * spacing
    return least
