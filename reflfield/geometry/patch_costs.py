"""Kernels of stereo by patches: costs of swept surfaces, and the least ones over paths.

`geometry.patch_stereo` says what they are for.
"""

from __future__ import annotations

from typing import Any, NamedTuple

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
    shown = np.zeros(shape, np.float32)
    for k in range(len(sweep.offsets)):
        lowest = np.full(shape, UNKNOWN)
        second = lowest.copy()
        for j in others:
            _show(images, j, sweep, k, own.covered, shown)
            _compare(own, shown, lowest, second)
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


# Sums over a patch: how many pixels are compared; of the own and the other brightness, of their
# squares and of their product.
N_SUMS = 6
# Rows and columns of a patch.
_ACROSS = 2 * REACH + 1


@numba.njit(cache=True, nogil=True, inline="always")
def _plus(index: int, step: int) -> Any:
    """Sum of two indices of which the compiler knows that they do not count from the end."""
    return np.uint64(index) + np.uint64(step)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _compare(own: OwnImage, shown: Floats, lowest: Floats, second: Floats) -> None:
    """Lower the two least costs of each pixel by those of one view.

    Sums are made row by row: over the height of a patch, then over its width. All loops along a
    row are without branches, for vector instructions.
    """
    height, width = shown.shape
    terms = np.zeros((_ACROSS, N_SUMS, width), np.float32)
    high = np.zeros((N_SUMS, width + 2 * REACH), np.float32)
    sums = np.zeros((N_SUMS, width), np.float32)
    for y in range(min(REACH, height)):
        _products(own.grey, shown, y, terms, y)
    for y in range(height):
        newest = (y + REACH) % _ACROSS
        if y + REACH < height:
            _products(own.grey, shown, y + REACH, terms, newest)
        else:
            terms[newest] = 0
        _over_patches(terms, high, sums)
        _lower(own.covered, y, sums, lowest, second)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _products(grey: Floats, shown: Floats, y: int, terms: Floats, place: int) -> None:
    """What each pixel of a row adds to the sums over patches."""
    for x in range(shown.shape[1]):
        other = shown[y, x]
        seen = np.float32(1) if other != NOT_SEEN else np.float32(0)
        mine, other = seen * grey[y, x], seen * other
        terms[place, 0, x], terms[place, 1, x], terms[place, 2, x] = seen, mine, other
        terms[place, 3, x] = mine * mine
        terms[place, 4, x] = other * other
        terms[place, 5, x] = mine * other


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _over_patches(terms: Floats, high: Floats, sums: Floats) -> None:
    """Sums over patches from the terms of their rows; `high` has zeros beside the row."""
    width = sums.shape[1]
    for i in range(N_SUMS):
        for x in range(width):
            total = terms[0, i, x]
            for row in range(1, _ACROSS):
                total += terms[row, i, x]
            high[i, _plus(x, REACH)] = total
        for x in range(width):
            total = high[i, x]
            for column in range(1, _ACROSS):
                total += high[i, _plus(x, column)]
            sums[i, x] = total


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _lower(
    covered: NDArray[np.bool_], y: int, sums: Floats, lowest: Floats, second: Floats
) -> None:
    """Lower the two least costs of a row where a patch can be compared."""
    one, noise = np.float32(1), np.float32(NOISE**2)
    for x in range(sums.shape[1]):
        n = sums[0, x]
        usable = covered[y, x] and n >= np.float32(LEAST_SHARE * _ACROSS**2)
        per = one / max(n, one)
        a, b = sums[1, x] * per, sums[2, x] * per
        mine = max(sums[3, x] * per - a * a, np.float32(0)) + noise
        other = max(sums[4, x] * per - b * b, np.float32(0)) + noise
        cost = one - (sums[5, x] * per - a * b) / np.sqrt(mine * other)
        cost = cost if usable else OUTSIDE
        least = lowest[y, x]
        second[y, x] = min(second[y, x], max(cost, least))
        lowest[y, x] = min(cost, least)


@numba.njit(cache=True, nogil=True)
def aggregated(costs: Floats, low: Indices, high: Indices) -> Floats:
    """Sums over 8 directions of the least costs of paths that end at a pixel's surface."""
    height, width, n = costs.shape
    total = np.zeros_like(costs)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        # A surface more at each end, so that all have neighbours.
        before = np.full((width, n + 2), OUTSIDE, np.float32)
        current = np.full((width, n + 2), OUTSIDE, np.float32)
        for row in range(height):
            y = row if dy >= 0 else height - 1 - row
            for column in range(width):
                x = column if dx >= 0 else width - 1 - column
                current[x] = OUTSIDE
                if high[y, x] < 0:
                    continue
                begins = not (0 <= x - dx < width and 0 <= y - dy < height)
                begins = begins or high[y - dy, x - dx] < 0
                first, end = low[y, x], high[y, x] + 1
                last = current if dy == 0 else before
                place = x if begins else x - dx
                _continue_path(costs, (y, x), (first, end), last, place, begins, current)
                for k in range(first, end):
                    total[y, x, _plus(k, 0)] += current[x, _plus(k, 1)]
            if dy != 0:
                before, current = current, before
    return total


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _continue_path(
    costs: Floats,
    at: tuple[int, int],
    ends: tuple[int, int],
    last: Floats,
    place: int,
    begins: bool,
    path: Floats,
) -> None:
    """Write the least costs of paths at a pixel: begun there, or at `place` of `last`."""
    y, x = at
    if begins:
        for k in range(ends[0], ends[1]):
            path[x, _plus(k, 1)] = costs[y, x, _plus(k, 0)]
        return
    least = OUTSIDE
    for k in range(last.shape[1]):
        least = min(least, last[place, k])
    jump = least + LARGE_STEP
    for k in range(ends[0], ends[1]):
        aside = min(last[place, _plus(k, 0)], last[place, _plus(k, 2)]) + SMALL_STEP
        step = min(min(last[place, _plus(k, 1)], aside), jump)
        path[x, _plus(k, 1)] = costs[y, x, _plus(k, 0)] + (step - least)


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
