"""Resampling: domain and weights, the solve against dense algebra, what is observed."""

from dataclasses import replace

import numpy as np
import pytest

from reflfield.errors import InputError
from reflfield.observations import frame_resampling
from reflfield.observations.frame_resampling import (
    apply_both,
    prior_covariance,
    resample,
)
from reflfield.observations.resampling_options import (
    ResamplingOptions,
)
from reflfield.observations.texel_samples import (
    POWERS,
    TransformedSamples,
    direction_taps,
    interpolation_matrices,
    transformed_samples,
)
from reflfield.sphere.hemisphere import HORIZON_SOFTNESS, HemisphereGrid

from .rigs import (
    dense_interpolation,
    directions_at,
    hemisphere,
    identity,
    interpolated,
    smoothness_precision,
    texel_samples,
    tilted_frames,
    transformed,
)

SMOOTHNESS = 0.03
# Operators are found in float64, so only their application rounds: products of 12 views and
# 10 lights whose terms may be ten times the result.
SOLVE = {"operations": 12, "condition": 10}


class TestInterpolation:
    @pytest.mark.parametrize("side", [1, 2, 5])
    def test_matrix_applies_the_taps(self, rng, side, rounding):
        samples = transformed(rng, 3, 9, 1, (side, 1))
        matrices = interpolation_matrices(samples.view_taps, side)
        dense = dense_interpolation(samples.view_taps, side)
        np.testing.assert_allclose(matrices, dense, rtol=rounding(np.float32))
        assert np.abs(matrices.sum(axis=2) - 1).max() < rounding(np.float32)

    def test_adjoint(self, rng, rounding):
        """<A X B^T, Y> = <X, A^T Y B> with the products applied the other way round."""
        samples = transformed(rng, 4, 6, 5, (5, 3))
        a = interpolation_matrices(samples.view_taps, 5)
        b = interpolation_matrices(samples.light_taps, 3)
        nodes = rng.normal(size=(4, 25, 9, 3)).astype(np.float32)
        y = rng.normal(size=(4, 6, 5, 3)).astype(np.float32)
        forth = (apply_both(a, b, nodes) * y).sum(dtype=float)
        back = apply_both(np.swapaxes(a, 1, 2), np.swapaxes(b, 1, 2), y)
        scale = np.abs(apply_both(a, b, nodes) * y).sum()
        assert abs(forth - (back * nodes).sum(dtype=float)) < rounding(np.float32, scale=scale)

    @pytest.mark.reference
    def test_both_products_against_einsum(self, rng, rounding):
        left, right = rng.normal(size=(3, 4, 6)), rng.normal(size=(3, 5, 7))
        values = rng.normal(size=(3, 6, 7, 3))
        expected = np.einsum("nab,ncd,nbdk->nack", left, right, values)
        assert np.abs(apply_both(left, right, values) - expected).max() < rounding(
            np.float64, 42, scale=10
        )

    def test_samples_between_nodes(self, rng, rounding):
        samples = transformed(rng, 3, 7, 6, (5, 3))
        nodes = rng.normal(size=(3, 25, 9, 3)).astype(np.float32)
        got = apply_both(
            interpolation_matrices(samples.view_taps, 5),
            interpolation_matrices(samples.light_taps, 3),
            nodes,
        )
        assert np.abs(got - interpolated(samples, nodes)).max() < rounding(
            np.float32, 16, scale=3
        )


class TestPrior:
    @pytest.mark.reference
    @pytest.mark.parametrize("side", [1, 2, 5, 9])
    def test_is_the_inverse_of_the_precision(self, side, rounding):
        product = prior_covariance(side, 0.2) @ smoothness_precision(side, 0.2)
        # The condition is that of 8 neighbours against 1e-3.
        assert np.abs(product - np.eye(side**2)).max() < rounding(np.float64, condition=8e3)

    def test_constants_vary_most(self):
        values, vectors = np.linalg.eigh(prior_covariance(5, 1.0))
        assert np.isclose(values[-1], 1e3, rtol=1e-10)  # eps times the condition
        assert np.ptp(np.abs(vectors[:, -1])) < 1e-10


def on_the_hemisphere(n, k, side):
    """Samples of weight 1 from the same k views and k lights, down to the horizon."""
    taps = direction_taps(np.tile(hemisphere(k, 0.0), (n, 1, 1)).astype(np.float32), side)
    weights = np.ones((n, k), np.float32)
    values = np.zeros((n, k, k, 3), np.float32)
    return TransformedSamples(values, taps, taps, weights, weights, np.ones((k, k), np.float32))


def dense_solution(samples, sides, smoothness, texel):
    """Node values of one texel from the normal equations, one Kronecker system."""
    normal, right = [], []
    for taps, weights, side in (
        (samples.view_taps, samples.view_weights, sides[0]),
        (samples.light_taps, samples.light_weights, sides[1]),
    ):
        a = dense_interpolation(taps, side)[texel]
        w = weights[texel].astype(float)
        normal.append(a.T @ (w[:, None] * a) + smoothness_precision(side, smoothness))
        right.append(a.T * w)
    values = samples.values[texel].reshape(-1, 3)
    solution = np.linalg.solve(np.kron(*normal), np.kron(*right) @ values)
    return solution.reshape(sides[0] ** 2, sides[1] ** 2, 3)


def weighted_solution(samples, sides, smoothness, texel):
    """The same with pairs that were not photographed left out of the data term."""
    matrices, normal, regular = [], [], []
    for taps, weights, side in (
        (samples.view_taps, samples.view_weights, sides[0]),
        (samples.light_taps, samples.light_weights, sides[1]),
    ):
        a = dense_interpolation(taps, side)[texel]
        matrices.append(a)
        normal.append(a.T @ (weights[texel].astype(float)[:, None] * a))
        regular.append(normal[-1] + smoothness_precision(side, smoothness))
    prior = np.kron(*regular) - np.kron(*normal)
    weights = np.outer(samples.view_weights[texel], samples.light_weights[texel])
    both, seen = np.kron(*matrices), (weights * samples.pairs).ravel()[:, None]
    values = samples.values[texel].reshape(-1, 3)
    solution = np.linalg.solve(both.T @ (seen * both) + prior, both.T @ (seen * values))
    return solution.reshape(sides[0] ** 2, sides[1] ** 2, 3)


class TestSolve:
    @pytest.mark.reference
    @pytest.mark.parametrize("sides", [(5, 5), (7, 3), (1, 5), (5, 1), (1, 1), (2, 2)])
    def test_against_dense_normal_equations(self, rng, sides, rounding):
        samples = transformed(rng, 3, 12, 10, sides)
        nodes = resample(samples, sides, SMOOTHNESS)
        for t in range(3):
            expected = dense_solution(samples, sides, SMOOTHNESS, t)
            scale = np.abs(expected).max()
            assert np.abs(nodes.values[t] - expected).max() < rounding(
                np.float32, **SOLVE, scale=scale
            )

    @pytest.mark.reference
    def test_missing_pairs_against_a_weighted_solve(self, rng, monkeypatch, rounding):
        pairs = (rng.random((12, 10)) < 0.8).astype(np.float32)
        smooth = np.array([[1.0, 2.0, 0.5]]) + 0.2 * rng.normal(size=(2, 12, 10, 3))
        samples = transformed(
            rng, 2, 12, 10, (5, 5), pairs=pairs, values=smooth.astype(np.float32)
        )
        expected = np.stack([weighted_solution(samples, (5, 5), 0.3, t) for t in range(2)])
        monkeypatch.setattr(frame_resampling, "FILLING_SWEEPS", 300)
        converged = resample(samples, (5, 5), 0.3)
        assert np.abs(converged.values - expected).max() < rounding(
            np.float32, **SOLVE, scale=3
        )
        monkeypatch.setattr(frame_resampling, "FILLING_SWEEPS", 4)
        after_four = resample(samples, (5, 5), 0.3)
        # Where a pair of nodes was observed, four sweeps end within a third of what the
        # samples scatter about their mean (0.2).
        seen = after_four.weights > 0.5
        error = np.sqrt((((after_four.values - expected) ** 2)[seen]).mean())
        assert error < 0.2 / 3

    def test_missing_values_are_not_read(self, rng):
        pairs = (rng.random((8, 9)) < 0.7).astype(np.float32)
        samples = transformed(rng, 2, 8, 9, (5, 5), pairs=pairs)
        other = replace(samples, values=np.where(pairs[..., None] > 0, samples.values, 77.0))
        one, two = (resample(s, (5, 5), SMOOTHNESS) for s in (samples, other))
        assert np.array_equal(one.values, two.values)

    def test_constant_survives_where_few_pairs_were_photographed(self, rng):
        """The filling starts from the mean, not from zero: nothing is left to approach."""
        samples = on_the_hemisphere(2, 20, 5)
        diagonal = np.eye(20, dtype=np.float32)
        samples = replace(samples, values=samples.values + 2, pairs=diagonal)
        # The prior pulls the farthest nodes 1e-3 towards zero, with every pair as well; at
        # most so much again in each of the sweeps.
        assert np.allclose(resample(samples, (5, 5), SMOOTHNESS).values, 2, rtol=5e-3)

    def test_planted_function_comes_back(self, rng):
        """Smooth functions are recovered; the bias falls like the smoothness demanded."""
        linear = 1 + HemisphereGrid(5).directions @ rng.normal(size=(3, 12))
        planted = np.einsum("vr,lr->vl", linear[:, :6], linear[:, 6:])
        planted = np.tile(planted[None, :, :, None], (1, 1, 1, 3)).astype(np.float32)
        samples = on_the_hemisphere(1, 300, 5)
        samples = replace(samples, values=interpolated(samples, planted).astype(np.float32))

        def error(smoothness):
            nodes = resample(samples, (5, 5), smoothness)
            assert (nodes.weights == 1).all()
            return np.sqrt(((nodes.values - planted) ** 2).mean() / planted.var())

        assert error(0.01) < 0.01
        assert 5 < error(0.1) / error(0.01) < 15

    def test_noise_averages_out(self, rng):
        """Node errors fall like sigma and like one over the root of the samples."""

        def error(sigma, k):
            samples = on_the_hemisphere(20, k, 3)
            noisy = 1 + sigma * rng.normal(size=samples.values.shape)
            samples = replace(samples, values=noisy.astype(np.float32))
            return np.sqrt(((resample(samples, (3, 3), 1e-3).values - 1) ** 2).mean())

        base = error(0.1, 80)
        # 20 texels x 81 nodes x 3 channels: errors are known to 1 / sqrt(2 * 4860), 1 %, and
        # a few times that for their correlation; directions of two spirals differ by more.
        assert np.isclose(error(0.01, 80) / base, 0.1, rtol=0.1)
        assert np.isclose(base / error(0.1, 160), 2.0, rtol=0.2)  # k * k samples


class TestSupport:
    def test_is_the_weight_of_directions_seen(self, rng):
        nodes = HemisphereGrid(5).directions[None].astype(np.float32)
        chosen = np.array([12, 7, 0])
        view_seen = np.array([[True, False, True]])
        texels = texel_samples(
            rng,
            1,
            3,
            2,
            views=nodes[:, chosen],
            view_seen=view_seen,
            samples=np.ones((1, 3, 2, 3)),
        )
        got = resample(
            transformed_samples(texels, identity(1), (5, 5), "linear"), (5, 5), SMOOTHNESS
        )
        expected = np.zeros(25)
        expected[[12, 0]] = 1
        # Nodes off the axes lie on float32 directions: taps differ by the map's rounding.
        assert np.allclose(got.view_support[0], expected, atol=1e-3)
        assert got.weights.max() <= 1
        assert got.weights.shape == (1, 25, 25)
        assert np.allclose(
            got.weights, got.view_support[:, :, None] * got.light_support[:, None, :]
        )

    def test_pairs_of_nodes_need_photographs(self, rng):
        """Two views and two lights at nodes; one pair of them was not photographed."""
        nodes = HemisphereGrid(5).directions[None].astype(np.float32)
        chosen = np.array([12, 4])
        pairs = np.array([[True, True], [True, False]])
        texels = texel_samples(
            rng, 1, 2, 2, views=nodes[:, chosen], lights=nodes[:, chosen], pairs=pairs
        )
        got = resample(
            transformed_samples(texels, identity(1), (5, 5), "linear"), (5, 5), SMOOTHNESS
        )
        # Directions are singles: taps differ by the map's rounding, half the digits.
        assert np.allclose(got.weights[0][np.ix_(chosen, chosen)], pairs, atol=1e-3)

    def test_a_photograph_of_each_light_from_a_view_of_its_own(self, rng):
        """The diagonal of the pairs: far less observed than the product, and so it says."""
        texels = texel_samples(rng, 2, 16, 16)
        every = transformed_samples(texels, identity(2), (5, 5), "cube_root")
        diagonal = replace(every, pairs=np.eye(16, dtype=np.float32))
        one, two = (resample(s, (5, 5), SMOOTHNESS).weights for s in (every, diagonal))
        assert one.mean() > 0.3
        assert two.sum(axis=(1, 2)).max() <= 16.001  # one interpolation weight a photograph
        assert (two <= one).all()

    def test_lonely_traces_do_not_count(self, rng):
        """A node with 5 % of a sample was not observed."""
        samples = transformed(rng, 1, 1, 1, (2, 2))
        taps = (
            np.array([[[0, 1, 2, 3]]], np.int32),
            np.array([[[0.05, 0.95, 0, 0]]], np.float32),
        )
        samples = replace(samples, view_taps=taps, view_weights=np.ones((1, 1), np.float32))
        support = resample(samples, (2, 2), SMOOTHNESS).view_support
        assert np.allclose(support, [[0, 0.95, 0, 0]])


class TestInvariance:
    def test_blocks_and_order_of_texels(self, rng):
        texels = texel_samples(rng, 30, 8, 9)
        frames = tilted_frames(rng, 30)

        def run(chosen):
            part = replace(
                texels,
                **{
                    name: getattr(texels, name)[chosen]
                    for name in ("samples", "views", "lights", "view_seen", "light_seen")
                },
            )
            return resample(
                transformed_samples(part, frames[chosen], (5, 5), "cube_root"),
                (5, 5),
                SMOOTHNESS,
            )

        whole = run(np.arange(30))
        order = np.concatenate([rng.permutation(30), [4, 4]])
        for part in np.array_split(order, 5):
            assert np.array_equal(run(part).values, whole.values[part])
            assert np.array_equal(run(part).weights, whole.weights[part])

    @pytest.mark.stability
    @pytest.mark.parametrize("domain", sorted(POWERS))
    @pytest.mark.parametrize("scale", [1e-12, 1e-3, 1e12])
    def test_global_scale(self, rng, domain, scale, rounding):
        """Samples in float32; what halves on disk allow is tested with the projection."""
        texels = texel_samples(rng, 3, 8, 9)
        scaled = replace(texels, samples=texels.samples * np.float32(scale))
        frames = tilted_frames(rng, 3)
        one, two = (
            resample(transformed_samples(t, frames, (5, 5), domain), (5, 5), SMOOTHNESS)
            for t in (texels, scaled)
        )
        factor = np.float64(scale) ** (1 / POWERS[domain])
        tolerance = rounding(np.float32, **SOLVE, scale=np.abs(one.values).max())
        assert np.abs(two.values / factor - one.values).max() < tolerance
        assert np.array_equal(two.weights, one.weights)


@pytest.mark.stability
class TestDegenerate:
    @pytest.mark.parametrize("what", ["view_seen", "light_seen"])
    def test_nothing_seen(self, rng, what):
        texels = texel_samples(rng, 2, 4, 5)
        texels = replace(texels, **{what: np.zeros_like(getattr(texels, what))})
        got = resample(
            transformed_samples(texels, identity(2), (5, 5), "cube_root"), (5, 5), 0.03
        )
        assert not got.values.any()
        assert not got.weights.any()

    def test_all_lights_below_the_horizon(self, rng):
        lights = -np.tile(hemisphere(5), (2, 1, 1)).astype(np.float32)
        texels = texel_samples(rng, 2, 4, 5, lights=lights)
        got = resample(
            transformed_samples(texels, identity(2), (5, 5), "cube_root"), (5, 5), 0.03
        )
        assert not got.values.any()
        assert not got.weights.any()

    def test_one_sample_continues_as_a_constant(self, rng):
        """Alone against the prior it holds everywhere, to the prior's own weight."""
        texels = texel_samples(rng, 1, 1, 1, samples=np.full((1, 1, 1, 3), 0.5, np.float32))
        samples = transformed_samples(texels, identity(1), (5, 5), "linear")
        got = resample(samples, (5, 5), 0.03)
        expected = samples.values[0, 0, 0, 0]
        at = interpolated(samples, got.values)[0, 0, 0]
        # At the sample P / (P + 1 / w) for each direction, P about 1e3 / 0.03 / 25 and the
        # light's weight w = 0.55^2: 0.996.
        assert np.allclose(at, expected, rtol=5e-3)
        # Away from it the random part of the prior adds some hundredths: observed .02.
        assert np.allclose(got.values, expected, rtol=0.05)
        assert got.weights.any()

    def test_no_photograph_at_all(self, rng):
        texels = texel_samples(rng, 2, 4, 5, pairs=np.zeros((4, 5), bool))
        got = resample(
            transformed_samples(texels, identity(2), (5, 5), "cube_root"), (5, 5), 0.03
        )
        assert not got.values.any()
        assert not got.weights.any()

    def test_zeros_stay_zero(self, rng):
        texels = texel_samples(rng, 2, 4, 5, samples=np.zeros((2, 4, 5, 3), np.float16))
        got = resample(
            transformed_samples(texels, identity(2), (5, 5), "cube_root"), (5, 5), 0.03
        )
        assert not got.values.any()
        assert got.weights.any()

    def test_largest_halves_from_the_horizon(self, rng):
        samples = np.full((1, 4, 2, 3), 65504, np.float16)
        lights = directions_at(-0.5 * HORIZON_SOFTNESS + 1e-6, 1.0)
        texels = texel_samples(rng, 1, 4, 2, samples=samples, lights=lights)
        for domain in POWERS:
            got = resample(
                transformed_samples(texels, identity(1), (5, 5), domain), (5, 5), 0.03
            )
            assert np.isfinite(got.values).all()

    @pytest.mark.parametrize("sides", [(1, 5), (5, 1), (1, 1)])
    def test_directions_that_do_not_vary(self, rng, sides):
        texels = texel_samples(rng, 2, 1 if sides[0] == 1 else 8, 1 if sides[1] == 1 else 8)
        got = resample(transformed_samples(texels, identity(2), sides, "linear"), sides, 0.03)
        assert got.values.shape == (2, sides[0] ** 2, sides[1] ** 2, 3)
        if sides == (1, 1):
            # One sample of weight 1 against precisions of 3e-5, twice.
            assert np.allclose(got.values[:, 0, 0], texels.samples[:, 0], rtol=1e-4)

    def test_many_samples_of_one_direction(self, rng, rounding):
        """Duplicates are a mean, however many."""
        lights = np.tile(directions_at(0.8), (1, 50, 1))
        texels = texel_samples(rng, 1, 1, 50, lights=lights)
        samples = transformed_samples(texels, identity(1), (1, 5), "linear")
        at = interpolated(samples, resample(samples, (1, 5), 0.03).values)[0, 0, 0]
        mean = samples.values[0, 0].mean(axis=0)
        assert np.allclose(at, mean, rtol=1e-3)  # the prior's weight against 50 samples


class TestOptions:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"view_side": -1}, "view_side: expected 0 to 64, received -1"),
            ({"light_side": 65}, "light_side: expected 0 to 64, received 65"),
            ({"domain": "log"}, "domain: expected one of"),
            ({"smoothness": 0.0}, "smoothness: expected > 0, at most 1e6, received 0.0"),
            ({"smoothness": float("nan")}, "smoothness: expected > 0"),
            ({"visibility": "traced"}, "visibility: expected 'factored', 'kept'"),
        ],
    )
    def test_are_checked(self, changes, message):
        with pytest.raises(InputError, match=message):
            ResamplingOptions(**changes)


def test_taps_have_the_shape_of_the_directions(rng):
    nodes, weights = direction_taps(np.tile(hemisphere(4), (3, 1, 1)).astype(np.float32), 5)
    assert nodes.shape == weights.shape == (3, 4, 4)
