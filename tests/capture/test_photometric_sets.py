"""Sets of views under many lights, as photometric stereo and light stages leave them."""

import json

import cv2
import numpy as np
import pytest
import scipy.io

from reflfield.capture.image_writing import write_png
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError
from tests.capture.calibrations import assert_same_cameras, ring, write_photographs

DIRECTIONS = np.array([[0.6, 0, 0.8], [0, 0.6, 0.8], [-0.6, 0, 0.8], [0, 0, 1.0]])
NAMES = [f"a.{i}.png" for i in (0, 1, 2, 10)]


def numbers(array):
    return "\n".join(" ".join(repr(float(n)) for n in row) for row in np.atleast_2d(array))


def seen(capture):
    """Photographs' names in the order of the lights, and the lights' directions."""
    order = capture.photograph_index[0]
    names = [capture.photographs[i].path.name for i in order]
    return names, np.array([light.direction for light in capture.lights])


# --- one view: lists of directions --------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("light_directions.txt", numbers(DIRECTIONS)),
        ("light_directions.txt", numbers(DIRECTIONS.T)),
        ("lights.txt", "4\n" + numbers(DIRECTIONS)),
        ("lights.txt", numbers(2 * DIRECTIONS).replace(" ", ", ")),
    ],
)
@pytest.mark.parametrize("folder", ["", "Objects", "anything"])
def test_lists_of_directions(tmp_path, file, text, folder, rounding):
    write_photographs(tmp_path / folder, [*NAMES, "a.mask.png", "a_normal.png"])
    write_photographs(tmp_path / "other", ["ref.png"])
    (tmp_path / file).write_text(text)
    capture = open_capture(tmp_path)
    names, directions = seen(capture)
    assert names == NAMES
    np.testing.assert_allclose(directions, DIRECTIONS, 0, rounding(np.float64))
    assert capture.silhouettes[0].name == "a.mask.png"
    assert (capture.format, capture.base_geometry, capture.n_views) == ("lights", "plane", 1)
    # x right, y up
    pixels, _ = capture.cameras[0].project([[0.25, 0.25, 0]])
    np.testing.assert_allclose(pixels, [[12, 2]])


def test_one_list_of_many_objects(tmp_path):
    for name in ("cat", "owl"):
        write_photographs(tmp_path / name, NAMES)
    (tmp_path / "lights.txt").write_text("4\n" + numbers(DIRECTIONS))
    with pytest.raises(CaptureError, match=r"several \(cat, owl\); open one of them"):
        open_capture(tmp_path)
    assert seen(open_capture(tmp_path / "owl"))[0] == NAMES
    # a list of its own counts before the one above
    (tmp_path / "owl/lights.txt").write_text(numbers(DIRECTIONS[::-1]))
    np.testing.assert_allclose(seen(open_capture(tmp_path / "owl"))[1], DIRECTIONS[::-1])


def test_diligent(tmp_path, rounding):
    """Names, intensities, and files of 16 bits that are linear."""
    for i, name in enumerate(reversed(NAMES)):
        write_png(tmp_path / name, np.full((6, 8, 3), 30000 + i, np.uint16))
    (tmp_path / "light_directions.txt").write_text(numbers(DIRECTIONS))
    (tmp_path / "light_intensities.txt").write_text(numbers(np.arange(12).reshape(4, 3) + 1))
    (tmp_path / "filenames.txt").write_text("\n".join(reversed(NAMES)) + "\n")
    write_photographs(tmp_path, ["mask.png", "Normal_gt.png", "unused.png"], (6, 8))
    capture = open_capture(tmp_path)
    assert seen(capture)[0] == NAMES[::-1]
    np.testing.assert_array_equal(capture.lights[2].intensity, [7, 8, 9])
    assert capture.read_photograph(1)[0, 0, 0] == pytest.approx(
        30001 / 65535, rel=rounding(np.float32)
    )
    assert any("files taken as linear" in detail for detail in capture.details)
    (tmp_path / "filenames.txt").write_text("a.0.png\n")
    with pytest.raises(CaptureError, match=r"filenames\.txt: expected 4 names"):
        open_capture(tmp_path)
    (tmp_path / "filenames.txt").write_text("../a.png\n" * 4)
    with pytest.raises(CaptureError, match="leaves the folder"):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "three numbers for each light"),
        ("1 2\n3 4\n", "three numbers for each light"),
        ("1 2 3\n3 4\n", "three numbers for each light"),
        (numbers(DIRECTIONS).replace("0.6", "nan"), "finite numbers"),
        (numbers(DIRECTIONS).replace("0.6", "1e300"), "finite numbers"),
        (numbers(DIRECTIONS * [1, 1, 0]), "z > 0|not zero"),
        (numbers(-DIRECTIONS), "z > 0, received 4 of 4"),
        (numbers(DIRECTIONS[:2]), "expected 2 photographs"),
        (numbers(np.ones((3, 3))), "do not tell which"),
        (numbers(np.eye(3)), "do not tell which"),
    ],
)
def test_lists_that_are_refused(tmp_path, text, reason):
    write_photographs(tmp_path, NAMES)
    (tmp_path / "light_directions.txt").write_text(text)
    with pytest.raises(CaptureError, match=reason):
        open_capture(tmp_path)


def test_intensities_of_another_number(tmp_path):
    write_photographs(tmp_path, NAMES)
    (tmp_path / "light_directions.txt").write_text(numbers(DIRECTIONS))
    (tmp_path / "light_strength.txt").write_text("1 2 3 4 5")
    with pytest.raises(CaptureError, match="one or three numbers for each of 4 lights"):
        open_capture(tmp_path)
    (tmp_path / "light_strength.txt").write_text("1 2 3 4")
    assert open_capture(tmp_path).lights[3].intensity.tolist() == [4, 4, 4]


def test_uw_gray_sphere(shared_data):
    """Normals of a sphere by least squares: axes of the lights, and linear values.

    Measured: 5.0 degrees on the inner half; 20 if the files are decoded as sRGB, over 30
    with a mirrored axis.
    """
    capture = open_capture(shared_data("uw_photometric_stereo") / "gray")
    inside = capture.read_silhouette(0) > 0.5
    values = np.stack([capture.read_photograph(i).mean(axis=2)[inside] for i in range(12)])
    lights = np.array([light.direction for light in capture.lights])
    normals = np.linalg.lstsq(lights, values, rcond=None)[0].T
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    y, x = np.nonzero(inside)
    radius = np.ptp(x) / 2
    sphere = np.stack([x - x.mean(), y.mean() - y], axis=1) / radius
    inner = np.hypot(*sphere.T) < 0.5
    expected = np.column_stack([sphere, np.sqrt(np.clip(1 - (sphere**2).sum(axis=1), 0, 1))])
    angles = np.degrees(np.arccos(np.clip((normals * expected).sum(axis=1), -1, 1)))
    assert np.median(angles[inner]) < 6


def test_psbox(shared_data):
    capture = open_capture(shared_data("psbox_probe"))
    assert (capture.n_lights, capture.photographs[0].path.parent.name) == (12, "Objects")
    # half of the last digit that is given here
    assert capture.lights[0].direction[0] == pytest.approx(-0.34766159, abs=5e-9)


# --- RTI ----------------------------------------------------------------------------------


def dome(**more):
    vectors = [{"x": x, "y": y, "z": z} for x, y, z in (DIRECTIONS * 250).tolist()]
    return {
        "label": "d", "notes": "", "imageWidth": 80, "domeDiameter": 500, "verticalOffset": 0,
        "lightConfiguration": "directional", "directions": vectors, "positionsSphere": vectors,
        "positions3d": vectors, "ledAdjust": [], **more,
    }  # fmt: skip


@pytest.mark.parametrize("kind", ["directional", "spherical", "lights3d"])
def test_relight_dome(tmp_path, kind, rounding):
    write_photographs(tmp_path / "jpg", NAMES)
    (tmp_path / "a.dome").write_text(json.dumps(dome(lightConfiguration=kind)))
    capture = open_capture(tmp_path)
    if kind == "directional":
        np.testing.assert_allclose(seen(capture)[1], DIRECTIONS, 0, rounding(np.float64))
        assert capture.cameras[0].fl_x == 16
    else:  # a lamp 250 mm away, an image 80 mm wide: 16 pixels
        np.testing.assert_allclose(capture.lights[0].position, [0.15, 0, 0.2])
        assert capture.cameras[0].fl_x == pytest.approx(200)


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({"lightConfiguration": "other"}, "directional, spherical, lights3d"),
        ({"directions": []}, "list of lights"),
        ({"directions": [{"x": 1}]}, r"directions\[0\]: expected 3 numbers"),
        ({"directions": [[0, 0, 0]]}, "photographs|not zero"),
        ({"ledAdjust": [{"r": 1, "g": 0.5, "b": 1}]}, r"ledAdjust\[0\]: expected 1"),
        ({"lampHeight": 3}, "lampHeight: expected the keys"),
        ({"ledAdjust": 5}, "ledAdjust: expected a list"),
        ({"lightConfiguration": "lights3d", "imageWidth": 0}, "imageWidth: expected the width"),
    ],
)
def test_domes_that_are_refused(tmp_path, more, reason):
    write_photographs(tmp_path, NAMES)
    (tmp_path / "a.dome").write_text(json.dumps(dome(**more)))
    with pytest.raises(CaptureError, match=reason):
        open_capture(tmp_path)


def test_lp_whose_photographs_lie_in_a_folder(tmp_path, rounding):
    write_photographs(tmp_path / "jpeg-exports", NAMES)
    lines = [f"{n} {numbers(d)}" for n, d in zip(NAMES, DIRECTIONS, strict=True)]
    (tmp_path / "a.lp").write_text("4\n" + "\n".join(lines))
    names, directions = seen(open_capture(tmp_path))
    assert names == NAMES
    np.testing.assert_allclose(directions, DIRECTIONS, 0, rounding(np.float64))
    write_photographs(tmp_path / "thumbnails", NAMES)
    with pytest.raises(CaptureError, match="expected it in one folder"):
        open_capture(tmp_path)


# --- near lights --------------------------------------------------------------------------


@pytest.fixture
def near(tmp_path):
    """Four lamps whose beams meet at depth 500, in MATLAB's files."""
    positions = np.array([[-200, 0, 400], [200, 0, 400], [0, -200, 400], [0, 200, 300.0]])
    beams = [0, 0, 500] - positions
    arrays = {"S": positions, "Dir": beams / 100, "Phi": np.arange(12.0).reshape(4, 3) + 1,
              "mu": np.array([[0], [1], [2], [3]])}  # fmt: skip
    write_photographs(tmp_path, NAMES)

    def opened(**more):
        kept = {k: v for k, v in (arrays | more).items() if v is not None}
        scipy.io.savemat(tmp_path / "light.mat", kept)
        matrix = np.array([[30, 0, 9], [0, 31, 6.5], [0, 0, 1.0]])
        scipy.io.savemat(tmp_path / "camera.mat", {"K": matrix})
        return open_capture(tmp_path)

    return opened


def test_near_lights(near):
    capture = near()
    pixels, depth = capture.cameras[0].project([[0, 0, 0], [50, 50, 0]])
    np.testing.assert_allclose(depth, 500)
    np.testing.assert_allclose(pixels, [[8.5, 6], [11.5, 2.9]])  # y up
    lamp = capture.lights[3]
    np.testing.assert_allclose(lamp.position, [0, -200, 200])
    # Phi cos^3 / d^2 along the beam, and to the origin they aim at
    np.testing.assert_allclose(lamp.irradiance([[0, 0, 0]]), [np.array([10, 11, 12]) / 80000])
    beside = np.array([[0, 200.0, 0]])
    towards = beside[0] - lamp.position
    cosine = towards @ lamp.direction / np.linalg.norm(towards)
    np.testing.assert_allclose(
        lamp.irradiance(beside)[0], np.array([10, 11, 12]) * cosine**3 / (towards @ towards)
    )


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({"mu": None}, "mu missing"),
        ({"mu": np.ones((3, 1))}, "other lengths"),
        ({"S": np.ones((4, 2))}, "S: expected an array of n x 3"),
        ({"S": np.full((4, 3), np.nan)}, "S: expected finite"),
        ({"S": np.array([["a", "b", "c"]] * 4, dtype=object)}, "S: expected an array"),
        ({"Dir": np.zeros((4, 3))}, "not zero"),
        ({"Phi": -np.ones((4, 3))}, "intensity: expected values >= 0"),
        ({"mu": -np.ones((4, 1))}, "exponent >= 0"),
    ],
)
def test_near_lights_that_are_refused(near, more, reason):
    with pytest.raises(CaptureError, match=reason):
        near(**more)


def test_damaged_matlab_files(near, tmp_path):
    near()
    content = (tmp_path / "light.mat").read_bytes()
    for damaged in (
        content[:200],
        content[:60],
        b"",
        b"x" * 500,
        b"\x89HDF\r\n\x1a\n" + content,
        b"\x00\x00\x00\x0c" + content,  # version 4 of a size that overflows
        (2000).to_bytes(4, "little") + content,  # numbers as a VAX has them
    ):
        (tmp_path / "light.mat").write_bytes(damaged)
        with pytest.raises(CaptureError, match=r"light\.mat"):
            open_capture(tmp_path)


# --- many views ---------------------------------------------------------------------------


def test_diligent_mv(tmp_path, rounding):
    cameras = ring(3, cx=8.0, cy=6.0)
    stretch = np.diag([1.003458, 1, 1])  # as the published rotations are off
    calibration = {"KK": cameras[0].matrix @ np.linalg.solve(stretch, np.eye(3))
                   - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])}  # fmt: skip
    inner = calibration["KK"] + 0.0
    for i, camera in enumerate(cameras, 1):
        pose = camera.camera_from_world
        shifted = np.linalg.solve(inner, (camera.matrix - [[0, 0, 0.5], [0, 0, 0.5], [0] * 3]))
        calibration[f"Rc_{i}"] = shifted @ pose[:3, :3]
        calibration[f"Tc_{i}"] = (shifted @ pose[:3, 3])[:, None]
        folder = tmp_path / f"view_{i:02d}"
        write_photographs(folder, [*NAMES, "mask.png"])
        (folder / "light_directions.txt").write_text(numbers(DIRECTIONS))
    scipy.io.savemat(tmp_path / "Calib_Results.mat", calibration)
    capture = open_capture(tmp_path)
    assert_same_cameras(capture.cameras, cameras, tolerance=1e-9)
    assert (capture.n_lights, len(capture.photographs)) == (12, 12)
    for photograph in capture.photographs:
        camera, light = capture.cameras[photograph.camera], capture.lights[photograph.light]
        in_camera = camera.rotation @ light.direction * [1, -1, -1]
        difference = np.abs(DIRECTIONS - in_camera).max(axis=1).min()
        assert difference < rounding(np.float64, condition=np.linalg.cond(inner))
    del calibration["Rc_2"]
    scipy.io.savemat(tmp_path / "Calib_Results.mat", calibration)
    with pytest.raises(CaptureError, match="none of Rc_2"):
        open_capture(tmp_path)


@pytest.fixture
def stage(tmp_path):
    """OpenIllumination: three cameras, lamps 0 and 2 of four."""
    frames = {
        f"CA{i}": {
            "transform_matrix": (np.linalg.solve(c.camera_from_world, np.eye(4))
                                 @ np.diag([1.0, -1, -1, 1])).tolist(),
            "camera_angle_x": 2 * np.arctan(8 / 30),
        }
        for i, c in enumerate(ring(3))
    }  # fmt: skip
    (tmp_path / "output").mkdir()
    (tmp_path / "output/transforms_train.json").write_text(json.dumps({"frames": frames}))
    for lamp in ("000", "002"):
        write_photographs(
            tmp_path / "Lights" / lamp / "raw_undistorted", [f"{n}.png" for n in frames]
        )
    write_photographs(tmp_path / "output/obj_masks", [f"{n}.png" for n in frames])
    np.save(tmp_path / "light_pos.npy", np.arange(12.0).reshape(4, 3))
    return tmp_path


def test_openillumination(stage):
    capture = open_capture(stage)
    assert_same_cameras(capture.cameras, ring(3, fl_y=30.0, cx=8.0, cy=6.0), tolerance=1e-9)
    assert [light.position.tolist() for light in capture.lights] == [[0, 1, 2], [6, 7, 8]]
    assert (capture.photograph_index >= 0).all()
    assert all(path.parent.name == "obj_masks" for path in capture.silhouettes)
    (stage / "Lights/002/raw_undistorted/CA1.png").unlink()
    capture = open_capture(stage)
    assert (capture.photograph_index < 0).sum() == 1
    assert any("1 of 6 photographs are absent" in note for note in capture.notes)


def test_openillumination_refusals(stage):
    np.save(stage / "light_pos.npy", np.ones((2, 3)))
    with pytest.raises(CaptureError, match="number below 2"):
        open_capture(stage)
    (stage / "light_pos.npy").unlink()
    with pytest.raises(CaptureError, match="positions of the lamps; copy"):
        open_capture(stage)
    (stage / "Lights/000").rename(stage / "Lights/001")
    with pytest.raises(CaptureError, match="patterns 001 to 013"):
        open_capture(stage)
    (stage / "output/transforms_train.json").write_text('{"frames": [1]}')
    with pytest.raises(CaptureError, match="expected an object of cameras by name"):
        open_capture(stage)


@pytest.fixture
def rene(tmp_path):
    pytest.importorskip("yaml")
    cameras = ring(3)
    text = (
        "intrinsics:\n  camera_matrix: [[30, 0, 8], [0, 31, 5], [0, 0, 1]]\n"
        "  image_size: [16, 12]\n  dist_coeffs:\n  - [-0.1, 0.02, 0.003, 0.004, 0.0]\n"
    )
    for lamp in range(2):
        folder = tmp_path / f"lset{lamp:03d}"
        rng = np.random.default_rng(lamp)
        for i, camera in enumerate(cameras):
            pixels = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
            (folder / "data").mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / f"data/{i:02d}_image.png"), pixels)
            pose = np.linalg.solve(camera.camera_from_world, np.eye(4))
            (folder / f"data/{i:02d}_pose.txt").write_text(numbers(pose))
        (folder / "camera.yml").write_text(text)
        light = np.eye(4)
        light[:3, 3] = lamp, 2, 3
        (folder / "light.txt").write_text(numbers(light))
    return tmp_path


def test_rene(rene):
    expected = ring(3, distortion=(-0.1, 0.02, 0.003, 0.004))
    capture = open_capture(rene)
    assert_same_cameras(capture.cameras, expected)
    assert [light.position.tolist() for light in capture.lights] == [[0, 2, 3], [1, 2, 3]]
    assert (capture.photograph_index >= 0).all()
    one = open_capture(rene / "lset001")
    assert (one.n_lights, len(one.photographs)) == (1, 3)


def test_black_photographs_of_rene_are_left_out(rene, monkeypatch):
    monkeypatch.setattr("reflfield.capture.rene.BLACK_SHARE", 0.5)
    write_png(rene / "lset000/data/01_image.png", np.zeros((12, 16, 3), np.uint8))
    capture = open_capture(rene)
    assert (capture.photograph_index < 0).sum() == 1
    assert any("1 black photographs" in note for note in capture.notes)


@pytest.mark.parametrize(
    ("file", "text", "reason"),
    [
        ("camera.yml", "a: &a [1]\nb: *a\n", "without anchors"),
        ("camera.yml", "intrinsics: [", "expected YAML"),
        ("camera.yml", "a: 1\n", "expected 'intrinsics'"),
        ("camera.yml", "intrinsics:\n  camera_matrix: 1\n", "camera_matrix: expected 3 x 3"),
        ("camera.yml", "intrinsics:\n  skew: 1\n", "'skew': expected only"),
        ("light.txt", "1 2 3", "matrix of 4 x 4"),
        ("data/01_pose.txt", numbers(2 * np.eye(4)), "rotation and a translation"),
    ],
)
def test_rene_refusals(rene, file, text, reason):
    (rene / "lset000" / file).write_text(text)
    with pytest.raises(CaptureError, match=reason):
        open_capture(rene)
