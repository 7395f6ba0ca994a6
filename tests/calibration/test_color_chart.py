"""A ColorChecker drawn as a camera of known matrix sees it, and what is fitted to it."""

import json
from dataclasses import replace
from importlib.util import find_spec

import cv2
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from reflfield.calibration import color_chart
from reflfield.calibration.color_chart import color_correction
from reflfield.calibration.corrected_photographs import with_colors_corrected
from reflfield.capture.conversion import convert_capture
from reflfield.capture.encoding import Encoding, encode_srgb, parse_encoding
from reflfield.capture.image_files import ImageReading, read_image
from reflfield.capture.image_writing import write_exr
from reflfield.capture.readers import open_capture
from reflfield.cli import app
from reflfield.errors import InputError
from tests.calibration.planted_poses import simulate

CAMERA_FROM_LINEAR = np.array([[0.40, 0.12, 0.03], [0.06, 0.55, 0.09], [0.02, 0.10, 0.28]])


def needs_the_extra():
    """Skip without it; not by an import, which would change how NumPy prints."""
    if find_spec("colour") is None:
        pytest.skip("needs the extra color")


def test_numpy_prints_as_before_after_the_library_was_used():
    """It switches NumPy to how it printed arrays in 2017."""
    needs_the_extra()
    with color_chart._library():
        pass
    assert repr(np.array([1.0, 2.0])) == "array([1., 2.])"
    assert np.get_printoptions()["legacy"] is False


@pytest.fixture
def chart_photograph():
    """Function that draws the chart as a camera sees it, linear."""
    needs_the_extra()
    with color_chart._library() as colour:
        colors = color_chart._reference(colour)

    def draw(camera_from_linear, exposure=1.0):
        seen = np.maximum(colors @ camera_from_linear.T, 0) * exposure
        image = np.full((480, 640, 3), 0.25)
        image[60:420, 50:590] = 0.005
        for number, color in enumerate(seen):
            row, column = divmod(number, 6)
            y, x = 72 + 88 * row, 62 + 88 * column
            image[y : y + 72, x : x + 72] = color
        return np.clip(image, 0, 1).astype(np.float32)

    return draw


def test_matrix_of_the_camera_is_inverted(chart_photograph, rounding):
    correction = color_correction(chart_photograph(CAMERA_FROM_LINEAR), "chart")
    assert correction.kind == "matrix"
    assert correction.grey_scatter < 1.1
    assert len(correction.lines()) == 2
    # Means of evenly coloured patches: single precision is all that is left.
    tolerance = rounding(np.float32, 4, np.linalg.cond(CAMERA_FROM_LINEAR))
    total = correction.matrix @ CAMERA_FROM_LINEAR
    np.testing.assert_allclose(total / total[1, 1], np.eye(3), atol=tolerance)
    assert correction.error_after < 1 < correction.error_balanced < correction.error_before


def patches(photograph):
    return color_chart._sampled(photograph, color_chart._chart(photograph, "chart.exr"))


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_chart_that_lies_turned_and_aslant_gives_the_same(chart_photograph, quarters):
    upright = chart_photograph(CAMERA_FROM_LINEAR)
    height, width = upright.shape[:2]
    corners = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
    aslant = corners + np.float32([[60, 20], [-30, 50], [-10, -60], [20, -10]])
    moved = cv2.warpPerspective(
        upright,
        cv2.getPerspectiveTransform(corners, aslant),
        (width, height),
        flags=cv2.INTER_LINEAR,
        borderValue=(0.25, 0.25, 0.25),
    )
    turned = patches(np.ascontiguousarray(np.rot90(moved, quarters)))
    # Means of evenly coloured patches: single precision and OpenCV's 5 bits between pixels.
    np.testing.assert_allclose(turned, patches(upright), atol=1e-5)


def test_two_charts_are_refused(chart_photograph):
    two = np.concatenate([chart_photograph(CAMERA_FROM_LINEAR)] * 2)
    with pytest.raises(InputError, match=r"expected one ColorChecker .* found 2"):
        patches(two)


def test_clipped_patches_are_left_out(chart_photograph, rounding):
    bright = color_correction(chart_photograph(CAMERA_FROM_LINEAR, 1.8), "chart")
    assert 12 <= bright.n_used < 24
    tolerance = rounding(np.float32, 4, np.linalg.cond(CAMERA_FROM_LINEAR))
    total = bright.matrix @ CAMERA_FROM_LINEAR
    np.testing.assert_allclose(total / total[1, 1], np.eye(3), atol=tolerance)


def test_photograph_without_chart_is_refused(chart_photograph):
    with pytest.raises(InputError, match="expected one ColorChecker"):
        color_correction(np.full((200, 300, 3), 0.3, np.float32), "wall.exr")


def test_missing_packages_are_named(monkeypatch):
    monkeypatch.setattr(color_chart, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r'pip install "reflfield\[color\]"'):
        color_correction(np.zeros((4, 4, 3)), "chart")


@pytest.fixture(scope="session")
def dome(made_once):
    return open_capture(made_once("pose-dome", simulate)[0])


def test_saturated_pixels_stay_saturated(dome, tmp_path):
    image = dome.read_photograph(0)
    image[10:20, 10:20] = [9.0, 0.2, 0.1]
    write_exr(tmp_path / "a.exr", image)
    exposure = replace(
        dome.photographs[0].exposures[0],
        path=tmp_path / "a.exr",
        reading=ImageReading(white_level=9.0),
    )
    photograph = replace(dome.photographs[0], exposures=(exposure,))
    one = replace(dome, photographs=(photograph,))
    corrected = with_colors_corrected(one, np.diag([0.5, 1.0, 2.0]), tmp_path)
    values, kinds = corrected.read_kinds(0)
    saturated = np.zeros(image.shape, bool)
    saturated[10:20, 10:20] = True
    np.testing.assert_array_equal(kinds == 1, saturated)
    expected = (image * np.array([0.5, 1.0, 2.0], np.float32))[~saturated]
    np.testing.assert_array_equal(values[~saturated], expected)


def test_command(dome, chart_photograph, tmp_path, rounding):
    one = dome.subset(views=[0, 1])
    convert_capture(one, tmp_path / "capture", link=True)
    write_exr(tmp_path / "chart.exr", chart_photograph(np.diag([0.8, 0.5, 0.3])))
    arguments = ["calibrate", str(tmp_path / "capture"), "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(app, [*arguments, "--color-checker", str(tmp_path / "chart.exr")])
    assert done.exit_code == 0, done.output
    entry = json.loads((tmp_path / "out/calibration.json").read_text())
    gains = np.array(entry["color"]["white_balance"])
    np.testing.assert_allclose(gains, [0.5 / 0.8, 1.0, 0.5 / 0.3], rounding(np.float32, 4))
    written = open_capture(tmp_path / "out")
    matrix = np.array(entry["color"]["matrix"], np.float32)
    expected = np.maximum(one.read_photograph(1) @ matrix.T, 0)
    np.testing.assert_allclose(written.read_photograph(1), expected, 0, rounding(np.float32))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["capture", "chart.exr", "out"]


def test_a_tone_curve_is_told_by_the_greys_and_undone(dome, chart_photograph, tmp_path):
    linear = chart_photograph(np.diag([0.9, 0.9, 0.9]))
    # Lifts the middle and rolls off the bright, as cameras do for JPEG files.
    toned = linear / (linear + 0.3) * 1.3
    codes = np.rint(255 * np.asarray(encode_srgb(np.clip(toned, 0, 1)))).astype(np.uint8)
    Image.fromarray(codes).save(tmp_path / "chart.png")
    convert_capture(dome.subset(views=[0, 1]), tmp_path / "capture", link=True)
    arguments = ["calibrate", str(tmp_path / "capture"), "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(app, [*arguments, "--color-checker", str(tmp_path / "chart.png")])
    assert done.exit_code == 0, done.output
    assert "chart_greys.csv has the curve" in done.output
    curve = parse_encoding(str(tmp_path / "out/chart_greys.csv"))
    again = color_correction(read_image(tmp_path / "chart.png", ImageReading(curve)), "chart")
    assert again.grey_scatter < 1.02
    assert again.curve == ()


def test_chart_of_a_museum(shared_data, tmp_path):
    needs_the_extra()
    path = shared_data("mia_rodin_metashape") / "colorchecker_231016_miaEURO_9505.jpg"
    correction = color_correction(read_image(path), path.name)
    assert correction.n_used >= 12
    # Developed with a tone curve: nothing linear does much, but the patches are the right ones.
    assert correction.error_before < 10
    # Observed 0.028: the greys do not agree, as the scatter says.
    np.testing.assert_allclose(correction.white_balance, 1.0, atol=0.05)
    assert correction.grey_scatter > 1.5
    assert "not linear" in correction.lines()[-1]
    codes = read_image(path, ImageReading(Encoding("linear")))
    curve = color_correction(read_image(path), path.name, codes).curve
    assert len(curve) >= 5
    assert np.diff(curve, axis=0).min() > 0
