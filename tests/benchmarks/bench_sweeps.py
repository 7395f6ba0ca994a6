"""What each option costs and brings on several captures, by `reflfield tradeoff`.

    python tests/benchmarks/bench_sweeps.py --out SWEEPS [--budget 8min]     # all captures
    python tests/benchmarks/bench_sweeps.py rti_loewenkopf --out SWEEPS      # some

Settings are chosen on photographs that make no field, and reported on others; the presets
(`reflfield/tradeoff/presets.py`) are chosen from these sweeps. A sweep that is finished in
SWEEPS, with its budget, is not made again.

Writes results/sweep_NAME.json. The simulated captures are made in SWEEPS; the others are test
data, looked for in REFLFIELD_DATA, by default ../shared/data, and skipped where absent.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from benchmarks.bench_plan import DATA, RUNS, capture_of, command  # noqa: E402
from benchmarks.measuring import Results  # noqa: E402

CAPTURES = ("demo_vase", "mitsuba_spot", "rti_loewenkopf", "dinoSparseRing")
ALONE, DEFAULT = "alone", "default"
MEASURED = ("reflfield.cli",)
TITLES = ("One option at a time", "All views and lights", "Picks of the front")


def swept(name, out, budget):
    """What `tradeoff.json` holds of a capture."""
    run, folder = RUNS[name], out / name
    made = folder / "tradeoff.json"
    if not made.is_file():
        words = ("tradeoff", capture_of(run, out), "-o", folder, "--budget", budget)
        command("reflfield", *words, "--hold-out", run.held_out)
    return json.loads(made.read_text())


def add_rows(results, name, document):
    """Rows of a sweep into the three tables."""
    alone, fronts, picked = results
    entries = [entry for entry in document["configurations"] if "failed" not in entry]
    default = next(entry for entry in entries if entry["part"] == DEFAULT)
    picks = document["picks"]
    for entry in entries:
        row = row_of(name, entry, default)
        if entry["part"] in (ALONE, DEFAULT):
            alone.append(row)
        if entry["views"] == entry["lights"] == 1.0:
            fronts.append({**row, "part": entry["part"]})
        for pick in (pick for pick, of in picks.items() if of == entry["name"]):
            reported = entry["reported"].get("mean", {}).get("psnr_ldr")
            picked.append({"capture": name, "pick": pick, **row, "reported, dB": reported})


def row_of(name, entry, default):
    """One configuration beside the default."""
    return {
        "capture": name,
        "configuration": entry["name"],
        "CPU time, s": entry["CPU seconds"],
        "of the default's": entry["CPU seconds"] / default["CPU seconds"],
        "PSNR, dB": round(entry["PSNR"], 2),
        "gain, dB": round(entry["gain"], 2),
        "+-": round(entry["error of the gain"], 2),
        "memory, GB": round(entry["peak bytes"] / 2**30, 2),
        "field, kB": round(entry["field bytes"] / 1000, 1),
    }


def main():
    """Sweep the captures that are named, or all that are here."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(CAPTURES))
    parser.add_argument("--out", type=Path, required=True, help="folder of the sweeps; kept")
    parser.add_argument("--budget", default="8min", help="time of each sweep")
    options = parser.parse_args()
    if unknown := set(options.names) - set(CAPTURES):
        parser.error(f"NAME: expected {', '.join(CAPTURES)}, received {', '.join(unknown)}")
    for name in options.names or CAPTURES:
        if RUNS[name].folder and not (DATA / RUNS[name].folder).is_dir():
            print(f"{name}: skipped: {DATA / RUNS[name].folder} not found: set REFLFIELD_DATA")
            continue
        results = Results(f"sweep_{name}", f"What options cost and bring: {name}", MEASURED)
        document = swept(name, options.out, options.budget)
        print(f"{name}: {document['photographs']}; not run: {len(document['not run'])}")
        rows = ([], [], [])
        add_rows(rows, name, document)
        for title, some in zip(TITLES, rows, strict=True):
            results.table(title)
            for row in some:
                results.add(row)
        print(results.write())


if __name__ == "__main__":
    main()
