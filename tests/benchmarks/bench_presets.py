"""Presets beside each other: images against photographs, time, memory, size.

    python tests/benchmarks/bench_presets.py --out RUNS                          # all
    python tests/benchmarks/bench_presets.py rti_loewenkopf --out RUNS           # some captures
    python tests/benchmarks/bench_presets.py --presets preview --out RUNS        # some presets

Each capture is processed by the command that a user would type, with each preset, in a process
of its own; those that are finished in RUNS are not made again. CPU time is that of all stages,
and of those that make the field, without its measurement, pages and report.

Writes results/presets.json. The simulated captures are made in RUNS; the others are test data,
looked for in REFLFIELD_DATA, by default ../shared/data, and skipped where absent.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from benchmarks.bench_plan import DATA, RUNS, capture_of, stage_records, timings_of  # noqa: E402
from benchmarks.measuring import Results  # noqa: E402

from reflfield.tradeoff.presets import LADDER, PRESETS  # noqa: E402

# Stages after the field is made.
AFTER = ("maps", "comparison", "error_analysis", "web_page", "report")
CAPTURES = ("small_vase", "mitsuba_spot", "rti_loewenkopf", "dinoSparseRing")


def measured(name, preset, out, workers):
    """One row: a capture processed with a preset."""
    run, folder = RUNS[name], out / f"{name}_{preset}"
    capture = capture_of(run, out)
    timings = timings_of(
        *(folder, "reflfield", "run", capture, "-o", folder, "--preset", preset),
        *("--hold-out", run.held_out, "--workers", workers),
    )
    stages = stage_records(timings)
    compared = folder / "stages" / "comparison" / "field"
    means = {
        what: json.loads((compared / f"{what}.json").read_text())["mean"]
        for what in ("heldout", "truth")
        if (compared / f"{what}.json").is_file()
    }
    return {
        "capture": name,
        "preset": preset,
        "held out": run.held_out,
        "PSNR, dB": round(means["heldout"]["psnr_ldr"], 2),
        "unseen, dB": round(means["truth"]["psnr_ldr"], 2) if "truth" in means else None,
        "SSIM": round(means["heldout"]["ssim"], 4),
        "CPU time, s": round(sum(stage[0] for stage in stages.values()), 1),
        "of the field, s": round(
            sum(cpu for n, (cpu, *_) in stages.items() if n not in AFTER), 1
        ),
        "memory, GB": round(max(stage[1] for stage in stages.values()) / 2**30, 2),
        "field, kB": round((folder / "field.rfld").stat().st_size / 1000, 1),
    }


def main():
    """Measure presets on captures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(CAPTURES))
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs; kept")
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=PRESETS)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    results = Results("presets", "Presets", ["reflfield.cli"])
    results.table("Presets")
    for name in options.names or CAPTURES:
        if name not in CAPTURES:
            parser.error(f"NAME: expected {', '.join(CAPTURES)}, received {name}")
        if RUNS[name].folder and not (DATA / RUNS[name].folder).is_dir():
            print(f"{name}: skipped: {DATA / RUNS[name].folder} not found: set REFLFIELD_DATA")
            continue
        for preset in options.presets:
            row = measured(name, preset, options.out, options.workers)
            results.add(row)
            print(json.dumps(row), flush=True)
    results.table("What the presets set")
    for preset, settings in LADDER.items():
        for option, value in settings.items():
            results.add({"preset": preset, "option": option, "value": str(value).lower()})
    print(results.write())


if __name__ == "__main__":
    main()
