"""``--max-memory`` of relight and compare: what would not fit is refused before it is begun."""

import json

import numpy as np
import pytest

from reflfield.capture.image_writing import write_exr
from reflfield.field.file import write_field
from reflfield.options import Resources
from reflfield.pipeline.memory import check_image_memory
from reflfield.render.renderer import RenderOptions
from tests.synthetic_fields import baked_field, lambert, sphere_surface

GB = 1 << 30


@pytest.fixture(scope="module")
def ball():
    return baked_field(sphere_surface(16), lambert(0.8), visibility="factored", light_side=5)


@pytest.fixture(scope="module")
def ball_file(ball, tmp_path_factory):
    path = tmp_path_factory.mktemp("ball") / "field.rfld"
    write_field(path, ball)
    return path


def unphotographed(folder, width):
    """One view without a photograph, square, in front of the ball."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 5.0
    camera = {"w": width, "h": width, "fl_x": width, "fl_y": width, "cx": width / 2,
              "cy": width / 2, "model": "opencv", "id": "a"}  # fmt: skip
    document = {
        "format": "reflfield-capture",
        "version": 1,
        "cameras": [{**camera, "camera_from_world": pose.tolist()}],
        "lights": [{"id": "l", "type": "directional", "direction": [0, 0, 1],
                    "irradiance": [1, 1, 1]}],
        "photographs": [{"camera": "a", "light": "l", "file": "a.exr"}],
    }  # fmt: skip
    folder.mkdir()
    (folder / "capture.json").write_text(json.dumps(document))
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ("--orbit", "3600", "--light", "0,0,1", "--size", "4000"),
        ("--orbit", "1", "--light", "0,0,1", "--size", "16000"),
    ],
)
def test_turntables_beyond_the_ceiling_are_refused(reflfield, ball_file, tmp_path, words):
    outcome = reflfield("relight", ball_file, "-o", tmp_path / "out", *words)
    assert outcome.status == 2
    assert "--max-memory: expected at least" in outcome.err
    assert "received 4.0 GB; raise it" in outcome.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("command", "width"), [("relight", 9000), ("compare", 5000)])
def test_frames_beyond_the_ceiling_are_refused(
    reflfield, ball_file, tmp_path, command, width, rng
):
    """64 bytes for a pixel to relight, 88 to compare."""
    where = unphotographed(tmp_path / "views", width)
    if command == "compare":
        picture = np.zeros((width, width, 1), np.float32)
        picture[:200] = rng.random((200, width, 1))
        write_exr(where / "a.exr", picture, names=["Y"])
    words = ("--capture", where) if command == "relight" else (where,)
    limit = ("--max-memory", "2GB", "--rays-per-pixel", "1")
    outcome = reflfield(command, ball_file, *words, "-o", tmp_path / "out", *limit)
    assert outcome.status == 2, outcome
    assert "--max-memory: expected at least" in outcome.err
    assert f"images of {width**2} pixels, received 2.0 GB" in outcome.err


def test_what_would_suffice_does(ball):
    """The number of the message is enough, and a tenth less is not."""
    options = RenderOptions(workers=2, samples_per_pixel=4)
    picture = {"pixels": 9000**2, "map_pixels": 8192 * 4096}
    with pytest.raises(Exception, match=r"at least \d+\.\d GB") as refused:
        check_image_memory(ball, Resources(2, GB), options, **picture)
    enough = float(str(refused.value).split("at least ")[1].split(" GB")[0])
    # Blocks grow with the ceiling up to 4096 pixels each.
    blocks = 2 * 4096 * 4096 * 4
    check_image_memory(ball, Resources(2, int(enough * GB) + blocks), options, **picture)
    with pytest.raises(Exception, match="max_memory"):
        check_image_memory(ball, Resources(2, int(0.9 * enough * GB)), options, **picture)


def test_a_ceiling_of_a_gigabyte_is_enough_for_small_pictures(reflfield, ball_file, tmp_path):
    outcome = reflfield(
        *("relight", ball_file, "-o", tmp_path / "out", "--orbit", "2", "--size", "40"),
        *("--light", "0,0,1", "--max-memory", "1GB", "--workers", "2"),
    )
    assert outcome.status == 0, outcome.err
