"""``reflfield relight --environment``: a white ball, lit from where the map is bright."""

import numpy as np
import pytest
from PIL import Image

from reflfield.capture.image_writing import write_exr
from reflfield.field.file import write_field
from tests.synthetic_fields import baked_field, lambert, sphere_surface


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A white ball in a world with +Z up, as a field on disk."""
    field = baked_field(sphere_surface(16), lambert(0.8), visibility="factored", light_side=5)
    field.metadata["up"] = [0.0, 0.0, 1.0]
    path = tmp_path_factory.mktemp("ball") / "field.rfld"
    write_field(path, field)
    return path


@pytest.fixture
def lit_from(reflfield, ball, tmp_path):
    """Function: where the ball is brightest, (right, up) in [-1, 1], seen from +X.

    The map is bright around one image coordinate.
    """

    def brightest(u, v, *words):
        radiance = np.zeros((32, 64, 3), np.float32)
        rows, columns = np.indices((32, 64))
        across = np.abs((columns - u * 64 + 32) % 64 - 32)
        radiance[(np.abs(rows + 0.5 - v * 32) < 4) & (across < 4)] = 1.0
        write_exr(tmp_path / "sky.exr", radiance)
        outcome = reflfield(
            *("relight", ball, "-o", tmp_path / "out", "--orbit", "1", "--elevation", "0"),
            *(
                "--environment",
                tmp_path / "sky.exr",
                "--rays-per-pixel",
                "4",
                "--size",
                "48",
                *words,
            ),
        )
        assert outcome.status == 0, outcome.err
        picture = np.asarray(Image.open(tmp_path / "out/orbit_000.png"), np.float64).sum(axis=2)
        rows, columns = np.indices(picture.shape)
        total = picture.sum()
        right = (picture * (columns + 0.5)).sum() / total / 24 - 1
        up = 1 - (picture * (rows + 0.5)).sum() / total / 24
        return np.array([right, up])

    return brightest


# The centroid of a half that is lit from one side lies a quarter to a half of the radius off.
SIDE = 0.2


def test_the_zenith_of_a_map_lights_the_top_of_a_capture_with_z_up(lit_from):
    """The README's own line: a map with +Y up and a field with +Z up."""
    right, up = lit_from(0.3, 0.0)
    assert up > SIDE
    assert abs(right) < 0.05


def test_conventions_stand_as_documented_seen_from_plus_x(lit_from):
    """The camera at +X sees +Y to its right; -Y is the centre of an OpenEXR map there."""
    centre, opposite = lit_from(0.5, 0.5), lit_from(0.0, 0.5)
    assert centre[0] < -SIDE
    assert opposite[0] > SIDE
    # Blender's map: +Y is a quarter to the left of its centre.
    assert lit_from(0.25, 0.5, "--convention", "blender")[0] > SIDE
    assert np.abs([centre[1], opposite[1]]).max() < 0.05


def test_rotation_and_up_turn_the_map(lit_from):
    # To the left from above: the centre of the map goes from -Y to +X, to the camera.
    assert np.abs(lit_from(0.5, 0.5, "--environment-rotation", "90")).max() < 0.05
    assert lit_from(0.5, 0.5, "--environment-rotation", "180")[0] > SIDE
    # The zenith towards +Y, to the right, by name and by numbers; and down.
    assert lit_from(0.3, 0.0, "--environment-up", "Y")[0] > SIDE
    assert lit_from(0.3, 0.0, "--environment-up", "0,-2,0")[0] < -SIDE
    assert lit_from(0.3, 0.0, "--environment-up", "-z")[1] < -SIDE


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--environment-up", "up"), "--environment-up: expected X, Y, Z, -X"),
        (("--environment-up", "0,0,0"), "--environment-up: expected X, Y, Z, -X"),
        (("--environment-up", "nan,0,1"), "--environment-up: expected X, Y, Z, -X"),
        (("--environment-rotation", "inf"), "rotation of the map: expected a finite"),
    ],
)
def test_turns_that_are_none_are_refused(reflfield, ball, tmp_path, words, message):
    write_exr(tmp_path / "sky.exr", np.ones((4, 8, 3), np.float32))
    outcome = reflfield(
        *("relight", ball, "-o", tmp_path / "out", "--orbit", "1"),
        *("--environment", tmp_path / "sky.exr", *words),
    )
    assert outcome.status == 2
    assert message in outcome.err


@pytest.mark.parametrize(
    "words",
    [
        ("--orbit", "1", "--light", "0,0,1", "--environment-up", "Z"),
        ("--orbit", "1", "--light", "0,0,1", "--environment-rotation", "0"),
        ("--orbit", "1", "--light", "0,0,1", "--convention", "blender"),
        ("--capture", "unseen.json", "--size", "64"),
        ("--capture", "unseen.json", "--elevation", "10"),
    ],
)
def test_options_that_would_be_ignored_are_refused(reflfield, ball, tmp_path, words):
    outcome = reflfield("relight", ball, "-o", tmp_path / "out", *words)
    assert outcome.status == 2
    assert f"{words[-2]}: expected with" in outcome.err
