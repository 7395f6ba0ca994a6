"""Captures written in other formats mean the same when they are read again, or are refused."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reflfield.capture.conversion import convert_capture
from reflfield.capture.encoding import Encoding
from reflfield.capture.image_files import ImageReading
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.capture.lights import Light
from reflfield.capture.photographs import Exposure
from reflfield.capture.readers import open_capture
from reflfield.errors import InputError
from tests.capture.calibrations import assert_same_cameras, colmap_text, ring, write_photographs

FROZEN = Path(__file__).parents[1] / "data" / "capture_v1"


def assert_same(received, expected, *, reading=True):
    """Demand captures of the same photographs, cameras, lights and masks; ids may differ."""
    assert len(received.photographs) == len(expected.photographs)
    assert received.base_geometry == expected.base_geometry
    for i, (ours, theirs) in enumerate(
        zip(received.photographs, expected.photographs, strict=True)
    ):
        assert ours.path.read_bytes() == theirs.path.read_bytes()
        cameras = received.cameras[ours.camera], expected.cameras[theirs.camera]
        assert_same_cameras([cameras[0]], [cameras[1]], tolerance=1e-12)
        assert_same_light(received.lights[ours.light], expected.lights[theirs.light])
        if reading:
            np.testing.assert_array_equal(
                received.read_photograph(i), expected.read_photograph(i)
            )
        masks = received.silhouettes[ours.camera], expected.silhouettes[theirs.camera]
        assert (masks[0] is None) == (masks[1] is None)
        if masks[0] is not None:
            np.testing.assert_array_equal(
                received.read_silhouette(ours.camera), expected.read_silhouette(theirs.camera)
            )


def assert_same_light(received, expected):
    assert received.kind == expected.kind
    assert (received.convention, received.exponent) == (expected.convention, expected.exponent)
    for name in ("position", "direction", "intensity", "cone_angle", "falloff_angle"):
        values = getattr(received, name), getattr(expected, name)
        np.testing.assert_allclose(*values, rtol=4 * np.finfo(np.float64).eps)
    for ours, theirs in zip(received.members, expected.members, strict=True):
        assert_same_light(ours, theirs)


@pytest.fixture
def calibrated(tmp_path):
    """A COLMAP capture of four views and two lamps, with masks."""
    root = tmp_path / "calibrated"
    names = [f"v{i}_l0.png" for i in range(4)]
    write_photographs(root / "images", [*names, *(f"v{i}_l1.png" for i in range(4))])
    parameters = (30.0, 31.0, 8, 6, -0.1, 0.02, 0.003, 0.004)
    colmap_text(root / "sparse/0", ring(4), names, "OPENCV", parameters)
    (root / "lights.csv").write_text("name,x,y,z,r,g,b\nl0,1,0,2,.1,2,3\nl1,0,1,2,4,5,6\n")
    mask = np.zeros((12, 16), np.uint8)
    mask[3:8, 4:9] = 200
    for name in names:
        (root / "masks").mkdir(exist_ok=True)
        write_png(root / "masks" / f"{name}.png", mask)
    return open_capture(root)


@pytest.mark.parametrize("to", ["native", "transforms", "colmap"])
@pytest.mark.parametrize("link", [False, True])
def test_calibrated_views_under_lamps(calibrated, tmp_path, to, link):
    written = convert_capture(calibrated, tmp_path / "out", to, link=link)
    assert all(path.is_file() for path in written)
    again = open_capture(tmp_path / "out")
    assert again.format == to
    assert again.n_views == 4
    assert again.n_lights == 2
    assert_same(again, calibrated)
    linked = again.photographs[0].path.samefile(calibrated.photographs[0].path)
    assert linked == link


@pytest.mark.parametrize("between", ["transforms", "colmap"])
def test_back_to_native(calibrated, tmp_path, between):
    convert_capture(calibrated, tmp_path / "a", between)
    convert_capture(open_capture(tmp_path / "a"), tmp_path / "b")
    assert_same(open_capture(tmp_path / "b"), calibrated)


@pytest.mark.parametrize("to", ["native", "transforms", "colmap"])
@pytest.mark.parametrize(
    "lens",
    [
        {"distortion": (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)},
        {"distortion": (0.1, 0.2, 0.3, 0.4, 0.5)},
        {"kind": "opencv_fisheye", "distortion": (0.1, 0.2, 0, 0, 0.3, 0.4)},
        {},
    ],
)
def test_lenses(calibrated, tmp_path, to, lens):
    cameras = tuple(replace(camera, **lens) for camera in ring(4))
    capture = replace(calibrated, cameras=cameras)
    convert_capture(capture, tmp_path / "out", to)
    assert_same(open_capture(tmp_path / "out"), capture)


@pytest.mark.parametrize("to", ["native", "transforms", "colmap"])
def test_unknown_light(calibrated, tmp_path, to):
    photographs = calibrated.photographs[:4]
    capture = replace(calibrated, photographs=photographs, lights=(Light("l", "unknown"),))
    convert_capture(capture, tmp_path / "out", to)
    assert not (tmp_path / "out/lights.csv").exists()
    assert_same(open_capture(tmp_path / "out"), capture)


def test_frozen_capture_of_every_kind_of_light(tmp_path):
    capture = open_capture(FROZEN)
    convert_capture(capture, tmp_path / "out")
    again = open_capture(tmp_path / "out")
    assert_same(again, capture)
    assert [camera.id for camera in again.cameras] == [camera.id for camera in capture.cameras]
    assert again.up.tolist() == capture.up.tolist()


def test_distant_lights_in_a_colmap_model(calibrated, tmp_path):
    lights = tuple(
        Light(f"l{i}", "directional", direction=[0, i, 1], intensity=[1, 2, 3]) for i in (0, 1)
    )
    capture = replace(calibrated, lights=lights)
    convert_capture(capture, tmp_path / "out", "colmap")
    assert_same(open_capture(tmp_path / "out"), capture)


def test_environments_and_groups(calibrated, tmp_path):
    write_exr(tmp_path / "sky.exr", np.ones((2, 4, 3), np.float32))
    sky = Light("l0", "environment", file=tmp_path / "sky.exr", convention="blender")
    members = tuple(Light("l", "point", position=[0, i, 1.5]) for i in range(3))
    group = Light("l1", "group", members=members)
    capture = replace(calibrated, lights=(sky, group))
    convert_capture(capture, tmp_path / "a", "transforms")
    again = open_capture(tmp_path / "a")
    assert_same(again, capture)
    assert again.lights[0].file.read_bytes() == sky.file.read_bytes()
    convert_capture(replace(capture, lights=(sky, members[0])), tmp_path / "b")
    assert_same(open_capture(tmp_path / "b"), replace(capture, lights=(sky, members[0])))
    with pytest.raises(
        InputError, match=r"capture\.json can say, received one of kind 'group'"
    ):
        convert_capture(capture, tmp_path / "c")


@pytest.mark.parametrize(
    "reading",
    [
        ImageReading(encoding=Encoding("linear")),
        ImageReading(encoding=Encoding("gamma", gamma=2.2), white_level=250.0),
        ImageReading(encoding=Encoding("table", pairs=((0.1, 0.02), (0.7, 0.9)))),
    ],
)
def test_readings_that_the_files_do_not_say(calibrated, tmp_path, reading):
    capture = calibrated.read_as(reading)
    for to in ("native", "transforms"):
        convert_capture(capture, tmp_path / to, to)
        again = open_capture(tmp_path / to)
        assert again.photographs[0].exposures[0].reading == reading
        assert_same(again, capture)
    with pytest.raises(InputError, match=r"how they are encoded.*received encoding"):
        convert_capture(capture, tmp_path / "colmap", "colmap")


def test_bracketed_exposures(calibrated, tmp_path):
    first = calibrated.photographs[0]
    shots = (Exposure(first.path, 0.1), Exposure(calibrated.photographs[4].path, 0.4))
    capture = replace(calibrated, photographs=(replace(first, exposures=shots),))
    convert_capture(capture, tmp_path / "out")
    again = open_capture(tmp_path / "out")
    assert [e.seconds for e in again.photographs[0].exposures] == [0.1, 0.4]
    np.testing.assert_array_equal(again.read_photograph(0), capture.read_photograph(0))
    for to in ("transforms", "colmap"):
        with pytest.raises(InputError, match=r"expected one exposure.*received 2"):
            convert_capture(capture, tmp_path / to, to)


@pytest.mark.parametrize("to", ["transforms", "colmap"])
def test_what_the_target_cannot_say(calibrated, tmp_path, to):
    spot = Light("l0", "spot", position=[0, 0, 2], direction=[0, 0, -1])
    flat = replace(calibrated, base_geometry="plane")
    cameras = tuple(replace(c, kind="orthographic") for c in ring(4))
    for capture, reason in (
        (replace(calibrated, lights=(spot, calibrated.lights[1])), "kind 'spot'"),
        (flat, "base geometry 'hull' of 4 views, received 'plane'"),
        (replace(calibrated, cameras=cameras), "received an orthographic one"),
    ):
        with pytest.raises(InputError, match=reason) as caught:
            convert_capture(capture, tmp_path / "out", to)
        assert "`to='native'`" in str(caught.value)
        assert not (tmp_path / "out").exists()
    mixed = replace(calibrated, lights=(Light("l0", "directional"), calibrated.lights[1]))
    with pytest.raises(InputError, match="can say, received one of kind"):
        convert_capture(mixed, tmp_path / "out", to)


def test_folders_that_are_not_empty(calibrated, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine.txt").write_text("kept")
    with pytest.raises(InputError, match="new or empty folder"):
        convert_capture(calibrated, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine.txt"]
    with pytest.raises(InputError, match="to: expected native, transforms, colmap"):
        convert_capture(calibrated, tmp_path / "other", "xml")


def test_ids_that_the_native_format_does_not_allow(calibrated, tmp_path):
    cameras = tuple(replace(c, id=f"view {i}") for i, c in enumerate(calibrated.cameras))
    capture = replace(calibrated, cameras=cameras)
    convert_capture(capture, tmp_path / "out")
    assert_same(open_capture(tmp_path / "out"), capture)


def test_masks_that_are_no_png(calibrated, tmp_path):
    mask = calibrated.read_silhouette(0)
    write_exr(tmp_path / "m.exr", mask.astype(np.float32))
    capture = replace(calibrated, silhouettes=(tmp_path / "m.exr", None, None, None))
    convert_capture(capture, tmp_path / "out", "colmap")
    again = open_capture(tmp_path / "out")
    assert [path is not None for path in again.silhouettes] == [True, False, False, False]
    np.testing.assert_array_equal(again.read_silhouette(0), mask)


@pytest.mark.parametrize(
    ("name", "to", "most"),
    [
        ("mia_guanyu_flash/guan-yu-replicability.vset", "native", 4),
        ("uw_photometric_stereo/cat", "native", 12),
        ("ethiopian_head_masks", "colmap", 6),
    ],
)
def test_real_sets(shared_data, tmp_path, name, to, most):
    folder, _, rest = name.partition("/")
    capture = open_capture(shared_data(folder) / rest)
    capture = replace(capture, photographs=capture.photographs[:most])
    capture = capture.subset(sorted({p.camera for p in capture.photographs}),
                             sorted({p.light for p in capture.photographs}))  # fmt: skip
    convert_capture(capture, tmp_path / "out", to)
    assert_same(open_capture(tmp_path / "out"), capture, reading=False)
    if to == "native":
        document = json.loads((tmp_path / "out/capture.json").read_text())
        assert document["photographs"][0].get("encoding") in ("linear", "encoding.csv")
