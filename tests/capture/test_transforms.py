"""transforms.json: cameras, lights and files of its frames, and what is wrong with them."""

import json

import numpy as np
import pytest

from reflfield.capture.image_writing import write_exr, write_png
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError


def frame(name="a", position=(0.0, 0.0, 1.0), **more):
    """A frame two metres up the +z axis in OpenGL axes, looking down at the origin."""
    matrix = np.eye(4)
    matrix[2, 3] = 2
    return {
        "file_path": name,
        "transform_matrix": matrix.tolist(),
        "pl_pos": list(position),
        "pl_intensity": [4.0, 4.0, 4.0],
    } | more


def unlit(name="a", **more):
    """A frame that does not say what lights it."""
    values = frame(name, **more)
    return {key: value for key, value in values.items() if not key.startswith("pl_")}


def write_frames(folder, frames, **common):
    document = {"fl_x": 10.0, "fl_y": 10.0, "w": 8, "h": 6, "frames": frames} | common
    folder.mkdir(exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


class TestTransforms:
    def open(self, folder, frames, **common):
        return open_capture(write_frames(folder, frames, **common), require_photographs=False)

    def test_axes(self, tmp_path, rounding):
        # OpenGL camera at z = 2 looking along -z, y up: world +y is up in the image.
        camera = self.open(tmp_path / "c", [frame()]).cameras[0]
        assert camera.centre.tolist() == [0, 0, 2]
        assert camera.up.tolist() == [0, 1, 0]
        pixels, depth = camera.project([[0.2, 0.4, 0.0]])
        np.testing.assert_allclose(pixels, [[4 + 1, 3 - 2]], rounding(np.float64))
        assert depth.tolist() == [2]

    def test_same_cameras_and_lights_become_one(self, tmp_path):
        other = frame("x", position=(1, 0, 0))
        moved = frame("y")
        moved["transform_matrix"][0][3] = 1.0
        capture = self.open(tmp_path / "c", [frame("a"), other, moved])
        assert [c.id for c in capture.cameras] == ["v000", "v001"]
        assert [light.id for light in capture.lights] == ["l000", "l001"]
        assert capture.photograph_index.tolist() == [[0, 1], [2, -1]]
        assert [p.name for p in capture.photographs] == ["a", "x", "y"]

    def test_the_first_of_several_masks_of_a_camera_is_used_and_said(self, tmp_path):
        frames = [
            frame("a", mask_path="m/a.png"),
            frame("b", position=(1, 0, 0), mask_path="m/b.png"),
        ]
        capture = self.open(tmp_path / "c", frames)
        assert capture.silhouettes == (tmp_path / "c" / "m" / "a.png",)
        (note,) = [note for note in capture.notes if "mask_path" in note]
        assert "1 of 1 cameras have several masks" in note
        assert "b.png" in note
        same = [f | {"mask_path": "m/a.png"} for f in frames]
        assert not self.open(tmp_path / "d", same).notes

    def test_angle_instead_of_focal_length(self, tmp_path):
        # 90 degrees over 8 pixels: focal length 4
        folder = write_frames(tmp_path / "c", [frame()])
        document = json.loads((folder / "transforms.json").read_text())
        del document["fl_x"], document["fl_y"]
        document["camera_angle_x"] = np.pi / 2
        (folder / "transforms.json").write_text(json.dumps(document))
        capture = open_capture(folder, require_photographs=False)
        assert capture.cameras[0].fl_x == pytest.approx(4)
        assert capture.cameras[0].fl_y == pytest.approx(4)

    def test_frame_overrides_the_top(self, tmp_path):
        capture = self.open(tmp_path / "c", [frame("a", fl_x=20.0), frame("b", cx=1.0)])
        assert [c.fl_x for c in capture.cameras] == [20, 10]
        assert [c.cx for c in capture.cameras] == [4, 1]

    def test_suffix_is_found(self, tmp_path):
        folder = write_frames(tmp_path / "c", [frame("./img/r_0.5")])
        (folder / "img").mkdir()
        write_png(folder / "img/r_0.5.png", np.full((6, 8, 3), 255, np.uint8))
        capture = open_capture(folder)
        assert capture.photographs[0].name == "r_0.5"
        assert capture.read_photograph(0).shape == (6, 8, 3)

    def test_size_from_the_photograph(self, tmp_path):
        folder = write_frames(tmp_path / "c", [frame("a.exr")])
        document = json.loads((folder / "transforms.json").read_text())
        del document["w"], document["h"]
        (folder / "transforms.json").write_text(json.dumps(document))
        with pytest.raises(CaptureError, match="'w' and 'h'"):
            open_capture(folder)
        write_exr(folder / "a.exr", np.zeros((3, 5, 3), np.float32))
        assert open_capture(folder).cameras[0].width == 5

    def test_frames_without_light_are_under_an_unknown_one(self, tmp_path):
        frames = [unlit("a"), unlit("b", cx=1.0)]
        capture = self.open(tmp_path / "c", frames)
        assert [light.kind for light in capture.lights] == ["unknown"]
        assert not capture.lights_known

    def test_environment_per_frame(self, tmp_path):
        frames = [
            unlit("a", environment="maps/sky.exr"),
            unlit("b", environment="maps/sky.exr"),
            unlit("c", environment="maps/sky.exr", environment_convention="blender"),
        ]
        with pytest.raises(CaptureError, match=r"sky\.exr: environment map of light 'l000'"):
            self.open(tmp_path / "c", frames)
        (tmp_path / "c/maps").mkdir()
        write_exr(tmp_path / "c/maps/sky.exr", np.ones((2, 4, 3), np.float32))
        capture = self.open(tmp_path / "c", frames)
        assert [light.kind for light in capture.lights] == ["environment"] * 2
        assert [light.convention for light in capture.lights] == ["mitsuba", "blender"]
        assert capture.lights[0].file == tmp_path / "c/maps/sky.exr"

    def test_several_lights_at_once(self, tmp_path):
        capture = self.open(tmp_path / "c", [frame("a", position=[[0, 0, 1], [0, 0, 2]])])
        first, second = capture.lights[0].sources
        assert first.position.tolist() == [0, 0, 1]
        assert second.intensity.tolist() == [4, 4, 4]

    def test_one_camera_stands_before_a_plane(self, tmp_path):
        assert self.open(tmp_path / "a", [frame()]).base_geometry == "plane"
        assert self.open(tmp_path / "b", [frame(), frame("b", cx=1.0)]).base_geometry == "hull"

    def test_repeated_names_get_their_folder(self, tmp_path):
        other = frame("test/0.exr", position=(1, 0, 0))
        capture = self.open(tmp_path / "c", [frame("train/0.exr"), other])
        assert [p.name for p in capture.photographs] == ["train_0", "test_0"]

    def test_up(self, tmp_path):
        assert self.open(tmp_path / "a", [frame()]).up.tolist() == [0, 1, 0]
        assert self.open(tmp_path / "b", [frame()], up=[0, 0, 2]).up.tolist() == [0, 0, 1]

    @pytest.mark.parametrize(
        ("bad", "reason"),
        [
            (frame(transform_matrix=np.zeros((4, 4)).tolist()), r"frame 0 \('a'\).*last row"),
            (frame(transform_matrix=np.diag([1.0, 1, 0, 1]).tolist()), "singular matrix"),
            (frame(transform_matrix=(2 * np.eye(4)).tolist()), "transform_matrix.*last row"),
            (frame(transform_matrix=np.diag([2.0, 2, 2, 1]).tolist()), "scale or shear"),
            (frame(transform_matrix=[[1, 2], [3]]), "transform_matrix"),
            (frame(transform_matrix="x"), "transform_matrix"),
            (frame(position=(0, 0)), "pl_pos"),
            (frame(pl_intensity="bright"), "pl_intensity"),
            (frame(pl_intensity=[[1, 1, 1], [2, 2, 2]]), "pl_intensity"),
            (frame(pl_intensity=[-1, 1, 1]), "intensity"),
            (frame(camera_model="THIN_PRISM_FISHEYE"), "camera_model.*THIN_PRISM"),
            (frame(k4=0.1), "k4"),
            (frame(fl_x=True), "fl_x"),
            (frame(fl_x=-1), "focal length"),
            (frame(mask_path="../m.png"), "leaves the folder"),
            (frame("/etc/passwd"), "leaves the folder"),
            (unlit(environment="../sky.exr"), "leaves the folder"),
            (unlit(environment="sky.exr", environment_convention="up"), "convention"),
            ({"transform_matrix": np.eye(4).tolist()}, r"frames\[0\].*file_path"),
            (7, r"frames\[0\]"),
        ],
    )
    def test_bad_frames(self, tmp_path, bad, reason):
        with pytest.raises(CaptureError, match=reason):
            self.open(tmp_path / "c", [bad])

    def test_no_frames(self, tmp_path):
        with pytest.raises(CaptureError, match="frames"):
            self.open(tmp_path / "c", [])

    def test_mitsuba_spot(self, shared_data):
        capture = open_capture(shared_data("mitsuba_spot"))
        assert (capture.n_views, capture.n_lights, len(capture.photographs)) == (32, 32, 1024)
        assert (capture.photograph_index >= 0).all()
        assert capture.up.tolist() == [0, 1, 0]
        # cameras at .65 m look at the origin: it lies at the principal point
        for camera in capture.cameras:
            pixels, depth = camera.project([[0.0, 0.0, 0.0]])
            np.testing.assert_allclose(pixels, [[64, 64]], atol=1e-3)  # float32 poses
            assert depth[0] == pytest.approx(0.65, abs=1e-6)

    def test_mitsuba_positions_project_to_their_pixels(self, shared_data):
        folder = shared_data("mitsuba_spot")
        capture = open_capture(folder)
        for view in (0, 8, 16, 24):
            buffers = np.load(folder / "truth" / f"aov_{view:03d}.npy").astype(np.float64)
            solid = capture.read_silhouette(view) > 0.99  # its full pixels say 254
            pixels, _ = capture.cameras[view].project(buffers[..., 6:9][solid])
            row, column = np.nonzero(solid)
            error = np.abs(pixels - np.stack([column + 0.5, row + 0.5], axis=1)).max(axis=1)
            # positions are pixel averages in half precision: a tenth of a pixel, except
            # where a pixel straddles a step in depth
            assert np.median(error) < 0.15
            middle = np.median(pixels[:, 0] - column)
            assert middle == pytest.approx(0.5, abs=0.005)  # observed 1.3e-3: they cancel

    def test_mitsuba_frames_to_relight(self, shared_data):
        capture = open_capture(shared_data("mitsuba_spot") / "truth" / "relit.json")
        assert {light.kind for light in capture.lights} == {"environment"}
        assert all(light.file.is_file() for light in capture.lights)
        assert capture.photographs[0].name == "relit_courtyard_0"
