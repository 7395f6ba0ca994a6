"""Compiled arrival of light against the plain one."""

from dataclasses import replace

import numpy as np
import pytest

from capture_sim.arrival import LightArrays
from capture_sim.effects import near_lights
from capture_sim.errors import SceneError
from capture_sim.model import EffectOptions
from capture_sim.scene import parse_scene

LIGHTS = (
    {"id": "a", "type": "point", "position": [0.3, -0.1, 0.9], "intensity": [1.0, 2.0, 3.0]},
    {"id": "b", "type": "directional", "direction": [1, 2, 2], "irradiance": [3.0, 2.0, 1.0]},
    {"id": "c", "type": "spot", "position": [0.0, 0.5, 0.5], "direction": [0, -1, -1.2],
     "intensity": [2.0, 2.0, 2.0], "exponent": 7.0},
)  # fmt: skip


@pytest.fixture
def scene():
    return parse_scene(
        {
            "object": {"preset": "vase"},
            "material": {"preset": "grey_card"},
            "cameras": {"preset": "rti"},
            "lights": {"preset": "rti"},
        }
    )


def random_points(rng, n=50):
    frames = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    return rng.uniform(-0.1, 0.1, (n, 3)), frames


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("near", [True, False])
def test_light_arrives_as_by_the_formulas(scene, near, precision, rng, rounding):
    points, frames = random_points(rng)
    scene = replace(scene, effects=EffectOptions(forced={"near_lights": near}))
    if near:
        expected = near_lights.apply(LIGHTS, points)
    else:
        expected = near_lights.far_field(LIGHTS, scene.mesh.centre, points)
    arrays = LightArrays.of(scene, LIGHTS)
    directions, strength = arrays.arrive(points, frames, precision)
    local = np.einsum("nij,nlj->nil", frames, expected.directions)
    np.testing.assert_allclose(directions, local, atol=rounding(precision))
    irradiance = strength[:, :, None] * arrays.colour
    np.testing.assert_allclose(
        irradiance, expected.irradiance, rtol=rounding(precision, operations=8)
    )
    light = np.arange(len(points)) % 3
    targets = expected.targets[np.arange(len(points)), light]
    np.testing.assert_allclose(arrays.targets(light, points), targets, rounding(np.float64))


def test_unknown_lights_are_refused(scene):
    scene = replace(scene, effects=EffectOptions(forced={"near_lights": True}))
    with pytest.raises(SceneError, match="light 'x': expected a point"):
        LightArrays.of(scene, ({"id": "x", "type": "area"},))
