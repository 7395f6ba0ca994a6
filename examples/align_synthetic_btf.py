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

from reflfield.alignment import align
from reflfield.sphere.hemisphere import HemisphereGrid
from reflfield.sphere.rotations import frames_from_normals

RINGS = ((0, 1), (17, 8), (34, 16), (51, 24), (68, 32))  # polar angle in degrees, count


def dome():
    """The 81 directions."""
    parts = []
    for polar, count in RINGS:
        azimuth = 2 * np.pi * (np.arange(count) + 0.5 * (polar % 2)) / count
        theta = np.full(count, np.deg2rad(polar))
        ring = [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)]
        parts.append(np.stack(ring, axis=1))
    return np.concatenate(parts)


def relief(width=124, height=90, slope=0.6):
    """Frames of a raised ring and a bar on a plane."""
    x, y = np.meshgrid(np.linspace(-1.4, 1.4, width), np.linspace(-1.0, 1.0, height))
    radius = np.hypot(x, y)
    edge = np.exp(-(((radius - 0.7) / 0.12) ** 2)) - np.exp(-(((radius - 0.35) / 0.1) ** 2))
    bar = np.exp(-((y / 0.08) ** 2)) * np.exp(-((x / 0.9) ** 4))
    bar *= np.sign(y) * np.minimum(1, np.abs(y) / 0.04)
    gx = slope * edge * x / (radius + 1e-3)
    gy = slope * (edge * y / (radius + 1e-3) + 0.7 * bar)
    normal = np.stack([gx, gy, np.ones_like(gx)], axis=-1).reshape(-1, 3)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    angle = (0.6 * np.cos(3 * x) * np.cos(2.5 * y)).ravel()
    hint = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    return frames_from_normals(normal, hint)


def material(view, light, nu=8.0, nv=60.0, diffuse=0.2, specular=0.1):
    """Reflectance times cosine of local directions, 0 below the horizon."""
    half = view[:, :, None, :] + light[:, None, :, :]
    half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-12)
    nl, nw = light[:, None, :, 2], view[:, :, None, 2]
    hk = np.maximum(np.sum(half * view[:, :, None, :], axis=-1), 1e-6)
    hz = np.clip(half[..., 2], 0.0, 1.0)
    power = (nu * half[..., 0] ** 2 + nv * half[..., 1] ** 2) / np.maximum(1 - hz**2, 1e-12)
    fresnel = specular + (1 - specular) * (1 - hk) ** 5
    lobe = np.sqrt((nu + 1) * (nv + 1)) / (8 * np.pi) * hz**power
    gloss = lobe * fresnel / (hk * np.maximum(np.maximum(nl, nw), 1e-3))
    base = 28 * diffuse / (23 * np.pi) * (1 - specular)
    base = base * (1 - (1 - nl / 2) ** 5) * (1 - (1 - nw / 2) ** 5)
    return np.where((nl > 0) & (nw > 0), (base + gloss) * nl, 0.0)


def render(frames, directions, block=128):
    """(n, 81, 81) samples of texels with the given frames."""
    parts = []
    for first in range(0, len(frames), block):
        local = np.einsum("nij,vj->nvi", frames[first : first + block], directions)
        parts.append(material(local, local).astype(np.float32))
    return np.concatenate(parts)


def errors(found, truth):
    """Angles of normals and of tangents (axes, up to their common turn), degrees."""
    sign = np.sign(np.sum(found[:, 0] * truth[:, 0], axis=1))
    folded = found * np.stack([sign, sign, np.ones_like(sign)], axis=1)[:, :, None]
    # The mean tangent is a convention: the base frame's for `align`, the map's for the truth.
    turn = np.einsum("nij,nkj->ik", truth, folded)
    angle = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    about = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    folded = about @ folded
    chord = np.linalg.norm(folded[:, 2] - truth[:, 2], axis=1)
    flat = folded[:, 0] - np.sum(folded[:, 0] * truth[:, 2], axis=1)[:, None] * truth[:, 2]
    cosine = np.sum(flat * truth[:, 0], axis=1) / np.linalg.norm(flat, axis=1)
    return (
        np.rad2deg(2 * np.arcsin(np.clip(chord / 2, 0, 1))),
        np.rad2deg(np.arccos(np.clip(cosine, -1, 1))),
    )


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
    return material(local, local).astype(np.float32)


def main() -> None:
    """Print the errors of both stages and the gain for compression."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--texels", type=int, default=2000, help="of 11,160")
    parser.add_argument("--noise", type=float, default=0.0, help="share of the deviation")
    parser.add_argument("--unobserved", type=float, default=0.0, help="share of the samples")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    frames = relief()
    if options.texels < len(frames):
        frames = frames[np.sort(rng.choice(len(frames), options.texels, replace=False))]
    directions = dome()
    samples = render(frames, directions)
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
        normals, tangents = errors(result.local_from_base, frames)
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
