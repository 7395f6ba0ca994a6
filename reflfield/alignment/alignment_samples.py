"""Samples of texels as alignment takes them: read in blocks, each texel over its largest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.util.validation import check_shape

BLOCK_BYTES = 64 * 2**20
# Texels whose mean is the first guess of samples that others miss.
MEAN_TEXELS = 1024


class SampleSource(Protocol):
    """Samples read block by block, for example from a store on disk."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(n_texels, n_views, n_lights)."""

    def read(self, rows: NDArray[np.int64]) -> NDArray[np.floating]:
        """Samples of some texels, rows ascending; not finite where unobserved."""


@dataclass(frozen=True, eq=False)
class ArraySource:
    """Samples that are in memory already."""

    samples: NDArray[np.floating]

    @property
    def shape(self) -> tuple[int, ...]:
        """(n_texels, n_views, n_lights)."""
        return self.samples.shape

    def read(self, rows: NDArray[np.int64]) -> NDArray[np.floating]:
        """Samples of some texels."""
        return self.samples[rows]


def as_source(samples: ArrayLike | SampleSource) -> SampleSource:
    """A source as it is; an array as one, in float64 or float32."""
    if hasattr(samples, "read") and hasattr(samples, "shape"):
        return samples  # type: ignore[return-value]
    array = np.asarray(samples)
    if array.dtype != np.float64:
        array = array.astype(np.float32, copy=False)
    return ArraySource(array)


def blocks_of(source: SampleSource, rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Parts of `rows` whose samples fit the block size."""
    each = max(1, BLOCK_BYTES // (4 * source.shape[1] * source.shape[2]))
    return [rows[first : first + each] for first in range(0, len(rows), each)]


@numba.njit(cache=True, nogil=True)
def _over_largest(block: NDArray[np.floating], out: NDArray[np.float32]) -> None:
    for i in range(block.shape[0]):
        largest = 0.0
        for value in block[i].flat:
            size = abs(value)
            if size > largest and size < np.inf:
                largest = float(size)
        if largest == 0.0:
            largest = 1.0
        texel = out[i]
        for v in range(block.shape[1]):
            for k in range(block.shape[2]):
                value = block[i, v, k]
                texel[v, k] = np.float32(value / largest if abs(value) < np.inf else np.nan)


def read_unit(source: SampleSource, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Samples over the largest of each texel, so that float32 holds any input scale.

    Parameters
    ----------
    source : SampleSource
    rows : (k,) int64
        Ascending.

    Returns
    -------
    (k, n_views, n_lights) float32
        NaN where unobserved.

    Raises
    ------
    ShapeError
        If the source returns another shape than asked for.

    Examples
    --------
    >>> read_unit(ArraySource(np.array([[[4.0, np.inf, -2.0]]])), np.array([0]))
    array([[[ 1. ,  nan, -0.5]]], dtype=float32)
    """
    block = np.ascontiguousarray(source.read(rows))
    check_shape("samples.read(rows)", block, (len(rows), *source.shape[1:]))
    if block.dtype not in (np.float32, np.float64):
        block = block.astype(np.float32)
    out = np.zeros(block.shape, np.float32)
    _over_largest(block, out)
    return out


def mean_samples(source: SampleSource, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Mean observed unit sample of each pair of directions, over some of the texels.

    Returns
    -------
    (n_views, n_lights) float32
        The mean of all where a pair was never observed.

    Examples
    --------
    >>> samples = np.array([[[1.0, np.nan, 0.5]], [[1.0, np.nan, 0.7]]])
    >>> mean_samples(ArraySource(samples), np.arange(2)).round(3)
    array([[1. , 0.8, 0.6]], dtype=float32)
    """
    total, count = np.zeros(source.shape[1:]), np.zeros(source.shape[1:])
    for part in blocks_of(source, rows[:: max(1, len(rows) // MEAN_TEXELS)]):
        block = read_unit(source, part)
        observed = np.isfinite(block)
        total += np.where(observed, block, 0).sum(axis=0, dtype=np.float64)
        count += observed.sum(axis=0)
    known = count > 0
    middle = total.sum() / max(count.sum(), 1.0)
    return np.where(known, total / np.where(known, count, 1), middle).astype(np.float32)
