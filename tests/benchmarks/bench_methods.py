"""Methods on four captures, a table of each: ours, with and without alignment, the paper's.

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

Writes results/methods_NAME.json. Rows that the same code has left in DIR are not measured
again.
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
    folder.mkdir(parents=True, exist_ok=True)
    for key in METHODS | (SOLID_METHODS if name in SOLID else OTHER_METHODS):
        path = folder / f"{key}.json"
        kept = json.loads(path.read_text()) if path.is_file() else {}
        if kept.get("code") != results.code:
            kept = {"code": results.code, "rows": list(measured(name, key, folder))}
            path.write_text(json.dumps(kept, indent=1) + "\n")
        for cells in kept["rows"]:
            results.add(cells)
            results.say()


def measured(name, key, folder):
    """Yield the rows of one method."""
    benchmark, out, log = CAPTURES[name], folder / "out", folder / "log.txt"
    capture = folder / "capture"
    if not (capture / "capture.json").is_file():
        capture = capture_of(benchmark, folder, log)
    options, fields = (METHODS | SOLID_METHODS | OTHER_METHODS)[key]
    ran("reflfield", ("run", capture, "-o", out, *benchmark.words, *options), log)
    stages = json.loads((out / "timings.json").read_text())["stages"]
    for field, method in fields.items():
        for images, mean in means(field, out / "stages" / "comparison").items():
            yield row((name, images, method), mean, out / "stages", field, stages)
        if field == "field" and benchmark.frames:
            # Of unseen views and lights, which the run has not compared.
            images, frames = benchmark.frames[0]
            mean = compare(out, capture / frames, folder / method, log)["mean"]
            yield row((name, images, method), mean, out / "stages", field, stages)


def means(field, folder):
    """Means over the images that the run itself has compared, held out or unseen."""
    files = {"held out": f"{field}/heldout.json", "unseen": f"{field}/truth.json"}
    return {
        images: json.loads((folder / file).read_text())["mean"]
        for images, file in files.items()
        if (folder / file).is_file()
    }


def needed(stages, left_out):
    """Stages up to the field, but for that of the other field."""
    others = {left_out, "maps", "comparison", "error_analysis", "web_page", "report"}
    return [stage for stage in stages if stage["name"] not in others]


def row(names, mean, stages_folder, field, stages):
    """One row of the table."""
    makers = ["compression", "without_alignment"]
    if field != "field":
        makers.reverse()
    made_by, left_out = makers
    size = (stages_folder / made_by / "field.rfld").stat().st_size
    spent = needed(stages, left_out)
    return dict(zip(("capture", "images", "method"), names, strict=True)) | {
        "PSNR, dB": round(mean["psnr_ldr"], 2),
        "SSIM": round(mean["ssim"], 4),
        "FLIP": round(mean["flip"], 4),
        "field, kB": round(size / 1000, 1),
        "CPU time, s": round(sum(stage["cpu_seconds"] for stage in spent), 1),
        "peak memory, GB": round(max(stage["peak_bytes"] for stage in spent) / 2**30, 2),
    }


def main():
    """Measure the captures that are named, or all that are here."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--out", type=Path, help="folder in which the runs stay")
    options = parser.parse_args()
    if unknown := set(options.names) - set(NAMES):
        parser.error(f"NAME: expected {', '.join(NAMES)}, received {', '.join(unknown)}")
    names = options.names or NAMES
    with ExitStack() as stack:
        out = options.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for name in names:
            why = missing(name)
            if why is not None:
                print(f"{name}: {why}", file=sys.stderr)
                continue
            results = Results(f"methods_{name}", f"Methods on {name}", MEASURED)
            results.table("Images, size, time and memory")
            measure(results, name, out / name)
            print(results.write())


if __name__ == "__main__":
    main()
