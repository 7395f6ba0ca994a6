"""The two steps of block recursive least squares, against their formulas written out."""

import numpy as np
import pytest

from reflfield.factorization.column_sources import Block, as_source, reader_of
from reflfield.factorization.initialisation import start_model, unbiased
from reflfield.factorization.packed_matrices import outer_products, pack, unpack
from reflfield.factorization.recursive_least_squares import (
    Model,
    RowStatistics,
    gram_of_samples,
    infer,
)

from .problems import problem


def small_case(rng, *, offset=0.0, n_channels=2):
    """A model and a block of float64 with weights anywhere in [0, 1]."""
    n_rows, rank, k = 6 * n_channels, 3, 5
    root = rng.standard_normal((rank, rank))
    offset = offset * rng.standard_normal(n_rows)
    basis, mean = rng.standard_normal((n_rows, rank)), rng.standard_normal(rank)
    model = Model(offset, basis, mean, root @ root.T + np.eye(rank), 0.3, n_channels)
    weights = np.where(rng.random((6, k)) < 0.3, 0.0, rng.random((6, k)))
    values = rng.standard_normal((n_rows, k))
    values[np.repeat(weights == 0, n_channels, axis=0)] = 0
    return model, Block(np.arange(k), values, weights)


def posterior_of(model, block, j):
    """Mean and covariance of one column's coefficients, from the joint Gaussian."""
    w = np.diag(np.repeat(block.weights[:, j], model.n_channels))
    prior = np.linalg.solve(model.prior_covariance, np.eye(3))
    covariance = np.linalg.solve(
        model.basis.T @ w @ model.basis / model.noise + prior, np.eye(3)
    )
    right = model.basis.T @ w @ (block.values[:, j] - model.offset) / model.noise
    return covariance @ (right + prior @ model.prior_mean), covariance


@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_posterior_is_that_of_the_gaussian_model(rng, rounding, offset):
    model, block = small_case(rng, offset=offset)
    posterior = infer(model, block, gram_of_samples(model.basis, 2))
    for j in range(5):
        mean, covariance = posterior_of(model, block, j)
        # Sums over 12 rows, and the inverse of a matrix.
        about = {"operations": 12, "condition": np.linalg.cond(covariance)}
        for got, expected in ((posterior.mean, mean), (posterior.covariance, covariance)):
            tolerance = rounding(float, **about, scale=np.abs(expected).max())
            np.testing.assert_allclose(got[j], expected, rtol=0, atol=tolerance)
        w = np.repeat(block.weights[:, j], 2)
        residual = block.values[:, j] - model.offset - model.basis @ mean
        squares = (w * residual**2).sum()
        assert posterior.squared_residual[j] == pytest.approx(
            squares, rel=rounding(float, **about)
        )


def test_rows_minimise_the_expected_squared_residual(rng, rounding):
    model, block = small_case(rng)
    posterior = infer(model, block, gram_of_samples(model.basis, 2))
    statistics = RowStatistics(model)
    counted = np.array([True, True, False, True, True])
    statistics.add(block, posterior, counted)
    strength = 0.1 * np.eye(statistics.width)
    rows = statistics.solve_rows(np.zeros_like(statistics.cross), strength)
    for row in range(len(model.basis)):
        left, right = strength.copy(), np.zeros(statistics.width)
        for j in np.flatnonzero(counted):
            z = posterior.mean[j]
            second = np.outer(z, z) + posterior.covariance[j]
            w = block.weights[row // 2, j]
            left += w * second
            right += w * block.values[row, j] * z
        expected = np.linalg.solve(left, right)
        about = {"condition": np.linalg.cond(left), "scale": np.abs(expected).max()}
        tolerance = rounding(float, operations=4, **about)
        np.testing.assert_allclose(rows[row], expected, rtol=0, atol=tolerance)
    assert statistics.count == 4


def test_packed_matrices_come_back(rng):
    half = rng.standard_normal((4, 3, 3))
    symmetric = half + half.transpose(0, 2, 1)
    np.testing.assert_array_equal(unpack(pack(symmetric), 3), symmetric)
    vectors = rng.standard_normal((4, 3))
    np.testing.assert_array_equal(
        unpack(outer_products(vectors), 3), vectors[:, :, None] * vectors[:, None, :]
    )


def test_unbiased_variance_counts_what_was_spent():
    # Rank 2 spends 2 (40 + 50 - 2) = 176 parameters; never under a tenth of the entries.
    assert unbiased(2000.0, 2000, (40, 50), 2) == pytest.approx(2000 / (2000 - 176))
    assert unbiased(1.0, 100, (40, 50), 2) == pytest.approx(1 / 10)


def test_start_reaches_the_noise(rng):
    data = problem("smooth", rng, n_directions=24, n_columns=400)
    reader = reader_of(as_source(data.measured, data.observed), 1, 200)
    for seed in range(4):
        order = np.random.default_rng(seed).permutation(400)
        _, floor = start_model(reader, order, 6, 200, np.random.default_rng(seed))
        # The start sees 200 columns: observed .01 off in four orders.
        assert np.sqrt(floor) * reader.scale == pytest.approx(0.01, rel=0.05)
