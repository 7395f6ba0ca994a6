"""Time and peak memory of a piece of work, on a stated number of cores."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import NamedTuple

import psutil

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
