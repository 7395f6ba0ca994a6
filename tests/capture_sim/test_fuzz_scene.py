"""Scene files with anything in them: a plan, or one error that names the key."""

import json
import os
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from capture_sim.errors import SceneError
from capture_sim.inputs import memory_limit
from capture_sim.plan import plan
from capture_sim.scene import load_scene, parse_scene
from capture_sim.write import MOST_WORKERS, write_capture

# Of what a plan may take beside what the process of the tests holds by then.
CEILING = 1 << 30
SCENE = {
    "name": "tiny",
    "description": "one line",
    "seed": 1,
    "base_geometry": "hull",
    "object": {"type": "vase", "height": 0.2, "handles": 0, "around": 16, "along": 16},
    "material": {
        "type": "mixed",
        "labels": {"type": "bands", "edges": [[0.2, 0.5]]},
        "materials": [
            {"type": "lambert", "albedo": [0.5, 0.4, 0.3]},
            {
                "type": "textured",
                "base": {"type": "ggx", "metal": "gold", "alpha_x": 0.4, "alpha_y": 0.2},
                "tangent_angle": {"type": "stripes", "columns": 2, "values": [-0.5, 0.5]},
                "height": {"type": "noise", "frequency": 4, "octaves": 2, "seed": 3},
                "height_scale": 0.01,
            },
        ],
    },
    "cameras": {
        "preset": "rings",
        "elevations_deg": [20, 50],
        "counts": [2, 1],
        "offsets_deg": [0, 10],
        "target": [0, 0, 0.1],
        "distance": 0.8,
        "width": 8,
        "height": 6,
        "extent": 0.3,
        "model": "opencv",
        "k1": 0.01,
    },
    "lights": {
        "preset": "list",
        "directions": [[0, 0, 1], [1, 0, 1]],
        "kind": "point",
        "distance": 0.7,
        "irradiance": [3, 3, 3],
    },
    "image": {"samples_per_side": 1, "edge_samples_per_side": 2},
    "effects": {
        "simulate": "auto",
        "tolerance": 0.01,
        "shadows": "on",
        "interreflection": {"paths": 2, "bounces": 1},
        "sensor_noise": {"electrons_per_radiance": 1e4, "read_noise": 2.0},
        "quantisation": {"bits": 10, "full_scale": 4.0},
    },
    "heldout": {"photographs": 1},
    "truth": {"per_view": False, "points": 5},
}

JUNK = st.one_of(
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.sampled_from([0, 1, -1, 2, 1000, 10**6, 2**24, 10**9]),
    st.sampled_from([1e308, -1e308, 1e-308, 1e18, 1e30, 0.0, np.nan, np.inf, -np.inf]),
    st.sampled_from(["", "rings", "auto", "x\x07y", "/dev/zero"]),
    st.floats(),
    st.text(st.characters(exclude_categories=["Cs"]), max_size=6),
    st.lists(st.one_of(st.floats(), st.integers(-5, 10**6), st.text(max_size=3)), max_size=4),
    st.lists(st.lists(st.floats(-1, 1), max_size=3), max_size=3),
    st.dictionaries(st.sampled_from(["type", "preset", "file", "values"]), st.text(max_size=4)),
    st.just({"type": "image", "file": "/dev/zero"}),
    st.just({"preset": "gold"}),
)


def places(tree, before=()):
    """Paths to all entries."""
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        yield (*before, key)
        if isinstance(value, dict | list):
            yield from places(value, (*before, key))


def spoiled(changes):
    scene = json.loads(json.dumps(SCENE))
    for place, junk in changes:
        at = scene
        for key in place[:-1]:
            fits = key in at if isinstance(at, dict) else isinstance(key, int) and key < len(at)
            at = at[key] if fits and isinstance(at[key], dict | list) else {}
        if isinstance(at, dict) or (isinstance(place[-1], int) and place[-1] < len(at)):
            at[place[-1]] = junk
    return scene


def fuzzed_scenes(folder, examples):
    path = folder / "scene.toml"
    everywhere = [*places(SCENE), ("unknown",), ("object", "unknown"), ("material", "preset")]

    @settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.lists(st.tuples(st.sampled_from(everywhere), JUNK), min_size=1, max_size=2))
    def fuzz(changes):
        path.write_text(tomli_w.dumps(spoiled(changes)), encoding="utf-8")
        start = time.process_time()
        message = planned(path)
        assert time.process_time() - start < 10
        if message:
            assert "expected" in message
            assert len(message) < 2000

    fuzz()


def planned(path):
    """Plan a scene; what is wrong with it, if anything."""
    try:
        ceiling = psutil.Process().memory_info().rss + CEILING
        with memory_limit(ceiling), np.errstate(all="ignore"):
            lines = plan(load_scene(str(path)), max_memory=ceiling).lines()
    except SceneError as error:
        return str(error)
    assert lines
    return ""


def test_the_scene_itself_is_planned(tmp_path):
    (tmp_path / "scene.toml").write_text(tomli_w.dumps(SCENE))
    assert planned(tmp_path / "scene.toml") == ""


def test_scenes_with_junk_are_one_error_or_a_plan(tmp_path):
    fuzzed_scenes(tmp_path, 60)


@pytest.mark.slow
def test_many_scenes_with_junk(tmp_path):
    fuzzed_scenes(tmp_path, 2000)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = " + "[" * 5000, r"scene\.toml: expected (a TOML file|tables in some levels)"),
        ("a = " + "{b=" * 5000, r"scene\.toml: expected (a TOML file|tables in some levels)"),
        ("seed = " + "9" * 5000, r"scene\.toml: expected a TOML file"),
        ("seed = 0x" + "f" * 5000, r"scene: .*|object: expected a value"),
        ("name = '\ud7ff", r"expected a TOML file"),
        ("\0", r"expected a TOML file"),
        ("a = 1\na = 2", r"expected a TOML file"),
    ],
    ids=["lists", "tables", "digits", "hexadecimal", "open", "nul", "twice"],
)
def test_files_that_are_no_scenes_are_refused(tmp_path, text, message):
    (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
    with pytest.raises(SceneError, match=message):
        load_scene(str(tmp_path / "scene.toml"))


def test_bytes_that_are_no_text_and_large_files_are_refused(tmp_path):
    (tmp_path / "scene.toml").write_bytes(b"\xff\xfe\x00name")
    with pytest.raises(SceneError, match=r"scene\.toml: expected a TOML file"):
        load_scene(str(tmp_path / "scene.toml"))
    (tmp_path / "scene.toml").write_bytes(b"#" * (5 << 20))
    with pytest.raises(SceneError, match=r"scene\.toml: expected at most 4,194,304 bytes"):
        load_scene(str(tmp_path / "scene.toml"))
    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(SceneError, match=r"pipe\.toml: expected a file, received a named pipe"):
        load_scene(str(tmp_path / "pipe.toml"))


def changed(*place, value):
    return spoiled([(place, value)])


HUGE = int("f" * 5000, 16)  # too many digits to be shown, and to be a float


@pytest.mark.parametrize(
    ("scene", "named"),
    [
        (changed("object", value={"preset": ["vase"]}), r"object\.preset: expected one of"),
        (changed("object", "type", value={"a": 1}), r"object\.type: expected one of"),
        (changed("object", value="vase"), r"object: expected a table"),
        (changed("material", value={"preset": {"a": 1}}), r"material\.preset: expected one of"),
        (changed("material", "materials", 0, value=["lambert"]), r"materials\[0\]: expected a"),
        (changed("material", "materials", 1, "base", "metal", value=[1]), r"metal: expected "),
        (changed("cameras", "preset", value=["rings"]), r"cameras\.preset: expected one of"),
        (changed("cameras", "distance", value=float("nan")), r"distance: expected a number in"),
        (changed("cameras", "distance", value=HUGE), r"distance: .*one too long to be shown"),
        (changed("cameras", "width", value=HUGE), r"width: .*one too long to be shown"),
        (changed("cameras", "target", value=[0, 0, 1e308]), r"target: expected a number in"),
        (changed("cameras", "counts", value=[90_000, 90_000]), r"counts: expected at most "),
        (changed("lights", "irradiance", value=1e308), r"irradiance: expected a number in"),
        (changed("lights", "irradiance", value=1e-200), r"lights: expected a light"),
        (changed("lights", "directions", value=[[0, 0, 1e-200]]), r"directions: expected "),
        (changed("effects", "simulate", value=[["shadows"]]), r"simulate: expected names"),
        (changed("effects", "shadows", value=[1]), r"effects\.shadows: expected a table"),
        (changed("effects", "quantisation", "full_scale", value=1e300), r"full_scale: "),
        (changed("name", value="a\x1b[2J"), r"scene\.name: expected one line .*\\x1b"),
        (changed("name", value="x" * 5000), r"scene\.name: expected one line of up to 1000"),
        (changed("name", value=["x"]), r"scene\.name: expected one line"),
        (changed("unknown", value=1), r"scene: expected keys .*received 'unknown'"),
    ],
)
def test_values_of_other_kinds_name_their_key(scene, named):
    with pytest.raises(SceneError, match=named):
        parse_scene(scene)


@pytest.mark.parametrize(
    ("scene", "named"),
    [
        (changed("object", "around", value=4096), None),
        (spoiled([(("object", "around"), 4096), (("object", "along"), 4096)]), "triangles"),
        (spoiled([(("cameras", "width"), 32768), (("cameras", "height"), 32768)]), "workers"),
        (changed("truth", "points", value=2**24), "workers"),
        (
            spoiled(
                [
                    (("effects", "interreflection", "paths"), 65536),
                    (("lights",), {"preset": "fibonacci", "n": 1000}),
                    (("effects", "simulate"), "all"),
                ]
            ),
            "workers",
        ),
        (
            spoiled(
                [
                    (("cameras", "preset"), "fibonacci"),
                    (("cameras",), {"preset": "fibonacci", "n": 2000, "distance": 0.8}),
                    (("lights",), {"preset": "fibonacci", "n": 2000, "distance": 0.8}),
                ]
            ),
            "at most 1,000,000 photographs",
        ),
    ],
    ids=["fits", "facets", "pixels", "points", "paths", "photographs"],
)
def test_what_memory_cannot_hold_is_refused_with_what_would_suffice(tmp_path, scene, named):
    (tmp_path / "scene.toml").write_text(tomli_w.dumps(scene))
    message = planned(tmp_path / "scene.toml")
    assert message == "" if named is None else named in message
    if named in ("triangles", "workers"):
        assert "--max-memory: expected at least" in message


@pytest.mark.parametrize("workers", [0, -1, MOST_WORKERS + 1, 10**9])
def test_numbers_of_workers_have_a_range(tmp_path, workers):
    with pytest.raises(SceneError, match=r"workers: expected 1 to 1024, received"):
        write_capture(parse_scene(SCENE), tmp_path / "out", workers=workers)
    assert list(tmp_path.iterdir()) == []


def test_many_workers_start_no_more_threads_than_there_are_views(tmp_path):
    ball = {"object": {"preset": "sphere", "around": 16}, "effects": "none"}
    simple = parse_scene({**SCENE, **ball, "material": {"preset": "grey_card"}})
    write_capture(simple, tmp_path / "out", workers=MOST_WORKERS)
    assert Path(tmp_path / "out" / "capture.json").is_file()
