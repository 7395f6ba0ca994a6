"""Predictions of `reflfield plan` against what runs have taken, stage by stage.

    python tests/benchmarks/bench_plan.py --out RUNS              # all captures that are here
    python tests/benchmarks/bench_plan.py vase_small --out RUNS   # some
    python tests/benchmarks/bench_plan.py --out RUNS --fit        # and fit the unit costs anew

Each run is predicted first, then made by the command that a user would type, in RUNS/NAME, in
a process of its own; those that are finished in RUNS are not made again. CPU times are
compared, which other programs on the machine change less; wall times are shown with them.

Writes results/plan.json. With --fit, unit costs are fitted to these runs, and to the stages in
results/capture_*.json, and written to reflfield/tradeoff/unit_costs.json; the errors that are
shown then are those of the fit. Without, they are predictions. The exit status is 1 where a
run's CPU time, memory or disk is not within a factor of 1.5.

The simulated captures are made in RUNS; the others are test data, looked for in REFLFIELD_DATA,
by default ../shared/data, and skipped where absent.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE.parent))

from benchmarks.bench_captures import CAPTURES  # noqa: E402
from benchmarks.measuring import RESULTS, Results  # noqa: E402

from reflfield.api.captures import open_capture  # noqa: E402
from reflfield.api.reconstruction import read_options  # noqa: E402
from reflfield.demo import OPTIONS as DEMO_OPTIONS  # noqa: E402
from reflfield.options import Resources, parse_hold_out  # noqa: E402
from reflfield.tradeoff.machine_speed import machine_seconds, slowness  # noqa: E402
from reflfield.tradeoff.measured_run import cpu_of, distinct  # noqa: E402
from reflfield.tradeoff.run_plan import plan_of, with_planned_selection  # noqa: E402
from reflfield.tradeoff.stage_costs import (  # noqa: E402
    BY_A_PROCESS,
    START_SECONDS,
    StageMeasured,
    fitted,
    shipped_costs,
)
from reflfield.tradeoff.work_counts import counts_of, planned_context  # noqa: E402

DATA = Path(os.environ.get("REFLFIELD_DATA", ROOT.parent / "shared" / "data"))
UNIT_COSTS = ROOT / "reflfield" / "tradeoff" / "unit_costs.json"
LARGEST_FACTOR = 1.5
SELECTION = "model_selection"


class Planned(NamedTuple):
    """A run that is predicted and made."""

    held_out: str
    scene: Path | str = ""  # of capture-sim, or
    folder: str = ""  # of the test data
    settings: tuple[str, ...] = ()


SMALL = HERE / "scenes" / "small_vase.toml"
CHEAP = ("compression.half_vector.n_lobes=2", "texture.texels_per_pixel=0.9")
CLUSTERS = ("compression.model=clustered", "compression.fit=samples")
COARSE = ("hull.resolution=96", "compression.half_vector.image_steps=0")
RUNS = {
    "small_vase": Planned("views=2,lights=2", SMALL),
    "small_vase_cheap": Planned("views=2,lights=2", SMALL, settings=CHEAP),
    "small_vase_clusters": Planned("views=2,lights=2", SMALL, settings=CLUSTERS),
    "small_vase_coarse": Planned("views=2,lights=2", SMALL, settings=(*CHEAP, *COARSE)),
    "demo_vase": Planned("views=2,lights=2", "demo_vase"),
    "mitsuba_spot": Planned("views=2,lights=2", folder="mitsuba_spot"),
    "rti_loewenkopf": Planned("lights=24", folder="rti_loewenkopf"),
    "rti_loewenkopf_grid": Planned(
        "lights=24", folder="rti_loewenkopf", settings=("compression.fit=grid",)
    ),
    "dinoSparseRing": Planned("views=2", folder="middlebury_sparse_rings/dinoSparseRing"),
}
# Results of `bench_captures` with default options, or those of the demo.
TABLES = ("mitsuba_spot", "dinoSparseRing")


def command(module, *words):
    """Run a module as a command.

    Raises
    ------
    RuntimeError
        If it ends with another status than 0; its last lines are quoted.
    """
    done = subprocess.run(
        [sys.executable, "-m", module, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        tail = "\n".join(done.stderr.splitlines()[-5:])
        raise RuntimeError(f"{module}: status {done.returncode}\n{tail}")


def timings_of(out, *words):
    """Times of a run that has been made, or is made by a command."""
    if not (out / "timings.json").is_file():
        command(*words)
    return json.loads((out / "timings.json").read_text())


def capture_of(run, out):
    """Folder of the capture, simulated first where it is."""
    if run.folder:
        return DATA / run.folder
    folder = out / f"capture_{Path(run.scene).stem}"
    if not (folder / "capture.json").is_file():
        command("capture_sim", "render", run.scene, "-o", folder, "--workers", 1)
    return folder


def prepared(run, capture, workers):
    """Context of a run and its counts."""
    context = planned_context(
        open_capture(capture),
        read_options(settings=run.settings),
        parse_hold_out(run.held_out),
        Resources(workers=workers),
    )
    return context, counts_of(context)


def stage_records(timings):
    """What each stage has taken, by name: CPU seconds, memory, disk; taken over ones once."""
    stages = {}
    for record in distinct(timings["stages"]):
        cpu = cpu_of(record)
        before = stages.get(record["name"], (0.0, 0, 0))
        stages[record["name"]] = (
            before[0] + cpu,
            max(before[1], record["peak_bytes"]),
            max(before[2], record["size_bytes"]),
        )
    return stages


def measured_rows(context, counts, stages):
    """Stages as the fit of unit costs takes them; of compared fields, the mean of both."""
    options = with_planned_selection(context, counts).options
    for name, (cpu, memory, disk) in stages.items():
        n = counts.n_fits if name in ("compression", "comparison") else 1
        yield StageMeasured(name, counts, options, cpu / n, memory, disk)


def table_rows(workers):
    """Stages in the results of `bench_captures`, with nothing of their disk."""
    for name in TABLES:
        path, benchmark = RESULTS / f"capture_{name}.json", CAPTURES[name]
        if not path.is_file() or not (DATA / benchmark.folder).is_dir():
            continue
        run = Planned(benchmark.words[1], folder=benchmark.folder)
        yield from table_stages(path, *prepared(run, DATA / benchmark.folder, workers))


def demo_rows(out, workers):
    """Stages of the demo, whose capture is the same."""
    context, _ = prepared(RUNS["demo_vase"], capture_of(RUNS["demo_vase"], out), workers)
    context = planned_context(
        context.capture, DEMO_OPTIONS, context.hold_out, context.resources
    )
    yield from table_stages(RESULTS / "capture_demo.json", context, counts_of(context))


def table_stages(path, context, counts):
    """Stages of one of those files, without the selection, which does not tell fields apart."""
    tables = {t["title"]: t["rows"] for t in json.loads(path.read_text())["tables"]}
    for row in tables["Stages"]:
        if row["stage"] != SELECTION:
            by_process = row["stage"] in BY_A_PROCESS
            cpu = row["wall time, s" if by_process else "CPU time, s"]
            memory = row["peak memory, GB"] * 2**30
            options = with_planned_selection(context, counts).options
            yield StageMeasured(row["stage"], counts, options, cpu, memory, float("nan"))


def factor(predicted, measured):
    """How far a prediction is off: 1 is exact, 2 twice too much, or half."""
    ratio = predicted / measured
    return max(ratio, 1 / ratio) if ratio > 0 else float("inf")


def main():
    """Predict, run, compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(RUNS))
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs; kept")
    parser.add_argument("--fit", action="store_true", help="fit the unit costs anew")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    for name in options.names:
        if name not in RUNS:
            parser.error(f"NAME: expected {', '.join(RUNS)}, received {name}")
    here = machine_seconds()
    runs = {}
    for name in options.names or RUNS:
        run = RUNS[name]
        if run.folder and not (DATA / run.folder).is_dir():
            print(f"{name}: skipped: {DATA / run.folder} not found: set REFLFIELD_DATA")
            continue
        capture = capture_of(run, options.out)
        settings = [word for setting in run.settings for word in ("--set", setting)]
        out = options.out / name
        timings = timings_of(
            *(out, "reflfield", "run", capture, "-o", out, "--hold-out", run.held_out),
            *("--workers", options.workers, *settings),
        )
        runs[name] = (*prepared(run, capture, options.workers), timings)
    if options.fit:
        fit(runs, here, options)
        shipped_costs.cache_clear()
    sys.exit(compare(runs, here))


def fit(runs, here, options):
    """Fit unit costs to runs and tables, and write them into the package."""
    rows = list(table_rows(options.workers))
    rows += demo_rows(options.out, options.workers)
    for context, counts, timings in runs.values():
        stages = stage_records(timings)
        # Of a busy machine the wall time of the atlas says nothing.
        for row in measured_rows(context, counts, stages):
            unknown = row.stage in BY_A_PROCESS
            rows.append(row._replace(cpu=float("nan")) if unknown else row)
    costs = fitted(rows, None, here)
    UNIT_COSTS.write_text(json.dumps(costs.document(), indent=1) + "\n")


def compare(runs, here):
    """Write predictions beside measurements; 1 if one is too far off."""
    costs = shipped_costs()
    slower = slowness(here, costs.machine_seconds)
    results = Results("plan", "What `reflfield plan` predicts", ["reflfield.tradeoff.run_plan"])
    rows, stage_rows = [], []
    for name, (context, counts, timings) in runs.items():
        plan = plan_of(context, counts, costs, slower)
        stages = stage_records(timings)
        rows.append(run_row(name, plan, stages, timings))
        stage_rows += stage_table_rows(name, plan, stages)
    for title, some in (("Whole runs", rows), ("Stages", stage_rows)):
        results.table(title)
        for row in some:
            results.add(row)
    for row in rows:
        print(json.dumps(row))
    print(results.write())
    kinds = ("CPU", "memory", "disk")
    return int(any(row[f"{kind}, factor"] > LARGEST_FACTOR for row in rows for kind in kinds))


def run_row(name, plan, stages, timings):
    """One run: predicted, measured, and the factor between them."""
    cpu = sum(stage[0] for stage in stages.values()) + START_SECONDS * plan.slowness
    memory = max(stage[1] for stage in stages.values())
    disk = sum(stage[2] for stage in stages.values())
    return {
        "run": name,
        "texels predicted": round(plan.counts.n_texels),
        "texels": texels_of(timings),
        "CPU predicted, s": round(plan.cpu_seconds, 1),
        "CPU, s": round(cpu, 1),
        "CPU, factor": round(factor(plan.cpu_seconds, cpu), 2),
        "time predicted, s": round(plan.seconds, 1),
        "time here, s": round(timings["seconds"], 1),
        "memory predicted, GB": round(plan.memory / 2**30, 2),
        "memory, GB": round(memory / 2**30, 2),
        "memory, factor": round(factor(plan.memory, memory), 2),
        "disk predicted, MB": round(plan.disk / 1e6, 1),
        "disk, MB": round(disk / 1e6, 1),
        "disk, factor": round(factor(plan.disk, disk), 2),
    }


def texels_of(timings):
    """Texels of the run, which the plan has to guess."""
    counts = [s["counts"] for s in timings["stages"] if s["name"] == "visibility"]
    return counts[0]["texels"]


def stage_table_rows(name, plan, stages):
    """Stages of one run that take more than a second."""
    for stage in plan.stages:
        cpu, memory, disk = stages.get(stage.name, (0.0, 0, 0))
        if max(stage.cpu_seconds, cpu) > 1.0 and cpu > 0:
            yield {
                "run": name,
                "stage": stage.name,
                "CPU predicted, s": round(stage.cpu_seconds, 2),
                "CPU, s": round(cpu, 2),
                "CPU, factor": round(factor(stage.cpu_seconds, cpu), 2),
                "memory predicted, GB": round(stage.memory / 2**30, 2),
                "memory, GB": round(memory / 2**30, 2),
                "disk predicted, MB": round(stage.disk / 1e6, 2),
                "disk, MB": round(disk / 1e6, 2),
            }


if __name__ == "__main__":
    main()
