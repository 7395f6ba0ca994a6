"""Evaluation against a NumPy form of the formula, and at its edges."""

import numpy as np
import pytest

from reflfield.errors import InputError, ShapeError
from reflfield.field.evaluation import (
    evaluate,
    light_response,
    sum_lights,
)
from reflfield.field.texel_taps import texel_taps
from reflfield.sphere.hemisphere import (
    HORIZON_SOFTNESS,
    HemisphereGrid,
    softened_cosine,
)
from tests.synthetic_fields import baked_field, blinn_phong, lambert, square_surface

POWER = {"cube_root": 3, "square_root": 2, "linear": 1}


def directions(rng, n):
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def evaluate_with_numpy(field, texels, views, lights):
    """The formula of `field.model`, written out with einsum."""
    frames = field.local_from_world[texels].astype(float)
    local_views = np.einsum("nij,nj->ni", frames, views)
    local_lights = np.einsum("nij,nj->ni", frames, lights)
    v, v_weights = HemisphereGrid(field.view_side).taps(local_views)
    l, l_weights = HemisphereGrid(field.light_side).taps(local_lights)  # noqa: E741
    cluster = field.cluster[texels]
    taps = (cluster[:, None, None], v[:, :, None], l[:, None, :])
    means = field.mean[taps]
    bases = np.moveaxis(field.basis, 1, 3)[taps]
    nodes = means + np.einsum("nk,nvlkc->nvlc", field.coefficients[texels], bases)
    value = np.einsum("nv,nl,nvlc->nc", v_weights, l_weights, nodes)
    sample = np.maximum(value, 0) ** POWER[field.domain]
    if field.light_side == 1:
        return sample
    return sample * softened_cosine(local_lights[:, 2:])


@pytest.mark.reference
@pytest.mark.parametrize("domain", ["cube_root", "square_root", "linear"])
@pytest.mark.parametrize(("view_side", "light_side"), [(5, 4), (1, 4), (5, 1), (1, 1), (2, 2)])
def test_kernel_agrees_with_numpy(domain, view_side, light_side, make_field, rng, rounding):
    field = make_field(domain=domain, view_side=view_side, light_side=light_side)
    texels = rng.integers(0, field.n_texels, 500)
    views, lights = directions(rng, 500), directions(rng, 500)
    expected = evaluate_with_numpy(field, texels, views, lights)
    # 16 taps of 5 components in float32, cubed; the taps lose half their digits at
    # the zenith of a frame (square roots), which 1e-3 of a node spacing covers.
    scale = np.abs(expected).max()
    error = np.abs(evaluate(field, texels, views, lights) - expected).max()
    assert error < rounding(np.float32, operations=80, condition=3, scale=scale) + 1e-4 * scale


@pytest.mark.parametrize("n_components", [0, 1, 7])
def test_any_number_of_components(n_components, make_field, rng, rounding):
    field = make_field(n_components=n_components)
    texels, views, lights = np.arange(60), directions(rng, 60), directions(rng, 60)
    expected = evaluate_with_numpy(field, texels, views, lights)
    # As above, of up to seven components.
    scale = np.abs(expected).max()
    error = np.abs(evaluate(field, texels, views, lights) - expected).max()
    assert error < rounding(np.float32, operations=112, condition=3, scale=scale) + 1e-4 * scale


@pytest.mark.parametrize(("view_side", "light_side"), [(5, 4), (1, 3), (4, 1)])
def test_sum_of_lights_equals_single_lights(view_side, light_side, make_field, rng, rounding):
    field = make_field(view_side=view_side, light_side=light_side)
    texels, views, lights = np.arange(60), directions(rng, 60), directions(rng, 7)
    irradiances, lit = rng.random((7, 3)), rng.random((60, 7)) < 0.6
    expected = 0
    for j in range(7):
        towards = np.tile(lights[j], (60, 1))
        indirect = field.indirect.towards(texels, towards, field.inverse_power)
        direct = evaluate(field, texels, views, towards)
        expected = expected + irradiances[j] * np.where(lit[:, [j]], direct, indirect)
    summed = sum_lights(field, texels, views, lights, irradiances, lit)
    # The same taps in another order, and seven lights.
    tolerance = rounding(np.float32, operations=16 + 7, scale=expected.max())
    np.testing.assert_allclose(summed, expected, rtol=0, atol=tolerance)
    everywhere = sum_lights(field, texels, views, lights, irradiances)
    assert np.array_equal(
        everywhere, sum_lights(field, texels, views, lights, irradiances, np.ones_like(lit))
    )


def test_light_response_at_a_node_is_the_sample_there(make_field, rng):
    field = make_field(domain="linear")
    views = directions(rng, 60)
    response = light_response(field, np.arange(60), views)
    assert response.shape == (60, 9, 3)
    node = HemisphereGrid(3).directions[4]
    lights = np.einsum("nij,i->nj", field.local_from_world, node)
    expected = evaluate(field, np.arange(60), views, lights)
    # The node is the zenith, where the map to the square has a root: half the digits.
    at_zenith = 2 * np.sqrt(np.finfo(np.float32).eps) * expected.max()
    np.testing.assert_allclose(np.maximum(response[:, 4], 0), expected, rtol=0, atol=at_zenith)


def test_lambert_square_has_the_textbook_value():
    field = baked_field(square_surface(2), lambert([0.3, 0.6, 0.9]), light_side=17)
    tilted = [[np.sin(0.5), 0.0, np.cos(0.5)]]
    value = evaluate(field, [0], [[0, 0, 1]], tilted)[0]
    expected = np.array([0.3, 0.6, 0.9]) / np.pi * np.cos(0.5)
    # Half a step of the mean's 16 bits, cubed.
    np.testing.assert_allclose(value, expected, rtol=3 * 0.5 / 32767)


def test_mirror_direction_is_brightest(rng):
    field = baked_field(
        square_surface(1), blinn_phong(0.0, 1.0, 80.0), view_side=33, light_side=33
    )
    view = np.array([0.5, 0.2, 0.0])
    view[2] = np.sqrt(1 - view @ view)
    mirrored = view * [-1, -1, 1]
    # Linear between nodes, the lobe is flat where it is highest: what is nearer than two of
    # them, 33 x 33 over a hemisphere, may be as bright.
    away = np.cos(2 * np.sqrt(2 * np.pi) / 32)
    others = directions(rng, 300)
    lights = np.concatenate([[mirrored], others[others @ mirrored < away]])
    n = len(lights)
    values = evaluate(field, np.zeros(n, int), np.tile(view, (n, 1)), lights)[:, 0]
    assert np.argmax(values / np.maximum(lights[:, 2], 0.3)) == 0


def test_cosine_is_rounded_at_the_horizon():
    field = baked_field(square_surface(1), lambda v, l: np.ones((len(v), len(l), 3)))  # noqa: E741
    z = np.linspace(-2 * HORIZON_SOFTNESS, HORIZON_SOFTNESS, 61)
    lights = np.stack([np.sqrt(1 - z**2), 0 * z, z], axis=1)
    values = evaluate(field, np.zeros(61, int), np.tile([[0, 0, 1.0]], (61, 1)), lights)[:, 0]
    expected = softened_cosine(z)
    step = expected.max() * 3 * 0.5 / 32767  # half a step of the mean's 16 bits, cubed
    np.testing.assert_allclose(values, expected, rtol=0, atol=step)
    # Just at the end of the foot float32 leaves its square.
    assert values[z <= -HORIZON_SOFTNESS].max() < 1e-15
    assert (np.diff(values) >= -1e-6).all()


def test_view_below_the_horizon_reads_the_horizon(make_field, rng, rounding):
    field = make_field()
    frame = field.local_from_world[:1].astype(float)
    light = frame[:, 2]
    below, level = np.array([0.6, 0.0, -0.8]) @ frame[0], np.array([1.0, 0, 0]) @ frame[0]
    read = evaluate(field, [0], level[None], light)
    taps = rounding(np.float32, operations=16, condition=3, scale=read.max())
    np.testing.assert_allclose(
        evaluate(field, [0], below[None], light), read, rtol=0, atol=taps
    )


@pytest.mark.stability
@pytest.mark.parametrize("scale", [0.0, 1e-12, 1.0, 1e12])
@pytest.mark.parametrize("domain", ["cube_root", "linear"])
def test_scale_of_the_samples_carries_through(scale, domain):
    field = baked_field(square_surface(1), lambert(scale * np.pi), domain=domain)
    value = evaluate(field, [0], [[0, 0, 1]], [[0, 0, 1]])
    # Half a step of the mean's 16 bits, cubed.
    np.testing.assert_allclose(value, np.full((1, 3), scale), rtol=3 * 0.5 / 32767)


@pytest.mark.stability
@pytest.mark.parametrize(
    "light", [[1, 0, 0], [0, 0, 1], [0, 0, -1], [0, 1, 1e-30], [1e-20, 0, 1], [0, 1, -1e-9]]
)
def test_poles_and_horizon_are_finite(light, make_field):
    field = make_field()
    for direction in (light, field.local_from_world[0].T @ np.array(light, np.float32)):
        values = evaluate(field, [0], [direction], [direction])
        assert np.isfinite(values).all()
        assert (values >= 0).all()


def test_absent_texels_are_black_and_others_refused(make_field):
    field, up = make_field(), [[0, 0, 1.0]]
    assert not evaluate(field, [-1], up, up).any()
    assert not light_response(field, [-1], up).any()
    with pytest.raises(InputError, match="texels: expected -1 to 59, received 60 to 60"):
        evaluate(field, [60], up, up)
    with pytest.raises(ShapeError, match="lights_world"):
        evaluate(field, [0], up, [[0, 1]])
    with pytest.raises(ShapeError, match="lit"):
        sum_lights(field, [0], up, up, [[1, 1, 1]], np.ones((2, 1), bool))


@pytest.mark.parametrize("bad", [[np.nan, 0, 1], [0, 0, 2], [0, 0, 0], [np.inf, 0, 0]])
def test_directions_that_are_no_unit_vectors_are_refused(bad, make_field):
    field, up = make_field(), [[0, 0, 1.0]]
    with pytest.raises(InputError, match=r"views_world: expected unit vectors, .* in row 0"):
        evaluate(field, [0], [bad], up)
    with pytest.raises(InputError, match=r"lights_world: expected unit vectors, .* in row 1"):
        evaluate(field, [0, 1], up * 2, [*up, bad])
    with pytest.raises(InputError, match="views_world: expected unit vectors"):
        light_response(field, [0], [bad])
    with pytest.raises(InputError, match="lights_world: expected unit vectors"):
        sum_lights(field, [0], up, [bad], [[1, 1, 1]])
    # Of no texel, nothing is asked.
    assert not evaluate(field, [-1], [bad], up).any()


def test_irradiance_that_is_not_finite_is_refused(make_field):
    up = [[0, 0, 1.0]]
    with pytest.raises(InputError, match="irradiances: expected finite"):
        sum_lights(make_field(), [0], up, up, [[1, np.inf, 1]])


def test_taps_interpolate_texel_coordinates(rng, rounding):
    field = baked_field(square_surface(8), lambert(0.5))
    inside = (0.5 + 7 * rng.random((200, 2))) / 8
    texels, weights = texel_taps(field, inside)
    row, column = np.divmod(texels, 8)
    x, y = (weights * (column + 0.5)).sum(1) / 8, 1 - (weights * (row + 0.5)).sum(1) / 8
    found = np.stack([x, y], axis=1)
    np.testing.assert_allclose(found, inside, rtol=0, atol=rounding(np.float32))


def test_taps_leave_out_absent_texels(make_field, rng, rounding):
    field = make_field()
    inside = (0.5 + rng.random((500, 2)) * (11, 8)) / (12, 9)
    texels, weights = texel_taps(field, inside)
    assert not weights[texels < 0].any()
    exists = (texels >= 0).any(axis=1)
    total = weights.sum(axis=1)
    assert np.abs(total[exists] - 1).max() < rounding(np.float32)
    assert not total[~exists].any()


def test_taps_of_a_single_pixel():
    field = baked_field(square_surface(1), lambert(0.5))
    texels, weights = texel_taps(field, [[0.0, 0.0], [0.7, 1.0]])
    assert not texels.any()
    assert np.allclose(weights.sum(1), 1)


@pytest.mark.parametrize(("transition", "expected"), [(1.0, 0.7), (0.5, 0.9), (0.0, 1.0)])
def test_texels_blend_over_the_transition(transition, expected, rounding):
    field = baked_field(square_surface(4), lambert(1.0))
    texels, weights = texel_taps(field, [[(1.5 + 0.7) / 4, 1 - 1.5 / 4]], transition)
    share = weights[0][texels[0] == 6].sum()
    assert share == pytest.approx(expected, abs=rounding(np.float32))
