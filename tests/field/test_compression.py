"""Clusters from completed texels: the same predictions, a sane prior, nothing left empty."""

from dataclasses import replace

import numpy as np
import pytest

from reflfield.errors import InputError
from reflfield.factorization import complete
from reflfield.field.clustered_pca import (
    CompressionOptions,
    _precision,
    cluster_completed,
    fill_unobserved,
)

COUNTS = (4, 9)
RANK = 4


@pytest.fixture
def completed(rng):
    """Columns of rank 4 about a mean: their completion, and the columns (n, rows)."""
    rows, n = COUNTS[0] * COUNTS[1] * 3, 120
    left, right = rng.normal(size=(rows, RANK)), rng.normal(size=(n, RANK))
    columns = (right * [3, 2, 1, 0.5]) @ left.T + 1
    return complete(columns.T, rank=RANK + 1), columns


def predicted(model):
    """Columns (n, rows) of a clustered model, (view, light, channel) with channel fastest."""
    basis = model.basis[model.cluster]
    nodes = model.mean[model.cluster] + np.einsum("tk,tkvlc->tvlc", model.coefficients, basis)
    return nodes.reshape(len(nodes), -1)


def clustered(completion, observed=None, scale=1.0, **options):
    n = len(completion.coefficients)
    observed = np.arange(n) if observed is None else observed
    coefficients = completion.coefficients.astype(np.float32)
    return cluster_completed(
        completion, coefficients, observed, COUNTS, CompressionOptions(**options)
    )


class TestClusters:
    def test_enough_components_return_the_columns(self, completed):
        completion, columns = completed
        model = clustered(completion, n_clusters=1, n_components=RANK + 1)
        assert model.table.shape == (1, *COUNTS, (RANK + 2) * 3)
        # Five components in float32.
        assert np.abs(predicted(model) - columns).max() < 1e-5 * np.abs(columns).max()

    def test_pairs_of_nodes_that_no_texel_showed_are_as_their_neighbours(self, rng, rounding):
        albedo = 1 + rng.random(60)
        columns = np.repeat(albedo[None], COUNTS[0] * COUNTS[1] * 3, axis=0)
        columns.reshape(*COUNTS, 3, -1)[1, 4:] = np.nan
        completion = complete(columns, rank=1)
        model = clustered(completion, n_clusters=1, n_components=1)
        # The completion's prior draws rows towards zero by a share of the noise, which is none
        # here: a mean and one component in singles are left.
        shown = predicted(model)
        assert np.abs(shown / albedo[:, None] - 1).max() < rounding(np.float32, operations=2)

    def test_more_clusters_and_components_fit_better(self, completed):
        completion, columns = completed

        def error(**options):
            return np.square(predicted(clustered(completion, **options)) - columns).mean()

        assert error(n_clusters=4, n_components=2) < error(n_clusters=1, n_components=2)
        assert error(n_clusters=1, n_components=2) < 0.9 * error(n_clusters=1, n_components=1)

    def test_components_are_limited_by_the_rank(self, completed):
        model = clustered(completed[0], n_clusters=2, n_components=50)
        assert model.coefficients.shape[1] == RANK + 1

    def test_texels_without_samples_get_nothing(self, completed):
        observed = np.arange(0, 120, 3)
        model = clustered(completed[0], observed, n_clusters=3, n_components=2)
        empty = np.setdiff1d(np.arange(120), observed)
        assert not model.cluster[empty].any()
        assert not model.coefficients[empty].any()
        assert np.any(model.coefficients[observed] != 0)

    def test_same_seed_same_bytes(self, completed):
        one, two = (clustered(completed[0], n_clusters=3, n_components=2) for _ in range(2))
        assert one.table.tobytes() == two.table.tobytes()
        assert one.cluster.tobytes() == two.cluster.tobytes()

    @pytest.mark.stability
    def test_no_components(self, completed):
        model = clustered(completed[0], n_clusters=3, n_components=0)
        assert model.coefficients.shape == (120, 0)
        assert model.precision.shape == (3, 0, 0)
        assert np.isfinite(predicted(model)).all()

    @pytest.mark.stability
    @pytest.mark.parametrize("n", [1, 2, 5])
    def test_fewer_texels_than_clusters_or_components(self, completed, n):
        completion, columns = completed
        model = clustered(completion, np.arange(n), n_clusters=8, n_components=4)
        assert len(model.precision) == len(model.table) <= 8
        assert (np.linalg.eigvalsh(model.precision) > 0).all()
        error = np.abs(predicted(model)[:n] - columns[:n]).max()
        assert error < 1e-5 * np.abs(columns).max()

    @pytest.mark.stability
    def test_texels_that_are_all_alike(self, completed):
        completion, _ = completed
        alike = replace(completion, coefficients=np.ones_like(completion.coefficients))
        model = clustered(alike, n_clusters=3, n_components=2)
        assert np.isfinite(model.precision).all()
        assert (np.linalg.eigvalsh(model.precision) > 0).all()


class TestPrecision:
    def test_is_noise_over_variance(self, rng, rounding):
        labels = np.repeat(np.arange(2, dtype=np.int32), 50)
        coefficients = rng.normal(size=(100, 3))
        precision = _precision(labels, coefficients, 0.3, 2)
        for c in range(2):
            expected = 0.09 / coefficients[labels == c].var(axis=0)
            tolerance = rounding(np.float64, operations=50)  # a variance of 50
            np.testing.assert_allclose(precision[c], np.diag(expected), rtol=tolerance)

    @pytest.mark.stability
    def test_clusters_without_members(self, rng):
        labels = np.array([0, 0, 2, 2], np.int32)
        precision = _precision(labels, rng.normal(size=(4, 2)), 0.1, 5)
        assert precision.shape == (5, 2, 2)
        assert (np.linalg.eigvalsh(precision) > 0).all()

    @pytest.mark.stability
    @pytest.mark.parametrize("scale", [1e-12, 1e12])
    def test_unit_does_not_matter(self, rng, scale):
        """Variances and noise in one unit: their ratio has none, floors included."""
        labels = np.zeros(50, np.int32)
        coefficients = rng.normal(size=(50, 2)) * [1, 1e-5]
        one = _precision(labels, coefficients, 1e-6, 1)
        assert np.allclose(_precision(labels, coefficients * scale, 1e-6 * scale, 1), one)


class TestFilling:
    def test_nearest_observed_texel(self, completed, rng):
        observed = np.arange(0, 120, 7)
        model = clustered(completed[0], observed, n_clusters=3, n_components=2)
        positions = rng.normal(size=(120, 3))
        filled = fill_unobserved(model, positions, observed)
        distances = np.linalg.norm(positions[:, None] - positions[observed], axis=2)
        nearest = observed[distances.argmin(axis=1)]
        assert np.array_equal(filled.cluster, model.cluster[nearest])
        assert np.array_equal(filled.coefficients, model.coefficients[nearest])
        assert filled.table is model.table

    def test_everything_observed(self, completed, rng):
        model = clustered(completed[0])
        assert fill_unobserved(model, rng.normal(size=(120, 3)), np.arange(120)) is model

    def test_nothing_observed(self, completed, rng):
        with pytest.raises(InputError, match="observed: expected texels with samples"):
            fill_unobserved(
                clustered(completed[0]), rng.normal(size=(120, 3)), np.zeros(0, int)
            )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fit": "best"}, "fit: expected 'auto', 'samples' or 'grid', received 'best'"),
        ({"n_clusters": 0}, "n_clusters: expected at least 1"),
        ({"n_components": -1}, "n_components: expected at least 0"),
        ({"rank": 0}, "rank: expected at least 1"),
    ],
)
def test_options_are_checked(changes, message):
    with pytest.raises(InputError, match=message):
        CompressionOptions(**changes)


def test_texels_with_very_few_or_very_many_samples_are_fitted_on_the_grid():
    assert CompressionOptions().fits_samples(96)
    assert not CompressionOptions().fits_samples(22_801 / 4)
    assert not CompressionOptions().fits_samples(5)
    assert CompressionOptions(fit="samples").fits_samples(9999)
    assert not CompressionOptions(fit="grid").fits_samples(100)
