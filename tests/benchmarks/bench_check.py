"""Which planted faults `reflfield check` finds and names, and what it says of clean captures.

    python tests/benchmarks/bench_check.py [CAPTURE ...] [--seeds N]

Without captures, a dome of 36 views and 24 lights is simulated at 128 pixels. Each further
capture is only checked: it should be clean. Writes results/check.json.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parents[1])]

from benchmarks.measuring import Results  # noqa: E402

from capture_sim.scene import parse_scene  # noqa: E402
from capture_sim.write import write_capture  # noqa: E402
from reflfield.capture.readers import open_capture  # noqa: E402
from reflfield.checking.capture_check import check_capture  # noqa: E402
from reflfield.checking.findings import NOTE  # noqa: E402
from tests.checking import conftest  # noqa: E402
from tests.checking.fault_table import FAULTS  # noqa: E402
from tests.checking.faults import Planted  # noqa: E402

WIDE = {
    **conftest.SCENE,
    "cameras": {
        **conftest.SCENE["cameras"],
        "counts": [8, 10, 10, 7, 1],
        "width": 128,
        "height": 128,
    },
    "lights": {**conftest.SCENE["lights"], "counts": [9, 8, 6, 1]},
}


def check(folder):
    """Findings of the capture in a folder, and CPU seconds."""
    started = time.process_time()
    findings = check_capture(open_capture(folder, require_photographs=False))
    return findings, time.process_time() - started


def outcome(clean, fault, scratch, seed):
    """Whether a planted fault is found, is named, and how gravely; other alarms; seconds."""
    planted = Planted.copy(clean, scratch)
    names = set(fault.plant(planted, np.random.default_rng(seed)))
    findings, seconds = check(scratch)
    grave = [one for one in findings.all if one.severity != NOTE]
    right = [one for one in grave if one.kind in fault.kinds]
    subjects = {name for one in right for name in one.subjects}
    is_named = bool(right) and names <= subjects
    others = sorted({one.kind for one in grave} - set(fault.kinds))
    severity = right[0].severity if right else "-"
    return bool(grave), is_named, severity, others, seconds


def add(results, row):
    """Print and keep a row."""
    results.add(row)
    print(json.dumps(row), flush=True)


def main():
    """Check, print and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("captures", nargs="*", type=Path)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--dome", type=Path, help="Clean capture in which faults are planted.")
    words = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        dome = words.dome or Path(folder) / "dome"
        if words.dome is None:
            write_capture(parse_scene(WIDE), dome)
        results = Results("check", "Planted faults", ["reflfield.checking.capture_check"])
        results.table("Clean captures")
        for path in (dome, *words.captures):
            findings, seconds = check(path)
            grave = sorted({one.kind for one in findings.all if one.severity != NOTE})
            row = {"capture": path.name, "errors and warnings": ", ".join(grave) or "none"}
            add(results, {**row, "CPU, s": round(seconds, 1)})
        results.table("Planted faults")
        for name, fault in FAULTS.items():
            runs = [
                outcome(dome, fault, Path(folder) / f"{name} {seed}", seed)
                for seed in range(words.seeds)
            ]
            detected, named, severity, others, seconds = zip(*runs, strict=True)
            also = ", ".join(sorted({kind for kinds in others for kind in kinds})) or "nothing"
            row = {
                "fault": name,
                "found": f"{sum(detected)} of {len(runs)}",
                "named": f"{sum(named)} of {len(runs)}",
                "severity": "/".join(sorted(set(severity))),
                "also said": also,
                "CPU, s": round(float(np.mean(seconds)), 1),
            }
            add(results, row)
        print(results.write())


if __name__ == "__main__":
    main()
