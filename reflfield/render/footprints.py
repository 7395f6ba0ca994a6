"""What the rays of a pixel meet, merged into one entry for each texel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Footprints:
    """The texels under each pixel: one entry for each pair of pixel and texel.

    Parameters
    ----------
    pixel : (n,) int64
        Pixel of the entry, counted within the block.
    texel : (n,) int32
        Its texel.
    position : (n, 3) float64
        Mean of the pixel's hits that read the texel.
    entry_of_tap : (n_hits, 4) int64
        Entry that each tap of each hit went to, -1 for taps without weight.
    weights : (n_hits, 4) float32
        Weights of the taps.
    """

    pixel: NDArray[np.int64]
    texel: NDArray[np.int32]
    position: Array
    entry_of_tap: NDArray[np.int64]
    weights: NDArray[np.float32]

    def summed(self, per_hit: NDArray[Any]) -> Array:
        """Sum a number per hit into the entries, weighted by the taps, (n,) float64."""
        sums = np.zeros((len(self.pixel), 1))
        _add_taps(self.entry_of_tap, self.weights, per_hit.astype(np.float64)[:, None], sums)
        return sums[:, 0]


def merged_taps(
    pixel: NDArray[np.int64],
    texels: NDArray[np.int32],
    weights: NDArray[np.float32],
    positions: Array,
) -> Footprints:
    """Merge the texel taps of each pixel's hits.

    Parameters
    ----------
    pixel : (n_hits,) int64
        Pixel of each hit, ascending.
    texels : (n_hits, 4) int32
    weights : (n_hits, 4) float32
        Taps without weight are left out.
    positions : (n_hits, 3) float64
    """
    entry = np.full(texels.shape, -1, np.int64)
    entry_pixel = np.zeros(texels.size, np.int64)
    entry_texel = np.zeros(texels.size, np.int32)
    n = _merge_taps(pixel, texels, weights, entry, entry_pixel, entry_texel)
    means, total = np.zeros((n, 3)), np.zeros((n, 1))
    _add_taps(entry, weights, positions, means)
    _add_taps(entry, weights, np.ones((len(pixel), 1)), total)
    means /= total
    return Footprints(entry_pixel[:n].copy(), entry_texel[:n].copy(), means, entry, weights)


@numba.njit(cache=True, nogil=True)
def _merge_taps(
    pixel: NDArray[np.int64],
    texels: NDArray[np.int32],
    weights: NDArray[np.float32],
    entry: NDArray[np.int64],
    entry_pixel: NDArray[np.int64],
    entry_texel: NDArray[np.int32],
) -> int:
    """Number the distinct texels of each pixel; returns their count."""
    n = 0
    first = 0  # first entry of the current pixel
    for i in range(len(pixel)):
        if i > 0 and pixel[i] != pixel[i - 1]:
            first = n
        for j in range(4):
            if not weights[i, j] > 0:
                continue
            # The latest entries are the likeliest: neighbouring samples share texels.
            same = n - 1
            while same >= first and entry_texel[same] != texels[i, j]:
                same -= 1
            if same < first:
                same = n
                entry_pixel[n] = pixel[i]
                entry_texel[n] = texels[i, j]
                n += 1
            entry[i, j] = same
    return n


@numba.njit(cache=True, nogil=True)
def _add_taps(entry: Any, weights: Any, per_hit: Any, sums: Any) -> None:
    """Add rows of hits (n_hits, k), weighted by the taps, to the entries (n, k)."""
    for i in range(len(entry)):
        for j in range(4):
            if entry[i, j] >= 0:
                for k in range(per_hit.shape[1]):
                    sums[entry[i, j], k] += weights[i, j] * per_hit[i, k]


def blended(values: NDArray[np.floating], corners: NDArray[np.int32], shares: Array) -> Array:
    """Values (n, k) within triangles: of vertices (m, k), at corners (n, 3) with shares (n, 3).

    Examples
    --------
    >>> ends = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    >>> blended(ends, np.array([[0, 1, 2]], np.int32), np.array([[0.5, 0.25, 0.25]]))
    array([[0.25, 0.25]])
    """
    within = np.zeros((len(corners), values.shape[1]))
    _blend(values, corners, shares, within)
    return within


@numba.njit(cache=True, nogil=True)
def _blend(values: Any, corners: Any, shares: Any, out: Any) -> None:
    for i in range(len(corners)):
        for k in range(values.shape[1]):
            total = 0.0
            for j in range(3):
                total += shares[i, j] * values[corners[i, j], k]
            out[i, k] = total
