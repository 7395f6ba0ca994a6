"""Dark frames are subtracted from photographs, in linear values, before anything reads them."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reflfield.calibration.corrected_photographs import with_colors_corrected
from reflfield.capture.clipping import BLACK, MEASURED, SATURATED, TRANSPARENT
from reflfield.capture.conversion import convert_capture
from reflfield.capture.encoding import Encoding, encode_srgb
from reflfield.capture.image_files import ImageReading, read_image
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.capture.inspect import describe
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError, InputError
from reflfield.pipeline.relight_command import check_kept

WIDTH, HEIGHT = 16, 12
# Half a step of 8 bits, 1/510, by sRGB's slope: 2.0 at 0.8 (photographs), 1.13 at 0.3 (dark).
STEPS = 3.15 / 510
NAMES = [f"v{view}_l{light}" for view in (0, 1) for light in (0, 1)]


@pytest.fixture
def lamp(rng):
    """Light of the lamp alone, (4, h, w, 3) float32."""
    return rng.uniform(0.2, 0.5, (4, HEIGHT, WIDTH, 3)).astype(np.float32)


@pytest.fixture
def room(rng):
    """Light of the room in each view, (2, h, w, 3) float32."""
    return rng.uniform(0.05, 0.3, (2, HEIGHT, WIDTH, 3)).astype(np.float32)


def camera(number, **more):
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = 0, 0.01 * number, 2
    size = {"w": WIDTH, "h": HEIGHT, "fl_x": 20, "fl_y": 20, "cx": 8, "cy": 6}
    return {"id": f"v{number}", **size, "camera_from_world": pose.tolist(), **more}


def light(number):
    return {"id": f"l{number}", "type": "point", "position": [number, 0, 2],
            "intensity": [1, 1, 1]}  # fmt: skip


def describe_in(folder, change=lambda document: None):
    """Write a description of photographs in a folder; open it."""
    document = {
        "format": "reflfield-capture",
        "version": 1,
        "base_geometry": "hull",
        "cameras": [camera(0, dark="dark0.png"), camera(1, dark="dark1.png")],
        "lights": [light(0), light(1)],
        "photographs": [
            {"camera": name[:2], "light": name[3:], "file": f"{name}.png"} for name in NAMES
        ],
    }
    change(document)
    (folder / "capture.json").write_text(json.dumps(document))
    return open_capture(folder)


def write_encoded(path, radiance):
    write_png(path, np.rint(255 * encode_srgb(np.clip(radiance, 0, 1))).astype(np.uint8))


@pytest.fixture
def lit_room(tmp_path, lamp, room):
    """A folder of photographs in a lit room, and of the room alone; sRGB of 8 bits."""
    folder = tmp_path / "lit"
    folder.mkdir()
    for view in (0, 1):
        write_encoded(folder / f"dark{view}.png", room[view])
    for i, name in enumerate(NAMES):
        write_encoded(folder / f"{name}.png", lamp[i] + room[i // 2])
    return folder


def assert_lamp(capture, lamp):
    """Demand the light of the lamp, to the steps of 8 bits in sRGB."""
    for i in range(len(capture.photographs)):
        image, kinds = capture.read_kinds(i)
        np.testing.assert_array_equal(image, capture.read_photograph(i))
        np.testing.assert_allclose(image, lamp[i], rtol=0, atol=STEPS)
        assert (kinds == MEASURED).all()


def test_the_light_of_the_room_is_subtracted(lit_room, lamp):
    capture = describe_in(lit_room)
    assert_lamp(capture, lamp)
    assert "2 dark frames, subtracted from 4 photographs" in describe(capture).details


def test_the_nearest_dark_frame_counts(lit_room, lamp, room):
    """That of a photograph before that of its camera, before that of all."""
    (lit_room / "dark0.png").rename(lit_room / "all.png")
    write_encoded(lit_room / "own.png", room[1] + 0.1)
    write_encoded(lit_room / f"{NAMES[3]}.png", lamp[3] + room[1] + 0.1)

    def change(document):
        del document["cameras"][0]["dark"]
        document["dark"] = "all.png"
        document["photographs"][3]["dark"] = {"file": "own.png"}

    assert_lamp(describe_in(lit_room, change), lamp)


@pytest.mark.parametrize("is_integer", [True, False])
def test_nothing_is_negative_and_what_is_lost_is_no_measurement(lit_room, is_integer, rounding):
    suffix = "png" if is_integer else "exr"
    photograph = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    dark = np.linspace(0.1, 0.2, photograph.size, dtype=np.float32).reshape(photograph.shape)
    photograph[0, 0], dark[0, 0] = 0.1, 0.3  # darker than without the lamp
    photograph[1, 1], dark[1, 1] = 0.5 if is_integer else 1.5, 1  # a hot pixel
    photograph[2, 2], dark[2, 2] = 1, 0.25  # a highlight
    photograph[3, 3] = dark[3, 3] = 0.2
    for name, image in (("a", photograph), ("d", dark)):
        if is_integer:
            write_png(lit_room / f"{name}.png", np.rint(65535 * image).astype(np.uint16))
        else:
            write_exr(lit_room / f"{name}.exr", image)
    encoding = "linear" if is_integer else None

    def change(document):
        stated = {"encoding": encoding} if encoding else {"white_level": 0.99}
        document["cameras"][0]["dark"] = f"d.{suffix}"
        document["photographs"][0] |= {"file": f"a.{suffix}", **stated}
        document["photographs"][1] |= {"dark": "dark0.png"}

    image, kinds = describe_in(lit_room, change).read_kinds(0)
    assert (image >= 0).all()
    assert (image[0, 0] == 0).all()
    assert (kinds[0, 0] == BLACK).all()
    assert (image[1, 1] == 0).all()
    assert (kinds[1, 1] == SATURATED).all()
    steps = 1 / 65535 + rounding(np.float32)  # half a step of 16 bits of each
    np.testing.assert_allclose(image[2, 2], 0.75, rtol=0, atol=steps)
    assert (kinds[2, 2] == SATURATED).all()
    # In integers equal codes say that what is left is less than a code.
    assert (kinds[3, 3] == (BLACK if is_integer else MEASURED)).all()
    rest = np.ones((HEIGHT, WIDTH), bool)
    rest[range(4), range(4)] = False
    assert (kinds[rest] == MEASURED).all()
    np.testing.assert_allclose(image[rest], 0.5 - dark[rest], rtol=0, atol=steps)


def test_bracketed_exposures_and_the_dark_frame_of_another_time(lit_room, lamp, room):
    for seconds in (0.5, 2.0):
        write_encoded(lit_room / f"a{seconds}.png", seconds * (lamp[0] + room[0]))
    write_encoded(lit_room / "dark.png", 3 * room[0])

    def change(document):
        exposures = [{"file": f"a{s}.png", "seconds": s} for s in (0.5, 2.0)]
        document["photographs"] = [
            {"camera": "v0", "light": "l0", "exposures": exposures,
             "dark": {"file": "dark.png", "seconds": 3}},
            *document["photographs"][1:],
        ]  # fmt: skip

    image, kinds = describe_in(lit_room, change).read_kinds(0)
    measured = kinds == MEASURED
    assert measured.mean() > 0.9
    # slopes of 1.33 at 0.4 in half a second, and of 2.13 at 0.9 in three
    steps = (1.33 / 0.5 + 2.13 / 3) / 510
    np.testing.assert_allclose(image[measured], lamp[0][measured], rtol=0, atol=steps)


def test_what_alpha_hides_is_not_subtracted(lit_room, lamp, room):
    """A photograph with alpha was multiplied by it: its dark frame is, too."""
    alpha = np.ones((HEIGHT, WIDTH, 1), np.float32)
    alpha[:3], alpha[3:6] = 0, 0.5
    codes = encode_srgb(np.dstack([lamp[0] + room[0]]))
    rgba = np.rint(255 * np.dstack([codes, alpha])).astype(np.uint8)
    write_png(lit_room / f"{NAMES[0]}.png", rgba)
    image, kinds = describe_in(lit_room).read_kinds(0)
    np.testing.assert_allclose(image, lamp[0] * alpha, rtol=0, atol=STEPS)
    assert (kinds[:3] == TRANSPARENT).all()


def test_silhouettes_are_made_of_what_is_left(tmp_path):
    """Before a wall that only the room lights, unevenly, the lamp shows the object alone."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    inside = (abs(x - 7.5) < 4) & (abs(y - 5.5) < 3)
    wall = 0.4 + 0.3 * np.sin(x) * np.cos(y)
    room_light = np.repeat(wall[..., None], 3, axis=2).astype(np.float32)
    write_exr(tmp_path / "dark.exr", room_light)
    for name in NAMES:
        write_exr(tmp_path / f"{name}.exr", room_light + inside[..., None] * np.float32(0.2))

    def change(document):
        document["dark"] = "dark.exr"
        for entry in document["cameras"]:
            del entry["dark"]
        for entry in document["photographs"]:
            entry["file"] = entry["file"].replace("png", "exr")

    capture = describe_in(tmp_path, change)
    np.testing.assert_array_equal(capture.read_silhouette(0) > 0.5, inside)


def exposed(document):
    document["photographs"][0].pop("file")
    document["photographs"][0]["exposures"] = [{"file": f"{NAMES[0]}.png", "seconds": 0.5}]


def timed(document):
    document["cameras"][0]["dark"] = {"file": "dark0.png", "seconds": 0.5}


def of_first_camera(dark):
    return lambda document: document["cameras"][0].update(dark=dark)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (exposed, "expected an exposure time, 'seconds'"),
        (timed, "expected no exposure time"),
        (of_first_camera("none.png"), "none.png: dark frame of camera 'v0' missing"),
        (of_first_camera("small.png"), "small.png: dark frame: image size"),
        (of_first_camera(f"{NAMES[3]}.png"), "a file that is a photograph"),
        (of_first_camera("../dark0.png"), "dark0.png"),
        (of_first_camera({"seconds": 1}), "cameras[0].dark"),
        (lambda document: document["lights"][0].update(dark="dark0.png"), "lights[0]"),
    ],
)
def test_contradictions_are_refused(lit_room, change, words):
    write_png(lit_room / "small.png", np.zeros((4, 5, 3), np.uint8))
    with pytest.raises(CaptureError) as raised:
        describe_in(lit_room, change)
    assert words in str(raised.value)


@pytest.mark.parametrize("kind", ["floats", "linear"])
def test_dark_frames_of_other_numbers_are_refused(lit_room, room, kind):
    """Values of an EXR may have any unit; a linear file was not developed as an sRGB one."""
    if kind == "floats":
        write_exr(lit_room / "other.exr", room[0])
        dark = "other.exr"
    else:
        dark = {"file": "dark0.png", "encoding": "linear"}
    capture = describe_in(lit_room, lambda d: d["cameras"][0].update(dark=dark))
    with pytest.raises(CaptureError, match=r"dark frame: expected integers \(encoding srgb\)"):
        capture.read_photograph(0)


def test_a_dark_frame_is_read_as_a_run_says(lit_room):
    """``--encoding`` is for all files."""
    reading = ImageReading(encoding=Encoding("linear"))
    capture = describe_in(lit_room).read_as(reading)
    values = [read_image(lit_room / name, reading) for name in (f"{NAMES[0]}.png", "dark0.png")]
    np.testing.assert_array_equal(capture.read_photograph(0), values[0] - values[1])


def test_the_digest_depends_on_dark_frames(lit_room, room):
    capture = describe_in(lit_room)
    parts = "photographs", "silhouettes"
    before = {part: capture.digest([part]) for part in parts}
    write_encoded(lit_room / "dark1.png", room[1] + 0.01)
    changed = {part: capture.digest([part]) for part in parts}
    photographs = tuple(replace(p, dark=None) for p in capture.photographs)
    without = {part: replace(capture, photographs=photographs).digest([part]) for part in parts}
    for part in parts:
        assert len({before[part], changed[part], without[part]}) == 3
    cameras = ["cameras", "lights"]
    assert capture.digest(cameras) == replace(capture, photographs=photographs).digest(cameras)


def test_a_dark_frame_that_is_replaced_is_read_again(lit_room, lamp, room):
    capture = describe_in(lit_room)
    capture.read_photograph(0)
    (lit_room / "dark0.png").unlink()
    write_encoded(lit_room / "dark0.png", 0 * room[0])
    np.testing.assert_allclose(capture.read_photograph(0), lamp[0] + room[0], 0, STEPS)


@pytest.mark.parametrize("with_times", [True, False])
def test_converted_captures_keep_their_dark_frames(lit_room, tmp_path, with_times):
    def change(document):
        for entry in document["photographs"] if with_times else []:
            file = entry.pop("file")
            entry["exposures"] = [{"file": file, "seconds": 1.0}]
            entry["dark"] = {"file": f"dark{entry['camera'][1]}.png", "seconds": 4}

    capture = describe_in(lit_room, change)
    convert_capture(capture, tmp_path / "out", "native")
    again = open_capture(tmp_path / "out")
    for i in range(4):
        np.testing.assert_array_equal(again.read_photograph(i), capture.read_photograph(i))
    assert len(list((tmp_path / "out/dark").iterdir())) == 2
    for other in ("transforms", "colmap"):
        with pytest.raises(InputError, match="expected no dark frame"):
            convert_capture(capture, tmp_path / other, other)


@pytest.mark.parametrize("name", ["dark", "cup_ambient", "Dark"])
@pytest.mark.parametrize("listed", ["light_directions.txt", "lights.lp", "filenames.txt"])
def test_sets_of_one_view_with_a_dark_frame_beside(tmp_path, lamp, room, name, listed):
    names = [f"a{i}.png" for i in range(4)]
    for i, file in enumerate(names):
        write_png(tmp_path / file, np.rint(65535 * (lamp[i] + room[0])).astype(np.uint16))
    write_png(tmp_path / f"{name}.png", np.rint(65535 * room[0]).astype(np.uint16))
    write_png(tmp_path / "dark_preview.png", np.zeros((2, 2, 3), np.uint8))
    directions = ["0.6 0 0.8", "0 0.6 0.8", "-0.6 0 0.8", "0 0 1"]
    if listed.endswith(".lp"):
        rows = [f"{file} {row}" for file, row in zip(names, directions, strict=True)]
        (tmp_path / listed).write_text("\n".join(["4", *rows]))
    else:
        (tmp_path / "light_directions.txt").write_text("\n".join(directions))
    if listed == "filenames.txt":
        (tmp_path / listed).write_text("\n".join(names))
    capture = open_capture(tmp_path)
    assert [p.dark.path.name for p in capture.photographs] == 4 * [f"{name}.png"]
    assert any("dark frame" in detail for detail in capture.details)
    if not listed.endswith(".lp"):  # whose files are sRGB unless they say otherwise
        np.testing.assert_allclose(capture.read_photograph(2), lamp[2], atol=1e-4)
    # Of several none is subtracted, which is said.
    shutil.copy(tmp_path / f"{name}.png", tmp_path / "ambient_2.png")
    several = open_capture(tmp_path)
    assert {p.dark for p in several.photographs} == {None}
    assert any("not subtracted" in note for note in several.notes)


def test_corrected_photographs_are_without_what_is_dark(lit_room, lamp, tmp_path):
    corrected = with_colors_corrected(describe_in(lit_room), np.eye(3), tmp_path)
    assert_lamp(corrected, lamp)


def test_files_that_are_read_are_not_replaced(lit_room):
    with pytest.raises(InputError, match="no file of the capture"):
        check_kept(describe_in(lit_room), [Path(lit_room / "dark0.png")])
