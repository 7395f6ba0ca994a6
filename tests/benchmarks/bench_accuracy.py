"""What accuracy costs: error of recovered frames against time, one picture and its table.

    python tests/benchmarks/bench_accuracy.py [--texels 600] [-o accuracy]

On the synthetic scene of section 5.1 (81 x 81 directions). Points, in CPU time of one core:

* exact: search of the coupled series over all rotations, each refined to its peak;
* K = 2 .. 8: the paper's Eq. 11, highest of its (2L)^3 grid, computed as in
  `reflfield/reproduction/paper_forms.py`, and after Newton steps on the series of the truncated
  functions;
* brute force: Eq. 10 on that grid, and after Newton steps on the exact series (timed on a few
  texels; the errors are those of all, whose maxima the exact series has at the same rotations);
* refined: the whole of `align` with 0 to 8 rounds of refinement on the samples.

The first three search once against one target, the material in its own frame; projection,
coupling and factorisation are not in their times, and what lies below a texel's base horizon
is dark, as in the paper. The last contains everything, from samples to frames: finding the
target, and filling in what lies below. Writes accuracy_against_time.png and .csv.
"""

from __future__ import annotations

import argparse
import csv
import os
import sys
import time
from pathlib import Path
from typing import NamedTuple

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS), str(TESTS / "alignment")]

import matplotlib  # noqa: E402
import numpy as np  # noqa: E402
from benchmarks.measuring import Results  # noqa: E402

from reflfield.alignment import align, search  # noqa: E402
from reflfield.alignment.correlation import spectrum  # noqa: E402
from reflfield.alignment.newton_ascent import follow  # noqa: E402
from reflfield.alignment.refinement import RefinementOptions  # noqa: E402
from reflfield.report.plots import SERIES_COLOURS  # noqa: E402
from reflfield.reproduction import paper_forms  # noqa: E402
from reflfield.reproduction.paper_scene import (  # noqa: E402
    dome_directions,
    frame_errors,
    relief_frames,
    sample_texels,
    with_the_truths_tangents,
)
from reflfield.sphere.coupling import couple  # noqa: E402
from reflfield.sphere.harmonic_projection import Projector  # noqa: E402

RANKS = (2, 4, 6, 8)
NEWTON_STEPS = 12
MEASURED = ("reflfield.alignment", "reflfield.sphere.harmonic_projection")
DEFAULT_LIMIT, DEFAULT_ROUNDS = 8, RefinementOptions().rounds
MARKERS = {"exact": "o", "grid": "s", "newton": "D", "brute": "^", "refined": "P"}
NAMES = {
    "exact": "exact, to the peak",
    "grid": "Eq. 11 with K = 2 .. 8, highest of the grid",
    "newton": "the same, then Newton steps",
    "brute": "brute force (Eq. 10), then Newton steps",
    "refined": "all of align, 0 to 8 rounds of refinement",
}


class Point(NamedTuple):
    """One method with its time and errors."""

    kind: str
    label: str
    band_limit: int
    n: int
    milliseconds: float  # per ABRDF
    normals: float  # mean angle, degrees
    tangents: float


class Scene(NamedTuple):
    """Texels with known frames."""

    frames: np.ndarray
    directions: np.ndarray
    samples: np.ndarray


def scene(n, noise):
    """Some texels of the relief."""
    rng = np.random.default_rng(1)
    frames = relief_frames()
    frames = frames[np.sort(rng.choice(len(frames), min(n, len(frames)), replace=False))]
    directions = dome_directions()
    samples = sample_texels(frames, directions, directions)
    samples += noise * samples.std() * rng.standard_normal(samples.shape, np.float32)
    return Scene(frames, directions, samples)


def timed(work):
    """Answer and CPU seconds of the faster of two runs; the first may load what is compiled."""
    seconds = []
    for _ in range(2):
        start = time.process_time()
        answer = work()
        seconds.append(time.process_time() - start)
    return answer, min(seconds)


def point(kind, label, band_limit, seconds, local_from_base, truth):
    """Errors of some frames; a common turn about the normals is free."""
    n = len(local_from_base)
    recovered = with_the_truths_tangents(local_from_base, truth[:n])
    normals, tangents = frame_errors(recovered, truth[:n])
    return Point(kind, label, band_limit, n, seconds / n * 1e3, normals.mean(), tangents.mean())


def local(rotations):
    """Frames of the rotations of a search."""
    return np.swapaxes(rotations, 1, 2)


class Problem(NamedTuple):
    """Coefficients of the texels and of one target, and the paper's grid."""

    coefficients: np.ndarray
    target: np.ndarray
    band_limit: int
    grid: np.ndarray


def problem(data, band_limit):
    """Project the texels, and the material in its own frame as their target."""
    projector = Projector(data.directions, data.directions, (band_limit, band_limit))
    upright = sample_texels(np.eye(3)[None], data.directions, data.directions)
    return Problem(
        projector.project(data.samples),
        projector.project(upright)[0],
        band_limit,
        paper_forms.paper_grid(band_limit),
    )


def exact_point(task, truth):
    """Global search, to the peak."""
    source, target = couple(task.coefficients), couple(task.target[None])
    maxima, seconds = timed(lambda: search(source, target, margins=False))
    return point("exact", "exact", task.band_limit, seconds, local(maxima.rotations), truth)


def rank_points(task, rank, truth):
    """Eq. 11: highest of the grid, and Newton steps on the truncated series from there."""
    view, light = (
        side.astype(np.float32) for side in paper_forms.factors(task.coefficients, rank)
    )
    table = paper_forms.turn_target(task.target, rank, task.grid)
    index, seconds = timed(lambda: paper_forms.factored_maxima(view, light, table))
    start = task.grid[index]
    truncated = [
        couple(np.swapaxes(a, 1, 2) @ b)
        for a, b in ((view, light), paper_forms.factors(task.target[None], rank))
    ]
    moved, more = timed(lambda: newton(*truncated, start))
    label, limit = f"K={rank}", task.band_limit
    return [
        point("grid", label, limit, seconds, local(start), truth),
        point("newton", f"{label}, Newton", limit, seconds + more, local(moved), truth),
    ]


def newton(source, target, start):
    """Peaks near some rotations."""
    rows = np.arange(len(source))
    return follow(spectrum(source, target.units()), rows, start, NEWTON_STEPS)[0]


def brute_points(task, n, truth):
    """Eq. 10: the direct sum takes up to a second a texel, so only a few are timed."""
    source, target = couple(task.coefficients), couple(task.target[None])
    index = paper_forms.exact_maxima(source, target, task.grid)
    start = task.grid[index]
    few = task.coefficients[:n]

    def work():
        sums = (
            paper_forms.direct_abrdf_correlations(one, task.target, task.grid) for one in few
        )
        return [(values.max(), values[i]) for values, i in zip(sums, index, strict=False)]

    values, seconds = timed(work)
    # Equal but for rounding: the maximum of the direct sum is that of the exact series.
    np.testing.assert_allclose(*np.array(values).T, rtol=1e-4)
    moved, more = timed(lambda: newton(source, target, start))
    each, limit = seconds / len(few) * len(start), task.band_limit
    return [
        point("brute", "brute force", limit, each, local(start), truth),
        point("brute", "brute force, Newton", limit, each + more, local(moved), truth),
    ]


def refined_points(data, most):
    """All of `align`, with more and more rounds of refinement."""
    points = []
    for rounds in range(most + 1):
        refine = RefinementOptions(rounds=rounds) if rounds else False
        start = time.process_time()
        alignment = align(
            data.samples, data.directions, data.directions, DEFAULT_LIMIT, refine=refine
        )
        seconds = time.process_time() - start
        label = f"{rounds} rounds"
        points.append(
            point(
                "refined", label, DEFAULT_LIMIT, seconds, alignment.local_from_base, data.frames
            )
        )
    return points


def all_points(data, options):
    """Everything, printed as it comes."""
    points = []
    for band_limit in options.band_limits:
        task = problem(data, band_limit)
        points.append(exact_point(task, data.frames))
        for rank in RANKS:
            points += rank_points(task, rank, data.frames)
        points += brute_points(task, options.brute, data.frames)
    return points + refined_points(data, options.rounds)


# --- table and picture ----------------------------------------------------------------------


def remark(one):
    """What a point stands for."""
    if one.kind == "grid" and (one.label, one.band_limit) == ("K=4", 8):
        return "the paper's choice"
    if one.kind == "refined" and one.label == f"{DEFAULT_ROUNDS} rounds":
        return "the default"
    return ""


def show(points):
    """The table, as Markdown."""
    print("| L | method | texels | ms per ABRDF | normals, mean degrees | tangents | |")
    print("|---|---|---|---|---|---|---|")
    for one in points:
        print(
            f"| {one.band_limit} | {one.label} | {one.n} | {one.milliseconds:.4g} | "
            f"{one.normals:.3f} | {one.tangents:.3f} | {remark(one)} |"
        )


def write_table(points, path):
    """The table, as CSV."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*Point._fields, "remark"])
        writer.writerows([*one, remark(one)] for one in points)


def written(points):
    """Write the table as results; their path."""
    results = Results("accuracy", "What accuracy of the frames costs", MEASURED)
    results.table("CPU time of one core; mean errors in degrees")
    for one in points:
        results.add(
            {
                "L": one.band_limit,
                "method": f"{NAMES[one.kind].partition(',')[0]}: {one.label}",
                "texels": one.n,
                "ms per ABRDF": one.milliseconds,
                "normals": one.normals,
                "tangents": one.tangents,
                "": remark(one),
            }
        )
    return results.write()


def draw(points, path, title):
    """Normals and tangents over time; lower left is better."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, both = pyplot.subplots(1, 2, figsize=(13, 6.6), sharex=True, layout="constrained")
    for axes, what in zip(both, ("normals", "tangents"), strict=True):
        draw_errors(axes, points, what)
    figure.legend(handles=legend(points), loc="outside lower center", ncols=4, fontsize=9)
    figure.suptitle(title, fontsize=11)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def colours(points):
    """One colour for each band limit, told apart by lightness too."""
    return dict(zip(sorted({one.band_limit for one in points}), SERIES_COLOURS, strict=False))


def draw_errors(axes, points, what):
    """One panel."""
    colour = colours(points)
    for kind in MARKERS:
        for limit in colour:
            some = [one for one in points if (one.kind, one.band_limit) == (kind, limit)]
            x = [one.milliseconds for one in some]
            y = [getattr(one, what) for one in some]
            hollow = "white" if kind == "newton" else colour[limit]
            axes.plot(
                x, y, MARKERS[kind], ls="-" if kind != "exact" else "", lw=1, ms=7,
                color=colour[limit], mfc=hollow,
            )  # fmt: skip
            for one, here in zip(some, zip(x, y, strict=True), strict=True):
                write_beside(axes, one, here)
    axes.set(
        xscale="log", yscale="log", xlabel="CPU milliseconds per ABRDF, one core",
        ylabel=f"mean error of {what}, degrees",
    )  # fmt: skip
    axes.margins(y=0.12)
    axes.grid(True, which="both", alpha=0.25)
    axes.annotate(
        "better", xy=(0.02, 0.03), xytext=(0.09, 0.1), xycoords="axes fraction",
        fontsize=10, arrowprops={"arrowstyle": "->"},
    )  # fmt: skip


def write_beside(axes, one, here):
    """Rank or round of a point; an arrow where a choice lies."""
    if one.kind in ("grid", "newton"):
        text = one.label.split(",")[0][2:]
    else:
        text = one.label.split()[0] if one.kind == "refined" else ""
    axes.annotate(text, here, xytext=(4, 4), textcoords="offset points", fontsize=7)
    if remark(one):
        axes.plot(*here, "o", ms=16, mfc="none", mec="black")
        # Away from the points that follow to the right.
        away = (-90, -4) if one.kind == "refined" else (-10, 26)
        axes.annotate(
            remark(one), here, xytext=away, textcoords="offset points", fontsize=9,
            ha="center", arrowprops={"arrowstyle": "-"},
        )  # fmt: skip


def legend(points):
    """Band limits by colour, methods by marker."""
    from matplotlib.lines import Line2D

    limits = [
        Line2D([], [], color=colour, lw=3, label=f"L = {limit}")
        for limit, colour in colours(points).items()
    ]
    methods = []
    for kind, marker in MARKERS.items():
        inside = "white" if kind == "newton" else "black"
        style = {"color": "black", "marker": marker, "ls": "", "mfc": inside}
        methods.append(Line2D([], [], **style, label=NAMES[kind]))
    return limits + methods


def main() -> None:
    """Measure, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--texels", type=int, default=600, help="of 11,160")
    parser.add_argument("--noise", type=float, default=0.0, help="share of the deviation")
    parser.add_argument("--band-limits", type=int, nargs="+", default=[4, 8, 12])
    parser.add_argument("--brute", type=int, default=16, help="texels of the brute force")
    parser.add_argument("--rounds", type=int, default=8, help="of refinement, at most")
    parser.add_argument("-o", "--output", type=Path, default=Path("accuracy"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    data = scene(options.texels, options.noise)
    # Compile the kernels before the clock starts.
    align(data.samples[:2], data.directions, data.directions)
    points = all_points(data, options)
    show(points)
    write_table(points, options.output / "accuracy_against_time.csv")
    picture = options.output / "accuracy_against_time.png"
    title = (
        f"Frames of {len(data.frames)} ABRDFs (81 x 81 directions, noise {options.noise:.0%}): "
        "what accuracy costs"
    )
    draw(points, picture, title)
    print(picture)
    print(written(points))


if __name__ == "__main__":
    main()
