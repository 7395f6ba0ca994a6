"""Gain of bounced light: found where it was planted, and none where there is none."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from reflfield.capture.lights import Light
from reflfield.field.indirect_light import IndirectLight
from reflfield.observations.stored_shade import StoredShade
from reflfield.pipeline import bounce_fit, results
from reflfield.pipeline.bounce_fit import LEAST_GAIN, with_bounced_light
from reflfield.pipeline.pipeline_options import IndirectOptions
from reflfield.render.bounced_light import BouncedLight
from tests.render.test_bounced_light import SIDE, bounced_light, corner_surface, field_of

N_LIGHTS = 12


@pytest.fixture
def corner(monkeypatch):
    """Function that makes context, field and shade of what shadows are said to show.

    Suns stand around a floor and a wall, a half of them below the horizon of each.
    """
    angles = np.linspace(-0.45, 0.95, N_LIGHTS) * np.pi
    lights = tuple(
        Light(
            f"l{i}",
            "directional",
            direction=np.array([np.cos(a), 0.3, np.sin(a)]),
            intensity=(1.0, 1.0, 1.0),
        )
        for i, a in enumerate(angles)
    )
    field = field_of(corner_surface(), gain=(0.0, 0.0, 0.0))
    traced = bounced_light(field)
    lit = np.stack([traced.lit(light) for light in lights], axis=1)
    bounced = np.stack([traced.under(light) for light in lights], axis=1)
    n = field.n_texels

    def make(gain, rest, noise=0.0, **options):
        rng = np.random.default_rng(5)
        values = gain * bounced + rest + noise * rng.standard_normal(bounced.shape)
        shade = StoredShade(
            texels=np.arange(n),
            values=values.astype(np.float16),
            weights=np.repeat(~lit[..., None], 3, axis=2),
            light=np.tile(np.arange(N_LIGHTS), (n, 1)),
            unit=1.0,
            lights=lights,
            positions=traced.surface.texel_points[0],
        )
        monkeypatch.setattr(results, "shade", lambda context: shade)
        monkeypatch.setattr(results, "light_visible", lambda context: lit)
        context = SimpleNamespace(
            options=SimpleNamespace(indirect=IndirectOptions(**options), seed=0),
            training=SimpleNamespace(lights=lights, n_lights=N_LIGHTS),
            resources=SimpleNamespace(workers=2),
        )
        return context, field, shade

    return make


def harmonics(n):
    return IndirectLight(np.ones((1, 1, 3), np.float32), np.zeros((n, 0), np.float32))


def test_a_planted_gain_is_found_and_harmonics_hold_the_rest(corner):
    planted = np.array([1.0, 0.8, 0.6])
    context, field, shade = corner(planted, rest=0.002, noise=1e-4)
    before = harmonics(field.n_texels)
    light = with_bounced_light(context, field, before)
    # Noise over what is bounced, .014 on average, in thousands of samples; steps of halves.
    np.testing.assert_allclose(light.gain, planted, atol=0.01)
    dark = ~results.light_visible(context)
    power, error, size = field.inverse_power, [], []
    for j, one in enumerate(context.training.lights):
        texels = np.flatnonzero(dark[:, j])
        towards = np.tile(one.direction, (len(texels), 1))
        bounced = bounced_light(field).under(one)[texels]
        shown = light.towards(texels, towards, power, bounced)
        error.append(shown - shade.values[texels, j].astype(float))
        size.append(shade.values[texels, j].astype(float))
    left = np.concatenate(error).std() / np.sqrt(np.mean(np.square(np.concatenate(size))))
    # What was planted is nearly in the model's range: noise, and steps of halves, are left.
    assert left < 0.05


@pytest.mark.parametrize("rest", [0.0, 0.02])
def test_harmonics_stay_alone_where_shadows_show_no_bounced_light(corner, rest):
    context, field, _ = corner(0.0, rest=rest * np.linspace(0, 1, N_LIGHTS)[::-1, None])
    before = harmonics(field.n_texels)
    assert with_bounced_light(context, field, before) is before


def test_gain_that_only_few_lights_show_counts_as_none(corner, monkeypatch):
    """As under a flash, whose stray light is in the shadows; no further light is traced."""
    context, field, shade = corner(1.0, rest=0.0)
    n_shown = len(np.unique(shade.light[shade.weights.any(axis=2)]))
    assert n_shown > 6
    before = harmonics(field.n_texels)
    gains = iter([np.full(3, 2 * LEAST_GAIN), np.full(3, 0.9 * LEAST_GAIN)])
    asked, traced = [], []
    under = BouncedLight.under

    def counted(self, light, lit=None):
        traced.append(light.id)
        return under(self, light, lit)

    def gain(shade, bounced, lights):
        asked.append(len(lights))
        return next(gains)

    monkeypatch.setattr(bounce_fit, "LIGHTS_TRIED", 3)
    monkeypatch.setattr(bounce_fit, "_gain", gain)
    monkeypatch.setattr(BouncedLight, "under", counted)
    assert with_bounced_light(context, field, before) is before
    assert asked == [3, 6]
    assert len(traced) == len(set(traced)) == 6


def test_lights_looked_at_in_rounds_give_the_gain_of_all(corner, monkeypatch):
    context, field, _ = corner(np.array([1.0, 0.8, 0.6]), rest=0.002, noise=1e-4)
    whole = with_bounced_light(context, field, harmonics(field.n_texels))
    monkeypatch.setattr(bounce_fit, "LIGHTS_TRIED", 2)
    rounds = with_bounced_light(context, field, harmonics(field.n_texels))
    np.testing.assert_array_equal(rounds.gain, whole.gain)
    np.testing.assert_array_equal(rounds.coefficients, whole.coefficients)


def test_without_shadows_or_not_asked_for_nothing_changes(corner, monkeypatch):
    context, field, shade = corner(1.0, rest=0.0, bounce=False)
    before = harmonics(field.n_texels)
    assert with_bounced_light(context, field, before) is before
    assert with_bounced_light(context, field, None) is None
    context, field, _ = corner(1.0, rest=0.0)
    assert with_bounced_light(context, field, None) is None
    empty = shade.only(np.zeros(0, np.intp))
    monkeypatch.setattr(results, "shade", lambda context: empty)
    assert with_bounced_light(context, field, before) is before


def test_rows_of_a_stored_shade_are_in_its_unit(corner):
    _, _, shade = corner(1.0, rest=0.0)
    rows = np.array([3, SIDE**2 + 2])
    double = replace(shade, unit=2.0, light=shade.light[:, ::-1])
    whole, some = double.rows(np.arange(len(shade.texels))), double.rows(rows)
    np.testing.assert_array_equal(some.values, 2 * shade.values[rows].astype(np.float32))
    np.testing.assert_array_equal(some.weights, shade.weights[rows])
    np.testing.assert_array_equal(some.lights, whole.lights[rows])
    # In the order in which the texel's lights are kept.
    np.testing.assert_allclose(
        some.lights[0, 0], shade.lights[-1].directions(np.zeros((1, 3)))[0], atol=1e-6
    )
