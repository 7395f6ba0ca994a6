"""Mutated descriptions either open or are refused: nothing else, soon, in bounded memory."""

import functools
import json
import resource
import shutil
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from reflfield.capture.image_writing import write_png
from reflfield.capture.inspect import describe
from reflfield.capture.readers import open_capture
from reflfield.errors import InputError

FROZEN = Path(__file__).parents[1] / "data" / "capture_v1"
EXAMPLES, MANY = 120, 4000
MOST_SECONDS = 10
MOST_BYTES = 2**30

POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
TRANSFORMS = {
    "w": 8, "h": 6, "fl_x": 10.0, "camera_model": "OPENCV", "k1": 0.01, "up": [0, 0, 1],
    "frames": [
        {"file_path": "a.png", "transform_matrix": POSE, "pl_pos": [0, 0, 1.5],
         "pl_intensity": [4, 4, 4], "mask_path": "a.png", "camera_angle_x": 0.5},
        {"file_path": "b", "transform_matrix": POSE, "pl_pos": [[0, 1, 2], [2, 1, 0]],
         "pl_intensity": 3, "camera_intrinsics": [4, 3, 9, 9], "is_fisheye": False},
    ],
}  # fmt: skip
LP = "2\na.png 0 0 1\nb.png 0,6 0 0,8\n"
MIDDLEBURY = (
    "2\na.png 100 0 3.5 0 100 2.5 0 0 1 1 0 0 0 1 0 0 0 1 0 0 2\n"
    "b.png 100 0 3.5 0 100 2.5 0 0 1 0 1 0 -1 0 0 0 0 1 0 0 2\n"
)

# What stands in the place of a value.
SCALARS = [
    None, True, False, 0, 1, -1, 2, 0.5, -0.0, 1e-320, 1e12, 1e308, -1e308, 10**18, 10**299,
    8.5, 65536, "", "nan", "1", "a.png", "../a.png", "/etc/passwd", "C:\\a.png", "a\n", "\x00",
    "\x1b[2J", "\u202e", "\ud800", "a" * 70_000, "native", "unknown", "environment", "OPENCV",
    "OPENCV_FISHEYE", "orthographic", "\u00b2",
]  # fmt: skip
NUMBERS = st.floats(-1e13, 1e13) | st.floats(0, 3) | st.integers(-3, 100_000)
VALUES = NUMBERS | st.sampled_from(SCALARS) | st.sampled_from([
    [], {}, [[]], [0, 0, 0], [1e308] * 3, ["1", "2", "3"], [True] * 3, [1, 2], [[1, 2, 3]] * 3,
    np.diag([2.0, 2, 2, 1]).tolist(), np.diag([1, 1, -1, 1]).tolist(), [[0] * 4] * 4,
    [[[[[[1]]]]]], {"a": {"b": []}}, [0] * 5000, {"pattern": "a.png"},
    {"pattern": "{camera}{light}\n"},
])  # fmt: skip
KEYS = st.sampled_from([
    "k1", "k4", "k6", "b1", "skew", "is_fisheye", "camera_model", "camera_intrinsics", "w",
    "pl_pos", "pl_intensity", "environment", "environment_convention", "mask_path", "file_ext",
    "camera_angle_x", "rolling_shutter", "train_filenames", "test_filenames", "n_frames",
    "name", "up", "silhouette", "exponent", "cone_angle", "model", "exposures", "new\nline",
    "\ud800",
])  # fmt: skip
CHANGES = st.lists(
    st.tuples(st.sampled_from(["replace", "delete", "add", "repeat", "wrap"]),
              st.floats(0, 0.999), KEYS, VALUES),
    min_size=1, max_size=3,
)  # fmt: skip
WORDS = NUMBERS.map(str) | st.sampled_from([
    "", "0", "-1", "nan", "inf", "1e308", "1e-320", "9" * 5000, "1_0", "0,5", "0,5,5", "#", "²",
    "../a.png", "/a.png", "C:\\x\\a.png", "a\x00.png", "\x1b[2J", "\ud800", "\u2028",
    "x" * 9000,
])  # fmt: skip


def places(value, above=()):
    """Paths of all values in a document."""
    if isinstance(value, dict | list):
        inner = value.items() if isinstance(value, dict) else enumerate(value)
        for key, item in list(inner):
            yield (*above, key)
            yield from places(item, (*above, key))


def mutated(document, changes):
    """A copy of the document after some changes, at places given as shares of all of them."""
    document = deepcopy(document)
    for kind, where, key, value in changes:
        paths = list(places(document))
        if paths:
            *above, last = paths[int(where * len(paths))]
            holder = functools.reduce(lambda inner, step: inner[step], above, document)
            change(holder, last, kind, key, deepcopy(value))
    return document


def change(holder, last, kind, key, value):
    """Change one value of an object or list, or add one."""
    if kind == "delete":
        del holder[last]
    elif kind == "replace":
        holder[last] = value
    elif kind == "wrap":
        holder[last] = [holder[last]]
    elif isinstance(holder, list):
        holder.append(holder[last] if kind == "repeat" else value)
    else:
        holder[key] = value


def mutated_text(text, changes):
    """Text after some of its words were replaced."""
    lines = [line.split(" ") for line in text.split("\n")]
    for where, word in changes:
        places_ = [(i, j) for i, line in enumerate(lines) for j in range(len(line))]
        i, j = places_[int(where * len(places_))]
        lines[i][j] = word
    return "\n".join(" ".join(line) for line in lines)


def opens_or_is_refused(folder):
    """Open and describe what a folder holds; refusals are answers, of bounded length."""
    for demanding in (False, True):
        try:
            capture = open_capture(folder, require_photographs=demanding)
            lines = describe(capture, sample=1).lines() if demanding else []
        except InputError as error:
            lines = [str(error)[3000:]]  # nothing
        else:
            names = [photograph.name.casefold() for photograph in capture.photographs]
            assert len(set(names)) == len(names)
        assert all(line.isprintable() for line in lines)
        assert sum(map(len, lines)) < 3000
    # the tests of this process before these take a part of it
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 < 2 * MOST_BYTES


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with photographs, and a native capture that is written over."""
    path = tmp_path_factory.mktemp("fuzz")
    for name in ("a.png", "b.png"):
        write_png(path / name, np.full((6, 8, 3), 128, np.uint8))
    shutil.copytree(FROZEN, path / "native")
    return path


def fuzzed(examples):
    return settings(
        max_examples=examples,
        deadline=MOST_SECONDS * 1000,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )


def native(folder, changes):
    document = json.loads((FROZEN / "capture.json").read_text())
    path = folder / "native" / "capture.json"
    path.write_text(json.dumps(mutated(document, changes)))
    opens_or_is_refused(path.parent)


def transforms(folder, changes):
    path = folder / "transforms.json"
    path.write_text(json.dumps(mutated(TRANSFORMS, changes)))
    opens_or_is_refused(path)


def lines(folder, name, text, changes, encoding):
    path = folder / name
    path.write_bytes(mutated_text(text, changes).encode(encoding, "surrogatepass"))
    opens_or_is_refused(path)


TEXT_CHANGES = st.lists(st.tuples(st.floats(0, 0.999), WORDS), min_size=1, max_size=4)
ENCODINGS = st.sampled_from(["utf-8", "utf-16", "utf-16-le", "utf-32"])


@given(changes=CHANGES)
@fuzzed(EXAMPLES)
def test_native(folder, changes):
    native(folder, changes)


@given(changes=CHANGES)
@fuzzed(EXAMPLES)
def test_transforms(folder, changes):
    transforms(folder, changes)


@given(changes=TEXT_CHANGES, encoding=ENCODINGS)
@fuzzed(EXAMPLES)
def test_lp(folder, changes, encoding):
    lines(folder, "dome.lp", LP, changes, encoding)


@given(changes=TEXT_CHANGES, encoding=ENCODINGS)
@fuzzed(EXAMPLES)
def test_middlebury(folder, changes, encoding):
    lines(folder, "a_par.txt", MIDDLEBURY, changes, encoding)


@pytest.mark.slow
@given(json_changes=CHANGES, text_changes=TEXT_CHANGES, encoding=ENCODINGS)
@fuzzed(MANY)
def test_all_for_long(folder, json_changes, text_changes, encoding):
    native(folder, json_changes)
    transforms(folder, json_changes)
    lines(folder, "dome.lp", LP, text_changes, encoding)
    lines(folder, "a_par.txt", MIDDLEBURY, text_changes, encoding)


@given(
    content=st.binary(max_size=300), name=st.sampled_from(["capture.json", "x.lp", "y_par.txt"])
)
@fuzzed(EXAMPLES)
def test_any_bytes(folder, content, name):
    path = folder / "bytes"
    path.mkdir(exist_ok=True)
    for old in path.iterdir():
        old.unlink()
    (path / name).write_bytes(content)
    opens_or_is_refused(path)
    opens_or_is_refused(path / name)
