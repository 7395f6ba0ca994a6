"""Methods on four captures in one table: ours, with and without alignment, and the paper's.

    python tests/benchmarks/bench_methods.py                        # all captures that are here
    python tests/benchmarks/bench_methods.py vase dinoSparseRing --out DIR

"default" is what ``reflfield run`` makes. "clusters, samples" are clustered local PCA fitted
to samples in aligned frames, "clusters, grid" to the resampled grid alone, "clusters" to what
is selected; "clusters, not aligned" are those to samples in the frames of the atlas, with as
many bytes. "half vector, samples" is the half-vector model fitted to samples of the hull
alone, "half vector, images" to the photographs on the hull; the default moves the hull to the
normals besides. "paper" is the pipeline of Müller, Sarlette and Klein 2006: samples resampled
onto a grid, completed and aligned, and local PCA of 16 clusters with 10 components, fitted to
the grid alone. All are compared with the same held-out photographs, and with those of views
and lights that are not in the capture where it has some. CPU time and peak memory are those of
the stages that a field needs.

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
SAMPLES, GRID = ("--set", "compression.fit=samples"), ("--set", "compression.fit=grid")
PAPER = (
    *CLUSTERED,
    *GRID,
    *("--set", "compression.n_clusters=16", "--set", "compression.n_components=10"),
    *("--set", "alignment.refine=false"),
)
HALF_VECTOR = ("--set", "compression.model=half_vector")
# Of `reflfield run` besides those of the capture, and which of its fields the rows are about.
METHODS = {
    "default": ((), {"field": "default"}),
    "paper": (PAPER, {"field": "paper"}),
}
OTHER_METHODS = {
    "clusters": (
        (*CLUSTERED, *SECOND_FIELD),
        {"field": "clusters", "without_alignment": "clusters, not aligned"},
    ),
}
# Of solid objects under known lights. Of the half-vector model: what the default does, in part.
SOLID_METHODS = {
    "clusters, grid": ((*CLUSTERED, *GRID), {"field": "clusters, grid"}),
    "clusters, samples": (
        (*CLUSTERED, *SAMPLES, *SECOND_FIELD),
        {"field": "clusters, samples", "without_alignment": "clusters, not aligned"},
    ),
    "samples": (
        (*HALF_VECTOR, "--set", "compression.half_vector.image_steps=0"),
        {"field": "half vector, samples"},
    ),
    "images": (
        (*HALF_VECTOR, "--set", "compression.half_vector.surface_from_normals=false"),
        {"field": "half vector, images"},
    ),
}
SOLID = ("vase", "mitsuba_spot")


def measure(results, name, folder):
    """Process one capture with all methods in a folder, and add their rows."""
    benchmark = CAPTURES[name]
    folder.mkdir(parents=True)
    out, log = folder / "out", folder / "log.txt"
    capture = capture_of(benchmark, folder, log)
    methods = METHODS | (SOLID_METHODS if name in SOLID else OTHER_METHODS)
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
            add(results, (name, images, method), mean, size, needed(stages, left_out))


def add_frames(results, name, method, out, capture, folder, log):
    """Row of images that the benchmark names besides: of unseen views and lights."""
    what, frames = CAPTURES[name].frames[0]
    compared = compare(out, capture / frames, folder / method, log)
    size = (out / "field.rfld").stat().st_size
    stages = json.loads((out / "timings.json").read_text())["stages"]
    spent = needed(stages, "without_alignment")
    add(results, (name, what, method), compared["mean"], size, spent)


def needed(stages, left_out):
    """Stages up to the field, but for that of the other field."""
    others = {left_out, "maps", "comparison", "error_analysis", "web_page", "report"}
    return [stage for stage in stages if stage["name"] not in others]


def add(results, names, mean, size, stages):
    """One row of the table."""
    results.add(
        dict(zip(("capture", "images", "method"), names, strict=True))
        | {
            "PSNR, dB": round(mean["psnr_ldr"], 2),
            "SSIM": round(mean["ssim"], 4),
            "FLIP": round(mean["flip"], 4),
            "field, kB": round(size / 1000, 1),
            "CPU time, s": round(sum(stage["cpu_seconds"] for stage in stages), 1),
            "peak memory, GB": round(max(s["peak_bytes"] for s in stages) / 2**30, 2),
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
    names = options.names or NAMES
    results = Results("methods", f"Methods on {len(names)} captures", MEASURED)
    results.table("Images, size, time and memory")
    with ExitStack() as stack:
        out = options.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for name in names:
            why = missing(name)
            if why is None:
                measure(results, name, out / name)
            else:
                print(f"{name}: {why}", file=sys.stderr)
    print(results.write())


if __name__ == "__main__":
    main()
