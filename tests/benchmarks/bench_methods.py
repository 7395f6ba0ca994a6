"""Methods on four captures in one table: ours, with and without alignment, and the paper's.

    python tests/benchmarks/bench_methods.py                        # all captures that are here
    python tests/benchmarks/bench_methods.py vase dinoSparseRing --out DIR

"default" is what ``reflfield run`` makes. "clusters" are clustered local PCA fitted to
samples in aligned frames; "clusters, not aligned" the same in the frames of the atlas, with as
many bytes. "half vector, samples" is the half-vector model fitted to samples of the hull alone,
"half vector, photographs" to the photographs on the hull; the default moves the hull to the
normals besides. "paper" is the pipeline of Müller, Sarlette and Klein 2006: samples resampled
onto a grid, completed and aligned, and local PCA of 16 clusters with 10 components, fitted to
the grid alone. All are compared with the same held-out photographs, and with those of views
and lights that are not in the capture where it has some. Times are of stages that fields need.

Writes results/methods.json.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.bench_captures import (
    CAPTURES,
    MEASURED,
    SECOND_FIELD,
    capture_of,
    compare,
    missing,
    ran,
)
from benchmarks.measuring import Results

NAMES = ("vase", "mitsuba_spot", "rti_loewenkopf", "dinoSparseRing")
CLUSTERED = ("--set", "compression.model=clustered")
PAPER = (
    *CLUSTERED,
    *("--set", "compression.fit=grid"),
    *("--set", "compression.n_clusters=16", "--set", "compression.n_components=10"),
    *("--set", "alignment.refine=false"),
)
# Of `reflfield run` besides those of the capture, and which of its fields the rows are about.
METHODS = {
    "default": ((), {"field": "default"}),
    "clusters": (
        (*CLUSTERED, *SECOND_FIELD),
        {"field": "clusters", "without_alignment": "clusters, not aligned"},
    ),
    "paper": (PAPER, {"field": "paper"}),
}
HALF_VECTOR = ("--set", "compression.model=half_vector")
# Of solid objects under known lights, besides: what the default does, less of it.
HALF_VECTOR_METHODS = {
    "samples": (
        (*HALF_VECTOR, "--set", "compression.half_vector.image_steps=0"),
        {"field": "half vector, samples"},
    ),
    "photographs": (
        (*HALF_VECTOR, "--set", "compression.half_vector.surface_from_normals=false"),
        {"field": "half vector, photographs"},
    ),
}
SOLID = ("vase", "mitsuba_spot")


def measure(results, name, folder):
    """Process one capture with all methods in a folder, and add their rows."""
    benchmark = CAPTURES[name]
    folder.mkdir(parents=True)
    out, log = folder / "out", folder / "log.txt"
    capture = capture_of(benchmark, folder, log)
    methods = METHODS | (HALF_VECTOR_METHODS if name in SOLID else {})
    for options, fields in methods.values():
        ran("reflfield", ("run", capture, "-o", out, *benchmark.words, *options), log)
        stages = json.loads((out / "timings.json").read_text())["stages"]
        for field, method in fields.items():
            add_row(results, name, method, out / "stages", field, stages)
            if field == "field" and benchmark.frames:
                add_frames(results, name, method, out, capture, folder, log)


def add_row(results, name, method, stages_folder, field, stages):
    """Row of the images that the run itself has compared, held out or unseen."""
    left_out = "compression" if field != "field" else "without_alignment"
    stage = "without_alignment" if field != "field" else "compression"
    size = (stages_folder / stage / "field.rfld").stat().st_size
    for kind, images in (("heldout", "held out"), ("truth", "unseen")):
        path = stages_folder / "comparison" / field / f"{kind}.json"
        if path.is_file():
            mean = json.loads(path.read_text())["mean"]
            add(results, name, method, images, mean, size, cpu_seconds(stages, left_out))


def add_frames(results, name, method, out, capture, folder, log):
    """Row of images that the benchmark names besides: of unseen views and lights."""
    what, frames = CAPTURES[name].frames[0]
    compared = compare(out, capture / frames, folder / method, log)
    size = (out / "field.rfld").stat().st_size
    stages = json.loads((out / "timings.json").read_text())["stages"]
    seconds = cpu_seconds(stages, "without_alignment")
    add(results, name, method, what, compared["mean"], size, seconds)


def cpu_seconds(stages, left_out):
    """CPU time of the stages up to the field, but for that of the other field."""
    others = {left_out, "maps", "comparison", "error_analysis", "web_page", "report"}
    return sum(stage["cpu_seconds"] for stage in stages if stage["name"] not in others)


def add(results, name, method, images, mean, size, seconds):
    """One row of the table."""
    results.add(
        {
            "capture": name,
            "images": images,
            "method": method,
            "PSNR, dB": round(mean["psnr_ldr"], 2),
            "SSIM": round(mean["ssim"], 4),
            "FLIP": round(mean["flip"], 4),
            "field, kB": round(size / 1000, 1),
            "CPU time, s": round(seconds, 1),
        }
    )
    print(results.tables[-1]["rows"][-1], flush=True)


def main():
    """Measure the captures that are named, or all that are here."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--out", type=Path, help="new folder in which the runs stay")
    options = parser.parse_args()
    if unknown := set(options.names) - set(NAMES):
        parser.error(f"NAME: expected {', '.join(NAMES)}, received {', '.join(unknown)}")
    results = Results("methods", "Methods on four captures", MEASURED)
    results.table("Images, size and time")
    with ExitStack() as stack:
        out = options.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for name in options.names or NAMES:
            why = missing(name)
            if why is None:
                measure(results, name, out / name)
            else:
                print(f"{name}: {why}", file=sys.stderr)
    print(results.write())


if __name__ == "__main__":
    main()
