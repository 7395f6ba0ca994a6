"""Brand's incremental SVD with imputation: the paper's completion, kept as a baseline."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.factorization.column_sources import Block, Columns, Reader, blocks_of, run_length
from reflfield.factorization.online_svd import OnlineSVD
from reflfield.factorization.recursive_least_squares import (
    Fit,
    Model,
    floored,
    gram_of_samples,
    infer,
)
from reflfield.util.progress import report

Array = NDArray[Any]


def fit_brand(reader: Reader, rank: int, passes: int, block: int) -> Fit:
    """All passes of Brand's update, columns in descending coverage.

    A block is filled from the basis so far (in later passes: from the basis of
    the pass before) and then counted as data.

    Parameters
    ----------
    reader : Reader
        Where columns come from.
    rank, passes, block : int
        As in `complete`.

    Returns
    -------
    Fit
        Zero offset; the residuals are those before each update.

    Raises
    ------
    InputError
        If nothing was observed.
    """
    order = _by_coverage(reader, block)
    model: Model | None = None
    residuals = []
    for _ in range(passes):
        svd = OnlineSVD(rank, reader.dtype)
        squared, weight = 0.0, 0.0
        previous = model
        for done, columns in enumerate(blocks_of(order, block)):
            report("completion", done * block, len(order))
            data = reader.block(columns)
            if not data.weights.any():
                continue
            filled, column_residuals = fill(previous or model, data, reader.n_channels)
            svd.update(filled)
            squared += float(column_residuals.sum())
            weight += float(data.weights.sum()) * reader.n_channels
            if previous is None:
                model = model_of(svd, reader.n_channels, squared / weight)
        if weight == 0:
            raise InputError(
                "observed: expected at least one observed entry, received none; there is "
                "nothing to complete from"
            )
        model = model_of(svd, reader.n_channels, squared / weight)
        residuals.append(float(np.sqrt(squared / weight)))
    report("completion", len(order), len(order))
    assert model is not None
    return Fit(model, tuple(residuals))


def model_of(svd: OnlineSVD, n_channels: int, noise: float) -> Model:
    """Subspace with the prior that the singular values imply: C = S^2 / n."""
    basis = svd.basis
    covariance = floored(np.diag(svd.singular_values**2 / svd.n_columns))
    offset = np.zeros(len(basis), dtype=basis.dtype)
    rank = basis.shape[1]
    model = Model(offset, basis, np.zeros(rank), covariance, noise, n_channels)
    return model.quieted()


def fill(model: Model | None, data: Block, n_channels: int) -> tuple[Array, Array]:
    """Block with its unobserved entries predicted, and its squared residuals.

    Without a model, by the mean of what was observed in the same row.
    """
    weights = np.repeat(data.weights, n_channels, axis=0)
    if model is None or model.rank == 0:
        total = (data.values * weights).sum(axis=1)
        expected = (total / np.maximum(weights.sum(axis=1), 1e-30))[:, None]
        residuals = (weights * (data.values - expected) ** 2).sum(axis=0)
    else:
        posterior = infer(model, data, gram_of_samples(model.basis, n_channels))
        expected = model.basis @ posterior.mean.T.astype(model.basis.dtype)
        residuals = posterior.squared_residual
    return expected + weights * (data.values - expected), residuals


def _by_coverage(reader: Reader, block: int) -> Columns:
    """Best observed columns first; stores that are read in runs keep their order."""
    n_columns = reader.source.shape[1]
    order = np.arange(n_columns)
    if run_length(reader.source) > 1:
        return order
    coverage = np.concatenate([reader.block(c).coverage for c in blocks_of(order, block)])
    return np.argsort(-coverage, kind="stable")
