"""Lights: directions, distances and irradiance."""

from pathlib import Path

import numpy as np
import pytest

from reflfield.capture.lights import Light
from reflfield.errors import CaptureError, InputError


class TestExact:
    def test_point_light_falls_with_the_square(self, rounding):
        light = Light("l", "point", position=[0, 0, 3], intensity=[9, 18, 0])
        points = [[0, 0, 0], [0, 0, 2], [4, 0, 0]]
        np.testing.assert_allclose(
            light.irradiance(points),
            [[1, 2, 0], [9, 18, 0], [9 / 25, 18 / 25, 0]],
            rounding(np.float64),
        )
        assert light.distances(points).tolist() == [3, 1, 5]
        np.testing.assert_allclose(
            light.directions(points)[2], [-0.8, 0, 0.6], rounding(np.float64)
        )

    def test_directional_light_is_the_same_everywhere(self):
        light = Light("l", "directional", direction=[0, 0, 5], intensity=[1, 2, 3])
        points = [[0, 0, 0], [1e6, 0, 0]]
        assert light.directions(points).tolist() == [[0, 0, 1]] * 2
        assert light.irradiance(points).tolist() == [[1, 2, 3]] * 2
        assert np.isinf(light.distances(points)).all()

    def test_unknown_light_counts_as_one(self):
        light = Light("l", "unknown")
        assert light.irradiance([[3, 4, 5]]).tolist() == [[1, 1, 1]]
        assert light.directions([[3, 4, 5]]).tolist() == [[0, 0, 1]]
        assert not light.known

    def test_spot_cone(self, rounding):
        light = Light(
            "l",
            "spot",
            position=[0, 0, 1],
            direction=[0, 0, -1],
            cone_angle=0.5,
            falloff_angle=0.2,
        )
        on_axis, within, outside = light.irradiance(
            [[0, 0, 0], [np.tan(0.15), 0, 0], [np.tan(0.6), 0, 0]]
        )[:, 0]
        assert on_axis == 1
        assert within == pytest.approx(np.cos(0.15) ** 2, abs=rounding(np.float64))
        assert outside == 0
        # a quarter of the way, in cosine, from dark to bright: smoothstep 5/32
        angle = np.arccos(0.75 * np.cos(0.5) + 0.25 * np.cos(0.2))
        edge = light.irradiance([[np.tan(angle), 0, 0]])[0, 0]
        tolerance = rounding(np.float64, condition=1 / (np.cos(0.2) - np.cos(0.5)))
        assert edge == pytest.approx(5 / 32 * np.cos(angle) ** 2, abs=tolerance)

    def test_spot_exponent(self):
        light = Light("l", "spot", position=[0, 0, 1], direction=[0, 0, -1], exponent=4)
        # 45 degrees: d^2 = 2, cos^4 = 1/4
        assert light.irradiance([[1, 0, 0]])[0, 0] == pytest.approx(1 / 8, rel=1e-14)
        assert light.irradiance([[0, 0, 2]])[0, 0] == 0  # behind the spot

    def test_group_names_its_members(self):
        lamp = Light("a", "point", position=[0, 0, 1])
        assert Light("g", "group", members=(lamp, lamp)).sources == (lamp, lamp)
        assert lamp.sources == (lamp,)


@pytest.mark.stability
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_irradiance_scales_with_the_inverse_square(rng, rounding, scale):
    position, points = rng.normal(size=3) + 5, rng.normal(size=(20, 3))
    unit = Light("l", "point", position=position).irradiance(points)
    scaled = Light("l", "point", position=position * scale).irradiance(points * scale)
    np.testing.assert_allclose(scaled * scale**2, unit, rtol=rounding(np.float64, 20))


@pytest.mark.stability
def test_point_at_the_light_stays_finite():
    light = Light("l", "point", position=[1, 2, 3])
    assert np.isfinite(light.irradiance([[1, 2, 3]])).all()
    assert np.isfinite(light.directions([[1, 2, 3]])).all()


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"kind": "laser"}, "'laser'"),
        ({"kind": "point", "position": [0, 0, np.nan]}, "position.*finite"),
        ({"kind": "point", "position": [0, 0]}, "position.*3 finite"),
        ({"kind": "point", "intensity": [1, -1, 1]}, "intensity.*>= 0"),
        ({"kind": "directional", "direction": [0, 0, 0]}, "direction.*not zero"),
        ({"kind": "spot", "cone_angle": 0.1, "falloff_angle": 0.5}, "falloff_angle <= cone"),
        ({"kind": "point", "intensity": [0, 1e-320, 0]}, "one of at least 1e-30 in"),
        ({"kind": "environment"}, "needs the file"),
        ({"kind": "environment", "file": Path("a"), "convention": "x"}, "convention.*'x'"),
        (
            {
                "kind": "environment",
                "file": Path("a"),
                "world_from_environment": np.ones((3, 3)),
            },
            "world_from_environment",
        ),
        ({"kind": "group"}, "at least one"),
    ],
)
def test_refused(fields, reason):
    with pytest.raises(CaptureError, match=f"light 'lamp'.*{reason}"):
        Light("lamp", **fields)


def test_environment_has_no_single_direction():
    with pytest.raises(InputError, match="single direction"):
        Light("e", "environment", file=Path("map.exr")).directions([[0, 0, 0]])
