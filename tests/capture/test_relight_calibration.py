"""Calibrated lamps of relight's documented ``.dome``."""

import json
import math

import numpy as np
import pytest

from reflfield.capture.conversion import convert_capture
from reflfield.capture.gain_grids import LARGEST_GAIN
from reflfield.capture.image_writing import write_exr
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError

# Photographs of an image plane 80 x 60 mm large, and lamps near it: millimetres.
COLUMNS, ROWS = 24, 18
WIDE, HIGH = 80.0, 60.0
POSITIONS = [(150.0, 0.0, 200.0), (-40.0, 120.0, 90.0), (0.0, -160.0, 60.0)]
COLORS = [(1.0, 0.8, 0.5), (0.5, 1.0, 2.0), (1.5, 1.5, 1.5)]
# Larger towards the top left.
SMALL = {"width": 80, "height": 60, "rows": 2, "cols": 3, "intensity": [9, 4, 2, 5, 3, 1]}
BALANCE = {"r": 0.5, "g": 1, "b": 4}


def objects(vectors):
    return [dict(zip("xyz", vector, strict=True)) for vector in vectors]


def written(folder, images, changes):
    """Open photographs with a documented ``.dome`` beside them; None removes a key."""
    (folder / "images").mkdir(exist_ok=True)
    for i, image in enumerate(images):
        write_exr(folder / f"images/p{i}.exr", image)
    document = {
        "path": "/somewhere/else/a.dome",
        "diameter": 500,
        "imageWidth": WIDE,
        "verticalOffset": 0,
        "positions": objects(POSITIONS),
        "directions": objects(POSITIONS),
        **changes,
    }
    kept = {key: value for key, value in document.items() if value is not None}
    (folder / "a.dome").write_text(json.dumps(kept))
    return open_capture(folder)


def each(**entry):
    return {"lightsCalibration": [entry] * 3}


@pytest.fixture
def images(rng):
    return rng.uniform(0.1, 0.9, (3, ROWS, COLUMNS, 3)).astype(np.float32)


def place_of(row, column):
    """Millimetres from the image's centre of a pixel's centre; x right, y up."""
    return (column + 0.5) / COLUMNS * WIDE - WIDE / 2, HIGH / 2 - (row + 0.5) / ROWS * HIGH


def grid_by_hand(grid, x, y):
    """Value of a ``spatialCalibration`` at millimetres from the centre; y up."""
    values = np.reshape(grid["intensity"], (grid["rows"], grid["cols"]))
    u = (x + grid["width"] / 2) / (grid["width"] / (grid["cols"] - 1))
    v = (grid["height"] / 2 - y) / (grid["height"] / (grid["rows"] - 1))
    c, r = min(math.floor(u), grid["cols"] - 2), min(math.floor(v), grid["rows"] - 2)
    s, t = u - c, v - r
    return (
        (1 - s) * (1 - t) * values[r, c]
        + s * (1 - t) * values[r, c + 1]
        + (1 - s) * t * values[r + 1, c]
        + s * t * values[r + 1, c + 1]
    )


def plane_points():
    """World positions of the pixels on the plane z = 0, metres."""
    places = [(*place_of(row, column), 0.0) for row in range(ROWS) for column in range(COLUMNS)]
    return 1e-3 * np.array(places)


def corrected(capture, index):
    """Radiance over the irradiance of a surface that faces the lamp, as samples are."""
    irradiance = capture.lights[index].irradiance(plane_points())
    return capture.read_photograph(index) / irradiance.reshape(ROWS, COLUMNS, 3)


def test_positions_count_before_directions(tmp_path, images):
    capture = written(tmp_path, images, {})
    positions = [light.position for light in capture.lights]
    np.testing.assert_allclose(positions, 1e-3 * np.array(POSITIONS))
    assert {light.kind for light in capture.lights} == {"point"}
    # 80 mm: 24 pixels
    assert capture.cameras[0].fl_x == pytest.approx(COLUMNS / 0.08)
    # the lens looks down on y up, at the middle
    assert capture.cameras[0].project([[0.04, 0.03, 0]])[0][0] == pytest.approx([COLUMNS, 0])


def test_positions_are_relative_to_the_dome(tmp_path, images):
    capture = written(tmp_path, images, {"verticalOffset": 15})
    assert capture.lights[1].position == pytest.approx([-0.04, 0.12, 0.105])
    assert any("15 mm below the origin" in detail for detail in capture.details)


def test_directions_without_positions(tmp_path, images, rounding):
    changes = {"positions": None, "imageWidth": None}
    balance = each(whiteBalance=BALANCE, intensity=2)
    capture = written(tmp_path, images, changes | balance)
    assert {light.kind for light in capture.lights} == {"directional"}
    np.testing.assert_allclose(capture.lights[0].direction, [0.6, 0, 0.8])
    # R' = R w a
    for i, image in enumerate(images):
        expected = image * (2 * np.array([0.5, 1, 4]))
        np.testing.assert_allclose(corrected(capture, i), expected, rounding(np.float32, 2))


def test_lamps_without_a_grid_fall_off(tmp_path, images, rounding):
    """R' = R w a d^2: relight's program multiplies by the squared distance."""
    capture = written(tmp_path, images, each(whiteBalance=BALANCE, intensity=0.25))
    squared = np.square(plane_points() - 1e-3 * np.array(POSITIONS[1])).sum(axis=1)
    factor = 0.25 * np.array([0.5, 1, 4]) * squared[:, None]
    expected = images[1] * factor.reshape(ROWS, COLUMNS, 3)
    np.testing.assert_allclose(corrected(capture, 1), expected, rounding(np.float32, 3))
    np.testing.assert_array_equal(capture.read_photograph(1), images[1])


def test_a_grid_holds_the_distance(tmp_path, images, rounding):
    """R' = R w g, pixel by pixel, and no distance beside it."""
    entry = {"whiteBalance": BALANCE, "intensity": 7, "spatialCalibration": SMALL}
    capture = written(tmp_path, images, each(**entry))
    for row in range(ROWS):
        for column in range(COLUMNS):
            gain = grid_by_hand(SMALL, *place_of(row, column))
            expected = images[2, row, column] * gain * np.array([0.5, 1, 4])
            pixel = corrected(capture, 2)[row, column]
            np.testing.assert_allclose(pixel, expected, rounding(np.float32, 4))
    # The lamps keep their places: directions differ over the image.
    assert capture.lights[0].directions(plane_points()).std(axis=0)[0] > 0.01
    assert any("intensity of 3 lights not used" in note for note in capture.notes)


def test_the_program_s_form_with_calibrations(tmp_path, images):
    form = {"positions": None, "lightConfiguration": "lights3d"}
    lists = {"positions3d": objects(POSITIONS), "positionsSphere": []}
    capture = written(tmp_path, images, form | lists | each(spatialCalibration=SMALL))
    assert [p.gain is None for p in capture.photographs] == [False] * 3
    np.testing.assert_allclose(capture.lights[0].position, 1e-3 * np.array(POSITIONS[0]))


def lamp_strength(i, points):
    """What lamp `i` gives a facing surface at places (n, 3), mm: a cone and 1 / d^2."""
    away = np.asarray(POSITIONS[i]) - points
    distance = np.sqrt(np.square(away).sum(axis=1))
    axis = np.asarray(POSITIONS[i]) / np.linalg.norm(POSITIONS[i])
    return 1e4 * (away @ axis / distance) ** 4 / distance**2


def grid_of(i, rows, columns):
    """The calibration that corrects lamp `i`, as its maker measures it."""
    x, y = np.meshgrid(
        np.linspace(-WIDE / 2, WIDE / 2, columns), np.linspace(HIGH / 2, -HIGH / 2, rows)
    )
    values = 1 / lamp_strength(i, np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]))
    size = {"width": WIDE, "height": HIGH, "rows": rows, "cols": columns}
    return size | {"intensity": values.tolist()}


def relative_curvature(grid):
    """Bound of the error of bilinear interpolation: an eighth of the second differences."""
    values = np.reshape(grid["intensity"], (grid["rows"], grid["cols"]))
    along = [np.abs(np.diff(values, 2, axis)).max() / 8 for axis in (0, 1)]
    return sum(along) / values.min()


@pytest.mark.parametrize("shape", [(7, 9), (13, 17)])
def test_a_white_plane_under_near_lamps_is_even(tmp_path, shape):
    """Its radiance over cosine and albedo is 1 in each colour and under each lamp."""
    points = 1e3 * plane_points()
    photographs, entries = [], []
    for i, color in enumerate(COLORS):
        away = np.asarray(POSITIONS[i]) - points
        cosine = away[:, 2] / np.sqrt(np.square(away).sum(axis=1))
        shade = 0.7 * lamp_strength(i, points) * cosine
        photographs.append((shade[:, None] * color).reshape(ROWS, COLUMNS, 3))
        balance = dict(zip("rgb", (1 / np.array(color)).tolist(), strict=True))
        entries.append({"whiteBalance": balance, "spatialCalibration": grid_of(i, *shape)})
    capture = written(tmp_path, photographs, {"lightsCalibration": entries})
    assert not capture.notes
    for i in range(3):
        light = capture.lights[i].directions(plane_points())[:, 2].reshape(ROWS, COLUMNS, 1)
        albedo = corrected(capture, i) / light
        # Interpolation; second differences at nodes are within a fifth of those between.
        bound = 1.2 * relative_curvature(grid_of(i, *shape)) + 1e-6
        assert bound < 0.02
        np.testing.assert_allclose(albedo, 0.7, rtol=bound)


def test_converted_domes_keep_their_calibration(tmp_path, images, rounding):
    entry = {"whiteBalance": BALANCE, "spatialCalibration": SMALL}
    capture = written(tmp_path, images, each(**entry))
    convert_capture(capture, tmp_path / "out", "native")
    again = open_capture(tmp_path / "out")
    assert [p.gain for p in again.photographs] == [p.gain for p in capture.photographs]
    for i in range(3):
        np.testing.assert_array_equal(corrected(again, i), corrected(capture, i))


def test_grids_that_fall_with_the_distance_are_told(tmp_path, images):
    """As light does that was measured; a correction rises."""
    grids = [grid_of(i, 4, 5) for i in range(3)]
    measured = [g | {"intensity": (1 / np.array(g["intensity"])).tolist()} for g in grids]
    for some, n_notes in ((grids, 0), (measured, 1)):
        entries = [{"spatialCalibration": grid} for grid in some]
        capture = written(tmp_path, images, {"lightsCalibration": entries})
        assert sum("write its reciprocals" in note for note in capture.notes) == n_notes


def changed(**changes):
    """A calibration of which the grid is changed."""
    return each(spatialCalibration=SMALL | changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lightsCalibration": {}}, "lightsCalibration: expected a list of one entry for each"),
        ({"lightsCalibration": [{}] * 2}, "each of 3 lights, received 2"),
        ({"lightsCalibration": [{}, 3, {}]}, "lightsCalibration[1]: expected an object"),
        (each(colour=1), "lightsCalibration[0]: expected an object with keys of"),
        (each(intensity=0), "lightsCalibration[0].intensity: expected a factor"),
        (each(intensity="1"), "lightsCalibration[0].intensity: expected a number"),
        (each(whiteBalance=[1, 1, 1]), "whiteBalance: expected an object with all of b, g, r"),
        (each(whiteBalance={"r": 1, "g": 1}), "whiteBalance: expected an object with all of"),
        (each(whiteBalance=BALANCE | {"b": -1}), "whiteBalance.b: expected a factor"),
        (changed(width=0), "spatialCalibration.width: expected a length in millimetres"),
        (changed(rows=2.5), "spatialCalibration.rows: expected a whole number above 0"),
        (changed(rows=6, cols=1), "expected at least 2 rows of 2 gains, received 6 x 1"),
        (changed(rows=10**6, cols=10**6), "expected at most 65,536 gains"),
        (changed(rows=3), "expected a list of 3 x 3 = 9 numbers (rows times cols), received 6"),
        (changed(intensity=5), "expected a list of 2 x 3 = 6 numbers"),
        (changed(intensity=[1, 1, 0, 1, 1, 1]), "spatialCalibration.intensity[2]: expected"),
        (changed(intensity=[1, 1, 1, -1, 1, 1]), "spatialCalibration.intensity[3]: expected"),
        (changed(intensity=[2 * LARGEST_GAIN] * 6), "intensity[0]: expected a factor"),
        (changed(intensity=[None] * 6), "intensity: expected 6 numbers"),
        (changed(depth=3), "spatialCalibration: expected an object with all of"),
        (changed(width=30), "covers the image, 80 x 60 mm, received 30 x 60 mm"),
        (changed(height=20), "covers the image, 80 x 60 mm, received 80 x 20 mm"),
        ({"lightsCalibration": [{"spatialCalibration": SMALL}, {}, {}]},
         "lightsCalibration[1]: expected a spatialCalibration as other lights have"),
        ({"positions": None} | each(spatialCalibration=SMALL),
         "[0].spatialCalibration: expected none where lights are directions only"),
        ({"imageWidth": None}, "imageWidth: expected a number"),
        ({"positions": None, "directions": None}, "expected lights, as positions"),
        ({"lightConfiguration": "lights3d", "positions3d": objects(POSITIONS)},
         "positions: expected positions3d beside lightConfiguration 'lights3d'"),
        ({"lightConfiguration": ["lights3d"]}, "lightConfiguration: expected directional"),
        ({"verticalOffset": "1"}, "verticalOffset: expected a number"),
        ({"unknown": 1}, "unknown: expected the keys"),
    ],
)  # fmt: skip
def test_calibrations_that_are_refused(tmp_path, images, changes, words):
    with pytest.raises(CaptureError) as raised:
        written(tmp_path, images, changes)
    assert "a.dome: " in str(raised.value)
    assert words in str(raised.value)
