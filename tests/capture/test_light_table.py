"""Lights from `lights.csv`: which row belongs to which photograph, and what is refused."""

import json

import numpy as np
import pytest

from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError
from tests.capture.calibrations import colmap_text, ring, write_photographs

LAMPS = "name,x,y,z,intensity\nl0,1,0,2,3\nl1,0,1,2,4\nl2,-1,0,2,5\n"


@pytest.fixture
def dome(tmp_path):
    """Function that calibrates some photographs, adds others and lights, and opens it all."""

    def opened(calibrated, lights, others=()):
        write_photographs(tmp_path / "images", [*calibrated, *others])
        colmap_text(tmp_path / "sparse/0", ring(len(calibrated)), calibrated)
        (tmp_path / "lights.csv").write_text(lights)
        return open_capture(tmp_path)

    return opened


def table(capture):
    """Light's position and intensity by the photograph's file, and its camera."""
    return {
        photograph.path.relative_to(capture.root / "images").as_posix(): (
            photograph.camera,
            capture.lights[photograph.light].position.tolist(),
            capture.lights[photograph.light].intensity[0],
        )
        for photograph in capture.photographs
    }


FILES = ["a/l0.png", "b/l1.png", "c/l2.png"]


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (["a/l0.png", "b/l1.png", "images/c/l2.png"], FILES),  # ends of paths
        (["l0.png", "L1.png", "l2.png"], FILES),  # file names
        (["l0", "l1", "l2"], FILES),  # without suffix
        (["a", "b", "c"], FILES),  # folders
        (["l0", "l1", "l2"], ["v0_l0.png", "v1-l1.png", "v2.l2.png"]),  # words
    ],
)
def test_one_photograph_for_each_row(dome, names, files):
    numbers = [line.partition(",")[2] for line in LAMPS.splitlines()[1:]]
    rows = "\n".join(f"{name},{n}" for name, n in zip(names, numbers, strict=True))
    capture = dome(files, f"name,x,y,z,intensity\n{rows}\n")
    assert table(capture) == {
        files[0]: (0, [1, 0, 2], 3),
        files[1]: (1, [0, 1, 2], 4),
        files[2]: (2, [-1, 0, 2], 5),
    }
    assert [light.kind for light in capture.lights] == ["point"] * 3
    assert any("lights: 3 rows of" in detail for detail in capture.details)


def test_a_lamp_of_many_photographs(dome):
    capture = dome([f"v{i}_l{i % 2}.png" for i in range(5)], LAMPS)
    assert [photograph.light for photograph in capture.photographs] == [0, 1, 0, 1, 0]
    assert len(capture.lights) == 2
    assert any("no photograph for l2" in note for note in capture.notes)


@pytest.mark.parametrize("pattern", ["v{view}_l{lamp}.png", "l{lamp}/v{view}.png"])
def test_photographs_under_other_lamps_are_those_of_the_same_view(dome, pattern):
    names = [[pattern.format(view=v, lamp=n) for n in range(3)] for v in range(4)]
    others = [name for row in names for name in row[1:]][:-1]  # one is missing
    capture = dome([row[0] for row in names], LAMPS, others)
    assert (capture.n_views, capture.n_lights, len(capture.photographs)) == (4, 3, 11)
    expected = {names[v][n]: (v, n) for v in range(4) for n in range(3)}
    for photograph in capture.photographs:
        name = photograph.path.relative_to(capture.root / "images").as_posix()
        assert (photograph.camera, photograph.light) == expected[name]
    assert any("which name 7 photographs" in detail for detail in capture.details)


def test_rows_that_name_the_view(dome):
    """Photographs of the calibration, under room light, are used only where a row says so."""
    lights = (
        "name,dx,dy,dz,r,g,b,view\n"
        "IMG_7.png,0,0,2,1,2,3,room1\n"
        "IMG_8,0,3,0,1,2,3,room2.png\n"
        "room0.png,0,0,1,1,2,3,room0\n"
    )
    capture = dome([f"room{i}.png" for i in range(3)], lights, ["IMG_7.png", "IMG_8.png"])
    seen = [(p.path.name, p.camera, p.light) for p in capture.photographs]
    assert seen == [("IMG_7.png", 1, 0), ("IMG_8.png", 2, 1), ("room0.png", 0, 0)]
    assert [light.kind for light in capture.lights] == ["directional"] * 2
    np.testing.assert_allclose(capture.lights[1].direction, [0, 1, 0])
    np.testing.assert_allclose(capture.lights[1].intensity, [1, 2, 3])


@pytest.mark.parametrize(
    "text",
    [
        "name;x;y;z;intensity\nl0;0,5;0;2;3\nl1;0;1;2;4\n",  # as spreadsheets of some languages
        "# lamps\n\nNAME\tX\tY\tZ\tINTENSITY\nl0\t.5\t0\t2\t3\nl1\t0\t1\t2\t4\n",
        'intensity,"name",z,y,x\n3,l0,2,0,0.5\n4,"l1",2,1,0\n',
    ],
)
def test_ways_to_write_it(dome, text):
    capture = dome(["v0_l0.png", "v1_l1.png"], text)
    assert capture.lights[0].position.tolist() == [0.5, 0, 2]
    assert capture.lights[1].intensity.tolist() == [4, 4, 4]


def test_intensity_is_1_where_it_is_not_said(dome):
    capture = dome(["v0_l0.png"], "name,x,y,z\nl0,1,2,3\n")
    assert capture.lights[0].intensity.tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "names the columns name,x,y,z or"),
        ("l0,1,0,2,3\n", "names the columns"),
        ("name,x,y\nl0,1,0\n", "names the columns"),
        ("name,x,y,z,dx,dy,dz\n", "names the columns"),
        ("name,x,y,z,intensity,r,g,b\n", "names the columns"),
        ("name,x,y,z,power\nl0,1,0,2,3\n", "names the columns"),
        ("name,x,y,z,z\nl0,1,0,2,3\n", "names the columns"),
        ("name,x,y,z\n", r"1 to 100,000 rows.*received 0"),
        ("name,x,y,z\nl0,1,0\n", "expected 4 values in a row, received 3"),
        ("name,x,y,z\nl0,1,0,nan\n", "finite numbers in a row"),
        ("name,x,y,z\n,1,0,2\n", "a name and finite"),
        (
            "name,x,y,z\nl0,1,0,1e300\n",
            "row 'l0': light: position: expected numbers of at most",
        ),
        ("name,dx,dy,dz\nl0,0,0,0\n", "direction: expected a vector that is not zero"),
        ("name,x,y,z,intensity\nl0,1,0,2,-1\n", "intensity: expected values >= 0"),
        ("name,x,y,z\nl0,1,0,2\nL0,1,0,2\n", "each name once"),
        ("name,x,y,z\nl7,1,0,2\n", r"v0_l0\.png: expected a row.*none of 1 \(l7\)"),
        ("name,x,y,z\nl0,1,0,2\nv0,0,1,2\n", r"v0_l0\.png: expected one row.*received l0, v0"),
        ("name,x,y,z,view\nl0,1,0,2,\n", "row 'l0': expected a view"),
        ("name,x,y,z,view\nl0,1,0,2,v9\n", "photographs of one camera.*'v9', which names 0"),
        ("name,x,y,z,view\n../l0.png,1,0,2,v0_l0\n", "leaves the folder"),
        ("name,x,y,z,view\n../../l0.png,1,0,2,v0_l0\n", "leaves the folder"),
        ('name,x,y,z\n"l0,1,0,2\n' + "l1,1,0,2\n" * 20_000, "a quotation mark left open"),
        ("name,x,y,z,view\n/etc/passwd,1,0,2,v0_l0\n", "leaves the folder|missing"),
    ],
)
def test_refusals(dome, text, reason):
    with pytest.raises(CaptureError, match=reason):
        dome(["v0_l0.png", "v1_l0.png"], text)


def test_a_description_with_lights_of_its_own(dome, tmp_path):
    capture = dome(["v0_l0.png"], LAMPS)
    frame = {
        "file_path": "images/v0_l0.png", "transform_matrix": np.eye(4).tolist(),
        "pl_pos": [0, 0, 1], "fl_x": 30,
    }  # fmt: skip
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    with pytest.raises(CaptureError, match=r"lights\.csv: expected a capture whose lights are"):
        open_capture(tmp_path)
    del frame["pl_pos"]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    again = open_capture(tmp_path)
    assert again.format == "transforms"
    np.testing.assert_array_equal(again.lights[0].position, capture.lights[0].position)


def test_two_tables(dome, tmp_path):
    dome(["v0_l0.png"], LAMPS)
    (tmp_path / "sparse/0/lights.csv").write_text(LAMPS)
    with pytest.raises(CaptureError, match="expected one table of lights"):
        open_capture(tmp_path)


@pytest.mark.parametrize(("row", "n_notes"), [("0,0.6,0.8", 0), ("0,90,30", 1), ("0,3,4", 1)])
def test_directions_of_different_lengths_are_noted(dome, row, n_notes):
    """Positions, or degrees."""
    lights = f"name,dx,dy,dz\nl0,0,0,1\nl1,{row}\n"
    notes = dome(["v0_l0.png", "v1_l1.png", "v2_l0.png"], lights).notes
    assert sum("light directions have lengths of 1 to" in note for note in notes) == n_notes
