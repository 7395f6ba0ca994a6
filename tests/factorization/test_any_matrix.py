"""Completion, online SVD and local PCA of whatever small matrices Hypothesis finds."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from reflfield.factorization import LocalPCA, OnlineSVD, complete
from tests.factorization.problems import reconstructed

pytestmark = pytest.mark.stability
SEARCH = settings(max_examples=60, deadline=None)
DTYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64])
# Small integers make columns that are equal, dependent and zero; the others differ in size.
ENTRIES = st.one_of(st.integers(-2, 2), st.sampled_from([1e-12, 1e-6, 1e6, 1e12]))
SHAPES = st.tuples(st.integers(1, 9), st.integers(1, 12))
MATRICES = SHAPES.flatmap(lambda shape: arrays(np.float64, shape, elements=ENTRIES))
# The largest value lies 1e5 below the largest of single precision: what is hardly observed is
# extrapolated, by more than a hundred times.
UNITS = st.sampled_from([1e-30, 1e-12, 1.0, 1e12, 1e21])


def departure(basis):
    """Largest entry of U^T U - 1."""
    wide = basis.astype(np.float64)
    return float(np.abs(wide.T @ wide - np.eye(wide.shape[1])).max(initial=0.0))


@DTYPES
def test_completion_is_finite_and_its_basis_orthonormal(dtype, bounded):
    errors, leaks = [0.0], [0.0]

    @SEARCH
    @given(MATRICES, UNITS, st.integers(1, 4), st.integers(0, 2**31))
    def search(matrix, unit, rank, seed):
        rng = np.random.default_rng(seed)
        observed = rng.random(matrix.shape) < rng.uniform(0, 1)
        assume(observed.any())
        values = np.where(observed, matrix * unit, np.nan).astype(dtype)
        fit = complete(values, observed, rank=rank, seed=1)
        assert fit.basis.shape[1] <= rank
        assert np.isfinite(fit.noise)
        assert np.isfinite(reconstructed(fit)).all()
        np.testing.assert_array_equal(fit.empty_rows, ~observed.any(axis=1))
        size = float(np.nanmax(np.abs(values), initial=0.0)) or 1.0
        leaks.append(np.abs(reconstructed(fit)[fit.empty_rows]).max(initial=0.0) / size)
        errors.append(departure(fit.basis))

    search()
    bounded.at_most(
        errors,
        64 * np.finfo(dtype).eps,
        case="any small matrix",
        quantity="largest entry of U^T U - 1",
        source="a QR in the data's precision: 64 eps",
        dtype=dtype,
    )
    bounded.at_most(
        leaks,
        64 * np.finfo(dtype).eps,
        case="a row never observed",
        quantity="value over the largest that was observed",
        source="zero, but for a QR in the data's precision",
        dtype=dtype,
    )


@DTYPES
def test_online_svd_of_any_blocks(dtype, bounded):
    errors, losses = [0.0], [0.0]
    limit = {np.float32: 1e-5, np.float64: 1e-12}[dtype]

    @SEARCH
    @given(st.lists(MATRICES, min_size=1, max_size=4), UNITS)
    def search(blocks, unit):
        n_rows = min(len(block) for block in blocks)
        blocks = [(block[:n_rows] * unit).astype(dtype) for block in blocks]
        svd = OnlineSVD(n_rows, dtype)
        for block in blocks:
            svd.update(block)
        whole = np.concatenate(blocks, axis=1).astype(np.float64)
        size = np.linalg.norm(whole, axis=0).max()
        errors.append(departure(svd.basis))
        basis = svd.basis.astype(np.float64)
        rest = whole - basis @ (basis.T @ whole)
        losses.append(np.linalg.norm(rest, axis=0).max() / max(size, 1e-300))

    search()
    about = {"case": "any blocks", "dtype": dtype}
    bounded.at_most(
        errors, limit, quantity="largest entry of U^T U - 1", source="target", **about
    )
    bounded.at_most(
        losses,
        4 * limit,
        quantity="of a column, what a full basis misses over the largest",
        source="directions below the threshold are dropped, one a block at most",
        **about,
    )


@DTYPES
def test_local_pca_is_never_worse_than_one_mean(dtype, bounded):
    errors, excess = [0.0], [0.0]

    @SEARCH
    @given(MATRICES, UNITS, st.integers(1, 5), st.integers(0, 3))
    def search(matrix, unit, n_clusters, n_components):
        columns = (matrix * unit).astype(dtype)
        fit = LocalPCA(n_clusters, n_components).fit(columns)
        assert ((fit.labels >= 0) & (fit.labels < n_clusters)).all()
        wide = columns.astype(np.float64)
        size = max(np.linalg.norm(wide), 1e-300)
        missed = np.linalg.norm(reconstructed(fit).astype(np.float64) - wide) / size
        one_mean = np.linalg.norm(wide - wide.mean(axis=1, keepdims=True)) / size
        excess.append(missed - one_mean)
        for basis in fit.bases:
            used = basis[:, np.linalg.norm(basis, axis=0) > 0]
            errors.append(departure(used))

    search()
    about = {"case": "any columns", "dtype": dtype}
    bounded.at_most(
        excess,
        1e-5 if dtype is np.float32 else 1e-7,
        quantity="error over that of one mean, less it, over the norm",
        source="squares of differences in the data's precision",
        **about,
    )
    bounded.at_most(
        errors,
        256 * np.finfo(dtype).eps,
        quantity="largest entry of P^T P - 1 of a cluster",
        source="products of two orthonormal bases",
        **about,
    )
