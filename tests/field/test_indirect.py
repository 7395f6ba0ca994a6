"""Indirect light: planted functions come back from scattered shade, at any scale."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from reflfield.errors import InputError, ShapeError
from reflfield.field.build import FittedReflectance, Quantisation, build_field
from reflfield.field.evaluation import sum_lights
from reflfield.field.indirect_fit import (
    Systems,
    band_limit_for,
    fit_indirect,
    fit_to_shade,
)
from reflfield.field.indirect_light import IndirectLight, no_indirect_light
from reflfield.field.observed_sphere import covered
from reflfield.observations.shade import Shade
from reflfield.sphere.harmonics import real_harmonics
from tests.synthetic_fields import square_surface

N_LIGHTS, N_COMPONENTS = 30, 3
ONE_THREAD = ThreadPoolExecutor(1)


def directions(rng, n):
    vectors = rng.standard_normal((n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def planted(rng, n_texels=400, noise=0.01, share=0.4):
    """Indirect light of a few functions, and the shade of texels under some lights each."""
    functions = rng.standard_normal((N_COMPONENTS + 1, 9, 3)).astype(np.float32)
    functions[0, 0] += 5.0
    light = IndirectLight(
        functions, rng.standard_normal((n_texels, N_COMPONENTS)).astype(np.float32)
    )
    lights = np.broadcast_to(directions(rng, N_LIGHTS), (n_texels, N_LIGHTS, 3))
    values = domain_values(light, lights)
    values = values + noise * rng.standard_normal(values.shape)
    weights = (rng.random((n_texels, N_LIGHTS, 1)) < share).repeat(3, axis=2).astype(np.float32)
    values = np.where(weights > 0, values, 0)
    return light, Shade(values.astype(np.float32), weights, lights.astype(np.float32))


def domain_values(light, lights):
    """Transformed values, negative ones too, (n_texels, n_lights, 3)."""
    harmonics = real_harmonics(lights[0], 3)
    weights = np.concatenate(
        [np.ones((len(light.coefficients), 1)), light.coefficients], axis=1
    )
    return np.einsum("lh,khc,nk->nlc", harmonics, light.functions, weights)


def some(shade, texels):
    return Shade(shade.values[texels], shade.weights[texels], shade.lights[texels])


def fitted(shade, n_components=N_COMPONENTS, n_lights=N_LIGHTS):
    model = fit_indirect(
        lambda texels: some(shade, texels),
        *(np.arange(len(shade.values)), n_lights, n_components, ONE_THREAD),
    )
    return model, IndirectLight(model.functions(), model.coefficients(shade))


@pytest.mark.parametrize("noise", [0.003, 0.03])
def test_planted_light_comes_back_where_nothing_was_seen(noise, rng):
    truth, shade = planted(rng, noise=noise)
    model, light = fitted(shade)
    elsewhere = np.broadcast_to(directions(rng, 50), (400, 50, 3))
    error = domain_values(light, elsewhere) - domain_values(truth, elsewhere)
    # Twelve lights in shadow tell 3 coefficients from 36 numbers: the error is below the noise.
    assert np.sqrt(np.mean(error**2)) < noise
    # The model fits a part of the noise: observed .90 to .96 of it.
    assert np.sqrt(model.noise) == pytest.approx(noise, rel=0.15)


def test_more_noise_is_more_error_in_proportion(rng):
    errors = []
    for noise in (0.001, 0.01, 0.1):
        truth, shade = planted(np.random.default_rng(7), noise=noise)
        light = fitted(shade)[1]
        elsewhere = np.broadcast_to(directions(np.random.default_rng(8), 50), (400, 50, 3))
        error = domain_values(light, elsewhere) - domain_values(truth, elsewhere)
        errors.append(np.sqrt(np.mean(error**2)))
    slope = np.diff(np.log(errors)) / np.log(10)
    # At noise .1 the limit, the brightest sample known to a tenth (.5), counts for .04 of a
    # sample in each of up to 18 lights beside the 12: measured 1.12.
    assert np.all((slope > 0.8) & (slope < 1.15)), errors


@pytest.mark.stability
@pytest.mark.parametrize("scale", [1e-12, 1e-4, 1e6])
def test_scale_does_not_matter(scale, rng):
    _, shade = planted(rng)
    usual = fitted(shade)[1]
    scaled = fitted(Shade(shade.values * np.float32(scale), shade.weights, shade.lights))[1]
    lights = np.broadcast_to(directions(rng, 20), (400, 20, 3))
    expected = domain_values(usual, lights)
    size = np.abs(expected).max()
    assert np.abs(domain_values(scaled, lights) / scale - expected).max() < 1e-4 * size


@pytest.mark.stability
def test_no_shade_no_energy_and_one_texel_are_defined(rng):
    _, shade = planted(rng, n_texels=5)
    unseen = Shade(shade.values, 0 * shade.weights, shade.lights)
    black = Shade(0 * shade.values, shade.weights, shade.lights)
    for nothing in (unseen, black):
        model, light = fitted(nothing)
        assert len(model.variances) == 0
        assert light.is_black
        assert light.coefficients.shape == (5, 0)
    one = some(shade, np.zeros(1, int))
    model, light = fitted(one)
    assert np.isfinite(light.functions).all()
    assert np.isfinite(light.coefficients).all()
    seen = one.weights[0] > 0
    residual = (domain_values(light, one.lights) - one.values)[0, seen]
    assert np.abs(residual).max() < 0.2 * np.abs(one.values).max()


def test_threads_change_nothing(rng):
    """Of more texels than are solved together."""
    _, shade = planted(rng, n_texels=3000)
    texels = np.arange(3000)
    one, four = (
        fit_to_shade(
            lambda t: some(shade, t), texels, N_LIGHTS, N_COMPONENTS, most=2500, workers=n
        )
        for n in (1, 4)
    )
    assert np.array_equal(one[0].functions(), four[0].functions())
    assert np.array_equal(one[1], four[1])


def test_coefficients_stay_in_the_order_of_the_texels(rng):
    """Parts come back from threads; each texel has what it would have alone."""
    _, shade = planted(rng, n_texels=3000)
    texels = rng.permutation(3000)[:2100]
    model, coefficients = fit_to_shade(
        lambda t: some(shade, t), texels, N_LIGHTS, N_COMPONENTS, most=500, workers=2
    )
    for place in (0, 1023, 1024, 2099):
        alone = model.coefficients(some(shade, texels[[place]]))
        assert np.allclose(coefficients[place], alone[0], atol=1e-5)  # as BLAS orders its sums


@pytest.mark.stability
def test_object_without_a_texel_in_shadow_has_black_indirect_light(rng):
    """As under a flash beside the camera: what it does not reach is not seen either."""
    _, shade = planted(rng, n_texels=4)
    model = fit_indirect(
        lambda texels: some(shade, texels),
        *(np.zeros(0, np.intp), N_LIGHTS, N_COMPONENTS, ONE_THREAD),
    )
    light = IndirectLight(model.functions(), model.coefficients(some(shade, np.arange(0))))
    assert light.is_black
    assert light.coefficients.shape == (0, 0)


@pytest.mark.stability
def test_duplicates_share_one_answer(rng, rounding):
    _, shade = planted(rng, n_texels=50)
    twice = some(shade, np.concatenate([np.arange(50), np.arange(50)]))
    first, second = np.split(fitted(twice)[1].coefficients, 2)
    tolerance = rounding(np.float32, scale=np.abs(first).max())
    np.testing.assert_allclose(first, second, rtol=0, atol=tolerance)


def test_texel_in_no_shadow_takes_the_mean(rng):
    _, shade = planted(rng)
    shade.weights[3] = 0
    light = fitted(shade)[1]
    assert np.all(light.coefficients[3] == 0)


def test_normal_equations_are_the_sums_they_say(rng, rounding):
    _, shade = planted(rng, n_texels=3)
    # Under some lights not every channel was measured.
    shade.weights[:, ::3, 1] = 0
    shade.weights[:, ::2, 2] *= 2
    system = Systems.of(shade, 3)
    for t in range(3):
        design = np.kron(real_harmonics(shade.lights[t], 3), np.eye(3))
        weight = shade.weights[t].ravel().astype(float)
        values = shade.values[t].astype(float).ravel()
        gram, moments = design.T @ (weight[:, None] * design), design.T @ (weight * values)
        for got, expected in ((system.gram[t], gram), (system.moments[t], moments)):
            sums = rounding(float, operations=N_LIGHTS, scale=np.abs(expected).max())
            np.testing.assert_allclose(got, expected, rtol=0, atol=sums)
        assert system.energy[t] == pytest.approx(np.sum(weight * values**2))
        assert system.count[t] == np.count_nonzero(shade.weights[t])


def test_few_lights_get_few_harmonics():
    assert [band_limit_for(n) for n in (1, 2, 7, 8, 18, 32, 10_000)] == [1, 1, 1, 2, 3, 4, 4]


def test_basis_functions_are_of_unit_size(rng, rounding):
    functions = fitted(planted(rng)[1])[1].functions.astype(float)
    # By Parseval, the mean square over the sphere is that of the coefficients over 4 pi.
    squares = np.sum(functions[1:] ** 2, axis=(1, 2)) / (4 * np.pi * 3)
    np.testing.assert_allclose(squares, 1.0, rtol=rounding(np.float32))


def test_both_evaluations_agree(rng, rounding):
    light, _ = planted(rng, n_texels=20)
    lights, texels = directions(rng, 7), rng.integers(0, 20, 9)
    under = light.under(texels, lights, 3)
    towards = light.towards(np.repeat(texels, 7), np.tile(lights, (9, 1)), 3)
    # Nine harmonics of four functions, before they are cubed.
    one, two = np.cbrt(under.reshape(-1, 3)), np.cbrt(towards)
    sums = rounding(np.float32, operations=9 * (N_COMPONENTS + 1), scale=two.max())
    np.testing.assert_allclose(one, two, rtol=0, atol=sums)
    assert under.min() >= 0
    assert light.towards(np.zeros(0, int), np.zeros((0, 3)), 3).shape == (0, 3)
    assert light.under(np.zeros(0, int), lights, 3).shape == (0, 7, 3)


DOME = np.array(
    [[np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]
     for e, n in ((0.2, 12), (0.7, 8), (1.2, 4)) for a in 2 * np.pi * np.arange(n) / n]
)  # fmt: skip


def test_lights_from_where_none_came_bring_what_the_nearest_did(rng, rounding):
    """Harmonics that are planted on a dome take any value below it; the light does not."""
    functions = rng.standard_normal((2, 16, 3)).astype(np.float32)
    # The harmonic of degree 1 that is z: brighter from below than all others are together.
    functions[0, 2] -= 10.0
    light = IndirectLight(
        functions,
        rng.standard_normal((50, 1)).astype(np.float32),
        DOME,
    )
    texels, below = np.arange(50), directions(rng, 200) * [1, 1, -1]
    below = below[below[:, 2] < -0.2]
    everywhere = directions(rng, 5000)
    dome = everywhere[covered(everywhere, DOME)]
    shown = light.under(texels, np.concatenate([DOME, dome]), 1)
    radiance = light.under(texels, below, 1)
    # The table interpolates in steps of 2 degrees: h^2 / 8 l (l + 1) of the largest.
    slack = (np.pi / 90) ** 2 / 8 * 12 * shown.max()
    assert np.all(radiance.max(axis=1) <= shown.max(axis=1) + slack)
    assert np.all(radiance.min(axis=1) >= shown.min(axis=1) - slack)
    unbounded = replace(light, observed=None).under(texels, below, 1)
    assert np.mean(unbounded.max(axis=1) > shown.max(axis=1) + slack) > 0.3
    towards = light.towards(np.repeat(texels, len(below)), np.tile(below, (50, 1)), 1)
    # Four taps of two functions.
    taps = rounding(np.float32, operations=8, scale=radiance.max())
    np.testing.assert_allclose(radiance.reshape(-1, 3), towards, rtol=0, atol=taps)


def test_no_texel_is_made_brighter_than_it_was_seen(monkeypatch, rng):
    """Half of the texels shine into themselves; the others were seen dark, under one light."""
    lights = np.broadcast_to(DOME, (200, *DOME.shape)).astype(np.float32)
    towards_x = 0.8 + 0.7 * lights[..., 0]
    values = np.where(np.arange(200)[:, None] < 100, towards_x, 0.1)
    weights = np.ones((200, len(DOME)), np.float32)
    weights[100:150] = np.arange(len(DOME)) == 6  # towards -X, as dark in the others
    noisy = values[..., None] + 0.02 * rng.standard_normal((200, len(DOME), 3))
    weights = weights[..., None].repeat(3, axis=2)
    shade = Shade(noisy.astype(np.float32), weights, lights)

    def brightest():
        model = fit_indirect(
            lambda some_: some(shade, some_), np.arange(200), len(DOME), 2, ONE_THREAD
        )
        light = IndirectLight(model.functions(), model.coefficients(shade), DOME)
        return light.under(np.arange(100, 150), DOME, 1).max()

    # The sample, and three standard deviations of its noise and of the model's.
    assert brightest() < 0.1 + 6 * 0.02
    monkeypatch.setattr("reflfield.field.indirect_fit.LIMIT_ROUNDS", 0)
    assert brightest() > 0.5


def test_field_keeps_it_within_half_a_step(parts):
    surface, fit = parts
    kept = build_field(surface, fit, quantisation=Quantisation(0.05)).indirect
    np.testing.assert_array_equal(kept.functions, fit.indirect.functions)
    off = np.abs(kept.coefficients - fit.indirect.coefficients)
    # Half a step of .05, and rounding to single precision.
    assert 0.02 < off.max() < 0.025001


def test_lights_that_do_not_reach_bring_indirect_light(make_field, rng, rounding):
    field = make_field()
    black = {**field.arrays, "indirect_functions": 0 * field.arrays["indirect_functions"]}
    texels, lights, powers = np.array([0, 5, -1]), directions(rng, 4), rng.random((4, 3))
    views = np.tile([0.0, 0.0, 1.0], (3, 1))
    lit = np.array([[1, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]], bool)
    with_it, without = (
        sum_lights(f, texels, views, lights, powers, lit)
        for f in (field, replace(field, arrays=black))
    )
    indirect = field.indirect.under(texels[:2], lights, 3)
    expected = np.einsum("nmc,mc,nm->nc", indirect, powers, ~lit[:2])
    # Nine harmonics and four lights; direct light is added before it is subtracted.
    sums = rounding(np.float32, operations=13, scale=with_it.max())
    np.testing.assert_allclose((with_it - without)[:2], expected, rtol=0, atol=sums)
    assert np.all(with_it[2] == 0)
    everywhere = sum_lights(field, texels, views, lights, powers)
    np.testing.assert_array_equal(
        everywhere, sum_lights(field, texels, views, lights, powers, lit | True)
    )


def test_bad_light_is_refused(rng):
    with pytest.raises(InputError, match="n_components: expected >= 0"):
        fitted(planted(rng, n_texels=2)[1], n_components=-1)
    with pytest.raises(ShapeError, match="coefficients"):
        IndirectLight(np.zeros((3, 9, 3), np.float32), np.zeros((5, 3), np.float32))
    surface = square_surface(2)
    fit = FittedReflectance(
        local_from_world=np.tile(np.eye(3), (4, 1, 1)),
        cluster=np.zeros(4, int),
        coefficients=np.zeros((4, 0)),
        mean=np.ones((1, 1, 1, 3)),
        basis=np.zeros((1, 0, 1, 1, 3)),
        indirect=no_indirect_light(3),
    )
    with pytest.raises(ShapeError, match="indirect"):
        build_field(surface, fit)
