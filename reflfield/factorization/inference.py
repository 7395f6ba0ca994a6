"""Coefficients of columns that did not shape a completion: the same prior, the same basis."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import ShapeError
from reflfield.factorization.column_sources import as_source, reader_of
from reflfield.factorization.recursive_least_squares import Model, floored
from reflfield.factorization.svd_completion import Completion, map_coefficients


def infer_coefficients(
    completion: Completion,
    matrix: Any,
    observed: Any = None,
    *,
    weights: Any = None,
    n_channels: int = 1,
    block: int = 256,
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Most probable coefficients of new columns in the basis of a completion.

    Parameters
    ----------
    completion : Completion
        Fitted to other columns of the same kind; their coefficients give the prior.
    matrix, observed, weights, n_channels, block
        As in `complete`.

    Returns
    -------
    coefficients : (n_columns, rank) float32
        About `completion.mean`; zero for a column of which nothing was observed.
    coverage : (n_columns,) float64
        Mean weight of each column.

    Raises
    ------
    ShapeError
        If the matrix has other rows than the completion.

    Examples
    --------
    >>> from reflfield.factorization import complete
    >>> known = np.outer([1.0, 2.0, 2.0], [3.0, 1.0, 4.0, -2.0])
    >>> fit = complete(known, rank=1)
    >>> inferred, _ = infer_coefficients(fit, np.array([[2.0], [4.0], [np.nan]]))
    >>> (fit.mean[:, None] + fit.basis @ inferred.T).round(2).ravel()
    array([2., 4., 4.])
    """
    source = as_source(matrix, observed, weights, n_channels)
    if source.shape[0] != len(completion.mean):
        raise ShapeError(
            f"matrix: expected {len(completion.mean)} rows like the completion, "
            f"received {source.shape[0]}"
        )
    reader = reader_of(source, n_channels, block)
    scale = reader.scale
    used = completion.coefficients[~completion.sparse_columns].astype(np.float64) / scale
    model = Model(
        offset=(completion.mean / scale).astype(reader.dtype),
        basis=completion.basis.astype(reader.dtype),
        prior_mean=np.zeros(completion.rank),
        # Directions that no column used get a prior too: few rows would not determine them.
        prior_covariance=floored(used.T @ used / max(len(used), 1)),
        noise=float(max((completion.noise / scale) ** 2, 1e-30)),
        n_channels=n_channels,
    )
    coefficients, coverage, _ = map_coefficients(reader, model.quieted(), block)
    return (coefficients * scale).astype(np.float32), coverage
