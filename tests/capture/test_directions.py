"""Directions to cameras and lights, pixels and irradiance of many points, against formulas."""

import numpy as np
import pytest

from reflfield.capture.cameras import Camera
from reflfield.capture.directions import Whereabouts, directions_towards
from reflfield.capture.lights import DirectionalLight, Light, PointLight, facing_irradiance
from reflfield.errors import InputError

EPS = np.finfo(np.float64).eps


def points_of(seed=0, n=50):
    return np.random.default_rng(seed).standard_normal((n, 3))


@pytest.mark.stability
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_directions_are_unit_vectors_to_points_and_along_directions(scale):
    points = scale * points_of()
    places = scale * points_of(1, 3)
    targets = [Whereabouts(place, is_point=True) for place in places]
    targets.append(Whereabouts(np.array([0.0, 0.6, 0.8]), is_point=False))
    towards = directions_towards(points, targets)
    assert towards.shape == (50, 4, 3)
    apart = places[None] - points[:, None]
    expected = apart / np.linalg.norm(apart, axis=2, keepdims=True)
    # A difference, a sum of squares, a root and a quotient.
    np.testing.assert_allclose(towards[:, :3], expected, atol=8 * EPS)
    assert (towards[:, 3] == [0.0, 0.6, 0.8]).all()
    single = directions_towards(points, targets, np.float32)
    np.testing.assert_array_equal(single, towards.astype(np.float32))


@pytest.mark.stability
def test_a_point_at_the_camera_has_no_direction():
    camera = Camera.look_at([1.0, 2.0, 3.0])
    assert camera.view_directions([camera.centre]).tolist() == [[0.0, 0.0, 0.0]]
    near = np.nextafter(camera.centre, np.inf)
    assert np.isfinite(camera.view_directions([near])).all()


def test_pixels_are_those_of_the_matrices():
    pose = Camera.look_at([2.0, -1.0, 0.5], [0.1, 0, 0]).camera_from_world
    camera = Camera("v", "opencv", 640, 480, 500.0, 450.0, 300.0, 250.0, pose)
    points = 3.0 * points_of()
    pixels, depth = camera.project(points)
    x_camera = points @ pose[:3, :3].T + pose[:3, 3]
    before = x_camera[:, 2] > 0
    assert 5 < before.sum() < 50
    image = (camera.matrix @ x_camera.T).T
    # Coordinates of some hundreds of pixels, from a quotient by depths that may be small.
    most = 1e3 * EPS * np.abs(pixels[before]).max()
    np.testing.assert_allclose(
        pixels[before], image[before, :2] / x_camera[before, 2:], atol=most
    )
    assert np.isnan(pixels[~before]).all()
    np.testing.assert_allclose(depth, x_camera[:, 2], atol=8 * EPS)


def test_a_lens_that_does_nothing_gives_the_pixels_of_none():
    pose = Camera.look_at([2.0, -1.0, 0.5]).camera_from_world
    plain = Camera("v", "opencv", 64, 48, 50.0, 50.0, 32.0, 24.0, pose)
    # Too weak to move a pixel, but by the general way.
    lens = Camera("v", "opencv", 64, 48, 50.0, 50.0, 32.0, 24.0, pose, (1e-30,))
    points = 0.3 * points_of()
    np.testing.assert_allclose(plain.project(points)[0], lens.project(points)[0], rtol=64 * EPS)


def test_irradiance_of_all_lights_is_that_of_each():
    spot = Light(
        "spot", "spot", position=np.array([0.0, 0, 3]), direction=np.array([0.0, 0, -1]),
        intensity=np.array([1.0, 2, 3]), cone_angle=0.3, falloff_angle=0.1, exponent=2.0,
    )  # fmt: skip
    lights = [
        PointLight([0.5, 0.2, 2.0], [1.0, 0.0, 3.0]),
        Light("even", "point", position=np.array([0.0, 1, 1]), intensity=np.ones(3) * 2,
              falls_off=False),
        DirectionalLight([0, 1, 1], [0.1, 0.2, 0.3]),
        spot,
        Light("unknown", "unknown"),
    ]  # fmt: skip
    points = points_of()
    expected = np.stack([light.irradiance(points) for light in lights], axis=1)
    found = facing_irradiance(lights, points)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=4 * np.finfo(np.float32).eps)
    lit = expected[:, 3].any(axis=1)
    assert 0 < lit.sum() < 50
    with pytest.raises(InputError, match="single light"):
        facing_irradiance([Light("both", "group", members=(lights[0], lights[2]))], points)
