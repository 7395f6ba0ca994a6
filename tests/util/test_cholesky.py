"""Small positive systems against LAPACK, and matrices that are not positive."""

import numpy as np
import pytest
import scipy.linalg

from reflfield.util.cholesky import cholesky_factor, solve_columns, solve_vector


def positive(rng, n, condition):
    """Symmetric positive matrix (n, n) of a condition number, of size 1."""
    vectors = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return (vectors * np.geomspace(1.0, 1.0 / condition, n)) @ vectors.T


@pytest.mark.parametrize("n", [1, 2, 5, 40])
@pytest.mark.parametrize("condition", [1.0, 1e4, 1e10])
def test_solutions_are_lapacks(rng, rounding, n, condition):
    matrix, right = positive(rng, n, condition), rng.normal(size=(n, 7))
    expected = scipy.linalg.solve(matrix, right, assume_a="pos")
    factor, columns, vector = matrix.copy(), right.copy(), right[:, 0].copy()
    assert cholesky_factor(factor, n)
    solve_columns(factor, columns)
    solve_vector(factor, vector)
    bound = rounding(np.float64, n, condition, np.abs(expected).max())
    np.testing.assert_allclose(columns, expected, rtol=0, atol=bound)
    np.testing.assert_allclose(vector, expected[:, 0], rtol=0, atol=bound)


def test_the_upper_triangle_is_not_read(rng, rounding):
    matrix = positive(rng, 6, 10.0)
    factor = np.tril(matrix) + np.triu(np.full((6, 6), np.nan), 1)
    assert cholesky_factor(factor, 6)
    bound = rounding(np.float64, 6, 10.0)
    np.testing.assert_allclose(
        np.tril(factor), scipy.linalg.cholesky(matrix, lower=True), rtol=0, atol=bound
    )


def test_rows_below_the_block_are_carried_along(rng, rounding):
    matrix, row = positive(rng, 4, 10.0), rng.normal(size=4)
    factor = np.vstack([matrix, row])
    assert cholesky_factor(factor, 4)
    expected = scipy.linalg.solve_triangular(np.tril(factor[:4]), row, lower=True)
    np.testing.assert_allclose(
        factor[4], expected, rtol=0, atol=rounding(np.float64, 4, 10.0, np.abs(row).max())
    )


@pytest.mark.stability
@pytest.mark.parametrize("scale", [1e-200, 1e-30, 1e30, 1e200])
def test_scale_does_not_matter(rng, rounding, scale):
    matrix, right = positive(rng, 5, 100.0), rng.normal(size=5)
    expected = np.linalg.solve(matrix, right)
    factor, vector = matrix * scale, right * scale
    assert cholesky_factor(factor, 5)
    solve_vector(factor, vector)
    bound = rounding(np.float64, 5, 100.0, np.abs(expected).max())
    np.testing.assert_allclose(vector, expected, rtol=0, atol=bound)


@pytest.mark.stability
@pytest.mark.parametrize("matrix", [np.zeros((2, 2)), -np.eye(2), np.full((2, 2), np.nan)])
def test_what_is_not_positive_is_said(matrix):
    assert not cholesky_factor(matrix.copy(), len(matrix))
