"""Parts of Brand's completion: what fills gaps, and the order of columns."""

import numpy as np

from reflfield.factorization.brand_svd import _by_coverage, fill, model_of
from reflfield.factorization.column_sources import Block, as_source, reader_of
from reflfield.factorization.online_svd import OnlineSVD


def test_gaps_are_filled_by_the_mean_of_their_row_and_data_are_kept():
    values = np.array([[1.0, 3.0, 99.0], [4.0, 99.0, 6.0]])
    weights = np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 0.5]])
    filled, residuals = fill(None, Block(np.arange(3), values, weights), 1)
    mean = (4.0 + 0.5 * 6.0) / 1.5
    np.testing.assert_allclose(filled[0], [1.0, 3.0, 2.0])
    # A sample of half the weight counts halfway between what is expected and itself.
    np.testing.assert_allclose(filled[1], [4.0, mean, 0.5 * (mean + 6.0)])
    expected = [1.0 + (4 - mean) ** 2, 1.0, 0.5 * (6 - mean) ** 2]
    np.testing.assert_allclose(residuals, expected)


def test_gaps_are_filled_from_the_basis_where_there_is_one():
    truth = np.outer([1.0, 2.0, -2.0], [3.0, 1.0, -1.0])
    model = model_of(OnlineSVD(1, np.float64).update(truth), 1, 1e-12)
    weights = np.array([[1.0, 1.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    spoiled = np.where(weights > 0, truth, 7.0)
    filled, residuals = fill(model, Block(np.arange(3), spoiled, weights), 1)
    # The prior of a noise of 1e-6 draws coefficients of 3 and more by 1e-12.
    np.testing.assert_allclose(filled, truth, rtol=1e-9)
    # Squares of 1e-12 of values up to 6, three of them.
    assert residuals.max() < 3 * (6e-12) ** 2


def test_columns_come_by_what_was_observed_of_them():
    observed = np.array([[1, 1, 0, 1], [0, 1, 0, 1], [0, 1, 1, 0]], bool)
    reader = reader_of(as_source(np.ones((3, 4)), observed, None, 1), 1, 2)
    assert _by_coverage(reader, 2).tolist() == [1, 3, 0, 2]
