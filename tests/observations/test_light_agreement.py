"""Lights that are described in other axes than the cameras are noticed in the photographs."""

import re

import numpy as np
import pytest

from reflfield.capture.cameras import Camera, looking_at
from reflfield.capture.lights import Light
from reflfield.observations.light_agreement import (
    Look,
    agreement,
    other_light_axes,
)

OPENGL = np.diag([1.0, -1.0, -1.0])


def as_they_are(vector, camera, is_position):
    return vector


def directions(rng, n):
    vectors = rng.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def photographed(rng, described, kind="point", n_looks=12):
    """Looks at a matt ball, each from one side under a lamp elsewhere that is told otherwise.

    `described` makes what a description says of the lamp (its vector, the camera).
    """
    looks = []
    for i in range(n_looks):
        pose = looking_at(3 * directions(rng, 1)[0], (0, 0, 0), (0, 0, 1))
        camera = Camera(f"v{i}", "opencv", 8, 8, 8.0, 8.0, 4.0, 4.0, pose)
        lamp = directions(rng, 1)[0] * (4.0 if kind == "point" else 1.0)
        normals = directions(rng, 600)
        normals = normals[(camera.centre * normals).sum(axis=1) > 1]  # the side that is seen
        towards = lamp - normals if kind == "point" else np.tile(lamp, (len(normals), 1))
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        brightness = np.maximum((towards * normals).sum(axis=1), 0)
        said = described(lamp, camera)
        place = {"position": said} if kind == "point" else {"direction": said}
        looks.append(Look(camera, Light(f"l{i}", kind, **place), normals, normals, brightness))
    return looks


def in_camera(axes):
    def told(lamp, camera):
        return axes @ (camera.camera_from_world[:3, :3] @ (lamp - camera.centre))

    return told


@pytest.mark.parametrize("kind", ["point", "directional"])
def test_lights_as_described_fit(rng, kind):
    looks = photographed(rng, lambda lamp, camera: lamp, kind)
    # Brightness is the cosine itself; looks from behind the lamp have hardly any of it.
    assert agreement(looks, as_they_are) > 0.6
    assert other_light_axes(looks) == ""


@pytest.mark.parametrize("kind", ["point", "directional"])
@pytest.mark.parametrize(
    ("told", "words"),
    [
        (lambda lamp: lamp[[0, 2, 1]] * [1, 1, -1], r"read as \(x, -z, y\)"),  # y is up
        (lambda lamp: lamp * [1, 1, -1], r"read as \(x, y, -z\)"),  # mirrored
        (lambda lamp: lamp[[1, 2, 0]], r"read as \(z, x, y\)"),
    ],
)
def test_other_axes_are_named(rng, kind, told, words):
    state = rng.bit_generator.state
    right = agreement(photographed(rng, lambda lamp, camera: lamp, kind), as_they_are)
    rng.bit_generator.state = state
    looks = photographed(rng, lambda lamp, camera: told(lamp), kind)
    expected = rf"do not fit.* but of {right:.2f} with the lights' coordinates {words}"
    assert re.search(expected, other_light_axes(looks))


@pytest.mark.parametrize(("axes", "name"), [(np.eye(3), "OpenCV"), (OPENGL, "OpenGL")])
def test_positions_in_the_axes_of_each_camera_are_named(rng, axes, name):
    words = other_light_axes(photographed(rng, in_camera(axes)))
    assert words.startswith("lights and photographs do not fit")
    assert f"in the camera's axes of {name}" in words


def test_brightness_of_the_opposite_side_fits_no_axes(rng):
    """A picture that is turned, say; by another rule of axes it would fit no better."""
    looks = photographed(rng, lambda lamp, camera: lamp)
    shuffled = [
        Look(look.camera, look.light, look.points, look.normals, 1 - np.sqrt(look.brightness))
        for look in looks
    ]
    words = other_light_axes(shuffled)
    assert "with a correlation of -" in words


def test_unknown_lights_flat_surfaces_and_few_points_say_nothing(rng):
    looks = photographed(rng, lambda lamp, camera: -lamp, n_looks=3)
    unknown = [
        Look(k.camera, Light("l", "unknown"), k.points, k.normals, k.brightness) for k in looks
    ]
    few = [
        Look(k.camera, k.light, k.points[:9], k.normals[:9], k.brightness[:9]) for k in looks
    ]
    assert other_light_axes(unknown) == other_light_axes(few) == ""


def of_bowl(rng, *, n_wall, told=lambda lamp: lamp):
    """Looks from above at a bowl that its hull closes with a shallow dome."""
    looks = []
    for i in range(12):
        pose = looking_at((0.3, 0.2, 3), (0, 0, 0), (0, 1, 0))
        camera = Camera(f"v{i}", "opencv", 8, 8, 8.0, 8.0, 4.0, 4.0, pose)
        lamp = 4 * directions(rng, 1)[0]
        lamp[2] = abs(lamp[2]) + 1
        around, radius = rng.uniform(0, 2 * np.pi, 400), np.sqrt(rng.uniform(0, 0.9, 400))
        x, y, height = radius * np.cos(around), radius * np.sin(around), np.sqrt(1 - radius**2)
        hull = np.stack([x / 2, y / 2, np.ones(400)], axis=1)
        hull /= np.linalg.norm(hull, axis=1, keepdims=True)
        inside, lid = np.stack([-x, -y, height], axis=1), np.stack([x, y, 0 * x], axis=1)
        around = rng.uniform(0, 2 * np.pi, n_wall)
        wall = np.stack([np.cos(around), np.sin(around), 0 * around], axis=1)
        points, normals = np.concatenate([lid, wall]), np.concatenate([inside, wall])
        towards = lamp - points
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        brightness = np.maximum((towards * normals).sum(axis=1), 0)
        light = Light(f"l{i}", "point", position=told(lamp))
        looks.append(Look(camera, light, points, np.concatenate([hull, wall]), brightness))
    return looks


def test_a_bowl_whose_hull_is_closed_is_not_taken_for_lights_in_other_axes(rng):
    looks = of_bowl(rng, n_wall=40)
    assert agreement(looks, as_they_are) < 0.2  # as if it were lit from the other side
    assert other_light_axes(looks) == ""


def test_a_surface_that_faces_one_way_may_be_a_hollow(rng):
    words = other_light_axes(of_bowl(rng, n_wall=0))
    assert "turned by half about (0.0, 0.0, 1.0); either the object is hollow there" in words


def test_lights_turned_by_half_are_no_hollow_where_the_surface_faces_sideways(rng):
    looks = photographed(rng, lambda lamp, camera: lamp * [-1, -1, 1])
    assert "read as (-x, -y, z)" in other_light_axes(looks)
