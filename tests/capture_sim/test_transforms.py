"""The splits for radiance-field software, read back by reflfield and as GS3 reads them."""

import json

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from capture_sim.errors import SceneError
from capture_sim.write import write_capture
from reflfield.capture.readers import open_capture
from tests.capture_sim.test_write import scene


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """A capture in the native format, and its splits."""
    folder = tmp_path_factory.mktemp("captures") / "tiny"
    write_capture(scene(), folder, as_transforms=True)
    native = open_capture(folder)
    return native, open_capture(folder / "transforms", test_split=True)


def test_cameras_lights_and_values_are_those_of_the_native_capture(both, rounding):
    native, transforms = both
    assert not any("png_white" in note for note in transforms.notes)
    assert all(one.path.suffix == ".exr" for one in transforms.photographs)
    train = [one for one in transforms.photographs if not one.is_test]
    assert len(train) == len(native.photographs) == 9
    for index, (one, other) in enumerate(zip(train, native.photographs, strict=True)):
        camera, wanted = transforms.cameras[one.camera], native.cameras[other.camera]
        np.testing.assert_allclose(
            camera.camera_from_world, wanted.camera_from_world, 0, rounding(np.float64)
        )
        assert (camera.fl_x, camera.cx, camera.width) == (wanted.fl_x, wanted.cx, wanted.width)
        light, same = transforms.lights[one.light], native.lights[other.light]
        np.testing.assert_array_equal(light.position, same.position)
        np.testing.assert_array_equal(light.intensity, same.intensity)
        covered = native.read_silhouette(other.camera) > 0
        # Alpha is in half precision.
        np.testing.assert_allclose(
            transforms.read_silhouette(one.camera),
            native.read_silhouette(other.camera),
            atol=2.0**-11,
        )
        np.testing.assert_array_equal(
            transforms.read_photograph(index)[covered], native.read_photograph(index)[covered]
        )


def test_held_out_frames_are_the_test_split(both):
    test = [one for one in both[1].photographs if one.is_test]
    assert [one.name for one in test] == ["h000", "h001"]


def test_a_loader_of_the_others_gets_what_it_asks_for(both):
    """``file_path`` without a suffix, centre before focal lengths, three splits."""
    folder = both[1].root
    document = json.loads((folder / "transforms_train.json").read_text())
    assert document["camera_intrinsics"] == document["frames"][0]["camera_intrinsics"]
    assert json.loads((folder / "transforms_val.json").read_text())["frames"] == []
    for frame in document["frames"]:
        cx, cy, fx, fy = frame["camera_intrinsics"]
        assert (cx, cy, fx, fy) == tuple(frame[k] for k in ("cx", "cy", "fl_x", "fl_y"))
        with OpenEXR.File(str(folder / f"{frame['file_path']}.exr")) as file:
            pixels = file.channels()["RGBA"].pixels
        assert pixels.shape == (20, 24, 4)
        assert pixels[..., 3].max() == 1
        with Image.open(folder / f"{frame['file_path']}.png") as opened:
            assert (opened.mode, opened.size) == ("RGBA", (24, 20))
        assert len(frame["pl_pos"]) == len(frame["pl_intensity"]) == 3


def test_without_held_out_frames_every_eighth_photograph_is_a_test(tmp_path):
    write_capture(scene(heldout={"photographs": 0}), tmp_path / "tiny", as_transforms=True)
    names = {
        split: [
            frame["file_path"]
            for frame in json.loads(
                (tmp_path / f"tiny/transforms/transforms_{split}.json").read_text()
            )["frames"]
        ]
        for split in ("train", "test")
    }
    assert names["test"] == ["test/v000_l000", "test/v002_l002"]
    assert len(names["train"]) == 7


def test_what_the_format_cannot_hold_is_refused(tmp_path):
    brackets = scene(effects={"exposure_brackets": {"seconds": [0.1, 1.0]}})
    with pytest.raises(SceneError, match="brackets"):
        write_capture(brackets, tmp_path / "tiny", as_transforms=True)
    assert not list(tmp_path.iterdir())
