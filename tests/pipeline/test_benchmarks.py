"""Benchmarks that no other test runs give the answers that they should, on small sizes."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

TINY_SCENE = """
[object]
preset = "sphere"
radius = 0.05
[material]
preset = "satin"
[cameras]
preset = "rings"
elevations_deg = [-30, 10, 50]
counts = [3, 4, 3]
distance = 0.5
extent = 0.13
width = 32
height = 32
[lights]
preset = "rings"
elevations_deg = [10, 60]
counts = [4, 2]
distance = 0.6
[heldout]
photographs = 2
[truth]
points = 20
"""
BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.mark.slow
def test_bench_synthetic_btf(subprocess_run, tmp_path):
    done = subprocess_run(
        BENCHMARKS / "bench_synthetic_btf.py", "--size", 12, 9, "--noise", 0, "-o", tmp_path
    )
    assert done.status == 0, done.err
    table = [line.split("|") for line in done.out.splitlines() if line.startswith("| clean")]
    errors = {row[2].strip(): float(row[6]) for row in table}
    # Few texels on a coarse relief: a tenth of what a constant guess (the base frame) errs.
    assert errors["refined"] < errors["harmonic"] < 3.0
    assert "unaligned ones" in done.out
    pictures = sorted(path.name for path in tmp_path.iterdir())
    assert [name[:8] for name in pictures] == ["figure_4", "figure_5", "figure_6"]
    assert np.asarray(Image.open(tmp_path / pictures[2])).std() > 20


def test_bench_accuracy(subprocess_run, tmp_path):
    done = subprocess_run(
        BENCHMARKS / "bench_accuracy.py",
        *("--texels", 40, "--band-limits", 4, "--brute", 2, "--rounds", 1, "-o", tmp_path),
    )
    assert done.status == 0, done.err
    with (tmp_path / "accuracy_against_time.csv").open(newline="") as file:
        rows = {(row["search"], row["K or rounds"]): row for row in csv.DictReader(file)}
    # The grid is coarse (22 degrees between neighbours); the peak is not.
    exact, grid = rows["exact", ""], rows["Eq. 11, highest of the grid", "4"]
    brute = rows["brute force, highest of the grid", ""]
    assert float(exact["normals"]) < 0.5 * float(grid["normals"])
    assert float(exact["ms per texel"]) < float(brute["ms per texel"])
    assert (exact["texels"], exact["timed"], brute["timed"]) == ("40", "40", "2")
    assert np.asarray(Image.open(tmp_path / "accuracy_against_time.png")).std() > 20


def test_bench_examples(subprocess_run):
    words = ("--texels", 60, "--unobserved", 0.3)
    done = subprocess_run(BENCHMARKS / "bench_examples.py", *words)
    assert done.status == 0, done.err
    ((row,),) = [
        t["rows"] for t in json.loads(Path(done.out.split()[-1]).read_text())["tables"]
    ]
    # Tilts of 15 degrees at most, which the tests of the example bound.
    assert 0 < row["normals off, degrees"] < 0.1 * row["unaligned"] < 1.5


@pytest.mark.slow
def test_bench_effects_on_field(subprocess_run, tiny_options, tmp_path):
    scene = tmp_path / "tiny.toml"
    scene.write_text(TINY_SCENE)
    done = subprocess_run(
        *(BENCHMARKS / "bench_effects_on_field.py", tmp_path / "out", "--scene", scene),
        *("--config", tiny_options, "--effects", "bayer"),
    )
    assert done.status == 0, done.err
    table = (tmp_path / "out" / "effects.md").read_text()
    names = [line.split("|")[1].strip() for line in table.splitlines()[2:]]
    assert names == ["none", "harmless_1", "harmless_2", "harmless_3", "bayer"]
    assert (tmp_path / "out" / "effects.png").stat().st_size > 10_000


@pytest.fixture
def scale(tiny_options, tmp_path):
    """Words of the script, for a small capture."""
    return (
        *(BENCHMARKS / "bench_scale.py", tmp_path, "--directions", 12),
        *("--pixels", 24, "--texels", 64, "--points", 0, "--config", tiny_options),
    )


@pytest.mark.slow
def test_scale_on_a_cluster_that_loses_workers(subprocess_run, scale):
    done = subprocess_run(*scale, "--kill-worker", "nanny")
    assert done.status == 0, done.err
    assert "killed in " in done.out
    assert " 0 differ" in done.out.splitlines()[-1]


@pytest.mark.slow
def test_scale(subprocess_run, scale):
    words = scale
    done = subprocess_run(*words, "--kill", 2)
    assert done.status == 0, done.err
    lines = done.out.splitlines()
    stages = [line.split()[0] for line in lines if line.split()[-1].startswith("0.")]
    assert {"simulation", "hull", "observations", "compression", "report"} <= set(stages)
    assert " 0 differ" in lines[-1]
    done = subprocess_run(*words, "--per-texel", 64, "--training", 100)
    assert done.status == 0, done.err
    assert "largest deviation" in done.out
