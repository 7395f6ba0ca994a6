"""Samples as alignment reads them: on common directions, or each texel at its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.errors import ShapeError
from reflfield.util.validation import check_shape, unit_directions

# Of the samples of texels that are worked on together; several threads hold as much each.
BLOCK_BYTES = 32 * 2**20
# Texels whose mean is the first guess of samples that others miss.
MEAN_TEXELS = 1024


class SampleSource(Protocol):
    """Samples on common directions, read block by block, for example from a store on disk."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(n_texels, n_views, n_lights)."""

    def read(self, rows: NDArray[np.int64]) -> NDArray[np.floating]:
        """Samples of some texels, rows ascending; not finite where unobserved."""


class ScatteredSource(Protocol):
    """Samples of texels, each at its own directions, read block by block."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(n_texels, n_views, n_lights)."""

    def read(self, rows: NDArray[np.int64]) -> SampleSet:
        """Samples of some texels, rows ascending."""


@dataclass(frozen=True, eq=False)
class SampleSet:
    """Samples of some texels with their directions in the base frames.

    Parameters
    ----------
    samples : (n, n_views, n_lights) float32
        Not finite where unobserved.
    views : (n_views, 3) or (n, n_views, 3) float64
        Unit vectors: the same for all texels, or each texel its own.
    lights : (n_lights, 3) or (n, n_lights, 3) float64

    Raises
    ------
    ShapeError
        If directions do not belong to the samples.
    """

    samples: NDArray[np.float32]
    views: NDArray[np.float64]
    lights: NDArray[np.float64]

    def __post_init__(self) -> None:
        n, *counts = self.samples.shape
        for name, directions, count in zip(
            ("views", "lights"), (self.views, self.lights), counts, strict=True
        ):
            own = (n,) if directions.ndim == 3 else ()
            check_shape(name, directions, (*own, count, 3))

    def part(self, rows: slice | NDArray[np.int64]) -> SampleSet:
        """Samples of some of the texels."""
        views, lights = (
            directions[rows] if directions.ndim == 3 else directions
            for directions in (self.views, self.lights)
        )
        return SampleSet(self.samples[rows], views, lights)

    def directions(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Views and lights with a leading axis: one entry for all texels, or one for each."""
        views, lights = (d if d.ndim == 3 else d[None] for d in (self.views, self.lights))
        return views, lights

    def brightness(self) -> NDArray[np.float64]:
        """(n,) root mean square of the observed samples; 0 where there is none."""
        observed = np.isfinite(self.samples)
        squares = np.where(observed, self.samples, 0).astype(np.float64) ** 2
        count = np.maximum(observed.sum(axis=(1, 2)), 1)
        return np.sqrt(squares.sum(axis=(1, 2)) / count)

    def normalised(self) -> SampleSet:
        """Samples over the largest of each texel; NaN where unobserved. See `normalised`."""
        return replace(self, samples=normalised(self.samples))

    def thinned(self, enough: int) -> SampleSet:
        """Every so many views of each texel, so that about `enough` samples are left."""
        n_views, n_lights = self.samples.shape[1:]
        stride = max(1, n_views * n_lights // enough)
        return SampleSet(
            np.ascontiguousarray(self.samples[:, ::stride]),
            np.ascontiguousarray(self.views[..., ::stride, :]),
            self.lights,
        )


@dataclass(frozen=True, eq=False)
class GriddedSamples:
    """Samples on common directions: a `ScatteredSource` whose directions are all the same.

    Parameters
    ----------
    samples : (n, n_views, n_lights) array or SampleSource
    views, lights : (n_views, 3), (n_lights, 3) float64
        Unit vectors in the texels' base frames.
    """

    samples: NDArray[np.floating] | SampleSource
    views: NDArray[np.float64]
    lights: NDArray[np.float64]

    @classmethod
    def checked(
        cls, samples: ArrayLike | SampleSource, views: ArrayLike, lights: ArrayLike
    ) -> GriddedSamples:
        """Samples and directions that fit together.

        Raises
        ------
        ShapeError
            If they do not, or there is no texel.
        InputError
            If directions are not unit vectors.
        """
        view, light = unit_directions("views", views), unit_directions("lights", lights)
        source = _as_source(samples)
        if len(source.shape) != 3 or tuple(source.shape[1:]) != (len(view), len(light)):
            raise ShapeError(
                f"samples: expected shape (n, {len(view)}, {len(light)}) for {len(view)} views "
                f"and {len(light)} lights, received {tuple(source.shape)}"
            )
        if source.shape[0] == 0:
            raise ShapeError("samples: expected at least one texel, received 0")
        return cls(source, view, light)

    @property
    def shape(self) -> tuple[int, ...]:
        """(n_texels, n_views, n_lights)."""
        return self.samples.shape

    def read(self, rows: NDArray[np.int64]) -> SampleSet:
        """Samples of some texels, each over its largest; NaN where unobserved.

        Raises
        ------
        ShapeError
            If the source returns another shape than asked for.
        """
        stored = self.samples
        block = stored[rows] if isinstance(stored, np.ndarray) else stored.read(rows)
        check_shape("samples.read(rows)", block, (len(rows), *self.shape[1:]))
        return SampleSet(normalised(block), self.views, self.lights)


def _as_source(samples: ArrayLike | SampleSource) -> NDArray[np.floating] | SampleSource:
    if hasattr(samples, "read") and hasattr(samples, "shape"):
        return samples  # type: ignore[return-value]
    array = np.asarray(samples)
    return array if array.dtype == np.float64 else array.astype(np.float32, copy=False)


def blocks_of(shape: tuple[int, ...], rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Parts of `rows` whose samples, of (n, n_views, n_lights) in all, fit the block size."""
    each = max(1, BLOCK_BYTES // bytes_per_texel(shape))
    return [rows[first : first + each] for first in range(0, len(rows), each)]


def bytes_per_texel(shape: tuple[int, ...]) -> int:
    """Memory of one texel's samples and of directions of its own."""
    n_views, n_lights = shape[1:]
    return 4 * n_views * n_lights + 24 * (n_views + n_lights)


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


def normalised(samples: NDArray[np.floating]) -> NDArray[np.float32]:
    """Samples over the largest of each texel, so that float32 holds any scale.

    Parameters
    ----------
    samples : (n, n_views, n_lights) float
        Not finite where unobserved.

    Returns
    -------
    (n, n_views, n_lights) float32
        NaN where unobserved.

    Examples
    --------
    >>> normalised(np.array([[[4.0, np.inf, -2.0]]]))
    array([[[ 1. ,  nan, -0.5]]], dtype=float32)
    """
    block = np.ascontiguousarray(samples)
    if block.dtype not in (np.float32, np.float64):
        block = block.astype(np.float32)
    out = np.zeros(block.shape, np.float32)
    _over_largest(block, out)
    return out


def mean_samples(source: GriddedSamples, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Mean observed normalised sample of each pair of directions, over some of the texels.

    Returns
    -------
    (n_views, n_lights) float32
        The mean of all where a pair was never observed.

    Examples
    --------
    >>> samples = np.array([[[1.0, np.nan, 0.5]], [[1.0, np.nan, 0.7]]])
    >>> up = np.array([[0.0, 0.0, 1.0]])
    >>> source = GriddedSamples(samples, up, up.repeat(3, 0))
    >>> mean_samples(source, np.arange(2)).round(3)
    array([[1. , 0.8, 0.6]], dtype=float32)
    """
    total, count = np.zeros(source.shape[1:]), np.zeros(source.shape[1:])
    for part in blocks_of(source.shape, rows[:: max(1, len(rows) // MEAN_TEXELS)]):
        block = source.read(part).samples
        observed = np.isfinite(block)
        total += np.where(observed, block, 0).sum(axis=0, dtype=np.float64)
        count += observed.sum(axis=0)
    known = count > 0
    mean_of_all = total.sum() / max(count.sum(), 1.0)
    return np.where(known, total / np.where(known, count, 1), mean_of_all).astype(np.float32)
