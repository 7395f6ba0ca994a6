"""One sparse matrix times many vectors, against SciPy."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from reflfield.sphere.sparse_recombination import LANES, LINE, TILE, recombination


@pytest.mark.parametrize("n", [0, 1, LANES - 1, LANES, 2 * LANES + 3])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_products_are_those_of_scipy(n, dtype, rng, rounding):
    parts, n_columns = [1, TILE, 0, 2 * TILE + 5], 3 * LINE + 1
    dense = rng.standard_normal((sum(parts), n_columns))
    matrix = csr_array(dense * (rng.random(dense.shape) < 0.2))
    vectors = rng.standard_normal((n, n_columns)).astype(dtype)
    products = recombination(matrix, parts, dtype)(vectors)
    assert [part.shape for part in products] == [(n, size) for size in parts]
    expected = (matrix @ vectors.T.astype(np.float64)).T
    product = np.concatenate(products, axis=1)
    np.testing.assert_allclose(product, expected, atol=rounding(dtype, n_columns))
    assert product.dtype == dtype
    assert all(part.flags.c_contiguous for part in products)


def test_rows_without_entries_give_zeros():
    products = recombination(csr_array((2, 3)), [2], "float32")(np.ones((4, 3), np.float32))
    assert not products[0].any()


def test_vectors_need_not_be_contiguous(rng):
    vectors = rng.standard_normal((6, 5)).T
    product = recombination(csr_array(np.eye(6)), [6], "float64")(vectors)[0]
    np.testing.assert_array_equal(product, vectors)
