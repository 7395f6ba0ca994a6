"""Train and test splits of transforms.json, in two files or listed in one."""

import json

import numpy as np
import pytest

from reflfield.capture.image_writing import write_exr
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError


def frame(name, x=0.0, light=1.0):
    """A frame two metres above the origin, moved along x, under a light at height `light`."""
    matrix = np.eye(4)
    matrix[:2, 3] = x, 0
    matrix[2, 3] = 2
    return {"file_path": name, "transform_matrix": matrix.tolist(), "pl_pos": [0, 0, light]}


def write(folder, name, frames, **more):
    """A description with its photographs, whose value is the number in their names."""
    for each in frames:
        value = float(each["file_path"].rsplit("_", 1)[1])
        path = folder / f"{each['file_path']}.exr"
        path.parent.mkdir(exist_ok=True)
        write_exr(path, np.full((6, 8, 3), value, np.float32))
    intrinsics = {"camera_intrinsics": [4.0, 3.0, 10.0, 10.0]}
    (folder / name).write_text(json.dumps(intrinsics | {"frames": frames} | more))


@pytest.fixture
def split(tmp_path):
    """Two cameras and two lights in train, one photograph of a third camera in test."""
    write(tmp_path, "transforms_train.json", [frame("train/r_0"), frame("train/r_1", 1, 2)])
    write(tmp_path, "transforms_test.json", [frame("test/r_2", 5, 1), frame("test/r_3", 0, 2)])
    return tmp_path


class TestTwoFiles:
    def test_the_folder_is_the_training_split_and_says_so(self, split, caplog):
        capture = open_capture(split)
        assert [p.name for p in capture.photographs] == ["r_0", "r_1"]
        assert (capture.n_views, capture.n_lights) == (2, 2)
        assert "transforms_test.json) is not used; `hold_out=HoldOut(test=True)`" in caplog.text

    def test_the_test_split_comes_after_and_is_marked(self, split):
        capture = open_capture(split, test_split=True)
        assert [p.is_test for p in capture.photographs] == [False, False, True, True]
        # cameras and lights of the training split keep their numbers; equal ones are shared
        assert (capture.n_views, capture.n_lights) == (3, 2)
        assert [(p.camera, p.light) for p in capture.photographs[2:]] == [(2, 0), (0, 1)]
        assert capture.cameras[2].centre.tolist() == [5, 0, 2]
        assert [capture.read_photograph(i)[0, 0, 0] for i in range(4)] == [0, 1, 2, 3]

    def test_validation_stands_in_for_a_missing_test_split(self, split):
        (split / "transforms_test.json").rename(split / "transforms_val.json")
        assert len(open_capture(split, test_split=True).photographs) == 4

    def test_asked_for_but_not_there(self, split):
        (split / "transforms_test.json").unlink()
        with pytest.raises(CaptureError, match=r"expected a test split.*transforms_test\.json"):
            open_capture(split, test_split=True)

    def test_each_file_is_a_capture_by_its_name(self, split):
        capture = open_capture(split / "transforms_test.json")
        assert [p.name for p in capture.photographs] == ["r_2", "r_3"]
        assert not any(p.is_test for p in capture.photographs)

    def test_other_formats_have_no_test_split(self, tmp_path):
        (tmp_path / "dome.lp").write_text("1\na.png 0 0 1\n")
        with pytest.raises(CaptureError, match="lp capture, which has none"):
            open_capture(tmp_path, test_split=True)


class TestOneFile:
    def write(self, folder, **lists):
        frames = [frame(f"r_{i}", light=1.0 + i) for i in range(4)]
        write(folder, "transforms.json", frames, **lists)
        return folder

    def test_listed_names(self, tmp_path):
        lists = {"train_filenames": ["r_0", "./r_1"], "test_filenames": ["r_3"]}
        folder = self.write(tmp_path, **lists)
        assert [p.name for p in open_capture(folder).photographs] == ["r_0", "r_1"]
        capture = open_capture(folder, test_split=True)
        assert [p.name for p in capture.photographs] == ["r_0", "r_1", "r_3"]
        assert [p.is_test for p in capture.photographs] == [False, False, True]
        assert "1 frames of other splits are not used" in capture.notes[0]

    @pytest.mark.parametrize(
        "lists",
        [
            {"test_filenames": ["r_9"]},
            {"train_filenames": ["r_0"], "test_filenames": ["r_0"]},
            {"test_filenames": ["r_0", "r_1", "r_2", "r_3"]},
            {"train_filenames": "r_0"},
            {"test_filenames": [1]},
        ],
    )
    def test_names_that_cannot_be(self, tmp_path, lists):
        with pytest.raises(CaptureError, match="_filenames"):
            open_capture(self.write(tmp_path, **lists))
