"""Where columns come from: arrays and stores on disk; read a few columns at a time.

Every method of this package reads its matrix through `ColumnSource`, so that
memory holds a block of columns and never the matrix. `as_source` wraps what
callers usually have.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import DTypeLike, NDArray

from reflfield.errors import InputError, ShapeError

Values: TypeAlias = NDArray[np.floating]
# Weights in [0, 1], or bool: True where the entry was observed.
Weights: TypeAlias = NDArray[np.floating] | NDArray[np.bool_]
Columns: TypeAlias = NDArray[np.intp]


@runtime_checkable
class ColumnSource(Protocol):
    """A matrix of which any few columns can be read.

    A source may also carry ``run_length`` (int, 1 if absent): columns are then
    visited in whole runs ``[i * run_length, (i + 1) * run_length)``, the runs
    in random order. Stores set it to the columns of one chunk, so that a chunk
    is decoded once a pass. A ``dtype`` (float32 if absent) sets the precision.
    """

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the matrix."""

    def read(self, columns: Columns) -> tuple[Values, Weights]:
        """Values (n_rows, k) and their weights, (n_samples, k) float or bool.

        Values of weight zero may be anything, NaN included. With several
        channels, rows are (sample, channel), channel fastest, and the weights
        have one row per sample.
        """


def run_length(source: ColumnSource) -> int:
    """Columns that the source likes to hand out together."""
    return max(1, int(getattr(source, "run_length", 1)))


def source_dtype(source: ColumnSource) -> np.dtype[np.floating]:
    """float64 for a source of float64, float32 for every other."""
    wide = np.dtype(getattr(source, "dtype", np.float32)) == np.float64
    return np.dtype(np.float64 if wide else np.float32)


def shuffled_columns(source: ColumnSource, rng: np.random.Generator) -> Columns:
    """All columns, whole runs in random order."""
    n_columns = source.shape[1]
    starts = np.arange(0, n_columns, run_length(source))
    order = rng.permutation(len(starts))
    edges = np.append(starts, n_columns)
    if run_length(source) == 1:
        return order
    return np.concatenate([np.arange(edges[i], edges[i + 1]) for i in order])


def blocks_of(columns: Columns, size: int) -> Iterator[Columns]:
    """Cut a list of columns into blocks, the last of which may be shorter."""
    for start in range(0, len(columns), size):
        yield columns[start : start + size]


# --- adapters ---------------------------------------------------------------------------

# A column of which less was seen tells the basis nothing that its noise does not, where others
# were seen better.
LEAST_COVERAGE = 0.02


@dataclass(frozen=True)
class MatrixSource:
    """Columns of an array, memory map or zarr array, with or without `observed` beside it.

    Without `observed`, NaN marks what is missing.
    """

    values: Any
    observed: Any = None
    n_channels: int = 1

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return int(self.values.shape[0]), int(self.values.shape[1])

    @property
    def dtype(self) -> DTypeLike:
        """Type of the values."""
        return np.dtype(self.values.dtype)

    @property
    def run_length(self) -> int:
        """Columns of one chunk for a chunked store, else 1."""
        chunks = getattr(self.values, "chunks", None)
        return int(chunks[1]) if chunks else 1

    def read(self, columns: Columns) -> tuple[Values, Weights]:
        """Values and weights of some columns."""
        values = take_columns(self.values, columns)
        if self.observed is not None:
            return values, take_columns(self.observed, columns)
        missing = np.isnan(values).reshape(-1, self.n_channels, len(columns))
        return values, ~missing.any(axis=1)


def take_columns(array: Any, columns: Columns) -> NDArray[Any]:
    """Columns of anything that can be sliced ``[:, a:b]``, in the order asked for."""
    if isinstance(array, np.ndarray):
        n = array.shape[1]
        if len(columns) == n and np.array_equal(columns, np.arange(n)):
            return array
        return np.take(array, columns, axis=1)
    breaks = np.flatnonzero(np.diff(columns) != 1) + 1
    runs = np.split(columns, breaks)
    parts = [np.asarray(array[:, int(run[0]) : int(run[-1]) + 1]) for run in runs]
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


def as_source(
    matrix: Any, observed: Any = None, weights: Any = None, n_channels: int = 1
) -> ColumnSource:
    """Wrap a matrix or store as a column source; a source stays as it is.

    Parameters
    ----------
    matrix : (n_rows, n_columns) ndarray, zarr array or ColumnSource
    observed : (n_rows // n_channels, n_columns) bool, optional
        True where the entry was measured. Without it, NaN marks what is missing.
    weights : (n_rows // n_channels, n_columns) float in [0, 1], optional
        Confidence, in place of `observed`; 0 is unobserved.
    n_channels : int
        Rows that share one observation, adjacent (channel fastest).

    Returns
    -------
    ColumnSource
        The source itself if `matrix` is one.

    Raises
    ------
    ShapeError
        If a shape does not fit.
    InputError
        If the arguments contradict each other.

    Examples
    --------
    >>> source = as_source(np.array([[1.0, np.nan], [3.0, 4.0]]))
    >>> source.read(np.array([1]))[1].ravel()
    array([False,  True])
    """
    if observed is not None and weights is not None:
        raise InputError("weights: expected either observed or weights, received both")
    beside = weights if weights is not None else observed
    source = _wrap(matrix, beside, n_channels)
    n_rows, n_columns = source.shape
    if n_rows == 0 or n_columns == 0:
        raise ShapeError(
            f"matrix: expected at least one row and column, received {source.shape}"
        )
    if n_channels < 1 or n_rows % n_channels:
        raise ShapeError(
            f"n_channels: expected a divisor of {n_rows} rows, received {n_channels}"
        )
    wanted = (n_rows // n_channels, n_columns)
    if beside is not None and tuple(beside.shape) != wanted:
        name = "observed" if weights is None else "weights"
        raise ShapeError(f"{name}: expected shape {wanted}, received {tuple(beside.shape)}")
    return source


def _wrap(matrix: Any, beside: Any, n_channels: int) -> ColumnSource:
    if not hasattr(matrix, "shape") or len(matrix.shape) != 2:
        received = getattr(matrix, "shape", type(matrix).__name__)
        raise ShapeError(f"matrix: expected shape (n_rows, n_columns), received {received}")
    if isinstance(matrix, np.ndarray) or not hasattr(matrix, "read"):
        return MatrixSource(matrix, beside, n_channels)
    if beside is not None:
        raise InputError(
            "observed: expected None with a source, which returns weights beside its values"
        )
    return matrix


# --- one block, ready for arithmetic ----------------------------------------------------


@dataclass(frozen=True)
class Block:
    """A block of columns without anything unread in it.

    Attributes
    ----------
    columns : (k,) intp
        Their numbers.
    values : (n_rows, k) float
        Zero where nothing was observed.
    weights : (n_rows // n_channels, k) float
        In [0, 1].
    """

    columns: Columns
    values: Values
    weights: NDArray[np.floating]

    @property
    def coverage(self) -> NDArray[np.float64]:
        """Share of each column that was observed, (k,)."""
        return self.weights.mean(axis=0, dtype=np.float64)


@dataclass(frozen=True)
class Reader:
    """Reads blocks of a source in one precision and one unit.

    Values are divided by `scale`, a power of two near the largest of them,
    so that squares neither underflow nor overflow in float32. Columns of which less than
    `least_coverage` was seen are completed, but do not shape the basis.
    """

    source: ColumnSource
    n_channels: int
    dtype: np.dtype[np.floating]
    scale: float = 1.0
    least_coverage: float = LEAST_COVERAGE

    def block(self, columns: Columns) -> Block:
        """Read columns, zero what is unobserved, check the rest."""
        values, weights = self.source.read(columns)
        n_rows = self.source.shape[0]
        _check_read("values", values, (n_rows, len(columns)))
        _check_read("weights", weights, (n_rows // self.n_channels, len(columns)))
        _check_weights(weights)
        by_sample = values.reshape(-1, self.n_channels, len(columns))
        clean = np.where((weights > 0)[:, None, :], by_sample, 0)
        _check_finite(clean, columns)
        if self.scale != 1.0:
            clean = clean / np.asarray(self.scale, dtype=clean.dtype)
        return Block(
            columns,
            clean.reshape(n_rows, -1).astype(self.dtype, copy=False),
            weights.astype(self.dtype),
        )


def reader_of(source: ColumnSource, n_channels: int, block: int) -> Reader:
    """Return a reader whose scale and least coverage suit the first columns not all zero."""
    reader = Reader(source, n_channels, source_dtype(source))
    for columns in blocks_of(np.arange(source.shape[1]), block):
        data = reader.block(columns)
        largest = float(max(data.values.max(), -data.values.min()))
        if largest > 0:
            return replace(
                reader,
                scale=float(2.0 ** np.round(np.log2(largest))),
                least_coverage=_least_coverage(data.coverage),
            )
    return reader


def _least_coverage(coverage: NDArray[np.float64]) -> float:
    """Below `LEAST_COVERAGE` where all columns are sparse: some have to shape the basis."""
    usual = float(np.quantile(coverage[coverage > 0], 0.9))
    return min(LEAST_COVERAGE, 0.5 * usual)


def _check_read(name: str, array: NDArray[Any], expected: tuple[int, int]) -> None:
    if array.shape != expected:
        raise ShapeError(f"{name} read: expected shape {expected}, received {array.shape}")


def _check_weights(weights: Weights) -> None:
    if weights.dtype != np.bool_ and not (weights.min() >= 0 and weights.max() <= 1):
        raise InputError(
            f"weights: expected values in [0, 1], received {weights.min()} to {weights.max()}"
        )


def _check_finite(values: Values, columns: Columns) -> None:
    # The extremes show NaN and infinity; entries are looked for only once something is wrong.
    if np.isfinite(values.min()) and np.isfinite(values.max()):
        return
    sample, channel, k = np.argwhere(~np.isfinite(values))[0]
    raise InputError(
        f"matrix: expected finite values where observed, received {values[sample, channel, k]} "
        f"in row {sample * values.shape[1] + channel}, column {columns[k]}; "
        "declare it unobserved"
    )
