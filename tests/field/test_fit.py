"""Fit to the samples: adjoints, exact solves, planted models, invariance."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from reflfield.errors import InputError
from reflfield.field.basis import BasisProblem, roughness
from reflfield.field.bounds import MOST_OF_MEAN
from reflfield.field.clustered_model import ClusteredModel, normalised, of_usual_size
from reflfield.field.coefficients import solve_coefficients
from reflfield.field.sample_fit import SampleFitOptions, fit_basis
from reflfield.observations.texel_samples import CHANNEL_BITS, TransformedSamples, all_channels
from reflfield.sphere.hemisphere import HemisphereGrid

SIDES = (3, 3)
NODES = (9, 9)


@pytest.fixture(scope="module")
def pool():
    with ThreadPoolExecutor(2) as pool:
        yield pool


def random_taps(rng, n, k, side):
    directions = rng.normal(size=(n * k, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    nodes, weights = HemisphereGrid(side).taps(directions)
    return nodes.reshape(n, k, 4), weights.reshape(n, k, 4)


def random_weights(rng, n, k):
    """A fifth zero, the others between 0.2 and 1."""
    return (rng.uniform(0.2, 1, (n, k)) * (rng.random((n, k)) < 0.8)).astype(np.float32)


def empty_samples(rng, n, n_views, n_lights, sides=SIDES, *, gaps=False):
    """Random directions and weights; with `gaps`, a third of the values was not measured."""
    channels = all_channels()
    if gaps:
        channels = (rng.random((n, n_views, n_lights, 3)) < 2 / 3) @ CHANNEL_BITS
    return TransformedSamples(
        values=np.zeros((n, n_views, n_lights, 3), np.float32),
        view_taps=random_taps(rng, n, n_views, sides[0]),
        light_taps=random_taps(rng, n, n_lights, sides[1]),
        view_weights=random_weights(rng, n, n_views),
        light_weights=random_weights(rng, n, n_lights),
        pairs=(rng.random((n_views, n_lights)) < 0.9).astype(np.float32),
        channels=channels,
    )


def planted_model(rng, n, *, n_clusters=2, n_components=2, nodes=NODES):
    """Means about 1, bases about 0.3, standard normal coefficients."""
    table = 0.3 * rng.normal(size=(n_clusters, *nodes, n_components + 1, 3))
    table[:, :, :, 0] += 1
    return ClusteredModel(
        cluster=rng.integers(0, n_clusters, n).astype(np.int32),
        coefficients=rng.normal(size=(n, n_components)).astype(np.float32),
        table=np.ascontiguousarray(table.reshape(n_clusters, *nodes, -1), np.float32),
        precision=np.tile(1e-3 * np.eye(n_components), (n_clusters, 1, 1)),
    )


def interpolation(taps, n_nodes):
    """Dense matrices (n, k, n_nodes), entry by entry."""
    nodes, weights = taps
    dense = np.zeros((*nodes.shape[:2], n_nodes))
    for index in np.ndindex(*nodes.shape):
        dense[index[0], index[1], nodes[index]] += weights[index]
    return dense


def predicted(samples, model, texels=None):
    """Values (n, n_views, n_lights, 3) of the model at the samples, by dense products."""
    texels = np.arange(len(samples.values)) if texels is None else texels
    a = interpolation(samples.view_taps, model.table.shape[1])
    b = interpolation(samples.light_taps, model.table.shape[2])
    c = model.cluster[texels]
    nodes = model.mean[c] + np.einsum(
        "tk,tkvlc->tvlc", model.coefficients[texels].astype(float), model.basis[c]
    )
    return np.einsum("tiv,tjl,tvlc->tijc", a, b, nodes)


def sample_weights(samples):
    return samples.view_weights[:, :, None] * samples.light_weights[:, None] * samples.pairs


def value_weights(samples):
    """(n, n_views, n_lights, 3): none where a channel was not measured."""
    return sample_weights(samples)[..., None] * samples.measured()


def measured(samples, model, rng, sigma):
    values = predicted(samples, model)
    values = values + sigma * rng.normal(size=values.shape)
    return replace(samples, values=np.where(samples.measured(), values, 7).astype(np.float32))


def part(samples, texels):
    """Samples of some texels, as a reader gives them."""
    return TransformedSamples(
        values=samples.values[texels],
        view_taps=tuple(a[texels] for a in samples.view_taps),
        light_taps=tuple(a[texels] for a in samples.light_taps),
        view_weights=samples.view_weights[texels],
        light_weights=samples.light_weights[texels],
        pairs=samples.pairs,
    )


def problem_of(samples, model, pool, smoothness=0.0):
    return BasisProblem(samples, model.cluster, model.coefficients, smoothness, pool)


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
        # Steps stop at a residual of 1e-5; the worst nodes see little.
        error = np.abs(table - np.linalg.solve(normal, right)).max()
        assert error < 1e-5 * np.linalg.cond(normal)
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
            assert np.isclose(squares[t, 1], freedom, rtol=1e-5)

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
        assert np.allclose(squares[:, 1], weight, rtol=1e-6)


class TestNormalised:
    def test_predictions_stay_and_coefficients_are_white(self, rng):
        model = planted_model(rng, 60)
        mixed = model.coefficients @ np.array([[2, 1], [0, 0.5]]) + [3, -1]
        model = replace(model, coefficients=mixed.astype(np.float32))
        chosen = np.arange(0, 60, 2)
        white = normalised(model, 0.04, chosen)
        samples = empty_samples(rng, 60, 3, 3)
        one, two = predicted(samples, model), predicted(samples, white)
        assert np.abs(one - two).max() < 1e-5 * np.abs(one).max()  # float32, sums of three
        for c in range(2):
            members = chosen[model.cluster[chosen] == c]
            assert np.abs(white.coefficients[members].mean(axis=0)).max() < 1e-5
            assert np.allclose(np.cov(white.coefficients[members].T), np.eye(2), atol=1e-5)
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


def disturbed(model, rng):
    """A start some way off: bases mixed with others, coefficients zero."""
    table = model.table + 0.1 * rng.normal(size=model.table.shape)
    return replace(
        model,
        table=np.ascontiguousarray(table, np.float32),
        coefficients=np.zeros_like(model.coefficients),
    )


def fitted(samples, start, *, observed=None, workers=1, max_bytes=192 << 20, **options):
    observed = np.arange(len(samples.values)) if observed is None else observed
    model = fit_basis(
        lambda texels: part(samples, texels),
        start,
        observed,
        samples.values[0].nbytes,
        SampleFitOptions(**{"smoothness": 1e-4, "max_bytes": max_bytes} | options),
        workers=workers,
    )
    coefficients = model.coefficients.copy()
    with ThreadPoolExecutor(workers) as pool:
        coefficients[observed], _ = solve_coefficients(
            part(samples, observed), model.cluster[observed], model, pool, bounded=True
        )
    return replace(model, coefficients=coefficients)


class TestFit:
    def test_planted_model_down_to_the_noise(self, rng):
        """Residuals are the noise, and fall like it; they never rise from round to round."""
        model = planted_model(rng, 240)
        empty = empty_samples(rng, 240, 8, 8)
        start = disturbed(model, rng)
        last = {}
        for sigma in (0.1, 0.01):
            fit = fitted(measured(empty, model, rng, sigma), start, rounds=8)
            assert len(fit.residuals) == 8
            assert (np.diff(fit.residuals) < 1e-3 * sigma).all()
            last[sigma] = fit.residuals[-1]
            # Some 40 samples of 3 channels a texel, 2 coefficients and a share of the basis.
            assert 0.9 * sigma < last[sigma] < 1.15 * sigma
            error = predicted(empty, fit) - predicted(empty, model)
            weights = sample_weights(empty)[..., None]
            assert np.sqrt((weights * error**2).sum() / (3 * weights.sum())) < 0.5 * sigma

    def test_bytes_do_not_depend_on_workers(self, rng):
        model = planted_model(rng, 50)
        samples = measured(empty_samples(rng, 50, 6, 6), model, rng, 0.1)
        one, two = (
            fitted(samples, disturbed(model, np.random.default_rng(1)), workers=w, rounds=2)
            for w in (1, 3)
        )
        assert one.table.tobytes() == two.table.tobytes()
        assert one.coefficients.tobytes() == two.coefficients.tobytes()
        assert one.residuals == two.residuals

    def test_texels_beyond_memory_get_coefficients_too(self, rng):
        """256 texels shape the basis; the other 144 are fitted with it."""
        model = planted_model(rng, 400)
        samples = measured(empty_samples(rng, 400, 6, 6), model, rng, 0.02)
        fit = fitted(samples, disturbed(model, rng), max_bytes=1, rounds=6)
        error = np.sqrt(
            ((predicted(samples, fit) - predicted(samples, model)) ** 2).mean((1, 2, 3))
        )
        # Noise 0.02 on about 23 x 3 samples; each texel must be far nearer than the spread of
        # 0.3 |coefficients| that it would keep without coefficients.
        assert np.median(error) < 0.02
        assert np.mean(error > 0.1) < 0.02

    def test_unobserved_texels_are_left_alone(self, rng):
        model = planted_model(rng, 40)
        samples = measured(empty_samples(rng, 40, 6, 6), model, rng, 0.1)
        observed = np.arange(0, 40, 2)
        hidden = replace(samples, values=samples.values.copy())
        hidden.values[1::2] = np.nan
        fit = fitted(hidden, disturbed(model, rng), observed=observed, rounds=2)
        assert np.isfinite(fit.table).all()
        assert np.isfinite(fit.coefficients).all()

    @pytest.mark.stability
    @pytest.mark.parametrize("exponent", [-40, -10, 40])
    def test_global_scale(self, rng, exponent):
        """Samples, start and its prior in a unit of 2^k (1e-12 to 1e12): the same digits."""
        model = planted_model(rng, 60)
        samples = measured(empty_samples(rng, 60, 6, 6), model, rng, 0.05)
        start = disturbed(model, rng)
        unit = np.float32(2.0**exponent)
        one = fitted(samples, start, rounds=3)
        two = fitted(
            replace(samples, values=samples.values * unit),
            replace(start, table=start.table * unit, precision=start.precision * 4.0**exponent),
            rounds=3,
        )
        assert np.array_equal(two.table, one.table * unit)
        assert np.array_equal(two.coefficients, one.coefficients)
        assert np.array_equal(two.residuals, np.array(one.residuals) * unit)

    @pytest.mark.stability
    @pytest.mark.parametrize("sides", [(1, 3), (3, 1), (1, 1)])
    def test_directions_that_do_not_vary(self, rng, sides):
        nodes = (sides[0] ** 2, sides[1] ** 2)
        model = planted_model(rng, 60, n_clusters=1, n_components=1, nodes=nodes)
        empty = empty_samples(rng, 60, 1 if sides[0] == 1 else 6, 6, sides)
        empty.view_weights[:] = empty.pairs[:] = 1
        samples = measured(empty, model, rng, 0.01)
        fit = fitted(samples, disturbed(model, rng), rounds=6)
        assert fit.table.shape == model.table.shape
        assert fit.residuals[-1] < 0.02

    @pytest.mark.stability
    def test_without_components(self, rng):
        model = planted_model(rng, 30, n_components=0)
        samples = measured(empty_samples(rng, 30, 8, 8), model, rng, 0.01)
        fit = fitted(samples, disturbed(model, rng), rounds=3, iterations=30)
        assert fit.coefficients.shape == (30, 0)
        assert 0.008 < fit.residuals[-1] < 0.012

    @pytest.mark.stability
    def test_clusters_without_members_and_texels_without_samples(self, rng):
        model = planted_model(rng, 30, n_clusters=4, n_components=3)
        model = replace(model, cluster=np.minimum(model.cluster, 2))
        model.cluster[:2] = 1
        samples = measured(empty_samples(rng, 30, 6, 6), model, rng, 0.05)
        samples.view_weights[5] = 0
        fit = fitted(samples, disturbed(model, rng), rounds=3)
        assert np.isfinite(fit.table).all()
        assert not fit.coefficients[5].any()
        assert np.isfinite(fit.residuals).all()

    @pytest.mark.stability
    @pytest.mark.parametrize("fill", ["values", "weights"])
    def test_zeros(self, rng, fill):
        model = planted_model(rng, 20)
        samples = empty_samples(rng, 20, 5, 5)
        if fill == "weights":
            samples.light_weights[:] = 0
        fit = fitted(samples, disturbed(model, rng), rounds=2)
        assert np.isfinite(fit.table).all()
        assert np.isfinite(fit.coefficients).all()
        assert fit.residuals[-1] < 0.05

    @pytest.mark.stability
    def test_fewer_samples_than_coefficients(self, rng):
        """Light weights and few samples leave few degrees of freedom, never none."""
        model = planted_model(rng, 100, n_components=8)
        empty = empty_samples(rng, 100, 2, 1)
        empty.view_weights[:] = empty.light_weights[:] = 0.3
        empty.pairs[:] = 1
        fit = fitted(measured(empty, model, rng, 0.05), disturbed(model, rng), rounds=4)
        assert np.isfinite(fit.coefficients).all()
        assert max(fit.residuals) < 1

    def test_nothing_observed_is_refused(self, rng):
        samples = empty_samples(rng, 3, 2, 2)
        with pytest.raises(InputError, match="observed: expected texels with samples"):
            fitted(samples, planted_model(rng, 3), observed=np.zeros(0, int))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rounds": 0}, "rounds: expected at least 1 and at most 1000, received 0"),
        ({"iterations": 0}, "iterations: expected at least 1"),
        (
            {"grid_refinement": 0.5},
            "grid_refinement: expected at least 1 and at most 16, received 0.5",
        ),
        (
            {"grid_refinement": float("nan")},
            "grid_refinement: expected at least 1 and at most 16, received nan",
        ),
        ({"smoothness": -1.0}, "smoothness: expected 0 to"),
        ({"smoothness": float("nan")}, "smoothness: expected 0 to"),
    ],
)
def test_options_are_checked(changes, message):
    with pytest.raises(InputError, match=message):
        SampleFitOptions(**changes)


@pytest.mark.stability
@pytest.mark.parametrize("scale", [2.0**-40, 2.0**-3, 2.0**30])
def test_fit_from_a_grid_does_not_depend_on_the_unit(rng, scale):
    """Exactly: powers of two are scaled without rounding."""
    model = planted_model(rng, 60)
    samples = measured(empty_samples(rng, 60, 7, 6), model, rng, 0.1)
    # A grid's basis is of unit size, its coefficients are in the unit of the samples.
    grid = replace(model, precision=model.precision * 0.01)
    table = grid.table.copy()
    table[..., :3] *= scale
    scaled = replace(grid, table=table, coefficients=np.float32(scale) * grid.coefficients)
    in_unit = replace(samples, values=np.float32(scale) * samples.values)
    options = SampleFitOptions(rounds=2, iterations=4)
    fits = [
        fit_basis(lambda t, s=s: part(s, t), of_usual_size(start), np.arange(60), 1000, options)
        for start, s in ((grid, samples), (scaled, in_unit))
    ]
    np.testing.assert_array_equal(fits[1].table, np.float32(scale) * fits[0].table)


def bounded_case(rng, spread):
    """Texels of one matt cluster, seen and lit from the upper left, with errors of `spread`."""
    n, side, n_directions = 40, 5, 6
    flat = HemisphereGrid(side).directions
    table = np.ones((1, side**2, side**2, 2, 3), np.float32)
    # The component is faint where texels are seen and lit, and strong elsewhere.
    elsewhere = (flat[:, 0] > 0.1)[:, None] & (flat[:, 0] > 0.1)
    table[..., 1, :] = np.where(elsewhere, 3.0, 0.05)[..., None]
    model = replace(
        planted_model(rng, n, n_clusters=1, n_components=1, nodes=(side**2, side**2)),
        table=np.ascontiguousarray(table.reshape(1, side**2, side**2, -1)),
    )
    towards = rng.normal(size=(2, n * n_directions, 3))
    towards[..., 0], towards[..., 2] = (
        -np.abs(towards[..., 0]) - 1,
        np.abs(towards[..., 2]) + 0.5,
    )
    towards /= np.linalg.norm(towards, axis=2, keepdims=True)
    taps = [
        tuple(part.reshape(n, n_directions, 4) for part in HemisphereGrid(side).taps(some))
        for some in towards
    ]
    every = np.ones((n, n_directions), np.float32)
    values = 1 + spread * rng.normal(size=(n, n_directions, n_directions, 3))
    samples = TransformedSamples(
        values=values.astype(np.float32),
        view_taps=taps[0],
        light_taps=taps[1],
        view_weights=every,
        light_weights=every,
        pairs=np.ones((n_directions, n_directions), np.float32),
    )
    return samples, model


def test_a_texel_is_nowhere_much_brighter_than_seen(rng, pool):
    samples, model = bounded_case(rng, 0.3)
    cluster = np.zeros(len(samples.values), np.int32)
    parts = model.table[0].reshape(-1, 2, 3)
    top = np.maximum(samples.values.max(axis=(1, 2)), MOST_OF_MEAN)
    highest = {}
    for bounded in (False, True):
        coefficients, _ = solve_coefficients(samples, cluster, model, pool, bounded=bounded)
        at_nodes = parts[:, 0] + np.einsum("tk,nkc->tnc", coefficients, parts[:, 1:])
        highest[bounded] = (at_nodes.max(axis=1) - top).max()
    assert highest[False] > 1.0
    assert highest[True] < 1e-5  # rounding in float32


def test_texels_within_their_bounds_are_as_without(rng, pool):
    samples, model = bounded_case(rng, 0.0)
    cluster = np.zeros(len(samples.values), np.int32)
    free, free_squares = solve_coefficients(samples, cluster, model, pool)
    held, held_squares = solve_coefficients(samples, cluster, model, pool, bounded=True)
    assert np.array_equal(free, held)
    assert np.array_equal(free_squares, held_squares)
