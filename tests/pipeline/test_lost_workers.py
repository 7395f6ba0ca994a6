"""Whole runs whose workers, scheduler or command are killed, and what is computed twice.

Each execution of a block leaves notes (`counted`), which the killed can not take back.
"""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from reflfield.util.dask_cluster import BLOCKS_PER_THREAD

HERE = Path(__file__).resolve().parent
# One work of each stage that reads or writes the samples, in their order.
WORKS = (
    "observations/projecting photographs",
    "completion/completing all texels",
    "alignment/frames of all texels",
    "resampling/completing all texels",
    "compression/coefficients on the samples, part 1",
)
WORKERS = 2
COMMAND = (
    "import counted, reflfield.util.dask_cluster as c; c.WAITING_SECONDS = 12; counted.main()"
)


class CountedRun:
    """The command on the tiny capture in small blocks, into a folder with notes."""

    def __init__(self, folder, capture, options):
        self.out, self.notes = folder / "run", folder / "notes"
        self.words = ("run", capture, "-o", self.out, "--config", options)
        self.words += ("--hold-out", "views=1,lights=1", "--set", "compression.fit=samples")
        search_path = os.pathsep.join(filter(None, [str(HERE), os.environ.get("PYTHONPATH")]))
        self.environment = {**os.environ, "PYTHONPATH": search_path}

    def start(self, *words, until="compression"):
        """Start the command; its process."""
        words = (self.notes, *self.words, "--until", until, *words)
        return subprocess.Popen(
            [sys.executable, "-c", COMMAND, *map(str, words)],
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def finish(self, *words, until="compression"):
        """Status and standard error of the command."""
        process = self.start(*words, until=until)
        _, errors = process.communicate(timeout=280)
        return process.returncode, errors

    def ask_to_die(self, work, before, delay):
        """Have the process killed that begins a block of a work when others were begun."""
        (self.notes / work).mkdir(parents=True, exist_ok=True)
        (self.notes / work / "die").write_text(f"{before} {delay}")

    def executions(self):
        """How often each block was begun, as {work: {number: times}}."""
        return {
            str(folder.relative_to(self.notes)): Counter(
                path.name.split(".")[0] for path in folder.glob("*.begun")
            )
            for folder in self.notes.glob("*/*")
        }

    def repeated(self):
        """Times that blocks were begun again, by work."""
        counts = {
            work: sum(n - 1 for n in of.values()) for work, of in self.executions().items()
        }
        return {work: times for work, times in counts.items() if times}

    def begun_by(self, processes):
        """Blocks that some processes began, as (work, number)."""
        return {
            (str(path.parent.relative_to(self.notes)), path.name.split(".")[0])
            for path in self.notes.glob("*/*/*.begun")
            if path.name.split(".")[1] in processes
        }

    def killed(self):
        """Processes that were killed, by the work that asked for it."""
        paths = self.notes.glob("*/*/killed")
        return {str(p.parent.relative_to(self.notes)): p.read_text() for p in paths}

    def records(self):
        """What the finished stages say of themselves."""
        paths = self.out.glob("stages/*/stage.json")
        return {path.parent.name: json.loads(path.read_text()) for path in paths}

    def digests(self):
        """Of the field and of all files of the stages but records, which hold times."""
        paths = [self.out / "field.rfld", *self.out.glob("stages/**/*")]
        return {
            str(path.relative_to(self.out)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in paths
            if path.is_file() and path.name not in ("stage.json", "files.json", ".lock")
        }


@pytest.fixture
def counted_run(tmp_path, tiny_capture, tiny_options):
    """A run to be killed."""
    return CountedRun(tmp_path, tiny_capture, tiny_options)


@pytest.fixture(scope="session")
def whole(tmp_path_factory, tiny_capture, tiny_options):
    """The run that was not killed, on threads. Read only."""
    run = CountedRun(tmp_path_factory.mktemp("counted"), tiny_capture, tiny_options)
    status, errors = run.finish("--workers", WORKERS)
    assert status == 0, errors
    assert run.repeated() == {}
    assert all(len(run.executions()[work]) >= 8 for work in WORKS)
    return run


def check_against(run, whole):
    """The same files, from the same blocks."""
    assert run.digests() == whole.digests()
    assert {w: set(of) for w, of in run.executions().items()} == {
        w: set(of) for w, of in whole.executions().items()
    }


@pytest.mark.slow
@pytest.mark.parametrize("nanny", [True, False])
def test_a_worker_is_killed_in_every_stage(whole, counted_run, processes, rng, nanny):
    """A nanny starts it again; without one the other worker does what is left."""
    cluster = processes(HERE)
    cluster.add_workers(2, nanny=nanny)
    for work in WORKS:
        n_blocks = len(whole.executions()[work])
        counted_run.ask_to_die(work, int(rng.integers(n_blocks // 2)), rng.uniform(0, 0.06))
    for work in WORKS:
        status, errors = counted_run.finish(
            "--scheduler", cluster.address, until=work.split("/")[0]
        )
        assert status == 0, errors
        assert work in counted_run.killed()
        if not nanny:
            assert cluster.count_workers() == 1
            cluster.add_workers(1, nanny=False)
    check_against(counted_run, whole)
    # Only what the killed had begun is begun again, and of that only what was not yet kept.
    killed = counted_run.killed()
    begun = counted_run.begun_by(set(killed.values()))
    again = {
        (work, number)
        for work, of in counted_run.executions().items()
        for number, times in of.items()
        if times > 1
    }
    assert again <= begun
    print("blocks computed again:", counted_run.repeated(), "of", len(begun), "of the killed")
    assert all(times <= BLOCKS_PER_THREAD for times in counted_run.repeated().values())
    assert 1 <= len(again) < len(begun)
    for stage, record in counted_run.records().items():
        works = {w: t for w, t in counted_run.repeated().items() if w.startswith(f"{stage}/")}
        assert record["blocks_computed"] == whole.records()[stage]["blocks_computed"]
        # What a worker said in its last milliseconds may have died with it.
        assert record["blocks_repeated"] <= sum(works.values())


@pytest.mark.slow
def test_all_workers_and_then_the_scheduler_are_killed(whole, counted_run, processes):
    """The run says so, ends, and goes on from its blocks, where they are computed now."""
    cluster = processes(HERE)
    cluster.add_workers(1, nanny=False)
    counted_run.ask_to_die(WORKS[1], 5, 0.02)
    status, errors = counted_run.finish("--scheduler", cluster.address)
    assert status == 2
    assert "waiting for workers of tcp" in errors
    assert "found none for 12 s; start some with `dask worker" in errors.splitlines()[-1]
    nothing_half_written(counted_run.out, "completion")

    cluster.add_workers(2, nanny=False)
    running = counted_run.start("--scheduler", cluster.address)
    wait_for_blocks(counted_run, WORKS[2], 5, running)
    cluster.scheduler.kill()
    _, errors = running.communicate(timeout=60)
    assert running.returncode == 2
    assert "lost it; start it and its workers, then run the same" in errors.splitlines()[-1]
    nothing_half_written(counted_run.out, "alignment")

    status, errors = counted_run.finish("--workers", WORKERS)
    assert status == 0, errors
    check_against(counted_run, whole)
    print("blocks computed again:", counted_run.repeated())
    assert set(counted_run.repeated()) <= set(WORKS[1:3])
    # With the scheduler went what both its workers had in hand.
    assert all(times <= 2 * BLOCKS_PER_THREAD for times in counted_run.repeated().values())
    # Five blocks were begun, of which all but those in hand were kept.
    for work in WORKS[1:3]:
        record = counted_run.records()[work.split("/")[0]]
        assert record["blocks_resumed"] >= 5 - 2 * BLOCKS_PER_THREAD, work


def wait_for_blocks(run, work, count, running):
    """Wait until some blocks of a work are begun."""
    while len(run.executions().get(work, ())) < count:
        assert running.poll() is None, running.communicate()
        time.sleep(0.01)


def nothing_half_written(out, stage):
    """Whole stages, and blocks of one that is not."""
    assert not (out / "field.rfld").exists()
    partial = out / "stages" / f"{stage}.partial"
    left = {path.name for path in partial.iterdir()}
    assert left == {"key", "blocks"}
    files = [path for path in (partial / "blocks").rglob("*") if path.is_file()]
    assert all(path.suffix == ".block" and path.name[0] != "." for path in files)
    others = [path for path in out.glob("stages/*") if path.is_dir() and path != partial]
    assert all((path / "stage.json").is_file() for path in others)


@pytest.mark.slow
def test_a_killed_command_repeats_at_most_a_block_of_each_thread(whole, counted_run, rng):
    works = [work for work, blocks in whole.executions().items() if len(blocks) > WORKERS]
    assert set(WORKS) < set(works)
    for work in works:
        n_blocks = len(whole.executions()[work])
        counted_run.ask_to_die(work, int(rng.integers(n_blocks - 1)), rng.uniform(0, 0.04))
    for _ in works:
        status, errors = counted_run.finish("--workers", WORKERS)
        assert status == -signal.SIGKILL, errors
    status, errors = counted_run.finish("--workers", WORKERS)
    assert status == 0, errors
    assert set(counted_run.killed()) == set(works)
    check_against(counted_run, whole)
    print("blocks computed again:", counted_run.repeated())
    assert set(counted_run.repeated()) <= set(works)
    assert all(times <= WORKERS for times in counted_run.repeated().values())
    assert counted_run.repeated()
