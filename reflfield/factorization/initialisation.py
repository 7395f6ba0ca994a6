"""A subspace to start completion from, and the noise level it should reach.

Started from the singular vectors of one zero-filled block, about one fit in
sixteen stalls far above the noise. So a few blocks are fitted on their own, on
a share of the rows; the best is extended to all rows, and its residual is
what the fit of all columns is measured by.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.factorization.column_sources import Block, Columns, Reader, blocks_of
from reflfield.factorization.recursive_least_squares import (
    Model,
    Posterior,
    RowStatistics,
    floored,
    gram_of_samples,
    infer,
    resolve_online,
    weighted,
    with_moments,
)

Array = NDArray[Any]
# Of a block that was observed, in the first guess of its variance.
LEAST_SHARE = 1e-3
# What a row weighs while columns stream by, in observations, when it is solved for again.
PSEUDO_OBSERVATIONS = 2.0
# The same towards zero, for rows that the start has not fitted yet.
EXTENDING_PSEUDO_OBSERVATIONS = 0.05
# Blocks fitted on their own, iterations of each, and samples used: a dozen iterations reach the
# noise.
CANDIDATES = 3
ITERATIONS = 12
SAMPLES = 2048
SAMPLES_PER_RANK = 32


def start_model(
    reader: Reader,
    order: Columns,
    rank: int,
    block: int,
    rng: np.random.Generator,
) -> tuple[Model, float]:
    """Model of the block that is fitted best, and the noise variance left in it.

    Parameters
    ----------
    reader : Reader
        Where columns come from.
    order : (n_columns,) intp
        Columns in the order in which they will be visited.
    rank, block : int
        Basis vectors; columns of a block.
    rng : numpy.random.Generator
        For the choice of rows and the first subspace.

    Returns
    -------
    model : Model
        Over all rows.
    floor : float
        Residual variance, corrected for the parameters spent.

    Raises
    ------
    InputError
        If no column was observed well enough.
    """
    n_samples = reader.source.shape[0] // reader.n_channels
    samples = _some_samples(n_samples, rank, rng)
    best: tuple[float, Model, Posterior, Block] | None = None
    for candidate, data in enumerate(_informative_blocks(reader, order, block)):
        part = rows_of(data, samples, reader.n_channels)
        model = _first_model(part, rank, reader.n_channels, rng, candidate)
        fitted = _alternated(model, part)
        if best is None or fitted[0] < best[0]:
            best = (*fitted, data)
    if best is None:
        raise InputError(
            f"observed: expected a column of which {reader.least_coverage:.0%} was observed, "
            "received none; there is nothing to complete from: check silhouettes, cameras, "
            "lights and exposure"
        )
    floor, model, posterior, data = best
    return _extended(model, posterior, data), floor


def _some_samples(n_samples: int, rank: int, rng: np.random.Generator) -> NDArray[np.intp]:
    n_chosen = min(n_samples, max(SAMPLES, SAMPLES_PER_RANK * rank))
    return np.sort(rng.choice(n_samples, n_chosen, replace=False))


def _informative_blocks(reader: Reader, order: Columns, block: int) -> list[Block]:
    """Blocks of well observed columns, one a candidate; the same again if there are too few."""
    blocks: list[Block] = []
    for columns in blocks_of(order, block):
        data = reader.block(columns)
        kept = data.coverage >= reader.least_coverage
        if kept.any():
            blocks.append(Block(columns[kept], data.values[:, kept], data.weights[:, kept]))
        if len(blocks) == CANDIDATES:
            return blocks
    return [blocks[i % len(blocks)] for i in range(CANDIDATES)] if blocks else []


def rows_of(data: Block, samples: NDArray[np.intp], n_channels: int) -> Block:
    """Block restricted to some samples, all channels of each."""
    values = data.values.reshape(len(data.weights), n_channels, -1)[samples]
    return Block(data.columns, values.reshape(-1, values.shape[2]), data.weights[samples])


def _alternated(model: Model, data: Block) -> tuple[float, Model, Posterior]:
    """Alternate coefficients and rows; return noise variance left, model, coefficients."""
    counted = np.ones(len(data.columns), dtype=np.bool_)
    for _ in range(ITERATIONS):
        statistics = RowStatistics(model)
        statistics.add(data, infer(model, data, gram_of(model)), counted)
        model = resolve_online(with_moments(model, statistics), statistics, PSEUDO_OBSERVATIONS)
    posterior = infer(model, data, gram_of(model))
    squared = float(posterior.squared_residual.sum())
    n_entries = float(data.weights.sum(dtype=np.float64)) * model.n_channels
    return unbiased(squared, n_entries, data.values.shape, model.rank), model, posterior


def gram_of(model: Model) -> Array:
    """Packed Gram matrices of the model's samples."""
    return gram_of_samples(model.basis, model.n_channels)


def unbiased(squared: float, n_entries: float, shape: tuple[int, ...], rank: int) -> float:
    """Residual variance after r (m + n - r) parameters were spent on n_entries."""
    spent = rank * (shape[0] + shape[1] - rank)
    return squared / max(n_entries - spent, 0.1 * n_entries)


def _extended(model: Model, posterior: Posterior, data: Block) -> Model:
    """Model over all rows: each solved from the coefficients that the chosen rows gave."""
    n_rows = len(data.values)
    dtype = data.values.dtype
    blank = replace(
        model, offset=np.zeros(n_rows, dtype), basis=np.zeros((n_rows, model.rank), dtype)
    )
    statistics = RowStatistics(blank)
    statistics.add(data, posterior, np.ones(len(data.columns), dtype=np.bool_))
    return resolve_online(blank, statistics, EXTENDING_PSEUDO_OBSERVATIONS)


# --- first subspace of a candidate -----------------------------------------------------------


def _first_model(
    data: Block,
    rank: int,
    n_channels: int,
    rng: np.random.Generator,
    candidate: int,
) -> Model:
    """Randomised SVD of a block with zeros where nothing was observed."""
    weights = np.repeat(data.weights, n_channels, axis=0)
    filled = weighted(data.values, data.weights, n_channels)
    if candidate > 0:
        # Another beginning on what may be the same block.
        filled = filled * (0.5 + rng.random((filled.shape[1],))).astype(filled.dtype)
    basis, values = leading_vectors(filled, rank, rng)
    share = max(float(weights.mean()), LEAST_SHARE)
    variance = (values.astype(np.float64) / share) ** 2 / filled.shape[1]
    power = float((filled.astype(np.float64) ** 2).sum()) / float(weights.sum())
    prior = floored(np.diag(variance))
    offset = np.zeros(len(weights), dtype=weights.dtype)
    model = Model(offset, basis, np.zeros(rank), prior, 0.1 * power, n_channels)
    return model.quieted()


def leading_vectors(
    matrix: NDArray[np.floating], rank: int, rng: np.random.Generator
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Leading left singular vectors and values by subspace iteration.

    Fewer columns than `rank` are topped up with random vectors of value zero.
    """
    sketch = matrix @ rng.standard_normal((matrix.shape[1], rank + 8)).astype(matrix.dtype)
    scale = np.abs(sketch).max() or 1.0
    sketch = sketch / scale + 1e-6 * rng.standard_normal(sketch.shape).astype(matrix.dtype)
    for _ in range(2):
        q = np.linalg.qr(sketch)[0]
        sketch = matrix @ (matrix.T @ q) + 1e-6 * scale * q
    q = np.linalg.qr(sketch)[0]
    u, values, _ = np.linalg.svd(q.T @ matrix, full_matrices=True)
    padded = np.zeros(rank, dtype=matrix.dtype)
    padded[: len(values)] = values[:rank]
    return q @ u[:, :rank], padded
