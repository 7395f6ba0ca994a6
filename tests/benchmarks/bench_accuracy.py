"""What accuracy costs: error of recovered frames against time, one picture and its table.

    python tests/benchmarks/bench_accuracy.py [--texels 400] [-o accuracy]

On the synthetic scene of section 5.1 (81 x 81 directions). Points, in CPU time of one core:

* exact: search of the coupled series over all rotations, each refined to its peak;
* K = 2 .. 8: the paper's Eq. 11, highest of its (2L)^3 grid, computed as in
  `reflfield/reproduction/paper_forms.py`, and after Newton steps on the series of the truncated
  functions;
* brute force: Eq. 10 on that grid, and after Newton steps on the exact series (timed on a few
  texels; the errors are those of all, whose maxima the exact series has at the same rotations);
* all of `align`, with 0 to 8 rounds of refinement on the samples.

The first three search once against one target, the material in its own frame; projection,
coupling and factorisation are not in their times, and what lies below a texel's base horizon
is dark, as in the paper. The last contains everything, from samples to frames: finding the
target, and filling in what lies below. Memory is the peak beyond what was held before.
Writes results/accuracy.json, and accuracy_against_time.png and .csv.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import os
import sys
from pathlib import Path
from typing import NamedTuple

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS), str(TESTS / "alignment")]

import numpy as np  # noqa: E402
from benchmarks.error_against_time import SEARCHES, alignment_picture  # noqa: E402
from benchmarks.measuring import Results, measured  # noqa: E402

from reflfield.alignment import align, search  # noqa: E402
from reflfield.alignment.correlation import spectrum  # noqa: E402
from reflfield.alignment.newton_ascent import follow  # noqa: E402
from reflfield.alignment.refinement import RefinementOptions  # noqa: E402
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

RANKS = range(2, 9)
NEWTON_STEPS, ROUNDS = 12, (0, 1, 2, 3, 4, 6, 8)
MEASURED = ("reflfield.alignment", "reflfield.sphere.harmonic_projection")
DEFAULT_LIMIT, DEFAULT_ROUNDS = 8, RefinementOptions().rounds
EXACT, GRID, NEWTON, BRUTE, BRUTE_NEWTON, WHOLE = SEARCHES


class Point(NamedTuple):
    """One method with its time, memory and errors."""

    search: str
    step: str  # K, or rounds of refinement
    band_limit: int
    n: int
    n_timed: int
    milliseconds: float  # CPU time of one texel
    normals: float  # mean angle, degrees
    tangents: float
    megabytes: float  # peak, beyond what was held before


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


class Cost(NamedTuple):
    """What a search of some texels took."""

    seconds: float
    megabytes: float
    n: int

    def then(self, other):
        """Both after each other, of one texel."""
        each = self.seconds / self.n + other.seconds / other.n
        return Cost(each, max(self.megabytes, other.megabytes), 1)


def timed(work, n):
    """Answer for n texels, and what a few runs took: their median."""
    # Memory that earlier searches have left to the allocator would hide that of this one.
    ctypes.CDLL(None).malloc_trim(0)
    done = measured(lambda: None, lambda _: work(), repeats=3)
    return done.answer, Cost(done.cpu_seconds, done.megabytes, n)


def point(search, step, band_limit, cost, local_from_base, truth, n_timed=None):
    """Errors of some frames; a common turn about the normals is free."""
    n = len(local_from_base)
    recovered = with_the_truths_tangents(local_from_base, truth[:n])
    normals, tangents = frame_errors(recovered, truth[:n])
    each = cost.seconds / cost.n * 1e3
    errors = normals.mean(), tangents.mean()
    return Point(search, step, band_limit, n, n_timed or n, each, *errors, cost.megabytes)


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
    maxima, cost = timed(lambda: search(source, target, margins=False), len(truth))
    return point(EXACT, "", task.band_limit, cost, local(maxima.rotations), truth)


def rank_points(task, rank, truth):
    """Eq. 11: highest of the grid, and Newton steps on the truncated series from there."""
    view, light = (
        side.astype(np.float32) for side in paper_forms.factors(task.coefficients, rank)
    )
    table = paper_forms.turn_target(task.target, rank, task.grid)
    index, cost = timed(lambda: paper_forms.factored_maxima(view, light, table), len(truth))
    start = task.grid[index]
    truncated = [
        couple(np.swapaxes(a, 1, 2) @ b)
        for a, b in ((view, light), paper_forms.factors(task.target[None], rank))
    ]
    moved, more = timed(lambda: newton(*truncated, start), len(truth))
    step, limit = str(rank), task.band_limit
    return [
        point(GRID, step, limit, cost, local(start), truth),
        point(NEWTON, step, limit, cost.then(more), local(moved), truth),
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

    values, cost = timed(work, len(few))
    # Equal but for rounding: the maximum of the direct sum is that of the exact series.
    np.testing.assert_allclose(*np.array(values).T, rtol=1e-4)
    moved, more = timed(lambda: newton(source, target, start), len(truth))
    limit, n = task.band_limit, len(few)
    return [
        point(BRUTE, "", limit, cost, local(start), truth, n),
        point(BRUTE_NEWTON, "", limit, cost.then(more), local(moved), truth, n),
    ]


def refined_points(data, most):
    """Yield all of `align`, with more and more rounds of refinement."""
    directions, limit = data.directions, DEFAULT_LIMIT
    for rounds in (n for n in ROUNDS if n <= most):
        refine = RefinementOptions(rounds=rounds) if rounds else False
        alignment, cost = timed(
            lambda how=refine: align(data.samples, directions, directions, limit, refine=how),
            len(data.frames),
        )
        frames = alignment.local_from_base
        yield point(WHOLE, str(rounds), limit, cost, frames, data.frames)


def all_points(data, options):
    """Yield everything."""
    for band_limit in options.band_limits:
        task = problem(data, band_limit)
        yield exact_point(task, data.frames)
        for rank in RANKS:
            yield from rank_points(task, rank, data.frames)
        yield from brute_points(task, options.brute, data.frames)
    yield from refined_points(data, options.rounds)


# --- table and picture ----------------------------------------------------------------------


def remark(one):
    """What a point stands for."""
    if (one.search, one.step, one.band_limit) == (GRID, "4", 8):
        return "the paper's choice"
    if (one.search, one.step) == (WHOLE, str(DEFAULT_ROUNDS)):
        return "the default"
    return ""


def cells(one):
    """One row."""
    return {
        "L": one.band_limit,
        "search": one.search,
        "K or rounds": one.step,
        "ms per texel": one.milliseconds,
        "normals": one.normals,
        "tangents": one.tangents,
        "peak memory, MB": one.megabytes,
        "texels": one.n,
        "timed": one.n_timed,
        "remark": remark(one),
    }


def written(points, folder):
    """Write the results, said as they come, their table as CSV and their picture; the paths."""
    results = Results("accuracy", "What accuracy of the frames costs", MEASURED)
    results.table("CPU time of one core, mean errors in degrees; memory beyond what was held")
    for one in points:
        results.add(cells(one))
        results.say()
    rows = results.tables[0]["rows"]
    table, picture = (folder / f"accuracy_against_time.{end}" for end in ("csv", "png"))
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    picture.write_bytes(alignment_picture(results.tables, "png"))
    return table, picture, results.write()


def main() -> None:
    """Measure, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--texels", type=int, default=400, help="of 11,160")
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
    print(*written(all_points(data, options), options.output), sep="\n")


if __name__ == "__main__":
    main()
