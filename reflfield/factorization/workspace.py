"""One global low-dimensional space in which columns are clustered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.factorization.column_sources import Reader, blocks_of
from reflfield.util.progress import report

Array = NDArray[Any]
# Random directions beyond those wanted.
OVERSAMPLING = 10


@dataclass(frozen=True)
class Workspace:
    """Columns as ``mean + basis @ coordinates[column]``, approximately.

    Attributes
    ----------
    mean : (n_rows,) float
    basis : (n_rows, d) float
        Orthonormal, by descending variance of the coordinates.
    coordinates : (n_columns, d) float
        Of mean zero.
    """

    mean: Array
    basis: Array
    coordinates: Array


def pca_workspace(reader: Reader, n_dimensions: int, block: int, seed: int) -> Workspace:
    """Leading principal components by randomised subspace iteration, in three readings.

    N. Halko, P. Martinsson, J. Tropp, "Finding structure with randomness", SIAM Review 53,
    2011.

    Raises
    ------
    InputError
        If an entry is missing.
    """
    n_rows, n_columns = reader.source.shape
    n_dimensions = min(n_dimensions, n_rows, n_columns)
    width = min(n_dimensions + OVERSAMPLING, n_rows, n_columns)
    probes = np.random.default_rng(seed).standard_normal((n_columns, width), dtype=np.float32)
    mean, sketch = _sketch(reader, probes, block)
    sketch, _ = _power_step(reader, mean, np.linalg.qr(sketch)[0], block)
    q = np.linalg.qr(sketch)[0]
    _, coordinates = _power_step(reader, mean, q, block)
    _, _, vectors = np.linalg.svd(coordinates, full_matrices=False)
    rotation = vectors[:n_dimensions].T
    return Workspace(mean, q @ rotation, coordinates @ rotation)


def _sketch(reader: Reader, probes: Array, block: int) -> tuple[Array, Array]:
    """Mean column and (X - mean) Omega."""
    n_rows, n_columns = reader.source.shape
    total = np.zeros(n_rows)
    sketch = np.zeros((n_rows, probes.shape[1]), dtype=reader.dtype)
    for columns in blocks_of(np.arange(n_columns), block):
        data = reader.block(columns)
        if data.weights.min() < 1:
            raise InputError(
                "matrix: expected complete columns, received some with missing entries; fill "
                "them with `complete` first"
            )
        report("principal components", int(columns[0]), n_columns)
        total += data.values.sum(axis=1, dtype=np.float64)
        sketch += data.values @ probes[columns].astype(reader.dtype)
    mean = (total / n_columns).astype(reader.dtype)
    return mean, sketch - np.outer(mean, probes.sum(axis=0)).astype(reader.dtype)


def _power_step(reader: Reader, mean: Array, q: Array, block: int) -> tuple[Array, Array]:
    """Z = (X - mean)^T Q and (X - mean) Z in one reading."""
    n_columns = reader.source.shape[1]
    coordinates = np.zeros((n_columns, q.shape[1]), dtype=reader.dtype)
    sketch = np.zeros_like(q)
    for columns in blocks_of(np.arange(n_columns), block):
        centred = reader.block(columns).values - mean[:, None]
        coordinates[columns] = centred.T @ q
        sketch += centred @ coordinates[columns]
    return sketch, coordinates
