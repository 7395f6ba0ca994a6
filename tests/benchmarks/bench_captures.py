"""Whole captures: images against photographs, size of the field, time and memory of the run.

    python tests/benchmarks/bench_captures.py                        # all that are here
    python tests/benchmarks/bench_captures.py demo mitsuba_spot      # some
    python tests/benchmarks/bench_captures.py --without-alignment    # with the second field
    python tests/benchmarks/bench_captures.py vase mitsuba_spot --model half_vector

Every capture is processed by the command that a user would type, with its default options, in a
process of its own. `demo` is ``reflfield demo``, simulation included; `vase` is its capture
with default options; `tiny` is a capture for tests, run only by name. The others are test data:
they are looked for in REFLFIELD_DATA, by default ../shared/data, and skipped where absent.

Writes results/capture_NAME.json, with --model capture_NAME_MODEL.json. CPU time is that of all
threads and processes of the command. Peak memory is resident, of the command and its processes
together. Run it on a quiet machine.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE.parent))

from benchmarks.measuring import Results  # noqa: E402

DATA = Path(os.environ.get("REFLFIELD_DATA", ROOT.parent / "shared" / "data"))
SECOND_FIELD = ("--set", "comparison.without_alignment=true")
MEASURED = ("reflfield.cli", "capture_sim.cli")


class Benchmark(NamedTuple):
    """A capture, and what it is compared with."""

    photographs: str
    held_out: str = ""  # in words
    words: tuple[str | Path, ...] = ()  # of `reflfield run`; none: it is the demo
    scene: str = ""  # of capture-sim, or
    folder: str = ""  # of the test data
    frames: tuple[tuple[str, str], ...] = ()  # compared besides: name, file in the folder


CAPTURES = {
    "demo": Benchmark("28 x 30, simulated", "2 views x 2 lights"),
    "vase": Benchmark(
        "28 x 30, simulated",
        "2 views x 2 lights",
        ("--hold-out", "views=2,lights=2"),
        scene="demo_vase",
    ),
    "mitsuba_spot": Benchmark(
        "32 x 32, rendered",
        "2 views x 2 lights",
        ("--hold-out", "views=2,lights=2"),
        folder="mitsuba_spot",
        frames=(
            ("unseen views and lights", "truth/heldout.json"),
            ("environment light", "truth/relit.json"),
        ),
    ),
    "rti_loewenkopf": Benchmark(
        "1 x 240", "24 lights", ("--hold-out", "lights=24"), folder="rti_loewenkopf"
    ),
    "dinoSparseRing": Benchmark(
        "16 x 1",
        "2 views",
        ("--hold-out", "views=2"),
        folder="middlebury_sparse_rings/dinoSparseRing",
    ),
    "mia_guanyu_flash": Benchmark(
        "240, by flash",
        "8 photographs",
        (
            *("--hold-out", "photographs=8", "--encoding"),
            DATA / "mia_guanyu_flash" / "guan-yu-replicability.vset",
        ),
        folder="mia_guanyu_flash",
    ),
    "tiny": Benchmark(
        "8 x 6, simulated",
        "1 view x 1 light",
        ("--hold-out", "views=1,lights=1", "--config", str(ROOT / ".ci/coarse_options.toml")),
        scene=str(ROOT / ".ci/tiny_scene.toml"),
    ),
}
BY_NAME_ONLY = ("tiny",)
# What the comparison stage calls its sets of images, and what they are.
SETS = {"heldout": "held out", "truth": "unseen views and lights"}
VARIANTS = {"field": "aligned", "without_alignment": "without alignment"}


class Spent(NamedTuple):
    """What a command took."""

    wall: float  # seconds
    cpu: float
    peak_bytes: int  # of its largest process


def ran(module, words, log):
    """Run a module as a command; what it took.

    Raises
    ------
    RuntimeError
        If it ends with another status than 0; its last lines are quoted.
    """
    command = [sys.executable, "-m", module, *map(str, words)]
    start = time.perf_counter()
    with log.open("w") as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    wall = time.perf_counter() - start
    if process.returncode:
        tail = "\n".join(log.read_text().splitlines()[-8:])
        raise RuntimeError(f"{' '.join(command)}: status {process.returncode}\n{tail}")
    return Spent(wall, usage.ru_utime + usage.ru_stime, 1024 * usage.ru_maxrss)


def measure(name, folder, *, second_field=False, model=None, resources=()):
    """Process one capture in a folder, and write its results."""
    benchmark = CAPTURES[name]
    folder.mkdir(parents=True)
    out, log = folder / "out", folder / "log.txt"
    results = Results(
        f"capture_{name}_{model}" if model else f"capture_{name}",
        f"Capture: {name}, {model}" if model else f"Capture: {name}",
        MEASURED,
    )
    if benchmark.words:
        capture = capture_of(benchmark, folder, log)
        more = (*(SECOND_FIELD if second_field else ()), *resources)
        more += ("--set", f"compression.model={model}") if model else ()
        words = ("run", capture, "-o", out, *benchmark.words, *more)
    else:
        capture, words = out / "capture", ("demo", "-o", out)
    spent = ran("reflfield", words, log)
    images_table(results, benchmark, out)
    for what, frames in benchmark.frames:
        compared = compare(out, capture / frames, folder / what.replace(" ", "_"), log)
        image_row(results, what, "aligned", compared)
    run_tables(results, benchmark, out, spent, words)
    return results.write()


def capture_of(benchmark, folder, log):
    """Folder of the capture, simulated first where it is."""
    if not benchmark.scene:
        return DATA / benchmark.folder
    capture = folder / "capture"
    ran("capture_sim", ("render", benchmark.scene, "-o", capture), log)
    return capture


def compare(out, frames, folder, log):
    """Metrics of other frames than those of the run, by ``reflfield compare``."""
    ran("reflfield", ("compare", out / "field.rfld", frames, "-o", folder), log)
    return json.loads((folder / "metrics.json").read_text())


# --- tables ---------------------------------------------------------------------------------


def images_table(results, benchmark, out):
    """Metrics of the images that the run itself has compared, with and without alignment."""
    results.table("Images")
    for key, words in SETS.items():
        for variant, shown in VARIANTS.items():
            path = out / "stages" / "comparison" / variant / f"{key}.json"
            if path.is_file():
                what = f"held out: {benchmark.held_out}" if key == "heldout" else words
                image_row(results, what, shown, json.loads(path.read_text()))


def image_row(results, what, field, metrics):
    """Means over one set of images."""
    mean = metrics["mean"]
    results.add(
        {
            "images": what,
            "field": field,
            "number": len(metrics["images"]),
            "PSNR, dB": round(mean["psnr_ldr"], 3),
            "HDR PSNR, dB": round(mean["psnr_hdr"], 3),
            "SSIM": round(mean["ssim"], 4),
            "FLIP": round(mean["flip"], 4),
        }
    )


def run_tables(results, benchmark, out, spent, words):
    """Size, time and memory of the whole command, and of each stage."""
    timings = json.loads((out / "timings.json").read_text())
    shown = [part.name if isinstance(part, Path) else part for part in words]
    results.table("Run")
    results.add(
        {
            "command": " ".join(["reflfield", *shown]),
            "photographs": benchmark.photographs,
            "field, kB": round((out / "field.rfld").stat().st_size / 1000, 1),
            "wall time, s": round(spent.wall, 1),
            "CPU time, s": round(spent.cpu, 1),
            "peak memory, GB": round(max(spent.peak_bytes, timings["peak_bytes"]) / 2**30, 2),
        }
    )
    results.table("Stages")
    for stage in timings["stages"]:
        results.add(
            {
                "stage": stage["name"],
                "wall time, s": round(stage["seconds"], 2),
                "CPU time, s": round(stage["cpu_seconds"], 2),
                "peak memory, GB": round(stage["peak_bytes"] / 2**30, 2),
            }
        )


def missing(name):
    """Why a capture cannot be measured here, or None."""
    folder = CAPTURES[name].folder
    if folder and not (DATA / folder).is_dir():
        return f"{DATA / folder} not found: set REFLFIELD_DATA to the folder of the test data"
    return None


def main():
    """Measure the captures that are named, or all that are here."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    every = [name for name in CAPTURES if name not in BY_NAME_ONLY]
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(CAPTURES))
    parser.add_argument(
        "--without-alignment", action="store_true",
        help="make a second field in the base frames, too; its time counts",
    )  # fmt: skip
    parser.add_argument(
        "--model", help="compression.model, instead of the default; not of demo"
    )
    parser.add_argument("--out", type=Path, help="new folder in which the runs stay")
    parser.add_argument("--workers", type=int, help="threads of the run; one for each core")
    options = parser.parse_args()
    for name in options.names:
        if name not in CAPTURES:
            parser.error(f"NAME: expected {', '.join(CAPTURES)}, received {name}")
    if options.model and "demo" in (options.names or every):
        parser.error(
            "--model: expected captures by name, without demo, whose options are fixed"
        )
    resources = ("--workers", str(options.workers)) if options.workers else ()
    with ExitStack() as stack:
        root = options.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for name in options.names or every:
            reason = missing(name)
            if reason:
                print(f"{name}: skipped: {reason}", flush=True)
                continue
            path = measure(
                name,
                root / name,
                second_field=options.without_alignment,
                model=options.model,
                resources=resources,
            )
            print(f"{name}: {path}", flush=True)


if __name__ == "__main__":
    main()
