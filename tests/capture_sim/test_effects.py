"""Each effect: when a scene calls for it, and what it does."""

import numpy as np
import pytest

from capture_sim.effects import (
    Photograph,
    Workload,
    antialiasing,
    near_lights,
    sensor_noise,
    shadows,
    simulated,
)
from capture_sim.effects.effect_registry import EFFECTS, decided
from capture_sim.errors import SceneError
from capture_sim.scene import parse_scene

WORK = Workload(n_views=2, n_lights=3, n_pixels=100, n_points=40, n_lit=60)


def scene(thing="sphere", kind="point", **tables):
    return parse_scene(
        {
            "object": {"preset": thing},
            "material": {"preset": "grey_card"},
            "cameras": {"preset": "rti"},
            "lights": {"preset": "rti", "kind": kind},
            **tables,
        }
    )


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.NAME)
def test_every_effect_has_the_same_interface(effect):
    decision = effect.needed(scene("vase"))
    assert decision.reason
    assert decision.bound >= 0.0
    assert effect.cost(scene("vase"), WORK).rays >= 0
    assert effect.Options() == effect.Options()
    assert effect.__name__.endswith("." + effect.NAME)


def test_a_convex_object_needs_no_shadow_rays():
    assert shadows.needed(scene("sphere")).bound == 0.0
    assert not simulated(scene("sphere"), shadows)
    assert simulated(scene("vase"), shadows)
    assert shadows.cost(scene("vase"), WORK).rays == 60


@pytest.mark.parametrize(("mode", "traced"), [("on", True), ("off", False)])
def test_effects_can_be_forced(mode, traced):
    for thing in ("sphere", "vase"):
        assert simulated(scene(thing, effects={"shadows": mode}), shadows) is traced


@pytest.mark.parametrize(
    ("choice", "expected"),
    [
        ("auto", {"antialiasing", "near_lights", "shadows", "interreflection"}),
        ("none", set()),
        (["shadows"], {"shadows"}),
        ({"simulate": "none", "near_lights": "on"}, {"near_lights"}),
        ({"simulate": "auto", "tolerance": 1.0}, {"antialiasing", "near_lights"}),
    ],
)
def test_the_choice_decides(choice, expected):
    # The reference light is close: its irradiance more than doubles over the vase.
    lights = {"preset": "rti", "distance": 0.2, "target": [0, 0, 0.1]}
    thing = parse_scene(
        {
            "object": {"preset": "vase"},
            "material": {"preset": "grey_card"},
            "cameras": {"preset": "rti"},
            "lights": lights,
            "effects": choice,
        }
    )
    assert decided(thing).effects.active == expected


def test_distant_lights_need_no_directions_per_point():
    assert near_lights.needed(scene(kind="point")).bound > 0.1
    decision = near_lights.needed(scene(kind="directional"))
    assert decision.bound == 0.0
    assert "all lights are directional" in decision.reason
    assert near_lights.cost(scene(), WORK).operations == 40 * 3


def test_far_field_is_the_light_at_the_centre():
    lamp = {"id": "a", "type": "point", "position": [0, 0, 2], "intensity": [8, 8, 8]}
    points = np.array([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
    exact = near_lights.apply((lamp,), points)
    flat = near_lights.far_field((lamp,), np.zeros(3), points)
    np.testing.assert_array_equal(flat.directions[:, 0], [[0, 0, 1], [0, 0, 1]])
    np.testing.assert_array_equal(flat.irradiance[:, 0, 0], [2.0, 2.0])
    assert exact.irradiance[0, 0, 0] == pytest.approx(8 / 4.25)


def test_antialiasing_is_off_with_single_rays():
    single = {"samples_per_side": 1, "edge_samples_per_side": 1}
    assert not simulated(scene(image=single), antialiasing)
    assert simulated(scene(), antialiasing)
    assert antialiasing.cost(scene(), WORK).rays == 100 * 16 + 40


def test_spot_beam_falls_off_with_the_cosine_power(rounding):
    spot = {
        "id": "l0",
        "type": "spot",
        "position": [0, 0, 1],
        "direction": [0, 0, -2],
        "intensity": [8, 8, 8],
        "exponent": 3,
    }
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    arriving = near_lights.apply((spot,), points)
    # On the axis 8; at 45 degrees 8 / 2 * (1/sqrt 2)^3; behind the lamp nothing.
    expected = [8.0, 4.0 / 2**1.5, 0.0]
    np.testing.assert_allclose(arriving.irradiance[:, 0, 0], expected, rounding(np.float64))


def test_far_point_light_tends_to_a_directional_one():
    towards = np.array([0.6, 0.0, 0.8])
    far = {
        "id": "a",
        "type": "point",
        "position": (1e5 * towards).tolist(),
        "intensity": [1e10] * 3,
    }
    sun = {"id": "b", "type": "directional", "direction": [3, 0, 4], "irradiance": [1, 1, 1]}
    points = np.array([[0.1, -0.2, 0.05]])
    both = near_lights.apply((far, sun), points)
    # The parallax of 0.2 m at 100 km.
    np.testing.assert_allclose(both.directions[:, 0], both.directions[:, 1], atol=5e-6)
    # 0.1 m nearer of 100 km, squared.
    np.testing.assert_allclose(both.irradiance[:, 0], both.irradiance[:, 1], rtol=2.1e-6)


@pytest.mark.parametrize(
    ("light", "named"),
    [
        ({"id": "x", "type": "unknown"}, "'x': type: expected point, directional or spot"),
        (
            {"id": "s", "type": "spot", "position": [0, 0, 1], "direction": [0, 0, -1],
             "intensity": [1, 1, 1], "cone_angle": 0.3},
            "'s': exponent",
        ),
    ],
)  # fmt: skip
def test_lights_that_cannot_be_simulated_are_refused(light, named):
    with pytest.raises(SceneError, match=named):
        near_lights.apply((light,), np.zeros((1, 3)))


def test_noise_has_the_variance_of_photons_and_reading(rng):
    radiance = np.full((120, 120, 3), 0.5, np.float32)
    noise = sensor_noise.Options(electrons_per_radiance=400.0, read_noise=6.0)
    errors = sensor_noise.with_noise(radiance, noise, rng).astype(float) - 0.5
    n = errors.size
    variance = 0.5 / 400.0 + (6.0 / 400.0) ** 2
    assert sensor_noise.standard_deviation(noise, 0.5) ** 2 == pytest.approx(variance)
    assert abs(errors.mean()) < 4 * np.sqrt(variance / n)  # 4 sigma of the mean
    assert errors.var() == pytest.approx(
        variance, rel=4 * np.sqrt(2 / n)
    )  # and of the variance


def test_noise_of_photographs_is_independent_and_repeatable():
    radiance = np.ones((64, 64, 3), np.float32)
    noisy = scene(effects={"sensor_noise": {"electrons_per_radiance": 100, "read_noise": 1}})
    camera = noisy.cameras[0]
    first = sensor_noise.apply(radiance, noisy, Photograph(camera, 0, 0))
    assert (first == sensor_noise.apply(radiance, noisy, Photograph(camera, 0, 0))).all()
    for photograph in (
        Photograph(camera, 0, 1),
        Photograph(camera, 1, 0),
        Photograph(camera, 0, 0, exposure=1),
    ):
        other = sensor_noise.apply(radiance, noisy, photograph)
        correlation = np.corrcoef(first.ravel(), other.ravel())[0, 1]
        assert abs(correlation) < 4 / np.sqrt(first.size)  # 4 sigma
