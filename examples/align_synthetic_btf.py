"""Frames of a synthetic BTF from its reflectance alone: section 5.1 of the paper.

A relief of 124 x 90 texels with cosine-modulated tangents and one anisotropic
material (Ashikhmin and Shirley, "An anisotropic Phong BRDF model", 2000) is seen from 81
directions under 81 lights. Prints errors of the recovered frames after the harmonic
search and after the refinement, and how many unaligned components equal two aligned ones.

    python examples/align_synthetic_btf.py --texels 2000 --noise 0.02 --unobserved 0.5
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from synthetic_btf import (
    ashikhmin_shirley,
    dome_directions,
    frame_errors,
    relief_frames,
    sample_texels,
    with_the_truths_tangents,
)

from reflfield.alignment import align
from reflfield.sphere.hemisphere import HemisphereGrid


def residual_energy(samples):
    """Share of the energy that each number of components leaves."""
    matrix = samples.reshape(len(samples), -1)
    values = np.linalg.eigvalsh((matrix @ matrix.T).astype(np.float64))[::-1].clip(0)
    return 1.0 - np.cumsum(values) / values.sum()


def in_own_frames(frames, local_from_base, side=9):
    """The texels' reflectance resampled at nodes of the recovered frames."""
    nodes = HemisphereGrid(side).directions
    inner = nodes[nodes[:, 2] > 0.3]
    base = np.einsum("nij,kj->nki", np.swapaxes(local_from_base, 1, 2), inner)
    local = np.einsum("nij,nkj->nki", frames, base)
    return ashikhmin_shirley(local, local).astype(np.float32)


def main() -> None:
    """Print the errors of both stages and the gain for compression."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--texels", type=int, default=2000, help="of 11,160")
    parser.add_argument("--noise", type=float, default=0.0, help="share of the deviation")
    parser.add_argument("--unobserved", type=float, default=0.0, help="share of the samples")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    frames = relief_frames()
    if options.texels < len(frames):
        frames = frames[np.sort(rng.choice(len(frames), options.texels, replace=False))]
    directions = dome_directions()
    samples = sample_texels(frames, directions, directions)
    samples += options.noise * samples.std() * rng.standard_normal(samples.shape, np.float32)
    samples[rng.random(samples.shape, np.float32) < options.unobserved] = np.nan
    # Compile the kernels before the clock starts.
    align(samples[:2], directions, directions)
    for refine in (False, True):
        start = time.perf_counter()
        result = align(
            samples, directions, directions, refine=refine, n_threads=options.threads
        )
        seconds = time.perf_counter() - start
        found = with_the_truths_tangents(result.local_from_base, frames)
        normals, tangents = frame_errors(found, frames)
        print(
            f"{'refined ' if refine else 'harmonic'}  {seconds:6.1f} s  degrees: "
            f"normals mean {normals.mean():.3f} median {np.median(normals):.3f} "
            f"95 % {np.percentile(normals, 95):.3f}  tangents mean {tangents.mean():.3f} "
            f"95 % {np.percentile(tangents, 95):.3f}"
        )
    some = slice(0, len(frames), max(1, len(frames) // 600))
    identity = np.tile(np.eye(3), (len(frames[some]), 1, 1))
    before = residual_energy(in_own_frames(frames[some], identity))
    after = residual_energy(in_own_frames(frames[some], result.local_from_base[some]))
    print(
        f"energy left by two aligned components {after[1]:.2e}; as many unaligned: "
        f"{int(np.argmax(before <= after[1])) + 1}"
    )


if __name__ == "__main__":
    main()
