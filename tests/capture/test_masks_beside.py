"""Masks in a folder beside the photographs, of descriptions that do not name them."""

import json

import numpy as np
import pytest

from reflfield.api.masks import make_masks
from reflfield.capture.image_files import read_coverage, read_image
from reflfield.capture.image_writing import write_png
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError
from tests.capture.calibrations import ring
from tests.capture.exr_files import write_layers

NAMES = [f"v{i}.png" for i in range(5)]
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture
def workspace(tmp_path):
    """Five photographs of a disc in `images`, described by a transforms.json without masks."""
    (tmp_path / "images").mkdir()
    frames = []
    y, x = np.mgrid[:12, :16]
    for name, camera in zip(NAMES, ring(), strict=True):
        image = np.where(np.hypot(x - 8, y - 6) < 4, 180, 0)[..., None].repeat(3, axis=2)
        write_png(tmp_path / "images" / name, image.astype(np.uint8))
        pose = np.linalg.solve(camera.camera_from_world, OPENGL)
        frames.append({
            "file_path": f"images/{name}", "transform_matrix": pose.tolist(),
            "w": 16, "h": 12, "fl_x": camera.fl_x, "fl_y": camera.fl_y, "cx": 8, "cy": 6,
            "pl_pos": [0, 0, 3],
        })  # fmt: skip
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    return tmp_path


def put(folder, names):
    mask = np.zeros((12, 16), np.uint8)
    mask[3:9, 4:12] = 255
    folder.mkdir(exist_ok=True)
    for name in names:
        write_png(folder / name, mask)


@pytest.mark.parametrize("ends", [".png", ".png.png", ".PNG"])
def test_masks_named_as_the_photographs_are_read(workspace, ends):
    put(workspace / "masks", [name.replace(".png", ends) for name in NAMES])
    capture = open_capture(workspace)
    assert [path.name for path in capture.silhouettes] == [
        name.replace(".png", ends) for name in NAMES
    ]
    assert capture.read_silhouette(0).sum() == 48
    assert any("masks in" in detail for detail in capture.details)
    assert capture.notes == ()


def test_masks_that_the_command_made_are_those_of_the_next_one(workspace):
    made = make_masks(workspace, workspace / "masks")
    assert list(open_capture(workspace).silhouettes) == [mask.path for mask in made]


def test_clean_plates_are_read_from_the_layer_of_the_photographs(workspace):
    path = workspace / "transforms.json"
    path.write_text(path.read_text().replace(".png", ".exr"))
    plain = np.zeros((12, 16), np.float32)
    for name in (*NAMES, "plate.png"):
        image = workspace / "images" / name
        seen = read_image(image)[..., 0] if image.exists() else plain
        layers = {"one": seen, "two": np.ones_like(plain)}
        channels = {f"{n}.{c}": a for n, a in layers.items() for c in "RGB"}
        write_layers(image.with_suffix(".exr"), channels)
    plate = workspace / "images/plate.exr"
    made = make_masks(workspace, workspace / "made", clean_plate=plate, layer="one")
    truth = read_image(workspace / "images/v0.png")[..., 0] > 0
    covered = read_coverage(made[0].path) > 0.5
    assert (covered & truth).sum() > 0.8 * (covered | truth).sum()


def test_masks_that_the_description_names_count_alone(workspace):
    put(workspace / "masks", NAMES)
    path = workspace / "transforms.json"
    document = json.loads(path.read_text())
    document["frames"][0]["mask_path"] = "images/v0.png"
    path.write_text(json.dumps(document))
    silhouettes = open_capture(workspace).silhouettes
    assert silhouettes == (workspace / "images/v0.png", None, None, None, None)


def test_missing_masks_are_counted(workspace):
    put(workspace / "masks", NAMES[:3])
    (note,) = open_capture(workspace).notes
    assert note.endswith("masks: no mask for 2 of 5 cameras")


@pytest.mark.parametrize("name", ["masks", "Masks", "silhouettes"])
def test_folders_that_are_not_read_are_spoken_of(workspace, name):
    put(workspace / name, ["mask_0.png"])
    capture = open_capture(workspace)
    assert not any(capture.silhouettes)
    (note,) = capture.notes
    assert "not read" in note
    assert name in note


def test_something_else_that_is_called_masks_is_refused(workspace):
    (workspace / "masks").symlink_to("masks")
    with pytest.raises(CaptureError, match=r"masks: expected a folder of masks"):
        open_capture(workspace)


def test_masks_of_another_size_are_refused(workspace):
    put(workspace / "masks", NAMES[1:])
    write_png(workspace / "masks/v0.png", np.full((6, 8), 255, np.uint8))
    with pytest.raises(CaptureError, match=r"masks.v0\.png: image size: expected 16 x 12"):
        open_capture(workspace)
