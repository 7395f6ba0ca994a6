"""Fixtures that every test may use."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

# One worker of the tests for each core: threads of BLAS beside them only wait for each other,
# and cost a third of the time. Before NumPy is imported, which reads this once.
for _library in ("OPENBLAS", "OMP"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import distributed
import numpy as np
import psutil
import pytest
from hypothesis import settings

try:
    import fcntl
except ImportError:  # Windows: each worker makes what it needs
    fcntl = None

# The table of `-m stability`.
pytest_plugins = ["tests.stability_table"]
# Scripts without doctests, which import much.
collect_ignore = ["benchmarks"]
SEED = 20060905  # one seed for all; change it with --seed


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="run the tests that take minutes")
    parser.addoption("--seed", type=int, default=SEED, help="seed of the `rng` fixture")


def pytest_configure(config):
    """The same examples in each run; `--slow` and `--hypothesis-seed` look for new ones."""
    settings.register_profile("same", derandomize=True)
    new = config.getoption("--slow") or config.getoption("--hypothesis-seed", None)
    if not new and not config.getoption("--hypothesis-profile", None):
        settings.load_profile("same")


def pytest_collection_modifyitems(config, items):
    if config.getoption("--slow"):
        return
    skip = pytest.mark.skip(reason="takes minutes; run with --slow")
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(skip)


@pytest.fixture
def rng(request):
    return np.random.default_rng(request.config.getoption("--seed"))


@pytest.fixture
def rounding():
    """Tolerance = safety * eps(dtype) * operations * condition * scale."""

    def tolerance(dtype, operations=1.0, condition=1.0, scale=1.0, safety=8.0):
        return float(safety * np.finfo(dtype).eps * operations * condition * scale)

    return tolerance


@pytest.fixture
def order_of_writes(monkeypatch):
    """Function from a file to what was done: "flushed" to the disk, "named" otherwise.

    Names count that a file got, or another path, such as the folder that it is in.
    """
    done = []

    def watched(function, name, inode):
        def call(first, *more):
            done.append((name, inode(first)))
            return function(first, *more)

        return call

    monkeypatch.setattr(os, "fsync", watched(os.fsync, "flushed", lambda f: os.fstat(f).st_ino))
    for name in ("replace", "rename"):
        moved = watched(getattr(Path, name), "named", lambda path: path.stat().st_ino)
        monkeypatch.setattr(Path, name, moved)

    def order(file, named=None):
        paths = {"flushed": file, "named": named or file}
        return [what for what, inode in done if inode == paths[what].stat().st_ino]

    return order


class Processes:
    """A dask cluster of commands in processes of their own, to be killed.

    The workers find the modules of `paths`.
    """

    def __init__(self, folder, paths):
        self.folder, self.started = folder, []
        places = [*map(str, paths), os.environ.get("PYTHONPATH")]
        self.environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, places))}
        named = folder / "scheduler.json"
        words = ("--host", "127.0.0.1", "--port", 0, "--no-dashboard", "--no-show")
        self.scheduler = self.start("scheduler", *words, "--scheduler-file", named)
        until(lambda: named.is_file() and named.read_text().endswith("}"))
        self.address = json.loads(named.read_text())["address"]

    def start(self, kind, *words):
        """A command of dask; its process."""
        log = self.folder / f"{kind}-{len(self.started)}.log"
        with log.open("w") as file:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", kind, *map(str, words)],
                stdout=file,
                stderr=subprocess.STDOUT,
                env=self.environment,
                cwd=self.folder,
            )
        self.started.append(process)
        return process

    def add_workers(self, count, *, nanny):
        """Workers of one thread, and a nanny for each that restarts it; waits for them."""
        kind = "--nanny" if nanny else "--no-nanny"
        before = self.count_workers()
        words = (self.address, kind, "--nthreads", 1, "--no-dashboard", "--host", "127.0.0.1")
        started = [self.start("worker", *words) for _ in range(count)]
        until(lambda: self.count_workers() == before + count)
        return started

    def count_workers(self):
        """Workers that the scheduler knows."""
        with distributed.Client(self.address, set_as_default=False) as client:
            return len(client.nthreads())

    def stop(self):
        """Kill all processes, those that the nannies have started too."""
        for process in self.started:
            if process.poll() is None:
                # First the nanny, which would start the worker again.
                family = psutil.Process(process.pid).children(recursive=True)
                process.send_signal(signal.SIGKILL)
                for member in family:
                    try:
                        member.kill()
                    except psutil.NoSuchProcess:
                        continue
            process.wait()


def until(happened, seconds=60):
    """Wait for something to happen."""
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end, "waited for long"
        time.sleep(0.05)


@pytest.fixture
def processes(tmp_path_factory):
    """Function that starts a scheduler whose workers find modules in the given folders."""
    running = []

    def start(*paths):
        running.append(Processes(tmp_path_factory.mktemp("dask"), paths))
        return running[-1]

    yield start
    for cluster in running:
        cluster.stop()


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    """Function that returns a folder filled once for all workers of the tests. Read only.

    The first that asks for `name` calls `fill(folder)`, the others wait. What it returns, in
    JSON, comes with the folder; a `fill` that fails is tried again by the next.
    """
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if fcntl and "PYTEST_XDIST_WORKER" in os.environ else base

    def make(name, fill):
        path, returned = shared / name, shared / f"{name}.json"
        with (shared / f"{name}.lock").open("w") as lock:
            if fcntl:
                fcntl.flock(lock, fcntl.LOCK_EX)  # until the file is closed
            if not returned.is_file():
                shutil.rmtree(path, ignore_errors=True)
                returned.write_text(json.dumps(fill(path)))
        return path, json.loads(returned.read_text())

    return make


@pytest.fixture(scope="session")
def cluster(tmp_path_factory):
    """Address of a dask cluster of two worker processes.

    Not a `LocalCluster`: its nannies would set the environment of this process, too, and
    what is started from it would compute with another number of threads.
    """
    running = Processes(tmp_path_factory.mktemp("dask"), ())
    try:
        running.add_workers(2, nanny=True)
        yield running.address
    finally:
        running.stop()


@pytest.fixture(scope="session")
def shared_data():
    """Return a function from the name of a test set to its folder; skips where it is absent."""
    here = Path(__file__).resolve().parents[2] / "shared" / "data"
    root = Path(os.environ.get("REFLFIELD_DATA", here))

    def folder(name):
        path = root / name
        if not path.exists():
            pytest.skip(f"test data {name!r} not found under {root} (set REFLFIELD_DATA)")
        return path

    return folder
