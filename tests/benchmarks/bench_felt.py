"""A measured felt rotated by known rotations: error of the recovered frames, by margin.

    python tests/benchmarks/bench_felt.py --texels 1000 --tilt 60 --noise 0.02

Data: texel mean of the felt `felt05` of UBO2014 (Weinmann, Gall and Klein, ECCV 2014) on the
151 x 151 directions of the Bonn dome, found under REFLFIELD_DATA or ../shared/data. It is
turned through thin-plate splines of the logarithm of the reflectance, one in the view and
one in the light: smooth, exact at the measured directions, and unrelated to both the
harmonics and the bilinear nodes of the aligner. Beyond the last measured ring (75 degrees) the
reflectance is that of the ring. What a texel's own horizon hides is 0.

Prints errors after the harmonic search and after the refinement, with time and peak
memory. All frames of one target may be turned in common, so errors are given as found and less
the common turn that fits best.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from benchmarks.measuring import Results, spent
from scipy.interpolate import RBFInterpolator
from scipy.spatial.transform import Rotation

from reflfield.alignment import RefinementOptions, align
from reflfield.reproduction.measured_felt import Felt, read_felt


def leave_one_out(directions, reflectance):
    """Root mean square relative error of the spline at each direction left out of it."""
    errors = []
    for i in range(len(directions)):
        rest = np.arange(len(directions)) != i
        spline = RBFInterpolator(
            directions[rest], np.log(reflectance[:, rest]).T, kernel="thin_plate_spline"
        )
        errors.append(spline(directions[i : i + 1])[0] - np.log(reflectance[:, i]))
    return float(np.sqrt(np.mean(np.square(errors))))


def random_frames(rng, n, tilt):
    """Frames with tilts uniform in angle up to `tilt`, any azimuth, any turn."""
    azimuth, turn = rng.uniform(0, 2 * np.pi, (2, n))
    angles = np.stack([azimuth, rng.uniform(0, tilt, n), turn - azimuth], axis=1)
    return np.swapaxes(Rotation.from_euler("ZYZ", angles).as_matrix(), 1, 2)


def frame_errors(recovered, truth):
    """Angles between normals, and turns about the normal that are left, degrees."""
    between = recovered @ np.swapaxes(truth, 1, 2)
    normal = np.arctan2(np.hypot(between[:, 0, 2], between[:, 1, 2]), between[:, 2, 2])
    turn = np.arctan2(between[:, 0, 1] - between[:, 1, 0], between[:, 0, 0] + between[:, 1, 1])
    return np.rad2deg(normal), np.rad2deg(np.abs(turn))


def without_common_turn(recovered, truth):
    """Found frames less the turn of all that brings them closest to the truth (robustly)."""
    turn = np.eye(3)
    for _ in range(20):
        between = np.einsum("ij,njk,nlk->nil", turn, recovered, truth)
        angle = Rotation.from_matrix(between).magnitude()
        weights = 1.0 / np.maximum(angle, np.deg2rad(0.2))
        total = np.einsum("n,nij,nkj->ik", weights, truth, recovered)
        u, _, vt = np.linalg.svd(total)
        turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return turn @ recovered


def mean_normal_error(truth):
    """Angle between the normal and the mean base normal, both seen in the frames, degrees.

    What is recovered from the mean of turned copies alone cannot be expected to be closer.
    """
    mean = truth[:, :, 2].mean(axis=0)
    return np.rad2deg(np.arctan2(np.hypot(mean[0], mean[1]), mean[2]))


def report(name, cost, result, truth, results):
    """One stage: errors, and the errors by margin."""
    results.table(f"Frames after the {name} stage, degrees")
    for label, frames in (
        ("as found", result.local_from_base),
        ("less the common turn", without_common_turn(result.local_from_base, truth)),
    ):
        normal, turn = frame_errors(frames, truth)
        print(
            f"{name:9s} {cost['CPU time, s']:6.1f} s  {label:21s} degrees: normal median "
            f"{np.median(normal):.2f} mean {normal.mean():.2f} 95 % "
            f"{np.percentile(normal, 95):.2f}   turn median {np.median(turn):.2f} 95 % "
            f"{np.percentile(turn, 95):.2f}"
        )
        results.add({"frames": label} | columns(normal, turn) | cost)
    print(f"          symmetry {result.symmetries[0]}; errors by margin:")
    print("          margin              texels  normal median   95 %   turn median   95 %")
    edges = np.quantile(result.margin, [0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0])
    for low, high in itertools.pairwise(edges):
        mine = (result.margin >= low) & (result.margin <= high)
        print(
            f"          {low:.5f} - {high:.5f} {mine.sum():7d} {np.median(normal[mine]):12.2f}"
            f" {np.percentile(normal[mine], 95):8.2f} {np.median(turn[mine]):11.2f}"
            f" {np.percentile(turn[mine], 95):8.2f}"
        )
        results.add(
            {"frames": f"margin {low:.5f} to {high:.5f}"}
            | columns(normal[mine], turn[mine])
            | {"texels": int(mine.sum())}
        )


def columns(normal, turn):
    """Cells of some texels' errors."""
    return {
        "normal, median": np.median(normal),
        "95 %": np.percentile(normal, 95),
        "turn, median": np.median(turn),
        "turn, 95 %": np.percentile(turn, 95),
    }


def main() -> None:
    """Print the errors of both stages."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--texels", type=int, default=1000)
    parser.add_argument("--tilt", type=float, default=60.0, help="largest, degrees")
    parser.add_argument("--noise", type=float, default=0.02, help="share of the deviation")
    parser.add_argument("--rounds", type=int, default=RefinementOptions().rounds)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    root = Path(os.environ.get("REFLFIELD_DATA", "../shared/data")) / "ubo2014_felt05"
    if not root.exists():
        raise SystemExit(f"{root} not found: set REFLFIELD_DATA to the folder of the test data")
    directions, reflectance = read_felt(root)
    results = Results("felt", "Known rotations of a measured felt", ["reflfield.alignment"])
    print(
        f"spline at a direction left out: {100 * leave_one_out(directions, reflectance):.1f} %"
    )
    rng = np.random.default_rng(5)
    truth = random_frames(rng, options.texels, np.deg2rad(options.tilt))
    off = mean_normal_error(truth)
    print(f"mean normal of the true frames, by chance: {off:.2f} degrees off")
    local = np.einsum("nij,kj->nki", truth, directions)
    felt = Felt(directions, reflectance)
    blocks = np.array_split(np.arange(options.texels), max(1, options.texels // 64))
    samples = np.concatenate([felt.samples(local[rows], local[rows]) for rows in blocks])
    samples += options.noise * samples.std() * rng.standard_normal(samples.shape, np.float32)
    align(samples[:2], directions, directions)  # compile before the clock starts
    held = {"of which samples": round(samples.nbytes / 2**30, 3)}
    for name, refine in (
        ("harmonic", False),
        ("refined", RefinementOptions(rounds=options.rounds)),
    ):
        result, cost = spent(
            lambda how=refine: align(
                samples, directions, directions, refine=how, n_threads=options.threads
            )
        )
        report(name, cost | held, result, truth, results)
        print(f"          peak memory {cost['peak memory, GB']:.2f} GB, {held}")
    print(results.write())


if __name__ == "__main__":
    main()
