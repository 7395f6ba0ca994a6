"""Blocks on a cluster whose workers, or scheduler, die: what is lost, and what is said."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from reflfield.errors import InputError
from reflfield.util.blocks import Blocks, Scheduler, Tally
from reflfield.util.dask_cluster import BLOCKS_PER_THREAD, threads_here
from reflfield.util.progress import listening

# Functions of blocks stand inside the tests, so that the workers need not find this file.


def test_address_without_a_scheduler(tmp_path, monkeypatch):
    monkeypatch.setattr("reflfield.util.dask_cluster.CONNECTING_SECONDS", 0.3)
    blocks = Blocks(Scheduler(1, "tcp://127.0.0.1:9"), tmp_path)
    with pytest.raises(InputError, match="scheduler: expected a dask scheduler at tcp"):
        blocks.map("blocks", len, None, [[]])


def test_a_lost_worker_costs_its_blocks(tmp_path, cluster):
    # Inside the test, so that the workers need not find this file.
    def process_of(folder, block):
        (Path(folder) / f"{block}.{os.getpid()}").write_text("")
        if block == 2 and not (Path(folder) / "killed").exists():
            (Path(folder) / "killed").write_text(str(os.getpid()))
            time.sleep(0.2)  # for what it says of its beginning to be sent
            os._exit(9)
        time.sleep(0.05)
        return {"process": np.array(os.getpid()), "square": np.array(block**2)}

    tally = Tally()
    blocks = Blocks(Scheduler(1, cluster), tmp_path / "blocks", tally)
    results = blocks.map("processes", process_of, str(tmp_path), range(12))
    assert [int(arrays["square"]) for arrays in results] == [n**2 for n in range(12)]
    assert os.getpid() not in {int(arrays["process"]) for arrays in results}
    assert tally.computed == 12
    # Begun twice: blocks of the worker that was lost, and no other.
    lost = (tmp_path / "killed").read_text()
    begun = [path.name.split(".") for path in tmp_path.glob("*.*")]
    assert tally.repeated == len(begun) - 12
    twice = {n for n, _ in begun if sum(other == n for other, _ in begun) > 1}
    assert twice <= {n for n, process in begun if process == lost}
    assert "2" in twice


def test_what_a_worker_has_computed_is_not_lost_with_it(tmp_path, cluster):
    """Even where results are kept much more slowly than they are computed."""

    def begun(folder, block):
        (Path(folder) / f"{block}.{time.monotonic_ns()}").touch()
        if block == 20 and not (Path(folder) / "killed").exists():
            (Path(folder) / "killed").touch()
            time.sleep(0.2)  # for the workers to run ahead, if they may
            os._exit(9)
        return {"block": np.array(block)}

    kept = []

    def keep(number, result):
        time.sleep(0.05)
        kept.append((number, int(result["block"])))

    scheduler = Scheduler(1, cluster)
    repeated = scheduler.run(begun, str(tmp_path), {n: n for n in range(40)}, keep)
    assert sorted(kept) == [(n, n) for n in range(40)]
    assert repeated == len(list(tmp_path.glob("*.*"))) - 40
    assert 1 <= repeated <= BLOCKS_PER_THREAD


def test_what_has_arrived_is_not_lost_with_the_worker_that_sent_it(processes):
    """A result that waits to be kept while its worker dies, and dask gives it up for lost."""
    cluster = processes()
    cluster.add_workers(1, nanny=True)
    kept = {}

    def process_of(context, block):
        return {"process": np.array(os.getpid())}

    def keep(number, result):
        kept[number] = int(result["process"])
        if len(kept) == 1:
            time.sleep(0.5)  # for the next result to arrive
            os.kill(kept[number], signal.SIGKILL)
            time.sleep(0.5)  # for its loss to be noticed

    blocks = {n: n for n in range(4)}
    Scheduler(1, cluster.address).run(process_of, None, blocks, keep)
    assert sorted(kept) == [0, 1, 2, 3]
    assert kept[0] == kept[1] != kept[2]


def test_no_worker_left(tmp_path, processes, monkeypatch):
    """The run says that it waits, then why it ends; the next goes on from its blocks."""

    def dies(folder, block):
        if block == 5 and not (Path(folder) / "killed").exists():
            (Path(folder) / "killed").touch()
            os._exit(9)
        return {"block": np.array(block)}

    monkeypatch.setattr("reflfield.util.dask_cluster.WAITING_SECONDS", 3)
    cluster, heard = processes(), []
    cluster.add_workers(1, nanny=False)
    blocks = Blocks(Scheduler(1, cluster.address), tmp_path / "blocks")
    with (
        listening(lambda *words: heard.append(words)),
        pytest.raises(InputError, match=r"expected workers at tcp.* found none for 3 s; start"),
    ):
        blocks.map("work", dies, str(tmp_path), range(8))
    waiting = f"waiting for workers of {cluster.address}"
    assert {(waiting, 1, 3), (waiting, 2, 3)} & set(heard)
    kept = list((tmp_path / "blocks" / "work").iterdir())
    assert all(path.name.endswith(".block") for path in kept)

    # A worker that comes while it is waited for does what is left.
    def start_worker(description, done, total):
        if description.startswith("waiting") and not started:
            started.append(cluster.start("worker", cluster.address, "--no-dashboard"))

    monkeypatch.undo()
    tally, started = Tally(), []
    blocks = Blocks(Scheduler(1, cluster.address), tmp_path / "blocks", tally)
    with listening(start_worker):
        results = blocks.map("work", dies, str(tmp_path), range(8))
    assert [int(arrays["block"]) for arrays in results] == list(range(8))
    assert tally == Tally(computed=8 - len(kept), resumed=len(kept))
    assert len(kept) >= 5 - BLOCKS_PER_THREAD


def test_the_scheduler_is_lost(tmp_path, processes):
    cluster = processes()
    cluster.add_workers(2, nanny=False)
    kept = []

    def keep(number, result):
        kept.append(number)
        if len(kept) == 3:
            cluster.scheduler.kill()

    def slow(context, block):
        time.sleep(0.1)
        return {"block": np.array(block)}

    started = time.monotonic()
    with pytest.raises(InputError, match=r"expected the scheduler at tcp.* to stay, lost it"):
        Scheduler(1, cluster.address).run(slow, None, {n: n for n in range(40)}, keep)
    # Closing waits for no one; time for a busy machine.
    assert time.monotonic() - started < 20
    assert 3 <= len(kept) <= 3 + 2 * BLOCKS_PER_THREAD


def test_a_block_that_kills_its_workers(processes, monkeypatch):
    monkeypatch.setattr("reflfield.util.dask_cluster.MOST_DEATHS", 2)
    cluster = processes()
    cluster.add_workers(3, nanny=False)

    def dies(context, block):
        os._exit(9)

    with pytest.raises(InputError, match=r"that live through a block, lost 2 at the same one"):
        Scheduler(1, cluster.address).run(dies, None, {0: 0}, lambda *_: None)


def test_an_error_of_a_block_is_raised_as_it_is(cluster):
    def fails(context, block):
        raise InputError(f"block {block}: damaged")

    with pytest.raises(InputError, match="block 7: damaged"):
        Scheduler(1, cluster).run(fails, None, {0: 7}, lambda *_: None)


def test_no_worker_computes_more_at_once_than_allowed_and_each_counts_its_own_threads(
    tmp_path, processes
):
    from_here = str(Path(__file__).parents[2])
    running = processes(from_here)
    running.start(
        *("worker", running.address, "--no-nanny", "--nthreads", 3, "--no-dashboard"),
        *("--host", "127.0.0.1"),
    )

    def wait(folder, block):
        from reflfield.util.dask_cluster import threads_here

        mine = Path(folder) / str(block)
        mine.touch()
        working = len(list(Path(folder).iterdir()))
        time.sleep(0.1)
        mine.unlink()
        return {"working": np.array(working), "threads": np.array(threads_here(64))}

    most = {}
    for at_once in (None, 2, 1):
        folder = tmp_path / str(at_once)
        folder.mkdir()
        blocks = Blocks(Scheduler(1, running.address), tmp_path / f"{at_once}.blocks")
        results = blocks.map("blocks", wait, str(folder), range(9), at_once=at_once)
        most[at_once] = max(int(arrays["working"]) for arrays in results)
        assert {int(arrays["threads"]) for arrays in results} == {3}
    assert most == {None: 3, 2: 2, 1: 1}
    assert threads_here(64) == 64
