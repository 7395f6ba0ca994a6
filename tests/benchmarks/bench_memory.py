"""Memory of whole runs of large photographs: the peak of each stage, and of each command.

    python tests/benchmarks/bench_memory.py --side 4000 --max-memory 2GB
    python tests/benchmarks/bench_memory.py --side 1000 --max-memory 1GB --model clustered

A small capture is simulated (4 views under 2 lights) and every pixel made many, so that the
files are large and the field is small. ``reflfield run``, ``relight`` and ``compare`` then run
in processes of their own with that ceiling. Peaks are of resident memory, the command and its
processes together, looked at 20 times a second. Status 1 if a command fails or takes more
than it may. Writes results/memory.json.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parents[1])]

import psutil  # noqa: E402
from benchmarks.measuring import Results  # noqa: E402

from capture_sim.scene import parse_scene  # noqa: E402
from capture_sim.write import write_capture  # noqa: E402
from reflfield.options import gigabytes, parse_bytes  # noqa: E402
from reflfield.pipeline.cache import resident_bytes  # noqa: E402
from tests.large_captures import enlarged_capture  # noqa: E402
from tests.pipeline.conftest import SCENE  # noqa: E402

SETTINGS = ("texture.largest=64", "hull.resolution=32", "relighting.samples_per_pixel=1")


def watched(words):
    """Status of a command, the largest resident memory of all its processes, and its times."""
    before, start = children_seconds(), time.perf_counter()
    process, peak = subprocess.Popen([sys.executable, "-m", "reflfield", *words]), 0
    while process.poll() is None:
        try:
            command = psutil.Process(process.pid)
            peak = max(peak, resident_bytes([command, *command.children(recursive=True)]))
        except psutil.NoSuchProcess:
            break
        time.sleep(0.05)
    status = process.wait()
    return status, peak, (time.perf_counter() - start, children_seconds() - before)


def children_seconds():
    """CPU seconds of the commands that have ended."""
    times = os.times()
    return times.children_user + times.children_system


def images_cell(folder, command):
    """PSNR of the photographs that a command has compared, or None."""
    files = {"run": "out/metrics.json", "compare": "compared/metrics.json"}
    path = folder / files.get(command, "no")
    return json.loads(path.read_text())["mean"]["psnr_ldr"] if path.is_file() else None


def cells(seconds, peak, ceiling):
    """Cells of wall and CPU time, of a peak and of what was allowed."""
    return {
        "wall time, s": round(seconds[0], 2),
        "CPU time, s": round(seconds[1], 2),
        "peak, GB": round(peak / 2**30, 3),
        "allowed, GB": round(ceiling / 2**30, 3),
    }


def commands(folder, ceiling, model):
    """Words of each command, by its name."""
    capture, out = str(folder / "large"), folder / "out"
    limit = ("--max-memory", ceiling)
    settings = [word for text in SETTINGS for word in ("--set", text)]
    field, drawn = str(out / "field.rfld"), ("--rays-per-pixel", "1", *limit)
    relit, compared = str(folder / "relit"), str(folder / "compared")
    return {
        "run": ("run", capture, "-o", str(out), "--hold-out", "photographs=1", *limit,
                *settings, "--set", f"compression.model={model}"),
        "relight": ("relight", field, "--capture", capture, "-o", relit, *drawn),
        "compare": ("compare", field, capture, "-o", compared, *drawn),
    }  # fmt: skip


def main():
    """Simulate, enlarge, run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=4000, help="pixels of a photograph's side")
    parser.add_argument("--max-memory", default="2GB", help="ceiling of every command")
    parser.add_argument("--model", default="half_vector", choices=("half_vector", "clustered"))
    arguments = parser.parse_args()
    ceiling, failed = parse_bytes(arguments.max_memory), False
    results = Results("memory", "Memory of large photographs", ["reflfield.cli"])
    results.table(f"Photographs of {arguments.side} x {arguments.side}, {arguments.model}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_capture(parse_scene(SCENE), folder / "small")
        enlarged_capture(folder / "small", folder / "large", arguments.side)
        for command, words in commands(folder, arguments.max_memory, arguments.model).items():
            status, peak, seconds = watched(words)
            failed |= status != 0 or peak > ceiling
            print(f"{command}: status {status}, at most {gigabytes(peak)} of "
                  f"{gigabytes(ceiling)}", flush=True)  # fmt: skip
            what = {"command": command, "stage": "", "PSNR, dB": images_cell(folder, command)}
            results.add(what | cells(seconds, peak, ceiling))
            if command == "run" and status == 0:
                timings = json.loads((folder / "out" / "timings.json").read_text())
                for stage in timings["stages"]:
                    seconds = stage["seconds"], stage["cpu_seconds"]
                    row = cells(seconds, stage["peak_bytes"], ceiling)
                    results.add({"command": command, "stage": stage["name"]} | row)
                    print(f"  {stage['name']:<22}{stage['peak_bytes'] / 2**30:5.2f} GB")
    print(results.write())
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
