"""Every set of the test data: what it is read as, what `check` finds, what a plain run makes.

    python tests/benchmarks/bench_sets.py --out SETS                # all, without the long one
    python tests/benchmarks/bench_sets.py cat gray --out SETS       # some
    python tests/benchmarks/bench_sets.py --all --out SETS          # guanyu is run, too

The commands are those that a user would type, with nothing but the folder: `check`, and `run`
where the set has lights. What is refused is told with the last line of its message. Sets are
looked for in REFLFIELD_DATA, by default ../shared/data, and left out where absent.

Writes results/sets.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from benchmarks.bench_captures import DATA  # noqa: E402
from benchmarks.measuring import Results  # noqa: E402

from reflfield.capture.readers import open_capture  # noqa: E402
from reflfield.errors import InputError  # noqa: E402

SETS = {
    "cup": "3dreconkit_ps/cup",
    "mouse": "colmap_mouse",
    "head": "ethiopian_head_masks",
    "guanyu": "mia_guanyu_flash",
    "guanyu, vset": "mia_guanyu_flash/guan-yu-replicability.vset",
    "rodin": "mia_rodin_metashape",
    "dino": "middlebury_sparse_rings/dinoSparseRing",
    "temple": "middlebury_sparse_rings/templeSparseRing",
    "spot": "mitsuba_spot",
    "probe": "psbox_probe/LightProbe-1",
    "psbox cat": "psbox_probe/ManualData",
    "lion": "rti_loewenkopf",
    "felt": "ubo2014_felt05",
    "cat": "uw_photometric_stereo/cat",
    "chrome": "uw_photometric_stereo/chrome",
    "gray": "uw_photometric_stereo/gray",
    "owl": "uw_photometric_stereo/owl",
}
LONG = ("guanyu", "guanyu, vset")
# Seconds that a command may take.
MOST_SECONDS = 900
KINDS_TOLD = 4


def read_as(path):
    """Columns that say what a set is read as; whether it has lights."""
    try:
        capture = open_capture(path)
    except InputError as error:
        return {"read as": f"refused: {error}".replace(str(DATA), "")}, False
    row = {
        "read as": f"{capture.format}, lights {'known' if capture.lights_known else 'unknown'}",
        "views": capture.n_views,
        "lights": capture.n_lights,
        "photographs": len(capture.photographs),
    }
    return row, capture.lights_known


def command(*words):
    """Status, last line and seconds of a command."""
    started = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "reflfield", *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        timeout=MOST_SECONDS,
    )
    lines = (done.stdout + done.stderr).strip().splitlines() or [""]
    return done.returncode, lines[-1].replace(str(DATA), ""), time.perf_counter() - started


def checked(path, out):
    """Columns of what `check` finds."""
    status, last, seconds = command("check", path, "-o", out)
    document = out / "check.json"
    if not document.is_file():
        return {"check": f"status {status}: {last}", "check, s": round(seconds, 1)}
    found = json.loads(document.read_text())
    counts = ", ".join(f"{n} {s}s" for s, n in found["counts"].items() if n)
    kinds = Counter(f["kind"] for f in found["findings"] if f["severity"] != "note")
    told = "; ".join(f"{kind} ({n})" for kind, n in kinds.most_common(KINDS_TOLD))
    return {
        "check": f"{counts or 'nothing'}: {told}".rstrip(": "),
        "check, s": round(seconds, 1),
    }


def made(path, out):
    """Columns of what a plain run makes."""
    status, last, seconds = command("run", path, "-o", out)
    if status:
        return {"run": f"status {status}: {last}", "run, s": round(seconds, 1)}
    size = (out / "field.rfld").stat().st_size / 1000
    return {"run": f"field of {size:.0f} kB", "run, s": round(seconds, 1)}


def main():
    """Read, check and run sets."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(SETS))
    parser.add_argument("--out", type=Path, required=True, help="folder of what is made")
    parser.add_argument("--all", action="store_true", help="run those that take long, too")
    options = parser.parse_args()
    results = Results("sets", "Sets of the test data", ["reflfield.cli"])
    results.table("Sets of the test data")
    for name in options.names or SETS:
        path = DATA / SETS[name]
        if not path.exists():
            print(f"{name}: left out: {path} not found: set REFLFIELD_DATA", flush=True)
            continue
        row, has_lights = read_as(path)
        out = options.out / name.replace(", ", "_").replace(" ", "_")
        row = {"set": SETS[name], **row, **checked(path, out / "check")}
        if has_lights and (options.all or name not in LONG):
            row |= made(path, out / "run")
        results.add(row)
        print(json.dumps(row), flush=True)
    print(results.write())


if __name__ == "__main__":
    main()
