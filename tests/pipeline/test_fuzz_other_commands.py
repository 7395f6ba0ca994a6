"""Commands that prepare captures and export fields, with junk: a result, or one message.

After an error nothing is left in the folder for results; the input is never changed. What a
command raises beyond its own exit fails the test, and so do warnings.
"""

import hashlib
import json
import os
import resource
import shutil
import time
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from capture_sim.scene import parse_scene
from capture_sim.write import write_capture
from reflfield.calibration.circles import Circle
from reflfield.capture.conversion import convert_capture
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.capture.readers import open_capture
from reflfield.export.formats import FORMATS, export_field
from reflfield.field.file import open_field, write_field
from tests.capture.test_fuzz_descriptions import CHANGES, WORDS, mutated
from tests.capture.test_fuzz_other_formats import CHANGES as PIECES
from tests.capture.test_fuzz_other_formats import mutated as mutated_bytes
from tests.synthetic_fields import baked_field, lambert, square_surface
from tests.tiny_dome import ball_scene

MOST_SECONDS = 10
MOST_BYTES = 2**30
LONGEST_MESSAGE = 2000
MANY = 600

SIDE = 24
PHOTOGRAPH = "stands for the path of a photograph"
# Words that make each command work, after its input; one of these lists at a time.
WORKING = {
    "check": ((),),
    "convert": (("--to", "colmap"), ("--to", "transforms"), ("--link",)),
    "masks": (("--rounds", "1"),),
    "calibrate": (("--cameras",), ("--lights",), ("--cameras", "--color-checker", PHOTOGRAPH)),
    "lights": (("--sphere", "12,12,8"),),
    "export": ((),),
}
OPTIONS = {
    "check": (),
    "convert": ("--to",),
    "masks": ("--backdrop", "--clean-plate", "--rounds"),
    "calibrate": ("--color-checker",),
    "lights": ("--sphere", "--matt-sphere", "--grey-card", "--radius", "--focal", "--encoding"),
    "export": ("--to", "--view", "--max-memory"),
}
OF_ALL_CAPTURES = ("--format", "--encoding", "--layer")
JUNK = WORDS | st.sampled_from([
    "1,2,3", "12,12,8", "12,12,1e9", "nan,nan,nan", "-5,5,9", "0,0,4,4", "9,9,1,1", "auto",
    "0,0,1", "0,0,0", "gamma=2.2", "gamma=0", "linear", "/dev/zero", "/proc/self/mem", ".",
    "d8d6da", "#000000", "x" * 5000, "%s%n", "native", "transforms", "rti", "btf", "1GB",
    "gltf", "exr", "lp", "R", "\u202e",
])  # fmt: skip
# What lies where a file was.
OTHERS = (
    *("pipe", "folder", "loop", "nowhere", "empty", "black", "white", "not a number"),
    *("one pixel", "grey", "nearly all alpha 0"),
)


def simulate(folder):
    """Write five views of a ball under three lamps, each photograph of 24 x 24 pixels."""
    scene = ball_scene("fuzzed", n_lights=(2, 1), heldout={"photographs": 0})
    scene["cameras"] |= {
        "elevations_deg": [-30, 30],
        "counts": [2, 3],
        "offsets_deg": [0, 30],
        "width": SIDE,
        "height": SIDE,
    }
    scene["truth"] = {"per_view": False, "points": 1}
    write_capture(parse_scene(scene), folder)


@pytest.fixture(scope="module")
def captures(made_once, tmp_path_factory):
    """A capture in two forms, by names; they are changed and made whole again."""
    made, _ = made_once("fuzzed", simulate)
    above = tmp_path_factory.mktemp("fuzz")
    without = shutil.ignore_patterns("truth")
    native = shutil.copytree(made, above / "native", ignore=without)
    convert_capture(open_capture(native), above / "colmap", "colmap")
    return {"native": native, "colmap": above / "colmap"}


@pytest.fixture(scope="module")
def spheres(tmp_path_factory):
    """Folder of two photographs of a glossy sphere under a lamp each, and a curve."""
    folder = tmp_path_factory.mktemp("fuzz") / "spheres"
    folder.mkdir()
    centre = Circle(12.0, 12.0, 8.0)
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    ball = np.hypot(x - centre.x, y - centre.y) < centre.radius
    for name, spot in (("a.exr", (10, 10)), ("b.exr", (14, 11))):
        shine = np.exp(-(np.square(x - spot[0]) + np.square(y - spot[1])) / 4)
        image = np.repeat((0.02 + ball * (0.1 + 4 * shine))[..., None], 3, axis=2)
        write_exr(folder / name, image.astype(np.float32))
    (folder / "curve.csv").write_text("encoded,linear\n0,0\n0.5,0.2\n1,1\n")
    return folder


@pytest.fixture(scope="module")
def field_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz") / "fields"
    folder.mkdir()
    field = baked_field(square_surface(4), lambert(0.5), view_side=3, light_side=3)
    write_field(folder / "field.rfld", field)
    return folder


def contents(folder):
    """Kind and digest of everything below a folder."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.is_symlink():
            found[path] = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            found[path] = os.path.realpath(path) if path.is_symlink() else path.is_dir()
    return found


@pytest.fixture
def answered(reflfield):
    """Function that runs a command on a folder, which must not change, into another one.

    A result, findings or one message, soon, in memory; nothing is left after an error.
    """

    def command(folder, out, *words):
        before, there = contents(folder), contents(out.parent)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        started = time.process_time()  # other processes may keep this one waiting
        outcome = reflfield(*words)
        assert time.process_time() - started < MOST_SECONDS, words
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak
        assert grown * 1024 < MOST_BYTES, words
        assert contents(folder) == before, words
        said = [line for line in outcome.err.splitlines() if "rror: " in line]
        found = words[0] == "check" and "index.html" in outcome.out
        assert outcome.status in ((0, 1, 2) if found else (0, 2)), (words, outcome)
        assert len(said) == (outcome.status == 2 and not found), (words, outcome)
        own = [line for line in said if line.startswith("reflfield")]
        assert all(len(line) < LONGEST_MESSAGE for line in own), words
        assert outcome.err.replace("\n", "").isprintable(), (words, outcome)
        assert outcome.out.replace("\n", "").isprintable(), (words, outcome)
        left = contents(out.parent)
        assert left == there if said else out.exists(), (words, outcome, set(left) - set(there))
        assert not [path for path in left if path.name.endswith(".partial")], (words, outcome)
        return outcome

    return command


def fuzzed(examples):
    return settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


class Spoilt:
    """A file whose content is another one within the block, or that is no file at all."""

    def __init__(self, path, change):
        self.path, self.change = path, change

    def __enter__(self):
        self.content = self.path.read_bytes()
        if isinstance(self.change, str):
            self.path.unlink()
            put(self.path, self.change)
        else:
            self.path.write_bytes(mutated_bytes(self.content, self.change))

    def __exit__(self, *_):
        shutil.rmtree(self.path) if self.path.is_dir() else self.path.unlink(missing_ok=True)
        self.path.write_bytes(self.content)


def put(path, kind):
    """Something else under the name of a photograph or mask; PNG where that can be."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind in ("loop", "nowhere"):
        path.symlink_to(path.name if kind == "loop" else "nothing.exr")
    elif kind == "empty":
        path.touch()
    else:
        image = np.full((1, 1, 3) if kind == "one pixel" else (SIDE, SIDE, 3), 0.25)
        image *= {"black": 0, "white": 1e9, "not a number": np.nan}.get(kind, 1)
        if path.suffix == ".exr":
            write_exr(path, image.astype(np.float32))
        else:
            shape = (*image.shape[:2], 4) if "alpha" in kind else image.shape
            codes = np.full(shape, {"black": 0, "white": 255}.get(kind, 128), np.uint8)
            codes[1:, :, 3:] = 0
            write_png(path, codes)


def places(folder):
    """Files of a folder that are inputs."""
    return sorted(path for path in folder.rglob("*") if path.is_file())


# Which file, what becomes of it, and whether of all of its folder.
DAMAGE = st.tuples(
    st.floats(0, 0.9999),
    PIECES | st.sampled_from(OTHERS),
    st.sampled_from([False, False, True]),
)


def fresh(folder):
    """Name of a folder for results, alone in a folder."""
    above = folder.parent / f"{folder.name}-results"
    shutil.rmtree(above, ignore_errors=True)
    above.mkdir()
    return above / "out"


@contextmanager
def described(capture, changes):
    """Within the block, the description of a capture holds junk."""
    path = capture / "capture.json"
    text = path.read_text()
    path.write_text(json.dumps(mutated(json.loads(text), changes)))
    yield
    path.write_text(text)


@contextmanager
def damaged(folder, damage):
    """Within the block, a file of a folder, or all beside it, are damaged or something else."""
    where, change, all_beside = damage
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    path = files[int(where * len(files))]
    spoilt = [p for p in files if p.parent == path.parent] if all_beside else [path]
    contents = [path.read_bytes() for path in spoilt]
    for path, content in zip(spoilt, contents, strict=True):
        if isinstance(change, str):
            path.unlink()
            put(path, change)
        else:
            path.write_bytes(mutated_bytes(content, change))
    yield
    for path, content in zip(spoilt, contents, strict=True):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        path.write_bytes(content)


def occupy(out, kind):
    """Something where the results shall be."""
    if kind == "full":
        out.mkdir()
        for name in ("mine.txt", "v000_l000.png", "lights.csv", "check.json"):
            (out / name).write_text("precious")
        (out / "scores.json").write_text('["v000_l000"')
    else:
        put(out, kind)


PLACES = ("pipe", "folder", "loop", "nowhere", "empty", "full")


def fuzz_command(answered, folder, words, out, change):
    """A command with junk in the description, in a file, in an option or for a place."""
    kind, junk = change
    words = [*words, "-o", out]
    if kind == "option":
        answered(folder, out, *words, f"{junk[0]}={junk[1]}")
    elif kind == "place":
        occupy(out, junk)
        answered(folder, out, *words)
    else:
        with (described if kind == "description" else damaged)(folder, junk):
            answered(folder, out, *words)


def changes_for(command):
    """Strategy of changes that a command is tried with."""
    on_capture = command not in ("lights", "export")
    options = [*OPTIONS[command], *(OF_ALL_CAPTURES if on_capture else ())]
    kinds = [
        st.tuples(st.just("file"), DAMAGE),
        st.tuples(st.just("option"), st.tuples(st.sampled_from(options), JUNK)),
        st.tuples(st.just("place"), st.sampled_from(PLACES)),
    ]
    if on_capture:
        kinds.insert(0, st.tuples(st.just("description"), CHANGES))
    return st.one_of(kinds)


def fuzz_on_captures(answered, captures, command, examples):
    forms = st.sampled_from(sorted(captures))

    @given(change=changes_for(command), form=forms, words=st.sampled_from(WORKING[command]))
    @fuzzed(examples)
    def fuzz(change, form, words):
        capture = captures["native" if change[0] == "description" else form]
        photograph = next(path for path in sorted(capture.rglob("*.exr")))
        words = [photograph if word is PHOTOGRAPH else word for word in words]
        fuzz_command(answered, capture, (command, capture, *words), fresh(capture), change)

    fuzz()


def fuzz_lights(answered, spheres, examples):
    @given(change=changes_for("lights"), curve=st.booleans())
    @fuzzed(examples)
    def fuzz(change, curve):
        words = ("lights", spheres, *WORKING["lights"][0])
        words += ("--encoding", spheres / "curve.csv") if curve else ()
        fuzz_command(answered, spheres, words, fresh(spheres), change)

    fuzz()


def fuzz_export(answered, folder, examples, formats):
    for to in formats:  # what is compiled when it is first used does not count
        if to != "mitsuba":  # which has a model of its own
            above = fresh(folder).with_suffix(FORMATS[to].suffix)
            export_field(open_field(folder / "field.rfld"), above, to)

    @given(change=changes_for("export"), to=st.sampled_from(formats))
    @fuzzed(examples)
    def fuzz(change, to):
        out = fresh(folder).with_suffix(FORMATS[to].suffix)
        words = ("export", folder / "field.rfld", "--to", to)
        fuzz_command(answered, folder, words, out, change)

    fuzz()


# Short ones take about as long for each command.
@pytest.mark.parametrize(
    ("command", "examples"),
    [("check", 14), ("convert", 80), ("masks", 6), ("calibrate", 14)],
)
def test_commands_on_captures(answered, captures, command, examples):
    fuzz_on_captures(answered, captures, command, examples)


def test_what_a_target_cannot_say_leaves_nothing(answered, captures):
    """Found when photographs have been copied already."""
    words = ("convert", captures["native"], "--to", "colmap")
    for option in (("--encoding", "gamma=2.2"), ("--layer", "rgba")):
        out = fresh(captures["native"])
        fuzz_command(answered, captures["native"], words, out, ("option", option))
        assert not out.exists()


def test_lights(answered, spheres):
    fuzz_lights(answered, spheres, 80)


def test_export(answered, field_folder):
    fuzz_export(answered, field_folder, 60, ["html", "exr", "materialx", "btf"])


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("command", ["check", "convert", "masks", "calibrate"])
def test_commands_on_captures_for_long(answered, captures, command):
    fuzz_on_captures(answered, captures, command, MANY)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_lights_and_export_for_long(answered, spheres, field_folder):
    fuzz_lights(answered, spheres, 5 * MANY)
    fuzz_export(answered, field_folder, 3 * MANY, sorted(FORMATS))
