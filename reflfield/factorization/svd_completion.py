"""Fill the unobserved entries of a large matrix of low rank, block by block."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.factorization.brand_svd import fit_brand
from reflfield.factorization.column_sources import (
    Columns,
    Reader,
    as_source,
    blocks_of,
    reader_of,
    shuffled_columns,
)
from reflfield.factorization.initialisation import (
    PSEUDO_OBSERVATIONS,
    start_model,
    unbiased,
)
from reflfield.factorization.recursive_least_squares import (
    Fit,
    Model,
    RowStatistics,
    gram_of_samples,
    infer,
    resolve_final,
    resolve_online,
    with_moments,
)
from reflfield.util.progress import report

# A fit is started again if its noise is this many times that of a block fitted on its own,
STALLED_RATIO = 1.25
# and the last pass left more than this share of the residual before it.
SLOW_FALL = 0.9
# While columns stream by, rows are solved again when so many times the columns were summed.
SOLVING_GROWTH = 1.05


@dataclass(frozen=True)
class Completion:
    """A low-rank matrix fitted to what was observed of it.

    Attributes
    ----------
    basis : (n_rows, rank) float
        Orthonormal; by descending second moment of the coefficients; the
        largest entry of each vector is positive.
    coefficients : (n_columns, rank) float
        About the mean: a column is ``mean + basis @ coefficients[column]``.
    mean : (n_rows,) float
        What a column is expected to be before any of it is seen.
    noise : float
        Standard deviation of the observations about the fit.
    residuals : tuple of float
        Root mean square over the observed entries in each pass, with the
        basis that the pass began with.
    coverage : (n_columns,) float32
        Observed share of each column (mean of the weights). A column of which nothing was
        observed equals `mean`.
    sparse_columns : (n_columns,) bool
        True where less than 2 % was observed (empty ones included); these
        were completed but did not shape basis, mean and noise.
    empty_rows : (n_rows,) bool
        True where no column was observed; such a row is zero, but for rounding.
    restarts : int
        Column orders tried and abandoned before this fit.
    """

    basis: NDArray[np.floating]
    coefficients: NDArray[np.floating]
    mean: NDArray[np.floating]
    noise: float
    residuals: tuple[float, ...]
    coverage: NDArray[np.float32]
    sparse_columns: NDArray[np.bool_]
    empty_rows: NDArray[np.bool_]
    restarts: int = 0

    @property
    def rank(self) -> int:
        """Columns of the basis."""
        return int(self.basis.shape[1])


def complete(
    matrix: Any,
    observed: Any = None,
    *,
    rank: int,
    passes: int = 4,
    method: Literal["map", "brand"] = "map",
    weights: Any = None,
    n_channels: int = 1,
    block: int = 256,
    restarts: int = 1,
    seed: int = 0,
) -> Completion:
    r"""Complete a matrix of low rank of which part was observed.

    ``method="map"`` is block recursive least squares with maximum a posteriori
    coefficients: columns are y = U z + noise with z ~ N(mu, C); for a block of
    columns the coefficients are

    .. math:: z_j = (U^\top W_j U + \nu C^{-1})^{-1} (U^\top W_j y_j + \nu C^{-1} \mu),

    and each row of U solves the least squares problem that all columns so far
    pose to it, :math:`u_i = (\sum_j w_{ij} E[z_j z_j^\top])^{-1} \sum_j w_{ij} y_{ij} z_j`.
    In the first pass rows are solved after every block, later once a pass.

    ``method="brand"`` is Brand's incremental SVD, which fills each column from
    the current basis and then counts the filling as data [1]_: the paper's
    choice, kept as a baseline. Gaps shaped like occlusion stall it.

    Parameters
    ----------
    matrix : (n_rows, n_columns) array_like, zarr array or ColumnSource
        See `as_source`. float64 is computed in float64, all else in float32.
    observed : (n_rows // n_channels, n_columns) bool, optional
        True where the entry was measured. Without it, NaN marks what is missing.
        Unobserved values are never used.
    rank : int
        Columns of the basis; reduced to the smaller side of the matrix.
    passes : int
        How often the data shape the basis. One more reading gives the coefficients.
    weights : (n_rows // n_channels, n_columns) float in [0, 1], optional
        Confidence, in place of `observed`: noise variance is noise^2 / weight.
    n_channels : int
        Rows that share one observation, adjacent (channel fastest).
    block : int
        Columns held in memory at once. For a source with a ``run_length``, a multiple of
        it: a chunk is then read once a pass.
    restarts : int
        How often to start again with another column order if the training residual
        does not converge.
    seed : int
        Of the column order and the starting basis.

    Returns
    -------
    Completion
        Basis, coefficients, mean, noise, flags.

    Raises
    ------
    InputError
        If nothing was observed, an observed value is not finite, or an option is out
        of range.
    ShapeError
        If shapes do not fit.

    Notes
    -----
    With r = rank: about 2 r^2 + 6 r multiply-adds per entry and pass, all in matrix
    products. Memory is n_samples r (r + 1) / 2 + n_rows (2 r + 5 block) numbers and
    r per column.

    References
    ----------
    .. [1] M. Brand, "Incremental singular value decomposition of uncertain data with
       missing values", ECCV 2002.

    Examples
    --------
    A rank-1 matrix with one hole:

    >>> truth = np.outer([1.0, 2.0, 2.0], [3.0, 1.0, 4.0])
    >>> holed = truth.copy()
    >>> holed[2, 1] = np.nan
    >>> fit = complete(holed, rank=1)
    >>> (fit.mean + fit.basis @ fit.coefficients[1]).round(2)
    array([1., 2., 2.])
    """
    _check_options(rank=rank, passes=passes, block=block)
    if method not in ("map", "brand"):
        raise InputError(f"method: expected 'map' or 'brand', received {method!r}")
    source = as_source(matrix, observed, weights, n_channels)
    reader = reader_of(source, n_channels, block)
    rank = min(rank, *source.shape)
    if method == "brand":
        fit = fit_brand(reader, rank, passes, block)
        return _finish(reader, fit, block, 0)
    fit, attempts = _fit_restarting(reader, rank, passes, block, restarts, seed)
    return _finish(reader, fit, block, attempts)


def _check_options(**counts: int) -> None:
    for name, count in counts.items():
        if count < 1:
            raise InputError(f"{name}: expected at least 1, received {count}")


def fit_map(
    reader: Reader,
    rank: int,
    passes: int,
    block: int,
    rng: np.random.Generator,
    limit: float = np.inf,
) -> Fit:
    """All passes of block recursive least squares.

    Rows are solved after every block in the first half of the passes, then once a pass.
    A fit whose first residual is not below `limit` is abandoned after that pass.
    """
    order = shuffled_columns(reader.source, rng)
    model, floor = start_model(reader, order, rank, block, rng)
    residuals: list[float] = []
    for number in range(passes):
        online = number < max(1, passes // 2)
        model, statistics = one_pass(reader, model, order, block, online=online)
        model = resolve_final(with_moments(model, statistics), statistics)
        residuals.append(statistics.residual)
        if residuals[0] > limit:
            break
        order = shuffled_columns(reader.source, rng)
    variance = unbiased(
        statistics.squared_residual, statistics.weight, reader.source.shape, rank
    )
    return Fit(model, tuple(residuals), _is_stalled(residuals, variance, floor))


def _is_stalled(residuals: list[float], variance: float, floor: float) -> bool:
    """True if the residual is far above that of a single block and no longer falls."""
    falling = len(residuals) < 2 or residuals[-1] < SLOW_FALL * residuals[-2]
    return not falling and variance > STALLED_RATIO**2 * floor


def _fit_restarting(
    reader: Reader, rank: int, passes: int, block: int, restarts: int, seed: int
) -> tuple[Fit, int]:
    """Best of several column orders; the next is tried only if the fit stalls."""
    best = fit_map(reader, rank, passes, block, np.random.default_rng([seed, 0]))
    attempt = 0
    while best.stalled and attempt < restarts:
        attempt += 1
        rng = np.random.default_rng([seed, attempt])
        limit = 0.9 * best.residuals[0]
        fit = fit_map(reader, rank, passes, block, rng, limit)
        if len(fit.residuals) == passes and fit.residuals[-1] < best.residuals[-1]:
            best = fit
    return best, attempt


def one_pass(
    reader: Reader, model: Model, order: Columns, block: int, *, online: bool
) -> tuple[Model, RowStatistics]:
    """Sum the statistics of all columns; `online` solves the rows as columns come."""
    statistics = RowStatistics(model)
    gram = gram_of_samples(model.basis, model.n_channels)
    solved_at = 0
    for done, columns in enumerate(blocks_of(order, block)):
        report("completion", done * block, len(order))
        data = reader.block(columns)
        counted = data.coverage >= reader.least_coverage
        statistics.add(data, infer(model, data, gram), counted)
        if online and statistics.count > SOLVING_GROWTH * solved_at:
            solved_at = statistics.count
            model = resolve_online(
                with_moments(model, statistics), statistics, PSEUDO_OBSERVATIONS
            )
            gram = gram_of_samples(model.basis, model.n_channels)
    report("completion", len(order), len(order))
    return model, statistics


# --- finish -----------------------------------------------------------------------------


def map_coefficients(
    reader: Reader, model: Model, block: int
) -> tuple[NDArray[np.floating], NDArray[np.float64], NDArray[np.float64]]:
    """Coefficients about the prior mean, coverage of columns, and total weight of samples."""
    n_rows, n_columns = reader.source.shape
    coefficients = np.zeros((n_columns, model.rank), dtype=reader.dtype)
    coverage = np.zeros(n_columns)
    sample_weight = np.zeros(n_rows // model.n_channels)
    gram = gram_of_samples(model.basis, model.n_channels)
    for columns in blocks_of(np.arange(n_columns), block):
        data = reader.block(columns)
        coefficients[columns] = infer(model, data, gram).mean - model.prior_mean
        coverage[columns] = data.coverage
        sample_weight += data.weights.sum(axis=1)
    return coefficients, coverage, sample_weight


def _finish(reader: Reader, fit: Fit, block: int, restarts: int) -> Completion:
    """Read all columns once more for coefficients and flags; back to the caller's unit."""
    model, scale, dtype = fit.model, reader.scale, reader.dtype
    coefficients, coverage, sample_weight = map_coefficients(reader, model, block)
    mean = model.offset + model.basis @ model.prior_mean
    return Completion(
        basis=model.basis,
        coefficients=coefficients * dtype.type(scale),
        mean=(mean * scale).astype(dtype),
        noise=float(np.sqrt(model.noise) * scale),
        residuals=tuple(residual * scale for residual in fit.residuals),
        coverage=coverage.astype(np.float32),
        sparse_columns=coverage < reader.least_coverage,
        empty_rows=np.repeat(sample_weight == 0, model.n_channels),
        restarts=restarts,
    )
