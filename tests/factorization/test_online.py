"""Online SVD: numpy and scikit-learn agree; orthogonality survives rank-deficient data."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reflfield.errors import InputError, ShapeError
from reflfield.factorization import OnlineSVD
from reflfield.factorization.online_svd import orthonormal_range, outside


def fed(matrix, rank, block, *, dtype=np.float64):
    svd = OnlineSVD(rank, dtype)
    for start in range(0, matrix.shape[1], block):
        svd.update(matrix[:, start : start + block])
    return svd


def departure(basis):
    """Largest entry of U^T U - I, in float64."""
    wide = basis.astype(np.float64)
    return np.abs(wide.T @ wide - np.eye(wide.shape[1])).max()


def test_hand_checked(rounding):
    svd = OnlineSVD(2, np.float64).update(np.array([[0.0, 3.0], [-2.0, 0.0]]))
    np.testing.assert_allclose(svd.singular_values, [3, 2], rtol=rounding(float))
    # Signs: the largest entry of each vector is positive.
    np.testing.assert_allclose(svd.basis, np.eye(2), atol=1e-15)
    assert svd.n_columns == 2


def test_calls_chain_and_empty_blocks_do_nothing(rng):
    block = rng.standard_normal((5, 3))
    once = OnlineSVD(2).update(block)
    twice = OnlineSVD(2).update(block).update(block[:, :0])
    np.testing.assert_array_equal(once.basis, twice.basis)


@pytest.mark.reference
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("block", [1, 7, 100])
def test_full_rank_update_is_the_svd(rng, rounding, dtype, block):
    matrix = rng.standard_normal((30, 100))
    svd = fed(matrix, 30, block, dtype=dtype)
    u, values, _ = np.linalg.svd(matrix, full_matrices=False)
    tolerance = rounding(dtype, operations=100, scale=values[0])
    np.testing.assert_allclose(svd.singular_values, values, atol=tolerance)
    projector = svd.basis @ svd.basis.T
    np.testing.assert_allclose(projector, u @ u.T, atol=rounding(dtype, operations=100))


@pytest.mark.reference
def test_truncated_update_matches_incremental_pca(rng):
    from sklearn.decomposition import IncrementalPCA  # long to import

    spectrum = 0.7 ** np.arange(40)
    matrix = (rng.standard_normal((40, 40)) * spectrum) @ rng.standard_normal((40, 150))
    # Columns in pairs of opposite signs: the mean of every batch is zero.
    matrix = np.stack([matrix, -matrix], axis=2).reshape(40, 300)
    svd = fed(matrix, 8, 60)
    other = IncrementalPCA(8, batch_size=60).fit(matrix.T)
    # Both truncate after each block, scikit-learn after 60 columns and this after 60 or 64:
    # what is cut off differs at second order in the spectrum's tail.
    np.testing.assert_allclose(svd.singular_values, other.singular_values_, rtol=0.01)
    cosines = np.linalg.svd(other.components_ @ svd.basis, compute_uv=False)
    assert cosines.min() > 0.99


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 12), st.integers(1, 40), st.integers(1, 6), st.integers(0, 2**31))
def test_low_rank_is_kept_whatever_the_blocks(n_rows, block, true_rank, seed):
    rng = np.random.default_rng(seed)
    matrix = rng.standard_normal((n_rows, true_rank)) @ rng.standard_normal((true_rank, 50))
    svd = fed(matrix, 6, block)
    # An update's rounding, of 50 columns one by one.
    assert departure(svd.basis) < 8 * np.finfo(float).eps * 50
    back = svd.basis @ (svd.basis.T @ matrix)
    assert np.abs(back - matrix).max() < 1e-11 * max(1.0, np.abs(matrix).max())


def test_columns_order_changes_little(rng):
    spectrum = 0.5 ** np.arange(20)
    matrix = (rng.standard_normal((60, 20)) * spectrum) @ rng.standard_normal((20, 400))
    values = [fed(matrix[:, rng.permutation(400)], 5, 50).singular_values for _ in range(3)]
    # Truncation loses (s6 / s5)^2 / 2 at most: the spectrum falls by half each.
    assert np.ptp(values, axis=0).max() < 0.1 * values[0][-1]


# --- stability ---------------------------------------------------------------------------

LIMIT = {np.float32: 1e-5, np.float64: 1e-12}


def hard_matrix(name, rng):
    low = rng.standard_normal((100, 4)) @ rng.standard_normal((4, 600))
    return {
        "rank deficient": low,
        "duplicate columns": np.repeat(rng.standard_normal((100, 3)), 200, axis=1),
        "zero columns": low * (np.arange(600) % 3 == 0),
        "all zero": np.zeros((100, 50)),
        "one column": low[:, :1],
        "1e-30": 1e-30 * low,
        "1e30": 1e30 * low,
        "condition 1e12": (rng.standard_normal((100, 10)) * np.logspace(0, -12, 10))
        @ rng.standard_normal((10, 600)),
        "single row": low[:1],
        "growing": low * np.logspace(-15, 15, 600),
    }[name]


@pytest.mark.stability
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    "name",
    [
        "rank deficient", "duplicate columns", "zero columns", "all zero", "one column",
        "1e-30", "1e30", "condition 1e12", "single row", "growing",
    ],
)  # fmt: skip
def test_basis_stays_orthonormal(rng, name, dtype, bounded):
    matrix = hard_matrix(name, rng)
    svd = fed(matrix, 10, 50, dtype=dtype)
    assert svd.basis.dtype == dtype
    assert svd.basis.shape[1] <= min(10, *matrix.shape)
    if svd.basis.size:
        bounded.at_most(
            departure(svd.basis),
            LIMIT[dtype],
            case="degenerate blocks",
            quantity="largest entry of U^T U - 1",
            source="target",
            dtype=dtype,
        )
    values = np.zeros(len(svd.singular_values))
    singular = np.linalg.svd(matrix.astype(np.float64), compute_uv=False)[: len(values)]
    values[: len(singular)] = singular
    # Backward stable: absolute accuracy on the scale of the largest.
    np.testing.assert_allclose(
        svd.singular_values, values, atol=LIMIT[dtype] * max(values, default=0.0), rtol=0
    )
    back = svd.basis.astype(np.float64) @ (svd.basis.T.astype(np.float64) @ matrix)
    largest = np.linalg.norm(matrix, axis=0).max()
    # Dropped directions are below 3e-6 or 1e-13 of the largest column, one a block at most.
    assert np.linalg.norm(back - matrix, axis=0).max() <= 4 * LIMIT[dtype] * largest


@pytest.mark.stability
@pytest.mark.parametrize(("dtype", "floor"), [(np.float32, 3e-6), (np.float64, 1e-13)])
def test_columns_inside_the_basis_add_no_direction(rng, dtype, floor):
    basis = np.linalg.qr(rng.standard_normal((80, 5)))[0].astype(dtype)
    columns = (basis @ rng.standard_normal((5, 20))).astype(dtype)
    assert orthonormal_range(outside(basis, columns), basis, 10 * floor).shape == (80, 0)
    columns[:, 3] += dtype(1e3 * floor) * rng.standard_normal(80).astype(dtype)
    extra = orthonormal_range(outside(basis, columns), basis, 10 * floor)
    assert extra.shape == (80, 1)
    # A direction found at the edge of rounding is still orthogonal to all the others.
    assert np.abs(basis.T @ extra).max() < 16 * np.finfo(dtype).eps


@pytest.mark.stability
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_lies_outside_is_orthogonal_however_little_it_is(rng, dtype, bounded):
    """A ten-thousandth of the columns: one projection leaves ten thousand roundings of it."""
    basis = np.linalg.qr(rng.standard_normal((200, 6)))[0].astype(dtype)
    columns = basis @ rng.standard_normal((6, 30)) + 1e-4 * rng.standard_normal((200, 30))
    rest = outside(basis, columns.astype(dtype)).astype(np.float64)
    inside = np.linalg.norm(basis.T.astype(np.float64) @ rest, axis=0)
    bounded.at_most(
        inside / np.linalg.norm(rest, axis=0),
        64 * np.finfo(dtype).eps,
        case="degenerate blocks",
        quantity="share of a residual inside the basis",
        source="projected twice: eps of what is left, and of sums of 200 terms",
        dtype=dtype,
    )


@pytest.mark.stability
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_orthogonality_after_many_blocks(rng, dtype, bounded):
    left = rng.standard_normal((300, 5))
    svd = OnlineSVD(12, dtype)
    for _ in range(157):
        svd.update(left @ rng.standard_normal((5, 64)))
    bounded.at_most(
        departure(svd.basis),
        LIMIT[dtype],
        case="exactly low rank, ten thousand columns",
        quantity="largest entry of U^T U - 1",
        source="target",
        dtype=dtype,
    )
    assert svd.singular_values[4] > 1.0
    assert (svd.singular_values[5:] < LIMIT[dtype] * svd.singular_values[0]).all()


# --- refused -----------------------------------------------------------------------------


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="rank: expected at least 1"):
        OnlineSVD(0)
    with pytest.raises(InputError, match="dtype: expected float32 or float64"):
        OnlineSVD(1, np.float16)
    with pytest.raises(InputError, match="call update"):
        _ = OnlineSVD(1).basis
    svd = OnlineSVD(2).update(np.ones((4, 2)))
    with pytest.raises(ShapeError, match=r"block: expected shape \(4, any\)"):
        svd.update(np.ones((5, 2)))
    with pytest.raises(InputError, match="block: expected finite values"):
        svd.update(np.full((4, 1), np.nan))
