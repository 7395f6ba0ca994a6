"""Materials mixed in one scene (section 4.3 of the paper): labels, normals, time and memory.

    python tests/benchmarks/bench_clusters.py --texels 2000
    python tests/benchmarks/bench_clusters.py --large 65536 --texels 0

The relief of section 5.1 with Ashikhmin-Shirley materials in random order, 81 x 81
directions. Labels are compared under the best matching; normals with those of each material
aligned alone. `--large` times 16 clusters on so many texels, which are made when they are
read, so that memory shows what the alignment itself holds.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import numpy as np  # noqa: E402
from benchmarks.measuring import Results, spent  # noqa: E402
from scipy.optimize import linear_sum_assignment  # noqa: E402

from reflfield.alignment import align  # noqa: E402
from reflfield.reproduction.paper_scene import (  # noqa: E402
    dome_directions,
    frame_errors,
    relief_frames,
    sample_texels,
)

BASE = {"nu": 8.0, "nv": 60.0}
SETS = {
    "two similar": [BASE, {"nu": 12.0, "nv": 60.0}],
    "two different": [BASE, {"nu": 20.0, "nv": 20.0, "diffuse": 0.4, "specular": 0.05}],
    "four similar": [
        BASE,
        {"nu": 8.0, "nv": 40.0},
        {"nu": 12.0, "nv": 60.0},
        {**BASE, "diffuse": 0.3},
    ],
    "four different": [
        BASE,
        {"nu": 60.0, "nv": 60.0, "diffuse": 0.1, "specular": 0.2},
        {"nu": 4.0, "nv": 4.0, "diffuse": 0.5},
        {"nu": 5.0, "nv": 200.0, "diffuse": 0.05, "specular": 0.3},
    ],
}


def agreement(labels, label):
    """Share of equal labels under the best matching of clusters and materials."""
    size = max(labels.max(), label.max()) + 1
    table = np.zeros((size, size), int)
    np.add.at(table, (labels, label), 1)
    return table[linear_sum_assignment(-table)].sum() / len(label)


def mixture(materials, n, noise, rng):
    """Samples, frames and labels of a mixed relief."""
    directions, frames = dome_directions(), relief_frames()
    frames = frames[np.sort(rng.choice(len(frames), min(n, len(frames)), replace=False))]
    label = rng.integers(0, len(materials), len(frames))
    samples = np.zeros((len(frames), len(directions), len(directions)), np.float32)
    for k, material in enumerate(materials):
        part = frames[label == k]
        samples[label == k] = sample_texels(part, directions, directions, **material)
    samples += noise * samples.std() * rng.standard_normal(samples.shape, np.float32)
    return samples, directions, frames, label


def compare(name, materials, options, results):
    """One line: labels and normals together, and normals of each material alone."""
    rng = np.random.default_rng(3)
    samples, d, frames, label = mixture(materials, options.texels, options.noise, rng)
    alignment, cost = spent(
        lambda: align(samples, d, d, n_clusters=len(materials), n_threads=options.threads)
    )
    together = frame_errors(alignment.local_from_base, frames)[0]
    alone = np.zeros(len(frames))
    for k in range(len(materials)):
        mine = label == k
        single = align(samples[mine], d, d, n_threads=options.threads)
        alone[mine] = frame_errors(single.local_from_base, frames[mine])[0]
    results.add(
        {
            "materials": name,
            "labels right, %": 100 * agreement(alignment.cluster, label),
            "normals, mean degrees": together.mean(),
            "95 %": np.percentile(together, 95),
            "each alone": alone.mean(),
            "alone, 95 %": np.percentile(alone, 95),
            **cost,
        }
    )
    results.say()


class Made:
    """Texels of 16 materials, made when they are read."""

    def __init__(self, n):
        self.directions, every = dome_directions(), relief_frames()
        self.frames = every[np.arange(n) % len(every)]
        self.shape = (n, len(self.directions), len(self.directions))
        self.label = np.arange(n) % 16
        self.wall = self.cpu = 0.0

    def read(self, rows):
        """Samples of some texels; the time it takes is kept apart."""
        start = time.perf_counter(), time.process_time()
        out = np.zeros((len(rows), *self.shape[1:]), np.float32)
        for k in range(16):
            mine = self.label[rows] == k
            material = {"nu": 4.0 * 2 ** (k % 4), "nv": 8.0 * 3 ** (k // 4)}
            d = self.directions
            out[mine] = sample_texels(self.frames[rows[mine]], d, d, **material)
        self.wall += time.perf_counter() - start[0]
        self.cpu += time.process_time() - start[1]
        return out


def large(n, options, results):
    """Time and memory of 16 clusters on many texels, by harmonics."""
    source = Made(n)
    d = source.directions
    for refine in (False, True) if options.refined else (False,):
        source.wall, source.cpu = 0.0, 0.0
        alignment, cost = spent(
            lambda how=refine: align(
                source, d, d, n_clusters=16, refine=how, n_threads=options.threads
            )
        )
        for clock, making in (("wall time, s", source.wall), ("CPU time, s", source.cpu)):
            cost[clock] = round(cost[clock] - making, 3)
        errors = frame_errors(alignment.local_from_base, source.frames)[0]
        results.add(
            {
                "materials": f"16, {n} texels, {'refined' if refine else 'harmonic'}",
                "labels right, %": 100 * agreement(alignment.cluster, source.label),
                "normals, mean degrees": errors.mean(),
                "95 %": np.percentile(errors, 95),
                **cost,
            }
        )
        results.say()


def main() -> None:
    """Print one line for each mixture, and the large case if asked for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--texels", type=int, default=2000, help="0: no comparison")
    parser.add_argument("--noise", type=float, default=0.0, help="share of the deviation")
    parser.add_argument("--large", type=int, default=0, help="texels of the large case")
    parser.add_argument("--refined", action="store_true", help="the large case refined too")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    results = Results("clusters", "Materials told apart", ["reflfield.alignment"])
    results.table(f"{options.texels} texels of each mixture, noise {options.noise:g}")
    warm = mixture(SETS["two similar"], 8, 0.0, np.random.default_rng(0))
    align(warm[0], warm[1], warm[1], n_clusters=2)  # compile before the clock starts
    for name, materials in SETS.items() if options.texels else ():
        compare(name, materials, options, results)
    if options.large:
        large(options.large, options, results)
    print(results.write())


if __name__ == "__main__":
    main()
