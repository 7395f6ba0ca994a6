r"""Block recursive least squares with MAP coefficients: one model, two steps.

The model of a column is y = m + U z + noise, with z ~ N(mu, C) and noise of
variance nu / w for an entry of weight w. `infer` gives the posterior of z for
a block of columns (E step); `RowStatistics` sums what the rows need to be
solved for again (M step). All heavy work is matrix products.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.factorization.column_sources import Block
from reflfield.factorization.packed_matrices import outer_products, pack, packed_size, unpack

# Directions of the coefficient covariance below this share of the largest are lifted to it,
# so that its inverse exists when the data have less than full rank.
COVARIANCE_FLOOR = 1e-9
# What stands for the variance of data that are all zero; its inverse is still in range.
LEAST_VARIANCE = 1e-200
# What the prior weighs at least, over all that a column's samples can.
LEAST_PRIOR = 8 * float(np.finfo(np.float64).eps)
# Rows solved at once; bounds the memory of the unpacked matrices.
ROWS_AT_ONCE = 4096

Array = NDArray[Any]


@dataclass(frozen=True)
class Model:
    """A subspace with a Gaussian prior on its coefficients.

    Attributes
    ----------
    offset : (n_rows,) float
        m, a fixed column that is subtracted; zero while a basis is fitted.
    basis : (n_rows, r) float
        U.
    prior_mean, prior_covariance : (r,), (r, r) float64
        mu and C.
    noise : float
        nu, the variance of an entry of weight 1.
    n_channels : int
        Adjacent rows that share one weight.
    """

    offset: Array
    basis: Array
    prior_mean: Array
    prior_covariance: Array
    noise: float
    n_channels: int

    @property
    def rank(self) -> int:
        """Columns of the basis."""
        return int(self.basis.shape[1])

    @property
    def noise_floor(self) -> float:
        """Variance of rounding, below which the noise means nothing."""
        power = np.trace(self.prior_covariance) + self.prior_mean @ self.prior_mean
        power = power * float((self.basis.astype(np.float64) ** 2).sum()) / len(self.basis)
        return float((8 * np.finfo(self.basis.dtype).eps) ** 2 * power + 1e-300)

    def quieted(self) -> Model:
        """Return the same model with its noise at least that of rounding."""
        return replace(self, noise=max(self.noise, self.noise_floor))


@dataclass(frozen=True)
class Fit:
    """A model and the training residual of every pass, in the reader's unit."""

    model: Model
    residuals: tuple[float, ...]
    stalled: bool = False


@dataclass(frozen=True)
class Posterior:
    """Coefficients of a block and how well they fit.

    Attributes
    ----------
    mean : (k, r) float64
        MAP coefficients.
    covariance : (k, r, r) float64
        Their posterior covariance.
    squared_residual : (k,) float64
        Weighted sum of squared residuals of each column.
    spread : (k,) float64
        trace(A S): what the uncertainty of z adds to the squared residual.
    """

    mean: Array
    covariance: Array
    squared_residual: Array
    spread: Array


def gram_of_samples(basis: Array, n_channels: int) -> Array:
    """Packed sum over channels of u u^T for each sample, (n_samples, r (r + 1) / 2)."""
    packed = outer_products(basis[::n_channels])
    for channel in range(1, n_channels):
        packed += outer_products(basis[channel::n_channels])
    return packed


def weighted(values: Array, weights: Array, n_channels: int) -> Array:
    """Values times the weight of their sample."""
    by_sample = values.reshape(len(weights), n_channels, -1)
    return (by_sample * weights[:, None, :]).reshape(values.shape)


def infer(model: Model, block: Block, gram: Array) -> Posterior:
    r"""Posterior of the coefficients of a block.

    .. math:: S_j = \nu (A_j + \nu C^{-1})^{-1}, \quad
              z_j = \mu + S_j U^\top w_j \circ (y_j - m - U \mu) / \nu,

    with :math:`A_j = U^\top \mathrm{diag}(w_j) U`, all of them one product of
    the weights with `gram` (see `gram_of_samples`).
    """
    expected = model.offset + model.basis @ model.prior_mean.astype(model.basis.dtype)
    residual = block.values - expected[:, None]
    projected = model.basis.T @ weighted(residual, block.weights, model.n_channels)
    precision = unpack((block.weights.T @ gram).astype(np.float64), model.rank)
    prior = _resolvable(
        model.noise * np.linalg.pinv(model.prior_covariance, hermitian=True), model
    )
    inverse = np.linalg.solve(precision + prior, np.eye(model.rank)[None])
    step = np.einsum("kij,jk->ki", inverse, projected.astype(np.float64))
    residual -= model.basis @ step.T.astype(model.basis.dtype)
    return Posterior(
        mean=model.prior_mean + step,
        covariance=model.noise * inverse,
        squared_residual=squared_residual(residual, block.weights, model.n_channels),
        spread=model.noise * np.einsum("kij,kij->k", precision, inverse),
    )


def _resolvable(prior: Array, model: Model) -> Array:
    """Prior that is not lost when it is added to what samples weigh.

    With less noise than rounding, columns of fewer samples than the rank would have singular
    equations.
    """
    least = LEAST_PRIOR * float(np.square(model.basis, dtype=np.float64).sum())
    if model.rank and (weakest := float(np.linalg.eigvalsh(prior)[0])) < least:
        return prior * (least / weakest)
    return prior


def squared_residual(residual: Array, weights: Array, n_channels: int) -> Array:
    """Weighted sum of squares of every column, (k,) float64. Overwrites `residual`."""
    np.square(residual, out=residual)
    by_sample = residual.reshape(len(weights), n_channels, -1).sum(axis=1)
    by_sample *= weights
    return by_sample.sum(axis=0, dtype=np.float64)


class RowStatistics:
    """Sums from which the rows of the basis are solved: G, B and the moments of z.

    Memory is n_samples r (r + 1) / 2 + n_rows r float64 with r = rank: 34 MB for 22,801
    samples x 3 channels at rank 16.
    """

    def __init__(self, model: Model) -> None:
        self.width = model.rank
        self.n_channels = model.n_channels
        n_rows = len(model.basis)
        self.gram = np.zeros((n_rows // model.n_channels, packed_size(self.width)))
        self.cross = np.zeros((n_rows, self.width))
        self.second_moment = np.zeros((self.width, self.width))
        self.first_moment = np.zeros(self.width)
        self.count = 0
        self.squared_residual = 0.0
        self.spread = 0.0
        self.weight = 0.0

    def add(self, block: Block, posterior: Posterior, counted: NDArray[np.bool_]) -> None:
        """Sum a block in; columns where `counted` is False leave no trace."""
        dtype = block.values.dtype
        vectors = posterior.mean * counted[:, None]
        # E[z z^T] of every column.
        second = vectors[:, :, None] * vectors[:, None, :] + posterior.covariance
        second *= counted[:, None, None]
        self.gram += block.weights @ pack(second).astype(dtype)
        values = weighted(block.values, block.weights, self.n_channels)
        self.cross += values @ vectors.astype(dtype)
        self.second_moment += second.sum(axis=0)
        self.first_moment += vectors.sum(axis=0)
        self.count += int(counted.sum())
        self._add_noise(block, posterior, counted)

    def _add_noise(
        self, block: Block, posterior: Posterior, counted: NDArray[np.bool_]
    ) -> None:
        self.squared_residual += float(posterior.squared_residual[counted].sum())
        self.spread += float(posterior.spread[counted].sum())
        weight = block.weights.sum(axis=0, dtype=np.float64)[counted].sum()
        self.weight += float(weight) * self.n_channels

    @property
    def mean_second_moment(self) -> Array:
        """E[z z^T] over the columns so far, (r, r)."""
        return self.second_moment / self.count

    @property
    def residual(self) -> float:
        """Root mean square of the residual over the observed entries."""
        return float(np.sqrt(self.squared_residual / self.weight))

    @property
    def noise(self) -> float:
        """Posterior variance of an entry of weight 1."""
        return (self.squared_residual + self.spread) / self.weight

    def solve_rows(self, prior_rows: Array, strength: Array) -> Array:
        """u_i = (G_i + strength)^-1 (b_i + strength u_i0) for every row, (n_rows, r) float64.

        Parameters
        ----------
        prior_rows : (n_rows, r) float
            u_i0, what a row falls back to.
        strength : (r, r) float64
            Positive definite; pseudo-observations of u_i0.
        """
        n_samples = len(self.gram)
        right = (self.cross + prior_rows @ strength).reshape(n_samples, self.n_channels, -1)
        rows = np.zeros_like(right)
        for start in range(0, n_samples, ROWS_AT_ONCE):
            part = slice(start, start + ROWS_AT_ONCE)
            left = unpack(self.gram[part], self.width) + strength
            rows[part] = np.linalg.solve(left, right[part].transpose(0, 2, 1)).transpose(
                0, 2, 1
            )
        return rows.reshape(-1, self.width)


# --- passes -----------------------------------------------------------------------------


def with_moments(model: Model, statistics: RowStatistics) -> Model:
    """The model with mu, C and nu from the sums."""
    mean = statistics.first_moment / statistics.count
    covariance = floored(statistics.mean_second_moment - np.outer(mean, mean))
    noise = statistics.noise
    return replace(model, prior_mean=mean, prior_covariance=covariance, noise=noise).quieted()


def floored(covariance: Array) -> Array:
    """Symmetric matrix whose eigenvalues are at least `COVARIANCE_FLOOR` of the largest."""
    if covariance.size == 0:
        return covariance
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    values = np.maximum(values, COVARIANCE_FLOOR * max(values[-1], LEAST_VARIANCE))
    return (vectors * values) @ vectors.T


def resolve_online(model: Model, statistics: RowStatistics, pseudo: float) -> Model:
    """Rows solved with `pseudo` observations of what they were; coordinates unchanged."""
    strength = pseudo * regular(statistics.mean_second_moment)
    basis = statistics.solve_rows(model.basis, strength)
    return replace(model, basis=basis.astype(model.basis.dtype))


def resolve_final(model: Model, statistics: RowStatistics) -> Model:
    """Rows solved with a weak prior at zero, then basis orthonormal, prior diagonal.

    The prior is that of a row of average size: nu / mean(u^2) per coefficient, which
    leaves rows with observations alone and sends rows without any to zero.
    """
    size = max(float(np.mean(model.basis.astype(np.float64) ** 2)), 1e-300)
    tiny = 1e-12 * np.trace(statistics.second_moment) / statistics.width
    strength = (model.noise / size + tiny) * np.eye(statistics.width)
    rows = statistics.solve_rows(np.zeros_like(statistics.cross), strength)
    return orthonormal(model, rows)


def regular(matrix: Array) -> Array:
    """Positive definite by a ridge of 1e-9 of the mean diagonal."""
    return matrix + (1e-9 * np.trace(matrix) / len(matrix) + 1e-300) * np.eye(len(matrix))


def orthonormal(model: Model, basis: Array) -> Model:
    """Same model in coordinates where U^T U = I and E[z z^T] is diagonal, descending."""
    if model.rank == 0:
        return model
    q, r = np.linalg.qr(basis)
    mean = r @ model.prior_mean
    covariance = r @ model.prior_covariance @ r.T
    values, vectors = np.linalg.eigh(covariance + np.outer(mean, mean))
    vectors = vectors[:, ::-1]
    basis = q @ vectors
    signs = np.where(basis[np.abs(basis).argmax(axis=0), np.arange(len(values))] < 0, -1.0, 1.0)
    vectors = vectors * signs
    return replace(
        model,
        basis=(basis * signs).astype(model.basis.dtype),
        prior_mean=vectors.T @ mean,
        prior_covariance=floored(vectors.T @ covariance @ vectors),
    )
