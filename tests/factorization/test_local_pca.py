"""Local PCA: planted clusters, scikit-learn's PCA, degenerate clusters, refusals."""

import numpy as np
import pytest

from reflfield.errors import InputError
from reflfield.factorization import LocalPCA
from reflfield.factorization.clustering import nearest, updated, without_empty

from .problems import clustered_subspaces, reconstructed


def relative_error(columns, fit):
    """Root mean square of what is left over that of the columns, by the fit's own account."""
    return float(fit.residual / np.sqrt(np.mean(np.square(columns, dtype=np.float64))))


def test_planted_clusters_are_found(rng):
    columns, truth = clustered_subspaces(rng)
    fit = LocalPCA(n_clusters=6, n_components=3).fit(columns)
    assert fit.residual < 1.1 * 0.01
    pairs = np.unique(np.stack([truth, fit.labels]), axis=1)
    assert pairs.shape[1] == 6


def test_error_is_that_of_the_reconstruction(rng, rounding):
    columns, _ = clustered_subspaces(rng, n_columns=400)
    for n_clusters, n_components in ((4, 2), (1, 2), (4, 0)):
        fit = LocalPCA(n_clusters, n_components).fit(columns)
        approximation = reconstructed(fit)
        left = np.sqrt(((columns - approximation) ** 2).mean())
        assert fit.residual == pytest.approx(left, rel=rounding(np.float32, operations=3))
        for some, same in ((7, slice(7, 8)), (slice(2, 9), slice(2, 9))):
            expected = approximation[:, same]
            products = rounding(np.float32, operations=3, scale=np.abs(expected).max())
            np.testing.assert_allclose(
                reconstructed(fit, some), expected, rtol=0, atol=products
            )


@pytest.mark.reference
def test_one_cluster_is_principal_component_analysis(rng, rounding):
    from sklearn.decomposition import PCA  # long to import

    columns, _ = clustered_subspaces(rng, n_columns=500)
    fit = LocalPCA(n_clusters=1, n_components=5).fit(columns)
    other = PCA(5, svd_solver="full").fit(columns.T)
    rebuilt = other.inverse_transform(other.transform(columns.T)).T
    left = np.sqrt(((columns - rebuilt) ** 2).mean())
    assert fit.residual == pytest.approx(left, rel=rounding(np.float32, operations=6))
    # Roundings of 500 additions wander as the root of their number.
    mean_of = rounding(np.float32, operations=np.sqrt(500))
    np.testing.assert_allclose(fit.means[0], other.mean_, rtol=0, atol=mean_of)


def test_more_rows_than_the_work_space(rng):
    """Bases found among 96 components serve columns that fill 300 dimensions."""
    columns, _ = clustered_subspaces(rng, n_rows=300, n_columns=900, noise=0.05)
    fit = LocalPCA(n_clusters=6, n_components=3, work_components=30).fit(columns)
    assert fit.residual < 1.05 * 0.05


def test_bases_are_orthonormal_and_coefficients_are_projections(rng, rounding):
    columns, _ = clustered_subspaces(rng, n_columns=300)
    fit = LocalPCA(n_clusters=3, n_components=4).fit(columns)
    for basis in fit.bases:
        assert np.abs(basis.T @ basis - np.eye(4)).max() < rounding(np.float32, 20)
    c = fit.labels[11]
    rest = columns[:, 11] - fit.means[c]
    # 64 additions, whose roundings wander as the root of their number.
    products = rounding(np.float32, operations=np.sqrt(64), scale=np.linalg.norm(rest))
    expected = fit.bases[c].T @ rest
    np.testing.assert_allclose(fit.coefficients[11], expected, rtol=0, atol=products)


def test_history_never_rises(rng, rounding):
    # Noise alone: of planted clusters the start is the answer.
    columns = rng.standard_normal((16, 2000)).astype(np.float32)
    history = LocalPCA(n_clusters=6, n_components=3).fit(columns).history
    assert len(history) > 5
    assert (np.diff(history) <= rounding(np.float32)).all()


def test_methods_rank(rng):
    columns, _ = clustered_subspaces(rng, n_clusters=12, n_columns=2000)
    local = LocalPCA(n_clusters=12, n_components=3).fit(columns)
    pca = LocalPCA(n_clusters=1, n_components=3).fit(columns)
    vq = LocalPCA(n_clusters=12, n_components=0).fit(columns)
    assert vq.bases.shape[2] == 0
    assert local.residual < 0.5 * pca.residual
    assert local.residual < 0.5 * vq.residual


def test_same_seed_same_bytes_and_blocks_do_not_matter(rng, rounding):
    columns, _ = clustered_subspaces(rng, n_columns=500)
    options = LocalPCA(n_clusters=5, n_components=2, seed=4)
    first, second = options.fit(columns), options.fit(columns)
    np.testing.assert_array_equal(first.bases, second.bases)
    other = LocalPCA(n_clusters=5, n_components=2, seed=4, block=77).fit(columns)
    np.testing.assert_array_equal(first.labels, other.labels)
    # Sums of up to 500 columns in another order.
    one, two = reconstructed(first), reconstructed(other)
    sums = rounding(np.float32, operations=np.sqrt(500), scale=np.abs(one).max())
    np.testing.assert_allclose(two, one, rtol=0, atol=sums)


def test_missing_samples_are_refused(rng):
    columns, _ = clustered_subspaces(rng, n_columns=40)
    columns[3, 5] = np.nan
    with pytest.raises(InputError, match="matrix: expected complete columns"):
        LocalPCA(2, 1).fit(columns)


# --- degenerate --------------------------------------------------------------------------


@pytest.mark.stability
@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_unit_does_not_matter(rng, scale):
    columns, _ = clustered_subspaces(rng, n_columns=200)
    scaled = columns * np.float32(scale)
    fit = LocalPCA(n_clusters=4, n_components=3).fit(scaled)
    assert relative_error(scaled, fit) < 0.5
    assert np.isfinite(reconstructed(fit)).all()


@pytest.mark.stability
@pytest.mark.parametrize(
    "columns",
    [
        np.zeros((10, 20)),
        np.ones((10, 20)),
        np.repeat(np.eye(10)[:, :3], 7, axis=1),
        np.arange(10.0)[:, None],
        np.arange(10.0)[None, :],
    ],
    ids=["zero", "equal", "three distinct", "one column", "one row"],
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_degenerate_columns_are_reproduced(columns, dtype, bounded):
    fit = LocalPCA(n_clusters=5, n_components=4).fit(columns.astype(dtype))
    bounded.at_most(
        np.abs(reconstructed(fit) - columns),
        9 * 8 * np.finfo(dtype).eps,
        case="degenerate columns",
        quantity="largest error",
        source="8 roundings of numbers up to 9",
        dtype=dtype,
    )
    assert fit.labels.min() >= 0
    assert fit.labels.max() < fit.n_clusters


@pytest.mark.stability
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_distances_of_columns_far_from_zero(rng, dtype, bounded):
    """The mean of all columns is a thousand times what they vary by."""
    columns, _ = clustered_subspaces(rng, n_columns=400, n_clusters=4)
    plain = LocalPCA(4, 3).fit(columns.astype(dtype))
    far = (columns.astype(np.float64) + 1e3 * rng.uniform(1, 2, (len(columns), 1))).astype(
        dtype
    )
    fit = LocalPCA(4, 3).fit(far)
    error = np.sqrt(np.mean((reconstructed(fit).astype(np.float64) - far) ** 2))
    alone = np.sqrt(np.mean((reconstructed(plain).astype(np.float64) - columns) ** 2))
    bounded.at_most(
        error / alone,
        1.1 if dtype is np.float64 else 1.1 + 4e3 * np.finfo(dtype).eps / alone,
        case="distances from an expanded square",
        quantity="error over that without the common mean",
        source="columns are centred first; in float32 a few roundings of the mean besides",
        dtype=dtype,
    )


@pytest.mark.stability
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_clusters_that_run_empty_are_filled_again(rng, dtype, bounded):
    """Three distinct columns for eight clusters: seeds that fall together leave five empty."""
    columns = np.repeat(rng.standard_normal((20, 3)), 40, axis=1)
    fit = LocalPCA(8, 1).fit(columns.astype(dtype))
    bounded.at_least(
        np.bincount(fit.labels, minlength=8).min(),
        1,
        case="empty clusters",
        quantity="columns of the smallest of 8 clusters, 3 distinct columns",
        source="empty clusters take the worst reconstructed columns",
        dtype=dtype,
    )


def test_empty_clusters_take_the_worst_points():
    labels = np.array([0, 0, 0, 2], dtype=np.int32)
    filled = without_empty(labels, np.array([0.1, 5.0, 1.0, 9.0]), 4)
    # Point 3 is alone in its cluster and stays; 1 and 2 leave cluster 0.
    assert filled.tolist() == [0, 1, 3, 2]


def test_assignment_is_the_least_distance_to_a_subspace(rng, rounding):
    points = rng.standard_normal((60, 8))
    clusters = updated(points, rng.integers(4, size=60).astype(np.int32), 4, 2)
    labels, squared = nearest(points, clusters)
    distances = []
    for mean, basis in zip(clusters.means, clusters.bases, strict=True):
        rest = points - mean
        rest = rest - rest @ basis @ basis.T
        distances.append((rest**2).sum(axis=1))
    np.testing.assert_array_equal(labels, np.argmin(distances, axis=0))
    # Squares of eight coordinates less those of the projections.
    tolerance = rounding(float, operations=2 * 8, scale=(points**2).sum(axis=1).max())
    np.testing.assert_allclose(squared, np.min(distances, axis=0), rtol=0, atol=tolerance)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_clusters": 0}, "n_clusters: expected at least 1"),
        ({"n_components": -1}, "n_components: expected at least 0"),
        ({"iterations": 0}, "iterations: expected at least 1"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        LocalPCA(**({"n_clusters": 2, "n_components": 1} | options))
