"""Mutated files of other programs either open or are refused, soon and in bounded memory."""

import json

import numpy as np
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from reflfield.capture.btf import read_btf
from reflfield.capture.readers import open_capture
from reflfield.errors import InputError
from tests.capture.calibrations import colmap_binary, colmap_text, ring, write_photographs
from tests.capture.test_btf import containers
from tests.capture.test_light_table import LAMPS
from tests.capture.test_other_calibrations import metashape, poses_bounds, view_set
from tests.capture.test_photometric_sets import DIRECTIONS, dome, numbers

EXAMPLES, MANY = 30, 2000
NAMES = [f"a_l{i % 3}_{i}.png" for i in range(5)]
GRID = {
    "whiteBalance": {"r": 1, "g": 0.5, "b": 2}, "intensity": 1,
    "spatialCalibration": {"width": 80, "height": 60, "rows": 2, "cols": 3,
                           "intensity": [9, 4, 2, 5, 3, 1]},
}  # fmt: skip
# The documented form of relight's .dome.
DOCUMENTED = {
    "imageWidth": 80, "diameter": 500, "positions": (DIRECTIONS * 250).tolist(),
    "lightsCalibration": [GRID] * 4,
}  # fmt: skip
PIECES = st.sampled_from([
    b"", b"\0", b"\xff" * 8, b"\0" * 8, b"\0\0\0\0\0\0\0\x80", b"nan", b"inf", b"1e308", b"-1",
    b"9" * 400, b"../../a.png", b"/etc/passwd", b"C:\\a.png", b"\n", b",", b"<", b"</a>",
    b"&lt;", b"'", b'"', b"#", b"\x00\x00\xc0\x7f", b"\xf0\x7f", b"null", b"[]", b"{}",
    b"v 9 9 9 a.png",
]) | st.binary(max_size=12)  # fmt: skip
CHANGES = st.lists(
    st.tuples(st.floats(0, 0.9999), st.integers(0, 30), PIECES), min_size=1, max_size=3
)


def mutated(content, changes):
    """Bytes of which some pieces were replaced by others."""
    for where, length, piece in changes:
        at = int(where * len(content))
        content = content[:at] + piece + content[at + length :]
    return content


def prepared(folder):
    """Folder of each format with one valid capture, and the file that is mutated."""
    lights = numbers(DIRECTIONS)
    texts = {
        "vset": ("a.vset", view_set(ring(), NAMES, extra="e 0.2 60|e 0.9 200")),
        "xml": ("a.xml", metashape(ring(), labels=NAMES)),
        "dome": ("a.dome", json.dumps(dome(lightConfiguration="lights3d"))),
        "grids": ("a.dome", json.dumps(DOCUMENTED)),
        "list": ("light_directions.txt", lights),
        "csv": ("lights.csv", LAMPS),
        "txt": ("sparse/0/images.txt", None),
        "bin": ("sparse/0/images.bin", None),
        "lens": ("sparse/0/cameras.bin", None),
        "npy": ("poses_bounds.npy", None),
        "mat": ("light.mat", None),
    }
    for name, (file, text) in texts.items():
        root = folder / name
        names = NAMES[:4] if name in ("dome", "grids", "list", "mat") else NAMES
        write_photographs(root / ("previews" if name == "vset" else "images"), names)
        if text is not None:
            (root / file).write_text(text)
        if name in ("txt", "csv"):
            colmap_text(root / "sparse/0", ring(), NAMES)
        if name in ("bin", "lens"):
            colmap_binary(root / "sparse/0", ring(), NAMES)
    np.save(folder / "npy/poses_bounds.npy", poses_bounds(ring()))
    lamps = {"S": DIRECTIONS * 300, "Dir": -DIRECTIONS + [0, 0, 2], "Phi": np.ones((4, 3)),
             "mu": np.ones((4, 1))}  # fmt: skip
    scipy.io.savemat(folder / "mat/light.mat", lamps)
    scipy.io.savemat(folder / "mat/camera.mat", {"K": np.diag([30.0, 30, 1])})
    return {name: (folder / name, folder / name / file) for name, (file, _) in texts.items()}


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    made = prepared(tmp_path_factory.mktemp("fuzz"))
    whole = {name: (root, path, path.read_bytes()) for name, (root, path) in made.items()}
    for root, _, _ in whole.values():
        open_capture(root)  # valid before it is mutated
    return whole


def fuzzed(examples):
    return settings(
        max_examples=examples,
        deadline=10_000,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )


FORMATS = ["vset", "xml", "dome", "grids", "list", "csv", "txt", "bin", "lens", "npy", "mat"]


def opens_or_is_refused(capture, changes):
    root, path, content = capture
    path.write_bytes(mutated(content, changes))
    text, paths = "", []
    try:
        paths = [photograph.path for photograph in open_capture(root).photographs]
    except InputError as error:
        text = str(error)
    finally:
        path.write_bytes(content)
    assert text.isprintable()
    assert len(text) < 3000
    assert all(path.resolve().is_relative_to(root.resolve()) for path in paths)


@pytest.mark.parametrize("name", FORMATS)
@given(changes=CHANGES)
@fuzzed(EXAMPLES)
def test_descriptions(captures, name, changes):
    opens_or_is_refused(captures[name], changes)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
@given(changes=CHANGES)
@fuzzed(MANY)
def test_descriptions_for_long(captures, name, changes):
    opens_or_is_refused(captures[name], changes)


@pytest.mark.parametrize("kind", ["FMF double", "FMF12", "DFMF", "BDI"])
@given(changes=CHANGES)
@fuzzed(EXAMPLES)
def test_containers(tmp_path_factory, kind, changes):
    table = np.random.default_rng(0).uniform(0.1, 4, (6, 5, 4, 3))
    path = tmp_path_factory.getbasetemp() / "fuzzed.btf"
    path.write_bytes(mutated(containers(table, np.tile(np.eye(3), (6, 1, 1)))[kind], changes))
    text = ""
    try:
        read_btf(path).image(0, 0)
    except InputError as error:
        text = str(error)
    assert text.isprintable()
