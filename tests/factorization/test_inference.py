"""Coefficients of columns that did not shape a completion."""

import numpy as np
import pytest

from reflfield.errors import ShapeError
from reflfield.factorization import complete
from reflfield.factorization.inference import infer_coefficients

from .problems import problem


@pytest.fixture
def planted(rng):
    """A fit to 400 of 500 columns of rank 4 in float64, with all of the problem."""
    data = problem("random", rng, n_directions=9, n_columns=500, rank=4, noise=0.01)
    wide = data._replace(
        truth=data.truth.astype(np.float64), measured=data.measured.astype(np.float64)
    )
    fit = complete(wide.measured[:, :400], wide.observed[:, :400], rank=4)
    return fit, wide


def infer(fit, data, columns, **options):
    return infer_coefficients(
        fit, data.measured[:, columns], data.observed[:, columns], **options
    )


def reconstructed(fit, coefficients):
    return fit.mean[:, None] + fit.basis @ coefficients.T


class TestAgreement:
    @pytest.mark.reference
    def test_with_the_completion_on_its_own_columns(self, planted):
        fit, data = planted
        coefficients, coverage = infer(fit, data, slice(0, 400))
        # Against some forty samples the prior weighs noise^2 / 40, about 3e-6; the two
        # priors differ by the posterior covariance, which the completion counts.
        size = np.sqrt((fit.coefficients**2).mean())
        assert np.abs(coefficients - fit.coefficients).max() < 1e-4 * size
        assert np.allclose(coverage, fit.coverage, rtol=1e-6)  # coverage is float32

    @pytest.mark.reference
    def test_with_ridge_regression(self, planted, rounding):
        fit, data = planted
        coefficients, _ = infer(fit, data, slice(400, 420))
        used = fit.coefficients
        prior = fit.noise**2 * np.linalg.solve(used.T @ used / len(used), np.eye(4))
        for j in range(20):
            seen = data.observed[:, 400 + j]
            basis, rest = fit.basis[seen], (data.measured[:, 400 + j] - fit.mean)[seen]
            expected = np.linalg.solve(basis.T @ basis + prior, basis.T @ rest)
            # The answer is float32.
            tolerance = rounding(np.float32, scale=np.abs(expected).max())
            assert np.abs(coefficients[j] - expected).max() < tolerance

    def test_with_the_truth_on_new_columns(self, planted):
        fit, data = planted
        coefficients, _ = infer(fit, data, slice(400, 500))
        error = reconstructed(fit, coefficients) - data.truth[:, 400:]
        # 4 coefficients from about 40 samples: noise * sqrt(4 / 40), and as much for the
        # basis; three times that.
        assert np.sqrt((error**2).mean()) < 3 * 0.01 * np.sqrt(2 * 4 / 40)


class TestInvariance:
    @pytest.mark.parametrize("block", [1, 7, 1000])
    def test_block_size(self, planted, block, rounding):
        fit, data = planted
        whole, _ = infer(fit, data, slice(400, 500))
        parts, _ = infer(fit, data, slice(400, 500), block=block)
        assert np.abs(parts - whole).max() < rounding(np.float32, scale=np.abs(whole).max())

    @pytest.mark.stability
    @pytest.mark.parametrize("scale", [1e-12, 1e12])
    def test_global_scale(self, planted, scale):
        fit, data = planted
        one, _ = infer(fit, data, slice(400, 500))
        scaled = data._replace(measured=data.measured * scale)
        fit = complete(scaled.measured[:, :400], scaled.observed[:, :400], rank=4)
        coefficients, _ = infer(fit, scaled, slice(400, 500))
        # The scale is no power of two: rounding differs and is amplified by the passes.
        error = np.abs(coefficients.astype(np.float64) / scale - one).max()
        assert error < 1e-5 * np.abs(one).max()

    def test_channels_share_their_weights(self, planted):
        """Three rows with one weight are the rows themselves with that weight each."""
        _, data = planted
        seen = data.observed[::3][:27]
        measured = data.measured[:81]
        fit = complete(measured, seen, rank=3, n_channels=3)
        one, _ = infer_coefficients(fit, measured, seen, n_channels=3)
        other, _ = infer_coefficients(fit, measured, np.repeat(seen, 3, axis=0))
        assert np.abs(one - other).max() < 1e-6 * np.abs(one).max()  # float32 answers


@pytest.mark.stability
class TestDegenerate:
    def test_column_without_samples_is_the_mean(self, planted):
        fit, _ = planted
        coefficients, coverage = infer_coefficients(fit, np.full((81, 2), np.nan))
        assert not coefficients.any()
        assert not coverage.any()

    def test_values_not_observed_are_not_read(self, planted):
        fit, data = planted
        seen = data.observed[:, 400:420]
        clean, _ = infer_coefficients(fit, np.where(seen, data.measured[:, 400:420], 0), seen)
        dirty, _ = infer_coefficients(
            fit, np.where(seen, data.measured[:, 400:420], np.nan), seen
        )
        assert np.array_equal(clean, dirty)

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_rank_above_that_of_the_data(self, rng, dtype):
        """A single sample leaves all but one direction to the prior."""
        truth = np.outer(rng.uniform(1, 2, 30), rng.uniform(1, 2, 40)).astype(dtype)
        fit = complete(truth, rank=5)
        lone = np.full((30, 1), np.nan, dtype)
        lone[3] = truth[3, 5]
        coefficients, _ = infer_coefficients(fit, lone)
        # The prior knows the one direction that the data have, up to its floor of 1e-9.
        assert np.allclose(reconstructed(fit, coefficients)[:, 0], truth[:, 5], rtol=1e-3)

    def test_no_column_shaped_the_prior(self, planted):
        """All columns too sparse: coefficients vanish rather than fail."""
        fit, _ = planted
        barren = type(fit)(**{**vars(fit), "sparse_columns": np.ones(400, bool)})
        coefficients, _ = infer_coefficients(barren, np.ones((81, 2)))
        assert np.isfinite(coefficients).all()

    def test_other_rows_are_refused(self, planted):
        fit, _ = planted
        with pytest.raises(ShapeError, match=r"expected 81 rows like the completion.*80"):
            infer_coefficients(fit, np.ones((80, 2)))
