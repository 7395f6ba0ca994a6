"""Killed in the middle of a stage and run again, a run ends with the same bytes."""

import hashlib
import os
import signal

import pytest

# Runs the command; the process kills itself, as SIGKILL does, at a step of the progress
# that is reported while the stage's partial folder exists.
KILLED_IN = """
import os, signal, sys
from pathlib import Path
import reflfield.cli as cli

partial, step = Path(sys.argv.pop(1)), int(sys.argv.pop(1))

class Killer:
    def __init__(self, write):
        self.steps = 0
    def __call__(self, description, done, total):
        self.steps += partial.is_dir()
        if self.steps == step:
            os.kill(os.getpid(), signal.SIGKILL)

cli.ProgressLines = Killer
cli.main()
"""


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs a system with SIGKILL")
def test_killed_in_three_stages_and_run_again(
    finished, tiny_capture, tiny_options, subprocess_run, run_tiny, tmp_path
):
    out = tmp_path / "run"
    words = ("run", tiny_capture, "-o", out, "--config", tiny_options)
    held = ("--hold-out", "views=1,lights=1")
    for stage, step in (("hull", 4), ("observations", 2), ("compression", 8)):
        partial = out / "stages" / f"{stage}.partial"
        killed = subprocess_run("-c", KILLED_IN, partial, step, *words, *held)
        assert killed.status == -signal.SIGKILL
        assert partial.is_dir()
        assert not partial.with_name(stage).exists()
        assert not (out / "field.rfld").exists()
    assert run_tiny(out).status == 0
    assert [p for p in out.rglob("*") if "partial" in p.name] == []
    for name in ("field.rfld", "hull.ply", "atlas.glb", "normals.exr", "metrics.json"):
        assert digest(out / name) == digest(finished.folder / name), name


def test_killed_while_an_earlier_result_is_replaced(run_copy, run_tiny, finished):
    # What a kill between the two steps of the replacement leaves: no record, files half gone.
    (run_copy / "stages" / "hull" / "stage.json").unlink()
    (run_copy / "stages" / "hull" / "hull.ply").unlink()
    (run_copy / "stages" / "hull.partial").mkdir()
    (run_copy / "stages" / "hull.partial" / "hull.ply").write_bytes(b"ply\n")
    (run_copy / ".field.rfld.partial").write_bytes(b"half")
    assert run_tiny(run_copy).status == 0
    assert [p for p in run_copy.rglob("*") if "partial" in p.name] == []
    assert digest(run_copy / "hull.ply") == digest(finished.folder / "hull.ply")
    assert digest(run_copy / "field.rfld") == digest(finished.folder / "field.rfld")


def test_an_unreadable_record_is_computed_again(run_copy, run_tiny):
    record = run_copy / "stages" / "hull" / "stage.json"
    for text in ("", "[]", '{"key": 3}', record.read_text()[:-40]):
        record.write_text(text)
        outcome = run_tiny(run_copy, "--until", "hull")
        assert outcome.status == 0
        assert "unchanged" not in outcome.out.splitlines()[1]


def test_two_runs_in_one_folder_are_kept_apart(run_copy, run_tiny):
    fcntl = pytest.importorskip("fcntl")
    handle = os.open(run_copy / "stages" / ".lock", os.O_RDWR)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        outcome = run_tiny(run_copy)
    finally:
        os.close(handle)
    assert outcome.status == 2
    assert "another run working" in outcome.err
    assert run_tiny(run_copy, "--until", "hull").status == 0
