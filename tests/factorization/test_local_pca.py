"""Local PCA: planted clusters, scikit-learn's PCA, missing samples, degenerate clusters."""

import numpy as np
import pytest
from sklearn.decomposition import PCA

from reflfield.errors import InputError, ShapeError
from reflfield.factorization import LocalPCA
from reflfield.factorization.clustering import nearest, updated, without_empty

from .problems import clustered_subspaces


def relative_error(columns, found):
    return float(np.linalg.norm(columns - found) / np.linalg.norm(columns))


def test_planted_clusters_are_found(rng):
    columns, truth = clustered_subspaces(rng)
    fit = LocalPCA(n_clusters=6, n_components=3).fit(columns)
    assert fit.relative_error < 1.1 * 0.01 * np.sqrt(columns.size) / np.linalg.norm(columns)
    pairs = np.unique(np.stack([truth, fit.labels]), axis=1)
    assert pairs.shape[1] == 6


def test_error_is_that_of_the_reconstruction(rng):
    columns, _ = clustered_subspaces(rng, n_columns=400)
    for method in ("local", "pca", "vq"):
        fit = LocalPCA(n_clusters=4, n_components=2, method=method).fit(columns)
        found = fit.reconstruct()
        assert fit.relative_error == pytest.approx(relative_error(columns, found), rel=1e-4)
        assert fit.residual == pytest.approx(np.sqrt(((columns - found) ** 2).mean()), rel=1e-4)
        np.testing.assert_allclose(fit.reconstruct(7), found[:, 7:8], atol=1e-5)
        np.testing.assert_allclose(fit.reconstruct(slice(2, 9)), found[:, 2:9], atol=1e-5)


@pytest.mark.reference
def test_one_cluster_is_principal_component_analysis(rng):
    columns, _ = clustered_subspaces(rng, n_columns=500)
    fit = LocalPCA(n_clusters=1, n_components=5).fit(columns)
    named = LocalPCA(n_clusters=9, n_components=5, method="pca").fit(columns)
    other = PCA(5, svd_solver="full").fit(columns.T)
    found = other.inverse_transform(other.transform(columns.T)).T
    expected = relative_error(columns, found)
    assert fit.relative_error == pytest.approx(expected, rel=1e-3)
    assert named.relative_error == pytest.approx(expected, rel=1e-3)
    np.testing.assert_allclose(fit.means[0], other.mean_, atol=1e-4)


def test_more_rows_than_the_work_space(rng):
    """Bases found among 96 components serve columns that fill 300 dimensions."""
    columns, _ = clustered_subspaces(rng, n_rows=300, n_columns=900, noise=0.05)
    fit = LocalPCA(n_clusters=6, n_components=3, work_components=30).fit(columns)
    floor = 0.05 * np.sqrt(columns.size) / np.linalg.norm(columns)
    assert fit.relative_error < 1.05 * floor


def test_bases_are_orthonormal_and_coefficients_are_projections(rng, rounding):
    columns, _ = clustered_subspaces(rng, n_columns=300)
    fit = LocalPCA(n_clusters=3, n_components=4).fit(columns)
    for basis in fit.bases:
        assert np.abs(basis.T @ basis - np.eye(4)).max() < rounding(np.float32, 20)
    c = fit.labels[11]
    expected = fit.bases[c].T @ (columns[:, 11] - fit.means[c])
    np.testing.assert_allclose(fit.coefficients[11], expected, atol=1e-4)


def test_history_never_rises_and_methods_rank(rng):
    columns, _ = clustered_subspaces(rng, n_clusters=12, n_columns=2000)
    local = LocalPCA(n_clusters=12, n_components=3).fit(columns)
    assert (np.diff(local.history) <= 1e-6).all()
    pca = LocalPCA(n_clusters=12, n_components=3, method="pca").fit(columns)
    vq = LocalPCA(n_clusters=12, n_components=3, method="vq").fit(columns)
    assert vq.bases.shape[2] == 0
    assert local.relative_error < 0.5 * pca.relative_error
    assert local.relative_error < 0.5 * vq.relative_error


def test_same_seed_same_bytes_and_blocks_do_not_matter(rng):
    columns, _ = clustered_subspaces(rng, n_columns=500)
    options = LocalPCA(n_clusters=5, n_components=2, seed=4)
    first, second = options.fit(columns), options.fit(columns)
    np.testing.assert_array_equal(first.bases, second.bases)
    blocks = [columns[:, :123], columns[:, 123:]]
    other = LocalPCA(n_clusters=5, n_components=2, seed=4, block=77).fit(blocks)
    np.testing.assert_array_equal(first.labels, other.labels)
    np.testing.assert_allclose(first.reconstruct(), other.reconstruct(), atol=1e-3)


def test_initial_labels_are_kept_without_iterations(rng):
    columns, truth = clustered_subspaces(rng, n_columns=300)
    kept = LocalPCA(n_clusters=6, n_components=3, iterations=0)
    fit = kept.fit(columns, initial_labels=truth)
    np.testing.assert_array_equal(fit.labels, truth)
    assert kept.fit(columns).labels.shape == (300,)
    started = LocalPCA(n_clusters=6, n_components=3).fit(columns, initial_labels=truth)
    assert (started.labels == truth).mean() > 0.99


# --- missing samples ---------------------------------------------------------------------


def test_missing_samples_are_weighted_not_zeros(rng):
    columns, truth = clustered_subspaces(rng, n_rows=90, n_columns=900, n_clusters=3)
    seen = rng.random((30, 900)) < 0.6
    spoiled = np.where(np.repeat(seen, 3, axis=0), columns, np.nan)
    fit = LocalPCA(n_clusters=3, n_components=3, completion_rank=12).fit(
        spoiled, observed=seen, n_channels=3
    )
    # Noise is 0.01; what was not seen is found from what was.
    assert np.sqrt(((fit.reconstruct() - columns) ** 2).mean()) < 0.02
    assert len(np.unique(np.stack([truth, fit.labels]), axis=1).T) == 3
    zeros = LocalPCA(n_clusters=3, n_components=3).fit(np.nan_to_num(spoiled))
    assert np.sqrt(((zeros.reconstruct() - columns) ** 2).mean()) > 0.2


def test_weights_of_one_need_no_completion(rng):
    columns, _ = clustered_subspaces(rng, n_columns=200)
    plain = LocalPCA(n_clusters=2, n_components=2).fit(columns)
    weighted = LocalPCA(n_clusters=2, n_components=2).fit(columns, np.ones(columns.shape))
    np.testing.assert_array_equal(plain.coefficients, weighted.coefficients)


def test_quantisation_with_missing_samples(rng):
    columns, _ = clustered_subspaces(rng, n_columns=300, n_components=1)
    seen = rng.random(columns.shape) < 0.7
    fit = LocalPCA(n_clusters=5, n_components=2, method="vq").fit(columns, observed=seen)
    member = fit.labels == fit.labels[0]
    total = np.where(seen, columns, 0)[:, member].sum(axis=1)
    expected = total / seen[:, member].sum(axis=1)
    # The lifted mean weighs half an observation.
    spread = columns[:, member].std()
    assert (
        np.abs(fit.means[fit.labels[0]] - expected).max()
        < spread / seen[:, member].sum(1).min()
    )


# --- degenerate --------------------------------------------------------------------------


@pytest.mark.stability
@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_unit_does_not_matter(rng, scale):
    columns, _ = clustered_subspaces(rng, n_columns=200)
    fit = LocalPCA(n_clusters=4, n_components=3).fit(columns * np.float32(scale))
    assert fit.relative_error < 0.5
    assert np.isfinite(fit.reconstruct()).all()


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
def test_degenerate_columns_are_reproduced(columns):
    fit = LocalPCA(n_clusters=5, n_components=4).fit(columns)
    np.testing.assert_allclose(fit.reconstruct(), columns, atol=1e-5)
    assert fit.labels.min() >= 0
    assert fit.labels.max() < fit.n_clusters


def test_empty_clusters_take_the_worst_points():
    labels = np.array([0, 0, 0, 2], dtype=np.int32)
    filled = without_empty(labels, np.array([0.1, 5.0, 1.0, 9.0]), 4)
    # Point 3 is alone in its cluster and stays; 1 and 2 leave cluster 0.
    assert filled.tolist() == [0, 1, 3, 2]


def test_assignment_is_the_least_distance_to_a_subspace(rng):
    points = rng.standard_normal((60, 8))
    clusters = updated(points, rng.integers(4, size=60).astype(np.int32), 4, 2)
    labels, squared = nearest(points, clusters)
    distances = []
    for mean, basis in zip(clusters.means, clusters.bases, strict=True):
        rest = points - mean
        rest = rest - rest @ basis @ basis.T
        distances.append((rest**2).sum(axis=1))
    np.testing.assert_array_equal(labels, np.argmin(distances, axis=0))
    np.testing.assert_allclose(squared, np.min(distances, axis=0), atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_clusters": 0}, "n_clusters: expected at least 1"),
        ({"n_components": -1}, "n_components: expected at least 0"),
        ({"method": "kmeans"}, "method: expected 'local', 'pca' or 'vq'"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        LocalPCA(**({"n_clusters": 2, "n_components": 1} | options))


def test_bad_labels_are_refused():
    with pytest.raises(ShapeError, match=r"initial_labels: expected shape \(4"):
        LocalPCA(2, 1).fit(np.ones((3, 4)), initial_labels=[0, 1])
    with pytest.raises(InputError, match="initial_labels: expected 0 to 1, received 0 to 2"):
        LocalPCA(2, 1).fit(np.ones((3, 4)), initial_labels=[0, 1, 2, 0])
