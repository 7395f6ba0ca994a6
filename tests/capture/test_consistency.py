"""Photographs, cameras and lights that do not fit together."""

import json
import shutil
from pathlib import Path

import pytest

from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError
from reflfield.pipeline.stages import run

FROZEN = Path(__file__).parents[1] / "data" / "capture_v1"


@pytest.fixture
def opened(tmp_path):
    """Function that changes the frozen capture of 2 cameras and 3 lights and opens it."""
    folder = tmp_path / "frozen"
    shutil.copytree(FROZEN, folder)

    def change(edit, **options):
        document = json.loads((FROZEN / "capture.json").read_text())
        document["photographs"] = [
            {"camera": c, "light": light, "file": f"photographs/{c}_{light}.exr"}
            for c in ("v000", "v001")
            for light in ("l000", "l001", "l002")
        ]
        edit(document)
        (folder / "capture.json").write_text(json.dumps(document))
        return open_capture(folder, **options)

    return change


@pytest.mark.parametrize("light", [0, 1, 2])
def test_a_light_that_gives_none(opened, light):
    def darken(document):
        entry = document["lights"][light]
        entry["irradiance" if light == 1 else "intensity"] = [0, 0, 0]

    name = f"l00{light}"
    with pytest.raises(CaptureError, match=rf"'{name}' of photograph 'v000_{name}'.*above 0"):
        opened(darken)
    assert opened(darken, require_photographs=False).n_lights == 3


def test_all_lights_dark(opened):
    def darken(document):
        document["lights"] = [
            {"id": f"l00{i}", "type": "point", "position": [0, 0, 1], "intensity": [0] * 3}
            for i in range(3)
        ]

    with pytest.raises(CaptureError, match=r"capture\.json: light 'l000'.*intensity above 0"):
        opened(darken)


def test_a_field_is_not_made_of_photographs_under_an_environment(opened):
    def add_sky(document):
        document["lights"][0] = {
            "id": "l000",
            "type": "environment",
            "file": "silhouettes/v000.png",
        }

    capture = opened(add_sky)
    with pytest.raises(CaptureError, match=r"'v000_l000': expected one point.*'l000'"):
        run(capture, capture.root / "out")
    assert not (capture.root / "out").exists()


def test_one_channel_of_light_is_light(opened):
    capture = opened(lambda d: d["lights"][0].update(intensity=[0, 1, 0]))
    assert capture.lights[0].shines


def test_an_unknown_light_among_known_ones(opened):
    def forget(document):
        document["lights"][1] = {"id": "l001", "type": "unknown"}

    with pytest.raises(CaptureError, match=r"'l001' of photograph 'v000_l001'.*'unknown'"):
        opened(forget)


def test_several_photographs_under_a_light_that_nobody_measured(opened):
    def forget(document):
        document["lights"] = [{"id": "sky", "type": "unknown"}]
        for photograph in document["photographs"]:
            photograph["light"] = "sky"

    with pytest.raises(CaptureError, match=r"light positions are missing.*'v000' has 3 photo"):
        opened(forget)


def test_cameras_and_lights_without_photographs_are_noted(opened, caplog):
    def thin(document):
        document["photographs"] = document["photographs"][:2]

    capture = opened(thin)
    assert capture.notes == (
        f"{capture.description}: no photograph for camera v001 (1 of 2)",
        f"{capture.description}: no photograph for light l002 (1 of 3)",
    )
    assert caplog.messages == list(capture.notes)


@pytest.mark.parametrize("key", ["k1", "fl_x", "position", "exponent", "file"])
def test_keys_of_cameras_and_lights_at_the_top(opened, key):
    with pytest.raises(CaptureError, match=rf"capture\.json: {key}: expected within a camera"):
        opened(lambda document: document.update({key: 1}))


@pytest.mark.parametrize("key", ["scale", "unit", "coordinate_system", "gamma", "linear"])
def test_keys_at_the_top_that_nothing_would_apply(opened, key):
    with pytest.raises(CaptureError, match=rf"capture\.json: {key}: expected no such key"):
        opened(lambda document: document.update({key: 2.0}))


def test_other_keys_at_the_top_are_noted(opened):
    capture = opened(lambda document: document.update(owner="me", mood=1))
    assert capture.notes == (f"{capture.description}: not used: 'mood', 'owner'",)


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (lambda d: d.update(name="a\nb"), r"name: .*control characters, received 'a\\nb'"),
        (lambda d: d.update(name="\ud800x"), r"name: .*received '\\ud800x'"),
        (lambda d: d["cameras"][0].update(id="a\nb"), r"cameras\[0\]\.id"),
        (lambda d: d["cameras"][0].update(w=8.5), r"cameras\[0\]\.w"),
        (lambda d: d["cameras"][0].update(w=70_000), r"cameras\[0\]\.w"),
        (lambda d: d["cameras"][0].update(w=True), r"cameras\[0\]\.w"),
        (lambda d: d["cameras"][0].update(fl_x=1e300), "camera 'v000'.*at most 1e.12"),
        (lambda d: d["cameras"][0].update(b1=0.5), r"cameras\[0\].*'b1'"),
        (
            lambda d: d["cameras"][0]["camera_from_world"][0].__setitem__(3, 1e308),
            r"capture\.json: camera 'v000': camera_from_world: .*numbers beyond 1e.12",
        ),
        (
            lambda d: d["cameras"][0].update(model="orthographic", k1=0.1),
            "camera 'v000': expected an orthographic camera without distortion",
        ),
        (
            lambda d: d["cameras"][0].update(model="opencv_fisheye", p1=0.1),
            "camera 'v000': p1: expected 0, since a fisheye",
        ),
        (lambda d: d["lights"][0].update(position=[0, 0, 1e308]), "light 'l000': position"),
        (lambda d: d["lights"][0].update(intensity=[1e30] * 3), "light 'l000': intensity"),
        (lambda d: d["lights"][0].update(position=["1", 2, 3]), r"lights\[0\]"),
        (lambda d: d.update(up=[0, 0, 0]), "up: expected a direction that is not zero"),
        (lambda d: d.update(up=[0, 0, 1e300]), "up: "),
        (
            lambda d: d.update(photographs={"pattern": "{camera}{light}"},
                               cameras=d["cameras"] * 400, lights=d["lights"] * 400),
            "at most 100,000 photographs, received 960,000",
        ),
    ],
)  # fmt: skip
def test_numbers_and_names_that_cannot_be(opened, edit, reason):
    with pytest.raises(CaptureError, match=reason) as caught:
        opened(edit)
    assert str(caught.value).isprintable()


def test_a_whole_number_may_have_a_point(opened):
    camera = opened(lambda d: d["cameras"][0].update(w=8.0)).cameras[0]
    assert camera.width == 8
    assert isinstance(camera.width, int)
