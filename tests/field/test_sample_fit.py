"""The fit of a clustered model to samples: planted models, bounds, degenerate cases."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from reflfield.errors import InputError
from reflfield.field.bounds import MOST_OF_MEAN
from reflfield.field.clustered_model import of_usual_size
from reflfield.field.coefficients import solve_coefficients
from reflfield.field.sample_fit import SampleFitOptions, fit_basis
from reflfield.observations.texel_samples import TransformedSamples
from reflfield.sphere.hemisphere import HemisphereGrid
from tests.field.fit_problems import (
    empty_samples,
    measured,
    part,
    planted_model,
    predicted,
    sample_weights,
)


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
