"""The ceiling of memory: no byte depends on it, it holds, and too low a one is refused."""

import filecmp
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import capture_sim.memory
from capture_sim.brightness import measured
from capture_sim.errors import SceneError
from capture_sim.memory import fitted, least_memory, parse_bytes
from capture_sim.model import Blocks
from capture_sim.rays import RayTracer
from capture_sim.render import lookup_nodes
from capture_sim.scene import parse_scene
from capture_sim.write import write_capture

EFFECTS = {
    "simulate": ["antialiasing", "near_lights", "shadows", "interreflection", "environment"],
    "interreflection": {"paths": 4, "bounces": 1},
    "environment": {"radiance": 0.01, "samples": 5},
}
STATUS = Path("/proc/self/status")
TINY = Blocks(block=1 << 19, images=2 * 24 * 480, tables=1 << 16, lights=2)


def scene(*more, material=None, effects=None, **changed):
    simulate = [*EFFECTS["simulate"], *more]
    return parse_scene(
        {
            "object": {"preset": "bowl", "around": 12, "along": 16},
            "material": material or {"preset": "painted_vase"},
            "cameras": {
                "preset": "fibonacci",
                "n": 3,
                "extent": 0.2,
                "width": 24,
                "height": 20,
            },
            "lights": {"preset": "fibonacci", "n": 5},
            "effects": {**EFFECTS, **(effects or {}), "simulate": simulate},
            "heldout": {"photographs": 1},
            "truth": {"points": 10},
            **changed,
        }
    )


MARBLE = {"type": "translucent", "albedo": [0.8, 0.7, 0.6], "length": 0.02}
CASES = {
    "paths": scene(),
    "below the surface": scene(
        "subsurface", material=MARBLE, effects={"subsurface": {"steps": 0.5}}
    ),
    "wide lamps": scene("light_extent", effects={"light_extent": {"samples": 3}}),
}


def difference(one, other):
    """Files of two captures that differ, but for the times that they took."""
    files = [str(p.relative_to(one)) for p in one.rglob("*") if p.is_file()]
    files.remove("truth/effects.json")
    same, different, missing = filecmp.cmpfiles(one, other, files, shallow=False)
    assert len(same) > 15
    return different + missing


@pytest.mark.parametrize(
    "case", ["paths", *(pytest.param(c, marks=pytest.mark.slow) for c in list(CASES)[1:])]
)
def test_no_byte_depends_on_the_blocks(case, tmp_path):
    whole = CASES[case]
    assert (lookup_nodes(measured(whole, RayTracer(whole.mesh))) is None) is (
        case == "wide lamps"
    )
    ample = write_capture(whole, tmp_path / "ample")
    tight = write_capture(replace(whole, blocks=TINY), tmp_path / "tight", workers=2)
    assert difference(ample, tight) == []


def test_no_byte_depends_on_the_ceiling(tmp_path):
    whole = scene()
    ceiling = least_memory(whole, 2) + (8 << 20)
    ample = write_capture(whole, tmp_path / "ample", max_memory=1 << 40)
    tight = write_capture(whole, tmp_path / "tight", workers=2, max_memory=ceiling + (1 << 27))
    assert difference(ample, tight) == []


def test_blocks_follow_the_ceiling():
    whole = CASES["below the surface"]
    least = least_memory(whole, 2)
    ample = fitted(whole, 2, least + (1 << 33)).blocks
    assert (ample.block, ample.images) == (Blocks().block, Blocks().images)
    assert ample.lights == 5
    tight = fitted(whole, 2, least + (1 << 22)).blocks
    assert capture_sim.memory.SMALLEST_BLOCK <= tight.block < ample.block
    assert tight.images < ample.images
    assert tight.lights <= 5


def test_lights_are_grouped_where_tables_do_not_fit(monkeypatch):
    whole = CASES["below the surface"]
    monkeypatch.setattr(capture_sim.memory.subsurface, "bytes_per_light", lambda _: 100 << 20)
    least = least_memory(whole, 1)
    assert fitted(whole, 1, least + (700 << 20)).blocks.lights == 3  # a third is 2 more
    assert fitted(whole, 1, least + (200 << 20)).blocks.lights == 1


def test_too_low_a_ceiling_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(SceneError, match=r"--max-memory: expected at least \d+ MB for 3 work"):
        write_capture(scene(), tmp_path / "c", workers=3, max_memory=100 << 20)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["lots", "4", "-1GB", "0MB", "nanGB", "infGB", "", "GB"])
def test_sizes_that_are_none_are_refused(text):
    with pytest.raises(SceneError, match="--max-memory: expected a number with MB or GB"):
        parse_bytes(text)


@pytest.mark.slow
@pytest.mark.stability
@pytest.mark.skipif(not STATUS.exists(), reason="the peak is read from /proc")
def test_the_ceiling_holds(tmp_path):
    """Peak of a process of its own, at the lowest ceiling that it accepts."""
    program = """
import sys
from pathlib import Path
from capture_sim.memory import least_memory
from capture_sim.open3d_library import load_open3d
from capture_sim.scene import parse_scene
from capture_sim.write import write_capture
load_open3d()  # the ceiling counts what the process holds
ring = {"preset": "fibonacci", "n": 48, "target": [0, 0, 0.1], "distance": 1.0}
scene = parse_scene({
    "object": {"preset": "vase"}, "material": {"preset": "painted_vase"},
    "cameras": {**ring, "n": 4, "extent": 0.25, "width": 200, "height": 200},
    "lights": ring, "effects": ["antialiasing", "near_lights", "shadows"],
})
ceiling = least_memory(scene, 2) + (160 << 20)  # trials before it decides
write_capture(scene, Path(sys.argv[1]), workers=2, max_memory=ceiling)
# Not that of getrusage, which begins with the process that this one was forked from.
lines = Path("/proc/self/status").read_text().splitlines()
peak = next(line.split()[1] for line in lines if line.startswith("VmHWM"))
print(ceiling, 1024 * int(peak))
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "c")],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    ceiling, peak = map(int, done.stdout.split())
    assert peak <= ceiling, done.stdout
