"""Killed in the middle of a stage and run again, a run ends with the same bytes."""

import hashlib
import json
import os
import signal

import pytest

from reflfield.pipeline.cache import StageFolder
from reflfield.util.blocks import BlockFiles

# Runs the command; the process is killed at the step of its progress that is named.
KILLED_AT = """
import os, signal, sys
import reflfield.cli as cli
from reflfield.util import terminal

last = int(sys.argv.pop(1))

class Killer:
    def __init__(self, write):
        self.steps = 0
    def __call__(self, description, done, total):
        self.steps += 1
        if self.steps == last:
            os.kill(os.getpid(), signal.SIGKILL)

terminal.ProgressLines = Killer
cli.main()
"""
# What only the basis needs is not looked at again once that is done.
FOR_THE_BASIS = "resampling for the basis"


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def whole_blocks(partial):
    """Verified results of blocks in an unfinished stage's folder."""
    folders = [f for f in (partial / "blocks").glob("*") if list(f.glob("*.block"))]
    return {
        (folder.name, number)
        for folder in folders
        for number in range(100)
        if BlockFiles(folder).read(number) is not None
    }


def records(out):
    """What the finished stages say of themselves."""
    paths = out.glob("stages/*/stage.json")
    return {path.parent.name: json.loads(path.read_text()) for path in paths}


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs a system with SIGKILL")
@pytest.mark.parametrize("n_kills", [1, pytest.param(5, marks=pytest.mark.slow)])
def test_killed_at_random_moments_and_run_again(
    finished, tiny_capture, tiny_options, subprocess_run, run_tiny, tmp_path, rng, n_kills
):
    out = tmp_path / "run"
    words = ("run", tiny_capture, "-o", out, "--config", tiny_options, "--workers", 2)
    held = ("--hold-out", "views=1,lights=1")
    left: dict[str, set] = {}
    n = 0
    # A stage that is killed before its first block is whole leaves nothing: once more, then.
    while n < n_kills or (n < n_kills + 6 and not any(left.values())):
        n += 1
        before = set(records(out)) if out.exists() else set()
        killed = subprocess_run("-c", KILLED_AT, int(rng.integers(14, 39)), *words, *held)
        assert killed.status == -signal.SIGKILL, killed.err
        assert not (out / "field.rfld").exists()
        for partial in out.glob("stages/*.partial"):
            # Blocks that were done are done for ever, as long as the stage lasts.
            assert left.get(partial.stem, set()) <= whole_blocks(partial)
            left[partial.stem] = whole_blocks(partial)
        assert before <= set(records(out))
    assert run_tiny(out).status == 0
    assert [p for p in out.rglob("*") if "partial" in p.name] == []
    for name in ("field.rfld", "hull.ply", "atlas.glb", "normals.exr", "metrics.json"):
        assert digest(out / name) == digest(finished.folder / name), name
    whole = records(finished.folder)
    for stage, record in records(out).items():
        # What a kill leaves is taken up; the rest is computed once.
        kept = left.get(stage, set())
        if ("basis", 0) in kept:
            kept = {block for block in kept if block[0] != FOR_THE_BASIS}
        assert record["blocks_resumed"] == len(kept), stage
        together = record["blocks_computed"] + record["blocks_resumed"]
        assert together <= whole[stage]["blocks_computed"], stage
    assert sum(map(len, left.values())) > 0


@pytest.mark.slow
def test_a_cluster_makes_the_same_bytes(finished, run_tiny, cluster, tmp_path):
    outcome = run_tiny(tmp_path / "run", "--until", "compression", "--scheduler", cluster)
    assert outcome.status == 0, outcome.err
    for name in ("field.rfld", "stages/completion/completion.npz", "hull.ply"):
        assert digest(tmp_path / "run" / name) == digest(finished.folder / name), name


@pytest.mark.parametrize("kind", ["memory://test_resume", "folder"])
def test_samples_in_a_store_elsewhere_make_the_same_bytes(finished, run_copy, run_tiny, kind):
    store = kind if "://" in kind else run_copy.parent / kind
    words = ("--from", "observations", "--until", "completion", "--store", store)
    outcome = run_tiny(run_copy, *words)
    assert outcome.status == 0, outcome.err
    assert not (run_copy / "stages" / "observations" / "samples").exists()
    made = run_copy / "stages" / "completion" / "completion.npz"
    assert digest(made) == digest(finished.folder / "stages" / "completion" / made.name)


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


def test_a_record_that_was_changed_is_computed_again(run_copy, run_tiny):
    path = run_copy / "stages" / "hull" / "stage.json"
    record = json.loads(path.read_text())
    changed = {**record, "counts": {**record["counts"], "triangles": 7}}
    lacking = {k: v for k, v in record.items() if k != "seconds"}
    for text in (changed, lacking):
        path.write_text(json.dumps(text))
        outcome = run_tiny(run_copy, "--until", "hull")
        assert outcome.status == 0
        assert "unchanged" not in outcome.out.splitlines()[1]
        assert json.loads(path.read_text())["counts"] == record["counts"]


def test_nothing_is_left_of_a_chunk_whose_writer_was_killed(tmp_path):
    """By a worker that dies the stage is not stopped."""
    stages = StageFolder(tmp_path)

    def compute(folder):
        (folder / "samples").mkdir()
        (folder / "samples" / "0.0123.partial").write_bytes(b"half")
        (folder / "samples" / "0").write_bytes(b"whole")
        return {}

    folder = stages.run("observations", compute)
    assert [path.name for path in sorted(folder.rglob("*")) if path.is_file()] == [
        "0",
        "stage.json",
    ]


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
