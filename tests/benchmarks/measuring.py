"""Time and peak memory of a piece of work; figures in files, with what they were measured on.

Benchmarks fill a `Results` and write it: ``results/NAME.json``.
``make_results.py`` makes the pages from these files.
"""

from __future__ import annotations

import json
import math
import os
import platform
import re
import shlex
import subprocess
import sys
import time
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import NamedTuple

import psutil

from reflfield.util.files import replacing

ROOT = Path(__file__).resolve().parents[2]


# Seconds that the runs of one measurement may take together before they are enough.
LONG = 3.0


class Measured(NamedTuple):
    """What a measurement found."""

    answer: object
    seconds: float  # median of the repeats
    cpu_seconds: float  # of all threads together, median
    megabytes: float  # of resident memory at the peak, beyond what was held before preparing


def resident():
    """Bytes of resident memory now."""
    return psutil.Process().memory_info().rss


def reset_peak():
    """Let the kernel's record of the peak start again from the memory held now."""
    Path("/proc/self/clear_refs").write_text("5")


def peak():
    """Bytes of resident memory at the peak since `reset_peak`, as the kernel saw it."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmHWM:")[1].split()[0])


def measured(prepare, work, repeats=5, shortest=0.05):
    """Prepare once, run once unmeasured (unless that takes long), then time some runs.

    Parameters
    ----------
    prepare : callable
        Returns what `work` needs besides its input: tables, plans, compiled functions.
    work : callable of what `prepare` returned
    repeats : int
        Timed runs, fewer if they take long.
    shortest : float
        Runs are repeated until one timing lasts so long, seconds.
    """
    before = resident()
    prepared = prepare()
    reset_peak()
    answer, *times = timed(lambda: work(prepared), 1)
    runs = [times]
    if times[0] < LONG:
        count = max(1, int(shortest / max(times[0], 1e-9)))
        # Compilers are gone by now: what remains is what the method needs to run.
        reset_peak()
        runs = []
        while len(runs) < repeats and count * sum(run[0] for run in runs) < LONG:
            answer, *times = timed(lambda: work(prepared), count)
            runs.append(times)
    seconds, cpu_seconds = (median(column) for column in zip(*runs, strict=True))
    return Measured(answer, seconds, cpu_seconds, (peak() - before) / 2**20)


def timed(work, count):
    """Last answer, seconds and CPU seconds of each of `count` runs."""
    start = time.perf_counter(), time.process_time()
    for _ in range(count):
        answer = work()
    end = time.perf_counter(), time.process_time()
    return answer, *((b - a) / count for a, b in zip(start, end, strict=True))


def spent(work):
    """Answer of one run, and cells of its times and of the process's peak memory meanwhile."""
    reset_peak()
    answer, seconds, cpu_seconds = timed(work, 1)
    values = seconds, cpu_seconds, peak() / 2**30
    names = "wall time, s", "CPU time, s", "peak memory, GB"
    return answer, dict(zip(names, (round(value, 3) for value in values), strict=True))


def on_cores(n_cores, script, *arguments):
    """Lines of JSON that a script prints in a process of its own on so many cores.

    The cores are withheld before any library starts, so BLAS, OpenMP, numba and XLA all size
    their pools by them.

    Raises
    ------
    RuntimeError
        If the process fails; its last lines of error output are quoted.
    """
    cores = sorted(os.sched_getaffinity(0))[:n_cores]
    if len(cores) < n_cores:
        raise RuntimeError(f"--cores: expected at most {len(cores)} here, received {n_cores}")
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    environment = {**os.environ, **dict.fromkeys(names, str(n_cores))}
    done = subprocess.run(
        [sys.executable, str(script), *map(str, arguments)],
        env=environment,
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        tail = "\n".join(done.stderr.strip().splitlines()[-5:])
        raise RuntimeError(f"{script} {' '.join(map(str, arguments))}: {tail}")
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


# --- results --------------------------------------------------------------------------------

RESULTS = ROOT / "tests" / "benchmarks" / "results"
# Another folder for what a test or a trial measures.
ELSEWHERE = "REFLFIELD_RESULTS"
# What every file of results holds.
KEYS = ("name", "title", "command", "date", "commit", "machine", "versions", "code", "tables")


class Results:
    """Figures of one benchmark, row by row, and what they were measured on.

    Parameters
    ----------
    name : str
        Of the file, without suffix.
    title : str
        One line, the heading in ``RESULTS.md``.
    modules : iterable of str
        Modules whose code, with all that they import, the figures depend on.
    """

    def __init__(self, name, title, modules):
        self.name, self.title = name, title
        # Of now: the tree may change while a long benchmark runs.
        self.commit, self.code = commit(), digests(modules)
        self.tables = []

    def table(self, title):
        """Begin a table; the rows that follow belong to it."""
        self.tables.append({"title": title, "rows": []})

    def row(self, **cells):
        """One row; text, numbers, or None where nothing was measured."""
        self.add(cells)

    def add(self, cells):
        """One row, as a mapping from column to value."""
        self.tables[-1]["rows"].append({name: plain(value) for name, value in cells.items()})

    def say(self):
        """Print the last row."""
        print(self.tables[-1]["rows"][-1], flush=True)

    def write(self, folder=None, written_by=None):
        """Write NAME.json, and return its path.

        By default into the folder of all results, as written by this process's command.
        """
        folder = Path(folder or os.environ.get(ELSEWHERE, RESULTS))
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.name}.json"
        with replacing(path) as partial:
            partial.write_text(
                json.dumps(self.to_dict(written_by), indent=1, allow_nan=False) + "\n"
            )
        return path

    def to_dict(self, written_by=None):
        """The file's content, by `KEYS`."""
        return {
            "name": self.name,
            "title": self.title,
            "command": written_by or command(),
            "date": datetime.now(UTC).date().isoformat(),
            "commit": self.commit,
            "machine": machine(),
            "versions": versions(),
            "code": self.code,
            "tables": self.tables,
        }


def plain(value):
    """A cell as JSON has it: numpy's numbers as Python's, what is not finite as text."""
    value = value.item() if hasattr(value, "item") else value
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, (str, int, float)):
        return value
    raise TypeError(f"cell: expected text, a number or None, received {type(value).__name__}")


def command():
    """This process's command line, as one would type it in the root of the repository."""
    script = Path(sys.argv[0]).resolve()
    inside = script.relative_to(ROOT) if script.is_relative_to(ROOT) else script
    return shlex.join(["python", str(inside), *sys.argv[1:]])


def commit():
    """Commit of the working tree, with a + where files differ from it; empty without git."""
    git = ["git", "-C", str(ROOT)]
    head = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True,
                          text=True, check=False)  # fmt: skip
    changed = subprocess.run([*git, "status", "--porcelain", "reflfield", "capture_sim"],
                             capture_output=True, text=True, check=False)  # fmt: skip
    return head.stdout.strip() + "+" * bool(changed.stdout.strip())


def machine():
    """Processor, cores that this process may use, memory, and how busy all of it is."""
    names = re.findall(r"^model name\s*:\s*(.+)$", read_if_there("/proc/cpuinfo"), re.MULTILINE)
    return {
        "processor": names[0] if names else platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": round(psutil.virtual_memory().total / 2**30, 1),
        "load": round(os.getloadavg()[1], 1),  # runnable processes, five minutes' mean
    }


def read_if_there(path):
    """Text of a file; empty where the system has none."""
    return Path(path).read_text() if Path(path).is_file() else ""


def versions():
    """Versions of this package and of what it computes with."""
    # The pipeline's packages import much that what is measured here does not need.
    from reflfield.pipeline.cache import versions as installed

    return installed()


def digests(modules):
    """Digest of each module's code with all that it imports."""
    from reflfield.pipeline.code_digests import code_digest

    for name in modules:
        if find_spec(name) is None:
            raise ValueError(f"modules: expected modules that exist, received {name!r}")
    return {name: code_digest(name) for name in modules}
