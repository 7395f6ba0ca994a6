"""A tiny simulated capture, a finished run of it, and the command in this process."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import pytest

from capture_sim.scene import parse_scene
from capture_sim.write import write_capture
from reflfield.cli import main
from reflfield.options import HoldOut, Resources
from reflfield.pipeline.cache import StageFolder
from reflfield.pipeline.context import Context
from tests.tiny_dome import ball_scene

# Cuts all blocks small when it is imported, which is for processes of its own only: looked
# into for doctests, it would do so to every test.
collect_ignore = ["counted.py"]

# A satin ball under 6 lights.
SCENE = ball_scene("tiny", heldout={"photographs": 2}, truth={"points": 20})
OPTIONS = """
[hull]
resolution = 32
n_triangles = 2000
[atlas]
resolution = 64
[resampling]
view_side = 5
light_side = 5
[completion]
rank = 4
passes = 1
training_texels = 200
[alignment]
band_limit = 4
iterations = 1
n_clusters = 1
[compression]
fit = "samples"
n_clusters = 2
n_components = 2
rank = 4
training_texels = 200
[compression.samples]
rounds = 1
iterations = 2
[relighting]
samples_per_pixel = 1
[comparison]
without_alignment = true
rate_distortion = true
"""
HELD_OUT = ("--hold-out", "views=1,lights=1")


@dataclass(frozen=True)
class Outcome:
    """What a command left: exit status, standard output, standard error."""

    status: int
    out: str
    err: str


@dataclass(frozen=True)
class Run:
    """A finished run of the tiny capture by the installed command."""

    folder: Path
    outcome: Outcome


@pytest.fixture(scope="session")
def tiny_capture(made_once):
    """Folder of the simulated capture. Read only."""

    def fill(folder):
        write_capture(parse_scene(SCENE), folder)

    return made_once("tiny", fill)[0]


@pytest.fixture(scope="session")
def tiny_options(tmp_path_factory):
    """TOML file of options that make a run short."""
    path = tmp_path_factory.mktemp("options") / "options.toml"
    path.write_text(OPTIONS)
    return path


@pytest.fixture(scope="session")
def subprocess_run(tmp_path_factory):
    """Function that runs a Python command line in a process of its own.

    What an example measures is not kept beside the results of the benchmarks.
    """
    results = str(tmp_path_factory.mktemp("results"))

    def run(*words, timeout=250):
        done = subprocess.run(
            [sys.executable, *map(str, words)],
            capture_output=True,
            text=True,
            check=False,
            timeout=timeout,
            env={**os.environ, "REFLFIELD_RESULTS": results},
        )
        return Outcome(done.returncode, done.stdout, done.stderr)

    return run


@pytest.fixture(scope="session")
def finished(made_once, tiny_capture, tiny_options, subprocess_run):
    """The whole run, once for all workers. Read only: copy it to change it."""

    def fill(folder):
        outcome = subprocess_run(
            *("-m", "reflfield", "run", tiny_capture, "-o", folder),
            *("--config", tiny_options, *HELD_OUT),
        )
        assert outcome.status == 0, outcome.err
        return asdict(outcome)

    folder, outcome = made_once("whole", fill)
    return Run(folder, Outcome(**outcome))


@pytest.fixture(scope="session")
def context_of():
    """Function that makes the context of a run into a folder, or of a finished one."""

    def make(capture, out, options, hold_out=None):
        held, stages = hold_out or HoldOut(1, 1), StageFolder(out / "stages")
        return Context(capture, out, options, held, Resources(), stages)

    return make


@pytest.fixture
def run_copy(finished, tmp_path):
    """A finished run to change."""
    return shutil.copytree(finished.folder, tmp_path / "run")


@pytest.fixture
def capture_copy(tiny_capture, tmp_path):
    """A capture to damage, without its truth."""
    return shutil.copytree(
        tiny_capture, tmp_path / "capture", ignore=shutil.ignore_patterns("truth")
    )


@pytest.fixture
def described():
    """Function that changes the description of a capture in place."""

    def change(folder, edit):
        path = folder / "capture.json"
        document = json.loads(path.read_text())
        edit(document)
        path.write_text(json.dumps(document))

    return change


@pytest.fixture
def reflfield(monkeypatch, capsys):
    """Function that runs ``reflfield WORDS`` in this process."""

    def command(*words):
        capsys.readouterr()
        monkeypatch.setattr(sys, "argv", ["reflfield", *map(str, words)])
        status = 0
        try:
            main()
        except SystemExit as end:
            status = int(end.code or 0)
        shown = capsys.readouterr()
        return Outcome(status, shown.out, shown.err)

    return command


@pytest.fixture
def run_tiny(reflfield, tiny_capture, tiny_options):
    """Function that runs the tiny capture, or a copy of it, into a folder."""

    def run(out, *words, capture=tiny_capture):
        return reflfield("run", capture, "-o", out, "--config", tiny_options, *HELD_OUT, *words)

    return run
