"""COLMAP's models: text, binary, lenses, folders, masks; and everything that can be wrong."""

import shutil
import struct

import numpy as np
import pytest

from reflfield.capture.colmap_model import MODELS
from reflfield.capture.image_writing import write_png
from reflfield.capture.inspect import describe
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError
from tests.capture.calibrations import (
    assert_same_cameras,
    colmap_binary,
    colmap_text,
    quaternion,
    ring,
    write_photographs,
)

NAMES = [f"v{i:02d} top.png" for i in range(5)]


@pytest.fixture
def workspace(tmp_path):
    """Photographs of five views; `sparse/0` is left to be written."""
    write_photographs(tmp_path / "images", NAMES)
    return tmp_path


@pytest.mark.parametrize("write", [colmap_text, colmap_binary])
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_cameras_and_photographs(workspace, write, place):
    cameras = ring()
    write(workspace / place, cameras, NAMES)
    capture = open_capture(workspace)
    assert_same_cameras(capture.cameras, cameras)
    assert capture.format == "colmap"
    assert [p.name for p in capture.photographs] == [name[:-4] for name in NAMES]
    assert [light.kind for light in capture.lights] == ["unknown"]
    text = "\n".join(describe(capture).lines())
    assert "5 images, lenses: 1 PINHOLE" in text
    assert f"photographs in {workspace / 'images'}" in text


def test_model_file_and_model_folder_find_photographs_above(workspace):
    model = colmap_binary(workspace / "sparse" / "0", ring(), NAMES)
    for path in (model, model / "cameras.bin"):
        assert len(open_capture(path).photographs) == 5


def test_binary_counts_before_text(workspace):
    model = workspace / "sparse" / "0"
    colmap_text(model, ring(fl_x=50.0), NAMES)
    colmap_binary(model, ring(), NAMES)
    assert open_capture(workspace).cameras[0].fl_x == 30


def test_images_without_points_at_the_end_of_the_file(workspace):
    model = colmap_text(workspace / "sparse", ring(), NAMES)
    path = model / "images.txt"
    path.write_text(path.read_text().rstrip())
    assert len(open_capture(workspace).cameras) == 5


LENSES = {
    "SIMPLE_PINHOLE": ((30.0, 8, 6), ()),
    "PINHOLE": ((30.0, 31.0, 8, 6), ()),
    "SIMPLE_RADIAL": ((30.0, 8, 6, -0.1), (-0.1,)),
    "RADIAL": ((30.0, 8, 6, -0.1, 0.02), (-0.1, 0.02)),
    "OPENCV": ((30.0, 31.0, 8, 6, -0.1, 0.02, 0.003, 0.004), (-0.1, 0.02, 0.003, 0.004)),
    "OPENCV_FISHEYE": ((30.0, 31.0, 8, 6, 0.1, 0.2, 0.03, 0.04), (0.1, 0.2, 0, 0, 0.03, 0.04)),
    "FULL_OPENCV": ((30.0, 31.0, 8, 6, *np.arange(1, 9) / 100), tuple(np.arange(1, 9) / 100)),
}  # fmt: skip


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("model", LENSES)
def test_lenses(workspace, model, binary):
    parameters, distortion = LENSES[model]
    number = next(n for n, (name, _) in MODELS.items() if name == model)
    if binary:
        colmap_binary(workspace, ring(), NAMES, number, parameters)
    else:
        colmap_text(workspace, ring(), NAMES, model, parameters)
    camera = open_capture(workspace).cameras[0]
    assert camera.kind == ("opencv_fisheye" if model == "OPENCV_FISHEYE" else "opencv")
    assert camera.distortion == (*distortion, *(0,) * (8 - len(distortion)))
    single = MODELS[number][1][0] == "f"
    assert (camera.fl_x, camera.fl_y, camera.cx, camera.cy) == (30, 30 if single else 31, 8, 6)


@pytest.mark.parametrize("number", [n for n, (_, known) in MODELS.items() if known is None])
def test_other_lenses_are_refused_by_name(workspace, number):
    name = MODELS[number][0]
    colmap_binary(workspace, ring(), NAMES, number, (1.0,) * 5)
    with pytest.raises(CaptureError, match=f"SIMPLE_PINHOLE.*received '{name}'.*undistort"):
        open_capture(workspace)
    (workspace / "cameras.bin").unlink()
    (workspace / "images.bin").unlink()
    colmap_text(workspace, ring(), NAMES, name, (1.0,) * 5)
    with pytest.raises(CaptureError, match=f"received '{name}'"):
        open_capture(workspace)


def test_masks_as_colmap_names_them(workspace):
    colmap_binary(workspace / "sparse/0", ring(), NAMES)
    mask = np.zeros((12, 16), np.uint8)
    mask[3:6, 3:6] = 255
    (workspace / "masks").mkdir()
    for name in (f"{NAMES[0]}.png", NAMES[1]):  # COLMAP's naming, and that of others
        write_png(workspace / "masks" / name, mask)
    capture = open_capture(workspace)
    assert [path is not None for path in capture.silhouettes] == [
        True,
        True,
        False,
        False,
        False,
    ]
    assert capture.read_silhouette(0).sum() == 9
    assert any("no mask for 3 of 5 cameras" in note for note in capture.notes)


@pytest.mark.parametrize("name", ["mask", "Silhouettes", "alpha"])
def test_a_folder_that_is_not_called_masks_is_spoken_of(workspace, name):
    colmap_text(workspace / "sparse/0", ring(), NAMES)
    (workspace / name).mkdir()
    (note,) = open_capture(workspace).notes
    assert f"and {name} beside the photographs is not read; rename it to 'masks'" in note
    (workspace / "masks").symlink_to("masks")
    with pytest.raises(CaptureError, match=r"masks: expected a folder of masks, received a"):
        open_capture(workspace)


def test_masks_of_which_none_fits_are_refused(workspace):
    colmap_binary(workspace / "sparse/0", ring(), NAMES)
    write_photographs(workspace / "masks", ["mask_1.png"])
    with pytest.raises(CaptureError, match=r"masks: expected masks.*a\.jpg\.png.*rename"):
        open_capture(workspace)


def test_images_of_one_pose_are_one_camera(workspace):
    cameras = ring()
    colmap_text(workspace, [*cameras, cameras[0]], [*NAMES, "again.png"])
    write_photographs(workspace / "images", ["again.png"])
    with pytest.raises(CaptureError, match=r"light positions are missing.*lights\.csv"):
        open_capture(workspace)


def test_photographs_that_are_absent_are_counted(workspace):
    colmap_binary(workspace / "sparse/0", ring(), NAMES)
    (workspace / "images" / NAMES[3]).unlink()
    capture = open_capture(workspace)
    assert len(capture.photographs) == len(capture.cameras) == 4
    assert any("4 of 5 photographs are there" in note for note in capture.notes)
    assert any(NAMES[3] in note for note in capture.notes)
    for name in NAMES:
        (workspace / "images" / name).unlink(missing_ok=True)
    with pytest.raises(CaptureError, match=r"photograph missing \(5 of 5 files are\)"):
        open_capture(workspace)
    assert len(open_capture(workspace, require_photographs=False).cameras) == 5


def test_reduced_photographs_scale_the_lens(workspace):
    cameras = ring(fl_x=60.0, fl_y=62.0, cx=17.0, cy=11.0)
    colmap_text(workspace, cameras, NAMES)
    path = workspace / "cameras.txt"
    path.write_text(path.read_text().replace(" 16 12 ", " 32 24 "))
    capture = open_capture(workspace)
    assert_same_cameras(capture.cameras, ring())
    assert any("scaled from 32 x 24" in detail for detail in capture.details)


@pytest.mark.parametrize("size", [(16, 12), (12, 13), (12, 20)])
def test_photographs_turned_or_cropped_are_refused(workspace, size):
    colmap_binary(workspace, ring(), NAMES)
    write_photographs(workspace / "images", NAMES, size)
    with pytest.raises(CaptureError, match=r"expected 16 x 12 pixels as calibrated.*turned"):
        open_capture(workspace)


def test_no_folder_of_photographs(tmp_path):
    model = colmap_binary(tmp_path / "a" / "b" / "c" / "d", ring(), NAMES)
    with pytest.raises(CaptureError, match=r"cameras\.bin: expected the photographs in"):
        open_capture(model)


@pytest.mark.parametrize(
    "name", ["../v.png", "/etc/passwd", "C:\\a.png", "a/../../v.png", "..\\v.png"]
)
def test_names_that_leave_the_folder(workspace, name):
    colmap_text(workspace, ring(), [*NAMES[:4], name])
    with pytest.raises(CaptureError, match=r"within the folder.*leaves it"):
        open_capture(workspace)


def test_links_out_of_the_folder_need_leave(workspace, tmp_path_factory):
    colmap_text(workspace, ring(), NAMES)
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "images"
    shutil.move(workspace / "images", elsewhere)
    (workspace / "images").symlink_to(elsewhere)
    with pytest.raises(CaptureError, match="symbolic link that leads out"):
        open_capture(workspace)
    assert len(open_capture(workspace, follow_links=True).cameras) == 5


@pytest.mark.parametrize(
    ("file", "change", "reason"),
    [
        ("images.bin", lambda b: b[:-5], "truncated|damaged"),
        ("images.bin", lambda b: b[:20], "truncated|damaged"),
        ("images.bin", lambda b: b + b"\0", "1 more bytes"),
        ("images.bin", lambda b: struct.pack("<Q", 2**60) + b[8:], "count of 1,152,921"),
        ("images.bin", lambda b: struct.pack("<Q", 0), "registered images, received none"),
        ("images.bin", lambda b: b[:72] + b"a" * 3000, "truncated|names of at most"),
        ("images.bin", lambda b: b[:12] + struct.pack("<d", np.nan) + b[20:], "finite numbers"),
        ("images.bin", lambda b: b[:12] + struct.pack("<d", 7.0) + b[20:], "of length 1"),
        ("images.bin", lambda b: b[:68] + struct.pack("<I", 9) + b[72:], "camera.*received 9"),
        ("cameras.bin", lambda b: b"", "truncated"),
        ("cameras.bin", lambda b: b[:-1], "truncated"),
        ("cameras.bin", lambda b: struct.pack("<Q", 2**63) + b[8:], "count of 9,223"),
        ("cameras.bin", lambda b: b[:12] + struct.pack("<i", -3) + b[16:], "'number -3'"),
        ("cameras.bin", lambda b: b[:16] + struct.pack("<Q", 2**40) + b[24:], "image size"),
        ("cameras.bin", lambda b: b[:32] + struct.pack("<d", np.inf) + b[40:], "finite"),
        ("cameras.bin", lambda b: b[:32] + struct.pack("<d", -5.0) + b[40:], "fl_y > 0"),
    ],
)  # fmt: skip
def test_damaged_binary_files(workspace, file, change, reason):
    model = colmap_binary(workspace / "sparse" / "0", ring(), NAMES)
    path = model / file
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(CaptureError, match=reason) as caught:
        open_capture(workspace)
    assert str(model) in str(caught.value)


@pytest.mark.parametrize(
    ("file", "old", "new", "reason"),
    [
        ("cameras.txt", "30.0", "nan", "PARAMS"),
        ("cameras.txt", " 30.0", "", "expected 4 parameters of PINHOLE"),
        ("cameras.txt", "1 PINHOLE", "x PINHOLE", "whole numbers"),
        ("cameras.txt", "16", "1e1", "whole numbers"),
        ("images.txt", " 1 v01 top.png", "", "IMAGE_ID QW"),
        ("images.txt", " 1 v01", " 4 v01", "received 4"),
        ("images.txt", "2 ", "2 inf ", "IMAGE_ID QW"),
    ],
)
def test_damaged_text_files(workspace, file, old, new, reason):
    model = colmap_text(workspace, ring(), NAMES)
    text = (model / file).read_text()
    head, _, rest = text.partition("\n")
    assert old in rest
    (model / file).write_text(f"{head}\n{rest.replace(old, new, 1)}")
    with pytest.raises(CaptureError, match=reason):
        open_capture(workspace)


def test_quaternions_of_the_tests_themselves(rng, rounding):
    from reflfield.capture.colmap_model import rotation_of_quaternion

    for _ in range(20):
        q = rng.normal(size=4)
        rotation = rotation_of_quaternion(q / np.linalg.norm(q), "random")
        again = rotation_of_quaternion(quaternion(rotation), "again")
        np.testing.assert_allclose(again, rotation, rtol=0, atol=rounding(np.float64))


@pytest.mark.reference
def test_against_pycolmap(workspace, rng, rounding):
    """Pixels of world points as COLMAP itself projects them."""
    pycolmap = pytest.importorskip("pycolmap")
    parameters, _ = LENSES["OPENCV"]
    model = colmap_text(workspace / "sparse" / "0", ring(), NAMES, "OPENCV", parameters)
    points = rng.uniform(-0.3, 0.3, (50, 3))
    cameras = open_capture(workspace).cameras
    theirs = pycolmap.Reconstruction(str(model))
    for image, camera in zip(
        sorted(theirs.images.values(), key=lambda i: i.name), cameras, strict=True
    ):
        expected = [image.project_point(point) for point in points]
        np.testing.assert_allclose(camera.project(points)[0], expected, rounding(np.float64))


def test_mouse(shared_data):
    capture = open_capture(shared_data("colmap_mouse"))
    assert (len(capture.cameras), len(capture.photographs)) == (56, 56)
    assert {(c.width, c.height) for c in capture.cameras} == {(1920, 1440), (1440, 1920)}
