"""Time and error of the correlation search, beside the paper's forms and s2fft, in one run.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_alignment.py --band-limits 4 8

Every ABRDF is a turned copy of the target with noise; the error is the angle to the
maximum of its own exact series, found from the planted rotation in double precision.
Read ratios: the machine may be busy. The rank-K forms evaluate the paper's (2L)^3 grid and
take its highest point, without refinement.
"""

from __future__ import annotations

import argparse
import importlib.util
import time

import numpy as np
from scipy.spatial.transform import Rotation

from reflfield.alignment import search
from reflfield.alignment.climbing import follow
from reflfield.alignment.correlation import spectrum
from reflfield.sphere.coupling import Coupled, couple, rotate_coupled, uncouple
from reflfield.sphere.hemisphere import HemisphereGrid
from reflfield.sphere.projection import Projector
from reflfield.sphere.rotations import matrix_from_euler, rotation_angle
from reflfield.sphere.wigner import block_offsets, rotation_blocks


def problem(band_limit, n, noise, rng):
    """Target and noisy turned copies in float32, and the maxima of their exact series."""
    falling = 1.0 / (1.0 + np.floor(np.sqrt(np.arange(band_limit**2))))
    scale = falling[:, None] * falling
    target = couple(rng.standard_normal((1, *scale.shape)) * scale)
    planted = Rotation.random(n, random_state=3).as_matrix()
    clean = rotate_coupled(target, rotation_blocks(planted, target.n_degrees))
    extra = couple(noise * rng.standard_normal((n, *scale.shape)) * scale)
    blocks = tuple(a + b for a, b in zip(clean.blocks, extra.blocks, strict=True))
    source = Coupled(clean.band_limits, blocks)
    truth = follow(spectrum(source, target), np.arange(n), planted, 20)[0]
    single = [
        Coupled(c.band_limits, tuple(b.astype(np.float32) for b in c.blocks))
        for c in (source, target)
    ]
    return single[0], single[1], truth


def best_time(work, repeats=3):
    """Shortest wall time of some runs, seconds, and the last answer."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        answer = work()
        times.append(time.perf_counter() - start)
    return min(times), answer


def angle(found, truth):
    return np.rad2deg(rotation_angle(np.swapaxes(truth, 1, 2) @ found))


def show(name, band_limit, seconds, n, error):
    print(
        f"L={band_limit:<3d} {name:<34s} {seconds / n * 1e3:10.4f} ms  {n / seconds:9.0f} /s  "
        f"error median {np.median(error):8.4f}  95 % {np.percentile(error, 95):8.4f} degrees"
    )


def paper_grid(band_limit):
    """The (2L)^3 rotations of the paper's grid."""
    count = 2 * band_limit
    alpha = 2 * np.pi * np.arange(count) / count
    beta = np.pi * (np.arange(count) + 0.5) / count
    a, b, c = np.meshgrid(alpha, beta, alpha, indexing="ij")
    return matrix_from_euler(a.ravel(), b.ravel(), c.ravel())


def factors(coefficients, rank):
    """Rank-K factors of a matrix, the root of the singular value on each side."""
    u, s, vt = np.linalg.svd(coefficients, full_matrices=False)
    root = np.sqrt(s[:rank])
    return u[:, :rank] * root, (vt[:rank].T * root)


def correlations(left, right, grid_blocks, band_limit):
    """2D correlations of all pairs of factors on the grid: (pairs, rotations)."""
    offsets, total = block_offsets(band_limit), 0.0
    for ell in range(band_limit):
        part = slice(ell * ell, (ell + 1) ** 2)
        products = np.einsum("mi,nj->ijmn", left[part], right[part])
        block = grid_blocks[:, offsets[ell] : offsets[ell + 1]]
        total = total + products.reshape(-1, (2 * ell + 1) ** 2) @ block.T
    return total


def rank_k(source, target, rank, grid, grid_blocks):
    """Eq. 11: K^2 products of 2D correlations on the grid, highest point."""
    band_limit = source.band_limits[0]
    b = factors(uncouple(target)[0], rank)
    found = []
    for a in (factors(matrix, rank) for matrix in uncouple(source)):
        view = correlations(a[0], b[0], grid_blocks, band_limit)
        light = correlations(a[1], b[1], grid_blocks, band_limit)
        found.append(grid[np.argmax(np.sum(view * light, axis=0))])
    return np.array(found)


def brute_force(source, target, grid, grid_blocks):
    """The exact series on the whole grid, highest point: no coarse step, no Newton."""
    return grid[np.argmax(spectrum(source, target) @ grid_blocks.T, axis=1)]


def s2fft_correlation(band_limit):
    """Time of one 2D correlation by s2fft's inverse Wigner transform, or None."""
    if importlib.util.find_spec("s2fft") is None:
        return None
    import s2fft

    rng = np.random.default_rng(0)
    shape = s2fft.sampling.so3_samples.flmn_shape(band_limit, band_limit)
    flmn = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    work = s2fft.wigner.inverse
    return best_time(lambda: work(flmn, band_limit, band_limit, reality=False))[0]


def projection(band_limit, n=64):
    """Seconds of projecting and of coupling one ABRDF of 151 x 151 directions."""
    grid = HemisphereGrid(13).directions[9:160]
    projector = Projector(grid, grid, (band_limit, band_limit))
    samples = np.random.default_rng(0).random((n, 151, 151), dtype=np.float32)
    couple(projector.project(samples[:1]))
    project_time, coefficients = best_time(lambda: projector.project(samples))
    couple_time, _ = best_time(lambda: couple(coefficients))
    return project_time / n, couple_time / n


def ours(source, target, truth, band_limit):
    """The search as it is used: global on one and two threads, and from a start."""
    n = len(source)
    runs = [
        ("exact, searched, peak, 1 thread", {}),
        ("exact, searched, peak, 2 threads", {"n_threads": 2}),
        ("exact, one peak and a start", {"start": truth, "n_peaks": 1}),
    ]
    search(source[:4], target)
    for name, options in runs:
        seconds, found = best_time(lambda o=options: search(source, target, margins=False, **o))
        error = angle(found.rotations, truth)
        assert np.percentile(error, 99) < 0.05, "the search missed its own accuracy"
        show(name, band_limit, seconds, n, error)


def papers(source, target, truth, band_limit):
    """The paper's grid, with the exact series and with rank-K factors."""
    grid = paper_grid(band_limit)
    full = rotation_blocks(grid, target.n_degrees, "float32")
    seconds, best = best_time(lambda: brute_force(source, target, grid, full), 1)
    show("exact on the paper's grid", band_limit, seconds, len(source), angle(best, truth))
    blocks = rotation_blocks(grid, band_limit, "float32")
    for rank in (2, 4, 6):
        seconds, best = best_time(lambda k=rank: rank_k(source, target, k, grid, blocks), 1)
        error = angle(best, truth)
        show(f"Eq. 11, K={rank}, stored Wigner", band_limit, seconds, len(source), error)


def main() -> None:
    """Print one table per band limit."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--band-limits", type=int, nargs="+", default=[4, 8])
    parser.add_argument("--n", type=int, default=1024)
    parser.add_argument("--noise", type=float, default=0.02)
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    for band_limit in options.band_limits:
        source, target, truth = problem(band_limit, options.n, options.noise, rng)
        ours(source, target, truth, band_limit)
        few = 64 if band_limit <= 4 else 8
        papers(source[:few], target, truth[:few], band_limit)
        one = s2fft_correlation(band_limit)
        if one is not None:
            print(
                f"L={band_limit:<3d} s2fft, K=4 by 32 correlations   {32 * one * 1e3:10.4f} ms"
            )
        project_time, couple_time = projection(band_limit)
        print(
            f"L={band_limit:<3d} 151 x 151 samples: projection {project_time * 1e3:.4f} ms, "
            f"coupling {couple_time * 1e3:.4f} ms"
        )


if __name__ == "__main__":
    main()
