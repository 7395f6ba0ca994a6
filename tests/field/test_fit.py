"""Fit to the samples: adjoints, exact solves, planted models, invariance."""

from dataclasses import replace

import numpy as np
import pytest

from reflfield.field.basis import roughness
from reflfield.field.clustered_model import normalised
from reflfield.field.coefficients import solve_coefficients
from tests.field.fit_problems import (
    NODES,
    empty_samples,
    interpolation,
    measured,
    planted_model,
    predicted,
    problem_of,
    sample_weights,
    value_weights,
)


class TestModel:
    def test_mean_and_basis_are_the_table(self, rng):
        model = planted_model(rng, 4, n_clusters=3, n_components=2)
        assert np.array_equal(model.mean, model.table[..., :3])
        for k in range(2):
            at = slice(3 * (k + 1), 3 * (k + 2))
            assert np.array_equal(model.basis[:, k], model.table[..., at])

    def test_without_components(self, rng):
        model = planted_model(rng, 4, n_components=0)
        assert model.basis.shape == (2, 0, *NODES, 3)


class TestNormalEquations:
    @pytest.fixture(params=[False, True], ids=["whole", "gaps"])
    def setting(self, rng, pool, request):
        model = planted_model(rng, 20)
        samples = empty_samples(rng, 20, 7, 6, gaps=request.param)
        samples = measured(samples, model, rng, 0.1)
        return samples, model, problem_of(samples, model, pool)

    def test_are_symmetric_and_positive(self, setting, rng, rounding):
        """<x, N y> = <N x, y>, <x, N x> >= 0."""
        _, model, problem = setting
        x, y = (rng.normal(size=model.table.shape).astype(np.float32) for _ in range(2))
        nx, ny = (problem.sums(v, of_samples=False).astype(float) for v in (x, y))
        # A node sums some hundred samples.
        tolerance = rounding(np.float32, 100, scale=np.abs(x * ny).sum() / 100)
        assert abs((x * ny).sum() - (nx * y).sum()) < tolerance
        assert (x * nx).sum() > 0

    @pytest.mark.reference
    def test_energy_is_that_of_the_predictions(self, setting, rounding):
        """<x, A^T W A x> = |W^1/2 A x|^2 and <x, A^T W u> = <A x, W u>, by dense products."""
        samples, model, problem = setting
        weights, values = value_weights(samples), predicted(samples, model)
        energy = (weights * values**2).sum()
        got = (model.table * problem.sums(model.table, of_samples=False)).sum(dtype=float)
        assert abs(got - energy) < rounding(np.float32, 100, scale=energy)
        cross = (weights * values * samples.values).sum()
        got = (model.table * problem.sums(model.table, of_samples=True)).sum(dtype=float)
        assert abs(got - cross) < rounding(np.float32, 100, scale=np.abs(cross))

    def test_do_not_read_what_has_no_weight(self, setting, pool):
        samples, model, problem = setting
        counted = value_weights(samples) > 0
        other = problem_of(
            replace(samples, values=np.where(counted, samples.values, np.float32(9e9))),
            model,
            pool,
        )
        one, two = (p.sums(model.table, of_samples=True) for p in (problem, other))
        assert np.array_equal(one, two)

    @pytest.mark.reference
    def test_solve_is_least_squares(self, rng, pool):
        """One cluster without components, enough steps: the dense ridge solution."""
        model = planted_model(rng, 30, n_clusters=1, n_components=0)
        samples = measured(empty_samples(rng, 30, 7, 6), model, rng, 0.1)
        problem = problem_of(samples, model, pool, smoothness=0.01)
        table = problem.solve(np.zeros_like(model.table), 200)[0].reshape(81, 3)
        a, b = interpolation(samples.view_taps, 9), interpolation(samples.light_taps, 9)
        both = np.einsum("tiv,tjl->tijvl", a, b).reshape(-1, 81)
        weights = sample_weights(samples).ravel()
        rough = np.stack(
            [roughness(e.reshape(1, 9, 9, 1)).ravel() for e in np.eye(81, dtype=np.float32)]
        )
        strength = 0.01 * weights.sum() / 81
        normal = both.T @ (weights[:, None] * both) + strength * (rough + 0.01 * np.eye(81))
        right = both.T @ (weights[:, None] * samples.values.reshape(-1, 3))
        error = np.linalg.norm(table - np.linalg.solve(normal, right))
        # Steps from zero stop at a residual of 1e-5 of the right side; the error is at most
        # the residual over the least eigenvalue, which the roughness keeps off zero.
        assert error < 1e-5 * np.linalg.norm(right) / np.linalg.eigvalsh(normal)[0]
        assert np.linalg.cond(normal) < 1e3


class TestRoughness:
    def test_is_symmetric_and_spares_constants(self, rng, rounding):
        x, y = rng.normal(size=(2, 2, 25, 9, 3))
        tolerance = rounding(np.float64, 25 * 9 * 6)
        assert abs((roughness(x) * y).sum() - (x * roughness(y)).sum()) < tolerance
        assert not roughness(np.ones((1, 25, 9, 3))).any()

    def test_energy_is_that_of_the_differences(self, rng, rounding):
        x = rng.normal(size=(1, 4, 9, 1))
        grid = x.reshape(2, 2, 3, 3)
        expected = sum((np.diff(grid, axis=axis) ** 2).sum() for axis in range(4))
        assert abs((x * roughness(x)).sum() - expected) < rounding(np.float64, 100)

    def test_side_one(self, rng):
        assert not roughness(rng.normal(size=(2, 1, 1, 6))).any()


class TestCoefficients:
    @pytest.mark.reference
    @pytest.mark.parametrize("gaps", [False, True])
    def test_against_lstsq_with_prior(self, rng, pool, rounding, gaps):
        model = planted_model(rng, 12)
        precision = np.array([[2.0, 0.3], [0.3, 1.0]])
        model = replace(model, precision=np.stack([precision, 3 * precision]))
        samples = measured(empty_samples(rng, 12, 6, 5, gaps=gaps), model, rng, 0.1)
        coefficients, squares = solve_coefficients(samples, model.cluster, model, pool)
        columns = [
            predicted(samples, replace(model, coefficients=np.tile(row, (12, 1))))
            for row in np.array([[0, 0], [1, 0], [0, 1.0]])
        ]
        weights = value_weights(samples)
        for t in range(12):
            half = np.sqrt(weights[t]).ravel()
            design = np.stack([(c - columns[0])[t].ravel() * half for c in columns[1:]], axis=1)
            rest = (samples.values[t] - columns[0][t]).ravel() * half
            prior = np.linalg.cholesky(model.precision[model.cluster[t]]).T
            expected = np.linalg.lstsq(
                np.vstack([design, prior]), np.append(rest, [0, 0]), rcond=None
            )[0]
            assert np.abs(coefficients[t] - expected).max() < rounding(np.float32, 30, scale=2)
            left = ((rest - design @ expected) ** 2).sum()
            assert np.isclose(squares[t, 0], left, rtol=1e-4)  # what is left of float32 sums
            full = design.T @ design
            determined = np.trace(np.linalg.solve(full + prior.T @ prior, full))
            share = 1 - determined / np.count_nonzero(weights[t])
            freedom = weights[t].sum() * share
            # Two components' normal equations in singles.
            assert squares[t, 1] == pytest.approx(freedom, rel=rounding(np.float32, 4))

    def test_planted_coefficients(self, rng, pool):
        model = planted_model(rng, 40)
        samples = measured(empty_samples(rng, 40, 12, 12), model, rng, 0.0)
        weak = replace(model, precision=1e-6 * model.precision)
        coefficients, _ = solve_coefficients(samples, model.cluster, weak, pool)
        assert (
            np.abs(coefficients - model.coefficients).max() < 1e-4
        )  # float32, a few hundred samples

    @pytest.mark.stability
    def test_texel_without_samples(self, rng, pool):
        model = planted_model(rng, 5)
        samples = measured(empty_samples(rng, 5, 6, 5), model, rng, 0.1)
        samples.view_weights[1] = 0
        samples.light_weights[2] = 0
        coefficients, squares = solve_coefficients(samples, model.cluster, model, pool)
        assert not coefficients[1:3].any()
        assert not squares[1:3].any()
        assert np.isfinite(coefficients).all()

    @pytest.mark.stability
    def test_one_sample_for_many_components(self, rng, pool):
        model = planted_model(rng, 3, n_components=8)
        samples = measured(empty_samples(rng, 3, 1, 1), model, rng, 0.1)
        samples.view_weights[:] = samples.light_weights[:] = samples.pairs[:] = 1
        coefficients, _ = solve_coefficients(samples, model.cluster, model, pool)
        assert np.isfinite(coefficients).all()
        fitted = predicted(samples, replace(model, coefficients=coefficients))
        before = predicted(samples, replace(model, coefficients=0 * coefficients))
        assert np.abs(fitted - samples.values).sum() < np.abs(before - samples.values).sum()

    def test_without_components(self, rng, pool, rounding):
        model = planted_model(rng, 6, n_components=0)
        samples = measured(empty_samples(rng, 6, 5, 4), model, rng, 0.1)
        coefficients, squares = solve_coefficients(samples, model.cluster, model, pool)
        assert coefficients.shape == (6, 0)
        rest = (
            sample_weights(samples)[..., None]
            * (samples.values - predicted(samples, model)) ** 2
        )
        assert np.allclose(squares[:, 0], rest.sum(axis=(1, 2, 3)), rtol=1e-4)  # float32 sums
        weight = 3 * sample_weights(samples).sum(axis=(1, 2))
        np.testing.assert_allclose(squares[:, 1], weight, rtol=rounding(np.float32))


class TestNormalised:
    def test_predictions_stay_and_coefficients_are_white(self, rng, rounding):
        model = planted_model(rng, 60)
        mixed = model.coefficients @ np.array([[2, 1], [0, 0.5]]) + [3, -1]
        model = replace(model, coefficients=mixed.astype(np.float32))
        chosen = np.arange(0, 60, 2)
        white = normalised(model, 0.04, chosen)
        samples = empty_samples(rng, 60, 3, 3)
        one, two = predicted(samples, model), predicted(samples, white)
        assert np.abs(one - two).max() < 1e-5 * np.abs(one).max()  # float32, sums of three
        # Singles of size 5 are divided by their deviations, of which the least is about .45.
        singles = rounding(np.float32, condition=5 / 0.45)
        for c in range(2):
            members = chosen[model.cluster[chosen] == c]
            assert np.abs(white.coefficients[members].mean(axis=0)).max() < singles
            covariance = np.cov(white.coefficients[members].T)
            np.testing.assert_allclose(covariance, np.eye(2), rtol=0, atol=singles)
            assert np.allclose(white.precision[c], 0.04 * np.eye(2))

    @pytest.mark.stability
    def test_too_few_members_change_nothing(self, rng):
        model = planted_model(rng, 8, n_clusters=3, n_components=4)
        same = normalised(model, 0.1, np.arange(8))
        assert np.array_equal(same.table, model.table)
        assert np.array_equal(same.coefficients, model.coefficients)

    @pytest.mark.stability
    @pytest.mark.parametrize("value", [0.0, 3.0])
    def test_coefficients_that_are_all_alike(self, rng, value):
        model = planted_model(rng, 50)
        model = replace(model, coefficients=np.full((50, 2), value, np.float32))
        white = normalised(model, 0.1, np.arange(50))
        assert np.isfinite(white.coefficients).all()
        assert np.isfinite(white.table).all()

    @pytest.mark.stability
    @pytest.mark.parametrize("scale", [1e-12, 1e12])
    def test_unit_of_the_coefficients(self, rng, scale):
        model = planted_model(rng, 50)
        scaled = replace(model, coefficients=model.coefficients * np.float32(scale))
        one, two = (normalised(m, 0.1, np.arange(50)).coefficients for m in (model, scaled))
        # Up to the signs of the axes, which eigh is free to choose.
        assert np.allclose(np.abs(one), np.abs(two), atol=1e-4)
