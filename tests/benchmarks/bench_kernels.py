"""Hot kernels beside what this machine could do: operations, bytes, and the roofline.

    python tests/benchmarks/bench_kernels.py [--threads 1 2] [--quick]

Every kernel runs on made-up input of the size of a run, each thread on input of its own, as
runs give threads views or blocks. Operations are counted by hand from the source; the comments
of `fit_kernels.py` and `search_kernels.py` say how, `roofline.py` by which rules. The limit is
the lesser of the peak of arithmetic and of bandwidth times operations a byte, both measured
here by loops of the same compiler. Where a kernel's arrays stay in a cache it may pass the
limit of memory.

Times are medians. Rates are of CPU time, times the number of threads: on a quiet machine that
is wall time; on a busy one it keeps most of what else runs out of them, but not what that takes
of caches and memory. Memory is at the peak, input included. Errors are the largest against
NumPy in double precision, over the largest value, on a small input; exit status 1 if one is
beyond what single precision explains.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

if __name__ == "__main__":  # one thread of BLAS to each of ours
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parents[1])]

from benchmarks import fit_kernels, search_kernels  # noqa: E402
from benchmarks.measuring import Results  # noqa: E402
from benchmarks.roofline import Limits, on_threads  # noqa: E402

# Kernels, sizes to time them at and to check them at.
KERNELS = {
    "derivatives of samples": (fit_kernels.linearisation, 4000, 20),
    "product of pixels": (fit_kernels.pixel_product, 20_000, 20),
    "product of tables": (fit_kernels.table_product, 300_000, 500),
    "half-vector samples": (fit_kernels.half_vector, 500_000, 500),
    "clustered samples": (fit_kernels.clustered, 300_000, 500),
    "correlation over SO(3)": (search_kernels.correlation, 2000, 4),
    "costs of patches": (search_kernels.stereo, 240, 30),
    "costs over paths": (search_kernels.paths, 240, 12),
}
MODULES = [
    "reflfield.fitting.pixel_kernels",
    "reflfield.fitting.table_fit",
    "reflfield.field.evaluation",
    "reflfield.alignment.newton_ascent",
    "reflfield.geometry.patch_costs",
]
# Largest error in single precision: places in tables come from arccosines, which lose digits
# where highlights are. Derivatives are differences of such samples over an angle.
LARGEST_ERROR = dict.fromkeys(KERNELS, 1e-05)
LARGEST_ERROR["derivatives of samples"] /= 2 * float(fit_kernels.HALF_ANGLE)


def kernel_rows(name, limits, quick):
    """Times of a kernel for each number of threads, and beside the limit."""
    make, n, few = KERNELS[name]
    n = few if quick else n
    error = make(few, 0).error()
    kernel = make(n, 0)
    for threads, limit in limits.items():
        cost, factor = on_threads(lambda seed: make(n, seed).work, threads)
        per_second = kernel.n_items * factor / cost.cpu_seconds
        done = 1e-9 * per_second * kernel.operations
        most, by = limit.of_kernel(kernel)
        run = {"kernel": name, "threads": threads}
        yield (
            run
            | {
                "items": kernel.n_items * threads,
                "wall, ms": 1e3 * cost.seconds,
                "CPU, ms": 1e3 * cost.cpu_seconds,
                "MB": round(cost.megabytes),
                "error": error,
            },
            run
            | {
                "million items/s": 1e-6 * per_second,
                "GFLOP/s": done,
                "GB/s": done / kernel.intensity,
                "limit, GFLOP/s": most,
                "limited by": by,
                "share of the limit": done / most,
            },
        )


def item_row(name):
    """What an item of a kernel is, and what it needs."""
    make, n, _ = KERNELS[name]
    kernel = make(n, 0)
    return {
        "kernel": name,
        "item": kernel.item,
        "precision": kernel.precision,
        "operations": kernel.operations,
        "bytes read": kernel.bytes_read / kernel.n_items,
        "written": kernel.bytes_written / kernel.n_items,
        "operations a byte": kernel.intensity,
    }


def limit_rows(limits):
    """Limits, one a row, for each number of threads."""
    for kind in ("float32", "float64"):
        for what, attribute in (("multiply-adds", "peak"), ("BLAS's matrix product", "blas")):
            cells = {n: getattr(limit, attribute)[kind] for n, limit in limits.items()}
            yield {"limit": f"{what}, {kind}", "unit": "GFLOP/s"} | of_threads(cells)
    cells = {n: limit.bandwidth for n, limit in limits.items()}
    yield {"limit": "triad, float64", "unit": "GB/s"} | of_threads(cells)


def of_threads(cells):
    """Cells by number of threads, with a heading."""
    return {f"{n} thread{'s' * (n > 1)}": value for n, value in cells.items()}


def fill(results, title, rows):
    """A table of rows, printed as it grows."""
    results.table(title)
    print(f"\n{title}")
    for row in rows:
        results.add(row)
        results.say()


def main():
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--quick", action="store_true", help="small input, nothing written")
    options = parser.parse_args()
    results = Results("kernels", "Kernels beside the limits of the machine", MODULES)
    limits = {n: Limits.of(n) for n in options.threads}
    fill(results, "Limits", limit_rows(limits))
    fill(results, "Operations and bytes an item", map(item_row, KERNELS))
    measured = [pair for name in KERNELS for pair in kernel_rows(name, limits, options.quick)]
    times, shares = zip(*measured, strict=True)
    fill(results, "Times, memory and error", times)
    fill(results, "Rates beside the limit", shares)
    if not options.quick:
        print(results.write())
    wrong = {row["kernel"] for row in times if not row["error"] < LARGEST_ERROR[row["kernel"]]}
    if wrong:
        print(f"wrong: {', '.join(sorted(wrong))}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
