"""transforms.json as other programs write it: read as its maker meant it, or refused."""

import json
import re
import unicodedata

import cv2
import numpy as np
import pytest

from reflfield.capture.image_writing import write_exr, write_png
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError

POSE = np.eye(4)
POSE[2, 3] = 2  # two metres up the z axis, looking down at the origin


def frame(name="a", pose=POSE, **more):
    """A frame under a light of its own: at 1 m plus the number in its name."""
    number = sum(int(c) for c in name if c.isdigit())
    return {
        "file_path": name,
        "transform_matrix": pose.tolist(),
        "pl_pos": [0.0, 0.0, 1.0 + number],
        "pl_intensity": [4.0, 4.0, 4.0],
    } | more


def without(values, *names):
    return {key: value for key, value in values.items() if key not in names}


def opened(folder, frames, top=None, **options):
    """The capture of frames; by default 8 x 6 pixels with a focal length of 10."""
    top = {"fl_x": 10.0, "fl_y": 10.0, "w": 8, "h": 6} if top is None else top
    folder.mkdir(exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(top | {"frames": frames}))
    return open_capture(folder, require_photographs=False, **options)


def intrinsics(camera):
    return [camera.cx, camera.cy, camera.fl_x, camera.fl_y]


class TestLights:
    def test_a_frame_without_light_among_others_is_named(self, tmp_path):
        dark = without(frame("b"), "pl_pos", "pl_intensity")
        with pytest.raises(
            CaptureError, match=r"frame 1 \('b'\): expected a light .* 2 of 3 frames have"
        ):
            opened(tmp_path, [frame("a"), dark, frame("c")])

    def test_null_is_no_position(self, tmp_path):
        with pytest.raises(CaptureError, match=r"frame 1 \('b'\): expected a light"):
            opened(tmp_path, [frame("a"), without(frame("b", pl_pos=None), "pl_intensity")])

    @pytest.mark.parametrize(
        ("frames", "reason"),
        [
            (
                [frame("a"), without(frame("b"), "pl_intensity")],
                r"frame 1 \('b'\): expected 'pl_intensity' as 1 of 2",
            ),
            (
                [without(frame("a"), "pl_pos")],
                r"frame 0 \('a'\): pl_intensity: expected with 'pl_pos'",
            ),
            (
                [frame("a", environment="sky.exr")],
                r"frame 0 \('a'\): expected 'pl_pos' or 'environment', received both",
            ),
            (
                [without(frame("a", environment="s.exr"), "pl_pos", "pl_intensity"),
                 without(frame("b", environment_convention="blender"), "pl_pos",
                         "pl_intensity")],
                r"frame 1 \('b'\): expected a light",
            ),
            (
                [frame("a", environment_convention="blender")],
                "environment_convention: expected with 'environment'",
            ),
            ([frame("a", light_pos=[0, 0, 1])], "light_pos: .*give the light as 'pl_pos'"),
        ],
    )  # fmt: skip
    def test_half_a_light(self, tmp_path, frames, reason):
        with pytest.raises(CaptureError, match=reason):
            opened(tmp_path, frames)

    def test_a_light_of_the_file_counts_for_all(self, tmp_path):
        frames = [without(frame(n), "pl_pos", "pl_intensity") for n in "ab"]
        top = {"fl_x": 10.0, "w": 8, "h": 6, "pl_pos": [0, 0, 3], "pl_intensity": 2}
        light = opened(tmp_path, frames, top).lights[0]
        assert light.position.tolist() == [0, 0, 3]
        assert light.intensity.tolist() == [2, 2, 2]

    def test_lights_of_tiny_numbers_stay_apart(self, tmp_path):
        frames = [frame("a", pl_pos=[0, 0, 1e-10]), frame("b", pl_pos=[0, 0, 3e-10])]
        assert opened(tmp_path, frames).n_lights == 2

    def test_several_photographs_of_a_camera_without_lights(self, tmp_path):
        frames = [without(frame(f"{n}.exr"), "pl_pos", "pl_intensity") for n in "ab"]
        for name in "ab":
            write_exr(tmp_path / f"{name}.exr", np.zeros((6, 8, 3), np.float32))
        opened(tmp_path, frames)
        with pytest.raises(
            CaptureError, match=r"light positions are missing: camera 'v000' has 2.*'pl_pos'"
        ):
            open_capture(tmp_path)


class TestIntrinsics:
    def test_camera_intrinsics_of_a_frame(self, tmp_path, rounding):
        matrix = [3.5, 2.5, 20.0, 21.0]
        capture = opened(
            tmp_path,
            [frame("a", camera_intrinsics=matrix), frame("b")],
            {"camera_angle_x": np.pi / 2, "w": 8, "h": 6},
        )
        assert intrinsics(capture.cameras[0]) == matrix
        # 90 degrees over 8 pixels
        found = intrinsics(capture.cameras[1])
        np.testing.assert_allclose(found, [4, 3, 4, 4], rounding(np.float64))

    def test_camera_intrinsics_of_the_file(self, tmp_path):
        top = {"camera_intrinsics": [3.5, 2.5, 20, 21], "w": 8, "h": 6}
        assert intrinsics(opened(tmp_path, [frame()], top).cameras[0]) == [3.5, 2.5, 20, 21]

    def test_angle_of_a_frame_before_the_lengths_of_the_file(self, tmp_path, rounding):
        frames = [frame("a", camera_angle_x=np.pi / 2)]
        camera = opened(tmp_path, frames, {"fl_x": 100, "fl_y": 99, "w": 8, "h": 6}).cameras[0]
        np.testing.assert_allclose([camera.fl_x, camera.fl_y], [4, 4], rounding(np.float64))

    @pytest.mark.parametrize(("own", "top"), [("x", "y"), ("y", "x"), ("x", "x"), ("y", "y")])
    def test_one_angle_of_a_frame_means_square_pixels(self, tmp_path, own, top, rounding):
        frames = [frame("a", **{f"camera_angle_{own}": np.pi / 2})]
        camera = opened(tmp_path, frames, {f"fl_{top}": 100, "w": 8, "h": 8}).cameras[0]
        np.testing.assert_allclose([camera.fl_x, camera.fl_y], [4, 4], rounding(np.float64))

    def test_angle_of_a_frame_before_the_intrinsics_of_the_file(self, tmp_path, rounding):
        top = {"camera_intrinsics": [3.5, 2.5, 20, 21], "w": 8, "h": 6}
        camera = opened(tmp_path, [frame("a", camera_angle_x=np.pi / 2)], top).cameras[0]
        np.testing.assert_allclose(intrinsics(camera), [3.5, 2.5, 4, 4], rounding(np.float64))

    def test_length_before_angle_where_both_stand_together(self, tmp_path):
        top = {"fl_x": 12.0, "camera_angle_x": 1.0, "camera_angle_y": 1.0, "w": 8, "h": 6}
        camera = opened(tmp_path, [frame()], top).cameras[0]
        assert (camera.fl_x, camera.fl_y) == (12, 12)

    @pytest.mark.parametrize(
        ("own", "top", "said"),
        [
            ({}, {"fl_x": 12.0, "camera_angle_x": 1.0}, "x means a focal length of 7.32195 "),
            ({"fl_x": 12.0, "camera_angle_x": 1.0}, {}, "x means .*7.32195 pixels, and 12 "),
            ({"camera_intrinsics": [4, 3, 9, 9], "camera_angle_x": 1.0}, {}, "x .*and 9 stand"),
            # of the whole sensor, as Blender's angle of a square picture is
            ({}, {"fl_x": 9.0, "fl_y": 9.0, "camera_angle_y": 0.2}, "y means"),
            ({}, {"fl_x": 9.0, "camera_angle_y": 0.2}, "y means"),
            ({}, {"fl_x": 9.0, "camera_angle_x": 0.836}, None),  # rounded
            ({"camera_angle_x": 1.0}, {"fl_x": 12.0}, None),  # not in the same place
            ({"fl_x": 12.0}, {"fl_x": 9.0, "camera_angle_x": 1.0}, None),  # not used
            ({}, {"fl_x": 12.0, "camera_angle_x": 1.0, "is_fisheye": True}, None),
        ],
    )
    def test_angles_that_contradict_the_length_beside_them_are_said(
        self, tmp_path, own, top, said
    ):
        frames = [frame("a", **own), frame("b", **own)]
        notes = opened(tmp_path, frames, {"w": 8, "h": 6} | top).notes
        assert len(notes) == (said is not None)
        if said:
            assert re.search(rf"frame 0 \('a'\): camera_angle_{said}.*\(1 of 1 cam", notes[0])

    @pytest.mark.parametrize("side", [{"w": 16}, {"h": 12}])
    def test_one_side_that_is_not_the_photographs(self, tmp_path, side):
        write_png(tmp_path / "a.png", np.zeros((6, 8, 3), np.uint8))
        with pytest.raises(CaptureError, match=r"[wh]: expected the 8 x 6 pixels of .*a\.png"):
            opened(tmp_path, [frame("a.png")], {"fl_x": 10.0} | side)
        right = {name: length // 2 for name, length in side.items()}
        camera = opened(tmp_path, [frame("a.png")], {"fl_x": 10.0} | right).cameras[0]
        assert (camera.width, camera.height) == (8, 6)

    def test_only_the_vertical_angle(self, tmp_path, rounding):
        camera = opened(tmp_path, [frame()], {"camera_angle_y": np.pi / 2, "w": 8, "h": 6})
        found = intrinsics(camera.cameras[0])
        np.testing.assert_allclose(found, [4, 3, 3, 3], rounding(np.float64))

    def test_whole_numbers_written_with_a_point(self, tmp_path):
        camera = opened(tmp_path, [frame()], {"fl_x": 10, "w": 8.0, "h": 6.0}).cameras[0]
        assert (camera.width, camera.height) == (8, 6)
        assert isinstance(camera.width, int)

    @pytest.mark.parametrize(
        ("values", "reason"),
        [
            ({"camera_angle_x": 53.1}, "camera_angle_x: .*degrees"),
            ({"camera_angle_x": 0}, "camera_angle_x: expected an angle"),
            ({"fl_x": "10"}, "fl_x: expected a number, received '10'"),
            ({"fl_x": True}, "fl_x: expected a number, received True"),
            ({"cx": [4]}, "cx: expected a number"),
            ({"w": 8.5}, "w: expected 1 to 65535 whole pixels, received 8.5"),
            ({"w": 0}, "w: expected 1 to 65535 whole pixels, received 0"),
            ({"w": 65536}, "w: expected 1 to 65535"),
            ({"w": 40000, "h": 40000}, "536,870,912 in all"),
            ({"h": 1e15}, "h: expected 1 to 65535"),
            ({"camera_intrinsics": [1, 2, 3]}, r"camera_intrinsics \[cx, cy, fx, fy\]"),
            ({"camera_intrinsics": [4, 3, 0, 10]}, "fx, fy > 0"),
            ({"camera_intrinsics": [4, 3, 20, 10], "fl_x": 10}, "the same fl_x twice"),
            ({"x_fov": 50}, "x_fov: .*camera_angle_x"),
            ({"fx": 10}, "fx: .*give 'fl_x'"),
            ({"k1": 1e300}, "finite intrinsics of at most 1e.12"),
        ],
    )
    def test_refused(self, tmp_path, values, reason):
        top = {"camera_angle_x": 1.0, "w": 8, "h": 6}
        with pytest.raises(CaptureError, match=rf"frame 0 \('a'\): .*{reason}"):
            opened(tmp_path, [frame("a", **values)], top)

    def test_no_focal_length(self, tmp_path):
        with pytest.raises(CaptureError, match=r"frame 0 \('a'\): expected a focal length"):
            opened(tmp_path, [frame()], {"w": 8, "h": 6})


class TestLenses:
    def points(self):
        """Points on the plane z = 0, and where OpenCV axes of the camera have them."""
        world = np.array([[0.0, 0, 0], [0.5, 0.25, 0], [-0.4, 0.7, 0]])
        return world, world * (1, -1, -1) + (0, 0, 2)

    @pytest.mark.parametrize("key", [{"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}])
    def test_fisheye(self, tmp_path, key, rounding):
        lens = {"k1": 0.05, "k2": -0.01, "k3": 0.003, "k4": 0.001}
        top = {"fl_x": 52, "fl_y": 53, "cx": 30, "cy": 33, "w": 64, "h": 64, "p1": 0.0}
        camera = opened(tmp_path, [frame()], top | lens | key).cameras[0]
        world, seen = self.points()
        # theta_d = theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9
        radius = np.hypot(seen[:, 0], seen[:, 1])
        theta = np.arctan2(radius, seen[:, 2])
        powers = theta[:, None] ** np.array([3, 5, 7, 9])
        bent = (theta + powers @ list(lens.values())) / np.maximum(radius, 1e-300)
        expected = seen[:, :2] * bent[:, None] * (52, 53) + (30, 33)
        np.testing.assert_allclose(camera.project(world)[0], expected, rounding(np.float64))

    def test_rational_model(self, tmp_path, rounding):
        lens = {"k1": 0.1, "k2": -0.05, "p1": 0.01, "p2": -0.02, "k3": 0.01}
        lens |= {"k4": 0.2, "k5": -0.01, "k6": 0.005}
        top = {"fl_x": 52, "fl_y": 53, "cx": 30, "cy": 33, "w": 64, "h": 64}
        camera = opened(tmp_path, [frame()], top | lens).cameras[0]
        world, seen = self.points()
        expected, _ = cv2.projectPoints(
            seen, np.zeros(3), np.zeros(3), camera.matrix, np.array(list(lens.values()))
        )
        found = camera.project(world)[0]
        np.testing.assert_allclose(found, expected[:, 0], rounding(np.float64))

    @pytest.mark.parametrize(
        ("values", "reason"),
        [
            ({"k4": 0.1}, "k4: expected 0.*FULL_OPENCV"),
            (
                {"camera_model": "PINHOLE", "k1": 0.1},
                "k1: expected 0 with camera_model PINHOLE",
            ),
            ({"camera_model": "SIMPLE_RADIAL", "k2": 0.1}, "k2: expected 0"),
            ({"camera_model": "OPENCV", "is_fisheye": True}, ".*contradict"),
            ({"is_fisheye": True, "p1": 0.1}, "p1: expected 0"),
            ({"is_fisheye": "yes"}, "is_fisheye: expected true or false"),
            ({"camera_model": "FOV"}, "camera_model: expected OPENCV.*'FOV'"),
            ({"camera_model": ["OPENCV"]}, "camera_model"),
        ],
    )
    def test_refused(self, tmp_path, values, reason):
        with pytest.raises(CaptureError, match=rf"frame 0 \('a'\): {reason}"):
            opened(tmp_path, [frame("a", **values)])

    def test_full_opencv_needs_no_further_coefficients(self, tmp_path):
        camera = opened(tmp_path, [frame("a", camera_model="FULL_OPENCV", k4=0.1)]).cameras[0]
        assert camera.distortion == (0, 0, 0, 0, 0, 0.1, 0, 0)


class TestKeys:
    @pytest.mark.parametrize(
        ("key", "value"),
        [
            ("b1", 4.0),
            ("b2", -1.5),
            ("skew", 0.1),
            ("s1", 0.1),
            ("p3", 1e-4),
            ("k7", 1e-4),
            ("ftheta_p1", 0.5),
            ("distortion_params", [0.1, 0, 0, 0, 0, 0]),
            ("latlong", True),
            ("camera_type", "EQUIRECTANGULAR"),
            ("gamma", 2.2),
            ("color_space", "linear"),
            ("rolling_shutter", [0, 0, 1, 0]),
            ("transform_matrix_end", np.eye(4).tolist()),
            ("R_opt", np.eye(3).tolist()),
            ("orientation_override", "up"),
            ("crop_x", 3),
            ("crop", {"left": 3}),
            ("white_transparent", True),
            ("driver_parameters", {"LightX": 1.0}),
            ("envmap", "sky.exr"),
            ("sk_x", 0.1),
            ("is_equirectangular", True),
            ("lens", "fisheye"),
            ("distortion_model", "division"),
            ("coordinate_system", "opencv"),
            ("camera_convention", "OpenCV"),
            ("K", np.eye(3).tolist()),
            ("intrinsic_matrix", np.eye(3).tolist()),
            ("is_linear", True),
        ],
    )
    @pytest.mark.parametrize("place", ["frame", "top"])
    def test_what_changes_the_result_is_refused(self, tmp_path, key, value, place):
        top = {"fl_x": 10.0, "w": 8, "h": 6}
        frames = [frame("a"), frame("b")]
        (top if place == "top" else frames[1])[key] = value
        at = "frame 0" if place == "top" else "frame 1"
        with pytest.raises(CaptureError, match=rf"{at}.*: {key}: expected none or 0"):
            opened(tmp_path, frames, top)

    def test_values_that_change_nothing_pass(self, tmp_path):
        neutral = {"b1": 0, "b2": 0.0, "rolling_shutter": [0, 0, 0, 0], "skew": None,
                   "white_transparent": False, "orientation_override": "none", "lens": None,
                   "coordinate_system": "OpenGL", "is_linear": False, "srgb": True,
                   "time": 0.5}  # fmt: skip
        assert opened(tmp_path, [frame("a", **neutral)]).n_views == 1

    def test_one_exposure_for_all_frames(self, tmp_path):
        frames = [frame("a", exposure_time=0.1), frame("b", exposure_time=0.2)]
        with pytest.raises(CaptureError, match=r"frame 1 \('b'\): exposure_time: expected 0.1"):
            opened(tmp_path, frames)
        assert opened(tmp_path, [frame("a", iso=100), frame("b", iso=100)]).n_lights == 1

    def test_one_time_for_all_frames(self, tmp_path):
        frames = [frame("a", time=0.0), frame("b", time=0.5)]
        with pytest.raises(CaptureError, match=r"frame 1 \('b'\): time: expected 0.0.* move"):
            opened(tmp_path, frames)

    def test_photographs_that_are_said_not_to_be_srgb(self, tmp_path):
        with pytest.raises(CaptureError, match=r"srgb: expected true.*'encoding'"):
            opened(tmp_path, [frame("a"), frame("b", srgb=False)])

    def test_frames_that_the_file_counts_out(self, tmp_path):
        top = {"fl_x": 10.0, "w": 8, "h": 6, "n_frames": 1}
        with pytest.raises(CaptureError, match="n_frames: expected the 2 frames"):
            opened(tmp_path, [frame("a"), frame("b")], top)

    def test_other_keys_are_listed_once(self, tmp_path, caplog):
        frames = [frame("a", mood="bad"), frame("b", mood="good", **{"new\nline": 1})]
        top = {"fl_x": 10.0, "w": 8, "h": 6, "aabb_scale": 16, "owner": "me"}
        capture = opened(tmp_path, frames, top | {"applied_transform": np.eye(3).tolist()})
        assert len(capture.notes) == 1
        assert capture.notes[0].endswith(
            r"transforms.json: not used: 'mood', 'new\nline', 'owner'"
        )
        assert caplog.messages == list(capture.notes)


class TestFiles:
    def write(self, path, value=0.5):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_exr(path, np.full((6, 8, 3), value, np.float32))

    @pytest.mark.parametrize(
        "name", ["images\\a 1.exr", ".\\images\\a 1", "images/a 1", "Images/A 1.EXR"]
    )
    def test_windows_paths_missing_suffixes_and_case(self, tmp_path, name):
        self.write(tmp_path / "images/a 1.exr")
        capture = opened(tmp_path, [frame(name)])
        assert capture.photographs[0].path == tmp_path / "images/a 1.exr"
        assert capture.read_photograph(0)[0, 0, 0] == 0.5

    def test_masks_and_maps_too(self, tmp_path):
        self.write(tmp_path / "maps/sky.exr")
        write_png(tmp_path / "masks/m.png".replace("/", "_"), np.full((6, 8), 255, np.uint8))
        lit = without(frame("a", environment="maps\\sky.exr", mask_path="MASKS_m.png"),
                      "pl_pos", "pl_intensity")  # fmt: skip
        (tmp_path / "masks").mkdir()
        (tmp_path / "masks_m.png").rename(tmp_path / "Masks_M.png")
        capture = opened(tmp_path, [lit])
        assert capture.lights[0].file == tmp_path / "maps/sky.exr"
        assert capture.silhouettes == (tmp_path / "Masks_M.png",)

    def test_accents_composed_otherwise(self, tmp_path):
        self.write(tmp_path / unicodedata.normalize("NFD", "Münze.exr"))
        capture = opened(tmp_path, [frame(unicodedata.normalize("NFC", "Münze.exr"))])
        assert capture.photographs[0].path.is_file()

    def test_two_files_that_differ_in_case_are_not_guessed_between(self, tmp_path):
        self.write(tmp_path / "a.exr", 0.25)
        self.write(tmp_path / "A.exr", 0.5)
        assert opened(tmp_path, [frame("A.exr")]).read_photograph(0)[0, 0, 0] == 0.5
        self.write(tmp_path / "b.EXR")
        self.write(tmp_path / "B.exr")
        assert not opened(tmp_path, [frame("b.exr")]).photographs[0].path.is_file()

    def test_file_ext_chooses_among_suffixes(self, tmp_path):
        self.write(tmp_path / "r_1.exr")
        write_png(tmp_path / "r_1.png", np.full((6, 8, 3), 255, np.uint8))
        chosen = opened(tmp_path, [frame("r_1", file_ext=".png")])
        assert chosen.photographs[0].path.suffix == ".png"
        with pytest.raises(CaptureError, match="file_ext: expected a suffix"):
            opened(tmp_path, [frame("r_1", file_ext="png")])

    @pytest.mark.parametrize(
        ("name", "reason"),
        [
            ("C:\\photos\\a.exr", "leaves the folder"),
            ("\\\\server\\a.exr", "leaves the folder"),
            ("..\\a.exr", "leaves the folder"),
            ("a\n.exr", r"'a\\n.exr' is not a usable path"),
            ("a\x1b[31m.exr", "not a usable path"),
            ("\ud800.exr", "not a usable path"),
            ("a" * 300 + ".exr", "not a usable path"),
            ("", "not a usable path"),
        ],
    )
    def test_paths_that_cannot_be(self, tmp_path, name, reason):
        with pytest.raises(CaptureError, match=reason) as caught:
            opened(tmp_path, [frame(name)])
        assert str(caught.value).isprintable()

    @pytest.mark.parametrize("suffix", [".exr", ""])
    @pytest.mark.parametrize("root", ["{folder}/", "/home/me/vase/", "D:\\vase\\"])
    def test_absolute_paths_of_this_folder_or_where_it_was(self, tmp_path, root, suffix):
        for folder in ("train", "test"):
            self.write(tmp_path / folder / "r_1.exr")
        name = root.format(folder=tmp_path.absolute()) + "train/r_1" + suffix
        capture = opened(tmp_path, [frame(name)])
        assert capture.photographs[0].path == tmp_path / "train/r_1.exr"

    def test_absolute_paths_of_another_folder_are_refused(self, tmp_path):
        """The last part alone is no evidence: both splits have an r_1."""
        self.write(tmp_path / "train/r_1.exr")
        self.write(tmp_path / "r_1.exr")
        with pytest.raises(CaptureError, match="leaves the folder"):
            opened(tmp_path, [frame("/home/me/vase/test/r_1.exr")])

    def test_links_within_a_download_cache(self, tmp_path):
        """Every file of a snapshot is a link to a blob beside it, the description too."""
        snapshot, blobs = tmp_path / "snapshots/1", tmp_path / "blobs"
        snapshot.mkdir(parents=True)
        self.write(blobs / "f00", 0.25)
        (snapshot / "a.exr").symlink_to("../../blobs/f00")
        text = json.dumps({"fl_x": 10.0, "w": 8, "h": 6, "frames": [frame("a.exr")]})
        (blobs / "f01").write_text(text)
        (snapshot / "transforms.json").symlink_to("../../blobs/f01")
        with pytest.raises(
            CaptureError, match=r"'a.exr'.*symbolic link.*blobs.*`follow_links=True`"
        ):
            open_capture(snapshot)
        capture = open_capture(snapshot, follow_links=True)
        assert capture.read_photograph(0)[0, 0, 0] == 0.25

    def test_links_that_stay_inside_need_no_leave(self, tmp_path):
        self.write(tmp_path / "real/a.exr")
        (tmp_path / "images").symlink_to("real")
        assert opened(tmp_path, [frame("images/a.exr")]).read_photograph(0)[0, 0, 0] == 0.5

    def test_link_to_itself(self, tmp_path):
        (tmp_path / "a.exr").symlink_to("a.exr")
        with pytest.raises(CaptureError, match=r"a\.exr' is not a usable path|symbolic link"):
            opened(tmp_path, [frame("a.exr")])


class TestPoses:
    @pytest.mark.parametrize(
        ("matrix", "reason"),
        [
            (np.diag([2.0, 2, 2, 1]), "scale or shear"),
            (np.diag([1.0, 1, -1, 1]), "mirrored"),
            (np.diag([1.0, 1, 0, 1]), "singular"),
            (np.eye(4) * (1, 1, 1, 1e308), "at most 1e.12"),
            (np.eye(3), "4 x 4 numbers or 3 x 4 numbers"),
            (np.eye(4).astype(str), "4 x 4 numbers"),
            (np.eye(4).astype(bool), "4 x 4 numbers"),
            (np.eye(4)[None], "4 x 4 numbers"),
        ],
    )
    def test_refused(self, tmp_path, matrix, reason):
        bad = frame("b") | {"transform_matrix": matrix.tolist()}
        with pytest.raises(
            CaptureError, match=rf"frame 1 \('b'\): transform_matrix: .*{reason}"
        ):
            opened(tmp_path, [frame("a"), bad])

    def test_strings_that_say_nan(self, tmp_path):
        with pytest.raises(CaptureError, match="pl_pos: expected 3 numbers"):
            opened(tmp_path, [frame("a", pl_pos=["nan", "1", "2"])])

    def test_three_rows_are_enough(self, tmp_path):
        camera = opened(tmp_path, [frame("a", pose=POSE[:3])]).cameras[0]
        assert camera.centre.tolist() == [0, 0, 2]
