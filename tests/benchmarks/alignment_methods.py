"""The methods that `bench_alignment.py` measures; run by it, in a process of its own.

    python alignment_methods.py METHODS PROBLEM.npz N_CORES

Prints one line of JSON per measurement.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from benchmarks.measuring import measured
from benchmarks.peers import Pysofft, S2fft

from reflfield.alignment import align, search
from reflfield.reproduction import paper_forms
from reflfield.sphere.coupling import couple
from reflfield.sphere.harmonic_projection import Projector
from reflfield.sphere.rotations import rotation_angle

RANKS = (4, 6)
# ABRDFs, or pairs of functions, that a method works on in one timed run.
MANY = {4: 256, 8: 64, 16: 16}
BATCHES = (1, 8, 32)


class Job:
    """One problem, the cores to use, and where results go."""

    def __init__(self, path, n_cores):
        self.data = np.load(path, allow_pickle=False)
        self.n_cores = n_cores
        self.band_limit = int(self.data["band_limit"])
        self.many = MANY.get(self.band_limit, 16)

    def abrdfs(self, n, dtype=np.float32):
        """Coefficients (n, L^2, L^2) and those of the target."""
        return self.data["abrdfs"][:n].astype(dtype), self.data["target"].astype(dtype)

    def functions(self, n, dtype=np.float64):
        """Coefficients (n, L^2) of functions of one direction, and of the target's."""
        return self.data["functions"][:n].astype(dtype), self.data["function"].astype(dtype)

    def report(self, table, method, measurement, n, **rest):
        """Print one row."""
        row = {
            "table": table,
            "method": method,
            "band_limit": self.band_limit,
            "cores": self.n_cores,
            "ms": measurement.seconds / n * 1e3,
            "cpu_ms": measurement.cpu_seconds / n * 1e3,
            "megabytes": measurement.megabytes,
        }
        print(json.dumps(row | rest), flush=True)

    def angles(self, rotations):
        """Degrees to the nearest maximum of the exact series, and to the planted frame."""
        n = len(rotations)
        return {
            name: np.rad2deg(
                rotation_angle(np.swapaxes(self.data[name][:n], -1, -2) @ rotations[:, None])
            ).min(axis=1)
            for name in ("maxima", "planted")
        }

    def report_rotations(self, method, measurement, rotations, **rest):
        """Print one row of Table 2."""
        error = self.angles(rotations)
        self.report(
            2,
            method,
            measurement,
            len(rotations),
            median=float(np.median(error["maxima"])),
            tail=float(np.percentile(error["maxima"], 99)),
            at_peak=float(np.mean(error["maxima"] <= 0.05)),
            planted=float(np.median(error["planted"])),
            **rest,
        )

    def report_values(self, method, measurement, values, rotations):
        """Print one row of Table 1: (n, rotations) values against the direct sum."""
        a, b = self.functions(1)
        exact = paper_forms.direct_correlations(a[0], b, rotations)
        scale = np.linalg.norm(a[0]) * np.linalg.norm(b)
        self.report(
            1,
            method,
            measurement,
            len(values),
            rotations=len(rotations),
            error=float(np.abs(values[0] - exact).max() / scale),
        )


# --- ours ---------------------------------------------------------------------------------


def ours(job):
    """Exact search, exact series on the paper's grid, factored form, and what comes before."""
    searching(job)
    spherical(job)
    if job.band_limit < 16:
        # Beyond, the Wigner matrices of a grid that nothing amortises take minutes.
        on_grid(job)
    for rank in RANKS:
        factored(job, rank)
    preparing(job)


def searching(job):
    """Every ABRDF searched globally, each refined to the peak; coupling excluded."""
    coefficients, target = job.abrdfs(None)
    source, aim = couple(coefficients), couple(target[None])
    measurement = measured(
        lambda: search(source[:4], aim),
        lambda _: search(source, aim, margins=False, n_threads=job.n_cores),
    )
    job.report_rotations(
        "exact, searched, to the peak", measurement, measurement.answer.rotations
    )


def spherical(job):
    """Correlations of functions of one direction."""
    a, b = job.functions(job.many, np.float32)
    pairs = np.broadcast_to(b, a.shape)
    grid = paper_forms.paper_grid(job.band_limit)
    measurement = measured(
        lambda: paper_forms.separation_kernel(job.band_limit),
        lambda kernel: paper_forms.separated_correlations(a, pairs, kernel, job.n_cores),
    )
    job.report_values("ours, any pairs (separated)", measurement, measurement.answer, grid)
    measurement = measured(
        lambda: paper_forms.turned(b[:, None], grid, "float32")[:, :, 0],
        lambda table: a @ table.T,
    )
    job.report_values("ours, one target (product)", measurement, measurement.answer, grid)


def on_grid(job):
    """The exact series on the whole of the paper's grid: no coarse step, no refinement."""
    coefficients, target = job.abrdfs(job.many)
    source, aim = couple(coefficients), couple(target[None])
    grid = paper_forms.paper_grid(job.band_limit)
    measurement = measured(
        lambda: None, lambda _: grid[paper_forms.exact_maxima(source, aim, grid)], 2
    )
    job.report_rotations("exact, on the paper's grid", measurement, measurement.answer)


def factored(job, rank):
    """Eq. 11 as two matrix products per ABRDF."""
    coefficients, target = job.abrdfs(job.many)
    grid = paper_forms.paper_grid(job.band_limit)
    own = [side.astype(np.float32) for side in paper_forms.factors(coefficients, rank)]
    measurement = measured(
        lambda: paper_forms.turn_target(target, rank, grid),
        lambda table: grid[paper_forms.factored_maxima(*own, table)],
    )
    job.report_rotations(f"Eq. 11, K={rank}, ours", measurement, measurement.answer, rank=rank)


def preparing(job):
    """Projection of 151 x 151 samples, and coupling."""
    directions, samples = job.data["directions"], job.data["samples"]
    projector = Projector(directions, directions, (job.band_limit, job.band_limit))
    measurement = measured(lambda: None, lambda _: projector.project(samples))
    job.report(0, "projection, 151 x 151 samples", measurement, len(samples))
    coefficients = measurement.answer
    measurement = measured(lambda: None, lambda _: couple(coefficients))
    job.report(0, "coupling", measurement, len(samples))


# --- the paper's direct sums ---------------------------------------------------------------


def brute(job):
    """Eq. 5, 8, 10 and 3, one pair."""
    grid, data = paper_forms.paper_grid(job.band_limit), job.data
    a, b = job.functions(1)
    measurement = measured(
        lambda: None, lambda _: paper_forms.direct_correlations(a[0], b, grid)[None]
    )
    job.report_values("Eq. 8, direct", measurement, measurement.answer, grid)
    # Weighted by solid angles the sum of Eq. 5 approximates the integral of Eq. 8.
    values, nodes, side = data["weighted"][0], data["function_nodes"], int(data["side"])

    def sums(rotations):
        sampled = paper_forms.sampled_correlations
        return sampled(values, data["directions"], nodes, side, rotations)[None]

    # Compiled before the clock starts.
    measurement = measured(lambda: sums(grid[:2]), lambda _: sums(grid))
    job.report_values("Eq. 5, 151 directions", measurement, measurement.answer, grid)
    brute_abrdf(job, grid)


def brute_abrdf(job, grid):
    """Eq. 10 and 3; they take seconds from L = 16 on."""
    (a,), b = job.abrdfs(1)
    measurement = measured(
        lambda: None, lambda _: paper_forms.direct_abrdf_correlations(a, b, grid), 1
    )
    job.report_rotations("Eq. 10, direct", measurement, grid[[measurement.answer.argmax()]])
    data = job.data
    nodes, side, directions = data["nodes"], int(data["side"]), data["directions"]
    measurement = measured(
        lambda: paper_forms.sampled_abrdf_correlations(
            data["samples"][0], directions, nodes, side, grid[:2]
        ),
        lambda _: paper_forms.sampled_abrdf_correlations(
            data["samples"][0], directions, nodes, side, grid
        ),
        1,
    )
    job.report_rotations(
        "Eq. 3, 151 x 151 samples", measurement, grid[[measurement.answer.argmax()]]
    )


# --- peers --------------------------------------------------------------------------------


def s2fft(job):
    """The peer in JAX; of some batch sizes the fastest counts."""
    a, b = job.functions(job.many)
    # Once unmeasured: importing JAX is not what the method needs.
    peer = S2fft(job.band_limit)
    left, right = peer.coefficients(a), peer.coefficients(np.broadcast_to(b, a.shape))
    measurement = measured(
        lambda: S2fft(job.band_limit), lambda fresh: fresh.correlations(left, right)
    )
    job.report_values("s2fft", measurement, measurement.answer, peer.rotations)
    for rank in RANKS:
        best = fastest(s2fft_of_batch(job, peer, rank, batch) for batch in BATCHES)
        rotations = peer.rotations[best.answer]
        job.report_rotations(f"Eq. 11, K={rank}, s2fft", best, rotations, rank=rank)


def s2fft_of_batch(job, peer, rank, batch):
    own, target = factors_of(job, peer, rank)
    return measured(lambda: peer.maxima(target, batch), lambda work: work(own), 3)


def factors_of(job, peer, rank):
    """Factors of ABRDFs and of the target, in a peer's form."""
    coefficients, target = job.abrdfs(job.many, np.float64)
    own = [peer.coefficients(side) for side in paper_forms.factors(coefficients, rank)]
    aim = [peer.coefficients(side[0]) for side in paper_forms.factors(target[None], rank)]
    return own, aim


def pysofft(job):
    """The peer in Fortran, with threads of its own where they make it faster."""
    peers = [Pysofft(job.band_limit, count) for count in sorted({1, job.n_cores})]
    a, b = job.functions(job.many)
    left, right = peers[0].coefficients(a), peers[0].coefficients(b)

    def all_pairs(peer):
        for one in left:
            peer.correlation(one, right)

    best = fastest(measured(lambda p=p: p, all_pairs) for p in peers)
    values = peers[0].correlations(left, [right] * len(left))
    job.report_values("pysofft", best, values, peers[0].rotations)
    for rank in RANKS:
        own, target = factors_of(job, peers[0], rank)
        best = fastest(
            measured(lambda p=p, t=target: p.maxima(t), lambda work, o=own: work(o), 3)
            for p in peers
        )
        rotations = peers[0].rotations[best.answer]
        job.report_rotations(f"Eq. 11, K={rank}, pysofft", best, rotations, rank=rank)


def fastest(tried):
    """The measurement of least time."""
    return min(tried, key=lambda measurement: measurement.seconds)


# --- memory -------------------------------------------------------------------------------


class Repeated:
    """A source of n texels that repeats the few that are in memory."""

    def __init__(self, samples, n):
        self.samples = samples
        self.shape = (n, *samples.shape[1:])

    def read(self, rows):
        """Samples of some texels."""
        return self.samples[rows % len(self.samples)]


def memory(job, n):
    """Peak of a whole harmonic alignment of n texels, read block by block."""
    directions, samples = job.data["directions"], job.data["samples"]
    measurement = measured(
        lambda: align(samples[:2], directions, directions, job.band_limit, refine=False),
        lambda _: align(
            Repeated(samples, n),
            directions,
            directions,
            job.band_limit,
            refine=False,
            n_threads=job.n_cores,
        ),
        1,
    )
    job.report(3, f"{n} ABRDFs aligned", measurement, n)


METHODS = {"ours": ours, "brute": brute, "s2fft": s2fft, "pysofft": pysofft}


def main():
    """Measure one group of methods."""
    name, path, n_cores, *rest = sys.argv[1:]
    job = Job(path, int(n_cores))
    if name == "memory":
        memory(job, int(rest[0]))
    else:
        METHODS[name](job)


if __name__ == "__main__":
    main()
