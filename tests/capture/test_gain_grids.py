"""Gains multiply the values of photographs, after dark frames, before anything reads them."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from reflfield.calibration.corrected_photographs import with_colors_corrected
from reflfield.capture.clipping import MEASURED, SATURATED
from reflfield.capture.conversion import convert_capture
from reflfield.capture.gain_grids import (
    LARGEST_GAIN,
    MOST_NODES,
    ROWS_AT_ONCE,
    GainGrid,
    gain_entry,
    gain_grid,
)
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.capture.inspect import describe
from reflfield.capture.readers import open_capture
from reflfield.checking.dark_frame_findings import dark_frame_findings
from reflfield.checking.photograph_statistics import read_photographs
from reflfield.errors import CaptureError, InputError

WIDTH, HEIGHT = 12, 10
# Larger towards the top left, so that no exchange of axes or edges goes unnoticed.
VALUES = ((9.0, 4.0, 2.0), (5.0, 3.0, 1.0))
GRID = GainGrid(-1.0, 0.5, 13.0, 9.5, VALUES)


def gain_by_hand(grid, x, y):
    """The gain at one place, by the formula of two neighbours along each axis."""
    rows, columns = len(grid.values), len(grid.values[0])
    u = (x - grid.left) / (grid.right - grid.left) * (columns - 1)
    v = (y - grid.top) / (grid.bottom - grid.top) * (rows - 1)
    u, v = min(max(u, 0), columns - 1), min(max(v, 0), rows - 1)
    c, r = min(math.floor(u), columns - 2), min(math.floor(v), rows - 2)
    s, t = u - c, v - r
    upper = (1 - s) * grid.values[r][c] + s * grid.values[r][c + 1]
    lower = (1 - s) * grid.values[r + 1][c] + s * grid.values[r + 1][c + 1]
    return (1 - t) * upper + t * lower


def map_by_hand(grid, width=WIDTH, height=HEIGHT):
    return np.array(
        [[gain_by_hand(grid, x + 0.5, y + 0.5) for x in range(width)] for y in range(height)]
    )


def document(**more):
    """Two views of two lights each; float photographs."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 2
    size = {"w": WIDTH, "h": HEIGHT, "fl_x": 20, "fl_y": 20, "cx": 6, "cy": 5}
    return {
        "format": "reflfield-capture",
        "version": 1,
        "cameras": [
            {"id": f"v{i}", **size, "camera_from_world": pose.tolist()} for i in (0, 1)
        ],
        "lights": [
            {"id": f"l{i}", "type": "point", "position": [i, 0, 2], "intensity": [1, 1, 1]}
            for i in (0, 1)
        ],
        "photographs": [
            {"camera": f"v{i}", "light": f"l{j}", "file": f"v{i}_l{j}.exr"}
            for i in (0, 1)
            for j in (0, 1)
        ],
        **more,
    }


def opened(folder, changed):
    (folder / "capture.json").write_text(json.dumps(changed))
    return open_capture(folder)


@pytest.fixture
def stored(tmp_path, rng):
    """Four photographs (4, h, w, 3) as they are in their files, in the test's folder."""
    images = rng.uniform(0.1, 0.9, (4, HEIGHT, WIDTH, 3)).astype(np.float32)
    for i, image in enumerate(images):
        write_exr(tmp_path / f"v{i // 2}_l{i % 2}.exr", image)
    return images


def with_gain(place, grid=GRID):
    """The description with a gain at the top, of the first camera or the first photograph."""
    changed = document()
    at = changed if place == "all" else changed[place][0]
    at["gain"] = gain_entry(grid)
    return changed


@pytest.mark.parametrize(
    "grid",
    [
        GRID,
        GainGrid(0.5, 0.5, 11.5, 9.5, ((1, 2), (3, 5))),
        GainGrid(2, 1, 10, 9, tuple(tuple(1 + i + j * j for i in range(3)) for j in range(4))),
    ],
)
def test_gains_between_nodes_are_bilinear(grid, rounding):
    x, y = np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5
    gains = grid.at(x, y)
    assert (gains.shape, gains.dtype) == ((HEIGHT, WIDTH), np.float32)
    np.testing.assert_allclose(gains, map_by_hand(grid), rtol=rounding(np.float32))


def test_the_first_value_is_the_top_left_one():
    x, y = np.array([-1.0, 6.0, 13.0]), np.array([0.5, 9.5])
    np.testing.assert_array_equal(GRID.at(x, y), VALUES)


def test_images_of_more_rows_than_are_made_at_once(rng, rounding):
    height = 2 * ROWS_AT_ONCE + 3
    grid = GainGrid(0, 0, 4, height, ((1, 2), (3, 5), (2, 8)))
    image = rng.uniform(0.1, 1, (height, 4, 3)).astype(np.float32)
    expected = image * map_by_hand(grid, 4, height)[..., None]
    result = grid.multiply(image, "a.png")
    np.testing.assert_allclose(result, expected, rtol=rounding(np.float32))


@pytest.mark.parametrize(
    ("place", "multiplied"),
    [("all", {0, 1, 2, 3}), ("cameras", {0, 1}), ("photographs", {0})],
)
def test_photographs_are_multiplied(tmp_path, stored, place, multiplied, rounding):
    capture = opened(tmp_path, with_gain(place))
    gains = map_by_hand(GRID)[..., None]
    for i, image in enumerate(stored):
        expected = image * gains if i in multiplied else image
        read, kinds = capture.read_kinds(i)
        # one rounding of the gain, one of the product
        np.testing.assert_allclose(read, expected, rtol=rounding(np.float32, 2))
        np.testing.assert_array_equal(capture.read_photograph(i), read)
        assert (kinds == MEASURED).all()
    detail = f"gains, which {len(multiplied)} photographs are multiplied by"
    assert detail in describe(capture).details


def test_the_nearest_gain_counts(tmp_path, stored, rounding):
    changed = with_gain("all")
    changed["cameras"][0]["gain"] = gain_entry(replace(GRID, values=((1, 1), (1, 1))))
    changed["photographs"][1]["gain"] = gain_entry(replace(GRID, values=((2, 2), (2, 2))))
    capture = opened(tmp_path, changed)
    np.testing.assert_array_equal(capture.read_photograph(0), stored[0])
    np.testing.assert_array_equal(capture.read_photograph(1), 2 * stored[1])
    assert capture.photographs[2].gain == capture.photographs[3].gain == GRID


def test_dark_frames_are_subtracted_before(tmp_path, stored, rounding):
    dark = np.full((HEIGHT, WIDTH, 3), 0.0625, np.float32)
    write_exr(tmp_path / "dark.exr", dark)
    capture = opened(tmp_path, with_gain("all") | {"dark": "dark.exr"})
    expected = (stored[2] - dark) * map_by_hand(GRID)[..., None]
    np.testing.assert_allclose(
        capture.read_photograph(2), expected, rtol=rounding(np.float32, 3)
    )
    # Of the dark frame `check` tells what it takes away of the light that the camera saw.
    findings = dark_frame_findings(capture)[0]
    share = 100 * np.median([0.0625 / stored[i].mean() for i in (0, 2)])
    assert f"{share:.1f} % of the light" in findings[0].line()


def test_saturated_values_stay_saturated(tmp_path, stored):
    codes = np.full((HEIGHT, WIDTH, 3), 40_000, np.uint16)
    codes[2, 3] = 65535
    write_png(tmp_path / "a.png", codes)
    changed = with_gain("all")
    changed["photographs"][0] |= {"file": "a.png", "encoding": "linear"}
    image, kinds = opened(tmp_path, changed).read_kinds(0)
    assert (kinds[2, 3] == SATURATED).all()
    assert (kinds == SATURATED).sum() == 3
    # At least that: the limit times the gain, to the last place of single precision.
    assert image[2, 3, 0] == pytest.approx(map_by_hand(GRID)[2, 3], rel=1e-6)


def test_statistics_and_corrected_copies_are_of_the_product(tmp_path, stored, rounding):
    capture = opened(tmp_path, with_gain("all"))
    product = stored[0] * map_by_hand(GRID)[..., None]
    statistics = read_photographs(capture, [0]).of[0]
    assert statistics.scale == pytest.approx(product.max(), rel=rounding(np.float32, 2))
    (tmp_path / "corrected").mkdir()
    copies = with_colors_corrected(capture, np.eye(3), tmp_path / "corrected")
    np.testing.assert_array_equal(copies.read_photograph(0), capture.read_photograph(0))
    assert {p.gain for p in copies.photographs} == {None}


def test_silhouettes_are_made_of_the_product(tmp_path):
    """A backdrop that the lamp lights unevenly is even after its gain."""
    grid = GainGrid(0, 0, WIDTH, HEIGHT, ((1, 8), (2, 16)))
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    inside = (abs(x - 5.5) < 3) & (abs(y - 4.5) < 3)
    for name in ("v0_l0", "v0_l1", "v1_l0", "v1_l1"):
        lit = np.where(inside, 0.05, 0.6) / map_by_hand(grid)
        write_exr(tmp_path / f"{name}.exr", np.repeat(lit[..., None], 3, axis=2))
    capture = opened(tmp_path, with_gain("all", grid))
    np.testing.assert_array_equal(capture.read_silhouette(0) > 0.5, inside)


def test_the_digest_depends_on_gains(tmp_path, stored):
    digests = {"photographs": set(), "silhouettes": set(), "cameras": set()}
    slight = tuple(tuple(v * (1 + 1e-12) for v in row) for row in VALUES)
    for grid in (None, GRID, replace(GRID, values=slight), replace(GRID, left=-1.5)):
        changed = document() if grid is None else with_gain("photographs", grid)
        capture = opened(tmp_path, changed)
        for part, seen in digests.items():
            seen.add(capture.digest([part]))
    counts = {part: len(seen) for part, seen in digests.items()}
    assert counts == {"photographs": 4, "silhouettes": 4, "cameras": 1}


@pytest.mark.parametrize("place", ["all", "cameras", "photographs"])
def test_converted_captures_keep_their_gains(tmp_path, stored, place):
    capture = opened(tmp_path, with_gain(place))
    convert_capture(capture, tmp_path / "out", "native")
    again = open_capture(tmp_path / "out")
    assert [p.gain for p in again.photographs] == [p.gain for p in capture.photographs]
    for i in range(4):
        np.testing.assert_array_equal(again.read_photograph(i), capture.read_photograph(i))
    written = json.loads((tmp_path / "out/capture.json").read_text())
    assert ("gain" in written["cameras"][0]) == (place != "photographs")
    assert ("gain" in written["photographs"][0]) == (place == "photographs")
    for other in ("transforms", "colmap"):
        with pytest.raises(InputError, match="expected no gain"):
            convert_capture(capture, tmp_path / other, other)


def test_point_lights_of_constant_irradiance(tmp_path, stored):
    changed = document()
    del changed["lights"][0]["intensity"]
    changed["lights"][0]["irradiance"] = [3, 2, 1]
    capture = opened(tmp_path, changed)
    points = [[0, 0, 0], [0, 0, 1.5]]
    np.testing.assert_array_equal(capture.lights[0].irradiance(points), [[3, 2, 1]] * 2)
    np.testing.assert_array_equal(capture.lights[0].distances(points), [2, 0.5])
    convert_capture(capture, tmp_path / "out", "native")
    again = open_capture(tmp_path / "out").lights[0]
    assert (again.falls_off, again.intensity.tolist()) == (False, [3, 2, 1])
    falling = replace(capture, lights=tuple(replace(x, falls_off=True) for x in capture.lights))
    assert capture.digest(["lights"]) != falling.digest(["lights"])
    for other in ("transforms", "colmap"):
        with pytest.raises(InputError, match="'point' that does not fall off"):
            convert_capture(capture, tmp_path / other, other)
    changed["lights"][0]["intensity"] = [1, 1, 1]
    with pytest.raises(CaptureError, match=r"lights\[0\]"):
        opened(tmp_path, changed)
    with pytest.raises(CaptureError, match="expected a point light where it is constant"):
        replace(again, kind="spot")


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"values": [[1, 2]]}, "expected at least 2 rows of 2 gains, received 1 x 2"),
        ({"values": [[1], [2]]}, "expected at least 2 rows of 2 gains, received 2 x 1"),
        ({"values": [[1, 2], [3]]}, "values[1]: expected 2 gains as the first row has"),
        ({"values": [[1, 2], [3, 4, 5]]}, "values[1]: expected 2 gains"),
        ({"values": [1, 2]}, "received 2 x 0"),
        ({"values": [[1, "2"], [3, 4]]}, "values: expected 2 x 2 numbers"),
        ({"values": [[1, True], [3, 4]]}, "values: expected 2 x 2 numbers"),
        ({"values": [[1, 2], [3, 0]]}, "values[1][1]: expected a gain of 1e-09"),
        ({"values": [[1, -2], [3, 4]]}, "values[0][1]: expected a gain of 1e-09"),
        ({"values": [[1, 2], [2 * LARGEST_GAIN, 1]]}, "values[1][0]: expected a gain"),
        ({"values": [[1] * (MOST_NODES // 2 + 1)] * 2}, "expected at most 65,536 gains"),
        ({"left": 20}, "left, right: expected left < right"),
        ({"bottom": 0.5}, "top, bottom: expected top < bottom"),
        ({"left": None}, "left: expected a number"),
        ({"width": 3}, "expected the keys left, top, right, bottom, values"),
    ],
)
def test_gains_that_are_refused(entry, words):
    with pytest.raises(CaptureError) as raised:
        gain_grid(gain_entry(GRID) | entry, "a.json: gain")
    assert str(raised.value).startswith("a.json: gain: ")
    assert words in str(raised.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"left": 6}, "v0_l0.exr: gain: expected nodes around all pixels, left 0.5"),
        ({"bottom": 5}, "v0_l0.exr: gain: expected nodes around all pixels, top 0.5"),
        ({"values": [[1, 0], [1, 1]]}, "capture.json: photographs[0].gain: values[0][1]"),
        ({"values": 3}, "photographs[0].gain.values"),
        ({"extra": 3}, "photographs[0].gain"),
    ],
)
def test_descriptions_with_gains_that_are_refused(tmp_path, stored, change, words):
    changed = with_gain("photographs")
    changed["photographs"][0]["gain"] |= change
    with pytest.raises(CaptureError) as raised:
        opened(tmp_path, changed)
    assert words in str(raised.value)


def test_pixels_a_little_outside_have_the_gain_of_the_edge():
    """Half of the distance of two nodes, not more."""
    grid = GainGrid(2.5, 0.5, 6.5, 9.5, ((1, 2), (3, 4)))
    grid.check_covers(9, HEIGHT, "a.png")
    assert grid.at(np.array([0.5]), np.array([0.5])) == 1
    with pytest.raises(CaptureError, match=r"a\.png: gain: .* right 9.5"):
        grid.check_covers(10, HEIGHT, "a.png")
