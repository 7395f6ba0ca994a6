"""Local frames of a BTF's texels from its reflectance alone, with part of it not measured.

    python examples/align_samples.py [--texels 400] [--unobserved 0.3]

Stands in for a measured BTF: texels of brushed metal, tilted and turned each its own way, seen
from 49 directions under 49 lights, with some of the samples missing. They are completed, one
column a texel, then aligned. Prints how far the normals are off.
"""

from __future__ import annotations

import argparse

import numpy as np

import reflfield as rf


def directions(rings: int = 4) -> np.ndarray:
    """Unit vectors over the hemisphere: one at the zenith, then 8, 16, .. on each ring."""
    polar = np.concatenate([np.full(max(8 * k, 1), 22.0 * k) for k in range(rings)])
    azimuth = np.concatenate([2 * np.pi * np.arange(max(8 * k, 1)) / max(8 * k, 1)
                              for k in range(rings)])  # fmt: skip
    theta = np.radians(polar)
    return np.stack(
        [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)], 1
    )


def frames(n: int, rng: np.random.Generator) -> np.ndarray:
    """(n, 3, 3): rows tangent, binormal, normal, tilted by 15 degrees at most."""
    normal = np.column_stack([rng.uniform(-0.18, 0.18, (n, 2)), np.ones(n)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    angle = rng.uniform(-0.6, 0.6, n)
    binormal = np.cross(normal, np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)]))
    binormal /= np.linalg.norm(binormal, axis=1, keepdims=True)
    return np.stack([np.cross(binormal, normal), binormal, normal], axis=1)


def brushed_metal(local_from_base: np.ndarray, rig: np.ndarray) -> np.ndarray:
    """(n, n_views, n_lights) apparent BRDF: a lobe wider across the tangent than along it."""
    local = rig @ local_from_base.swapaxes(1, 2)
    view, light = local[:, :, None], local[:, None, :]
    half = view + light
    slope = half[..., :2] / half[..., 2:]
    lobe = np.exp(-0.5 * (slope / [0.15, 0.5]) ** 2).prod(axis=-1)
    above = (view[..., 2] > 0) & (light[..., 2] > 0)
    return np.where(above, (0.1 + lobe) * light[..., 2], 0.0).astype(np.float32)


def main() -> None:
    """Simulate, complete, align, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--texels", type=int, default=400)
    parser.add_argument("--unobserved", type=float, default=0.3, help="share of the samples")
    arguments = parser.parse_args()
    rng = np.random.default_rng(1)
    rig, truth = directions(), frames(arguments.texels, rng)
    samples = brushed_metal(truth, rig)
    samples[rng.random(samples.shape) < arguments.unobserved] = np.nan

    fit = rf.complete(samples.reshape(len(samples), -1).T, rank=24)
    completed = (fit.mean + fit.coefficients @ fit.basis.T).reshape(samples.shape)
    alignment = rf.align(completed, rig, rig, band_limit=6)
    cosine = np.einsum("nd,nd->n", alignment.local_from_base[:, 2], truth[:, 2])
    base = np.degrees(np.arccos(truth[:, 2, 2]))
    error = np.degrees(np.arccos(cosine.clip(-1, 1)))
    print(f"{len(samples)} texels, {arguments.unobserved:.0%} of the samples not measured")
    print(
        f"normals off by {np.mean(error):.2f} degrees on average; unaligned {base.mean():.2f}"
    )


if __name__ == "__main__":
    main()
