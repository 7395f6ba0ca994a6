"""The synthetic scene of the paper's section 5.1, rebuilt: frames, directions, samples.

A raised ring and bars on a plane, tangents modulated by cosines, one anisotropic
material (M. Ashikhmin, P. Shirley, "An anisotropic Phong BRDF model", 2000). The tests of
the alignment and its benchmarks use it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from reflfield.sphere.rotations import frames_from_normals

Array = NDArray[np.float64]

# Of samples that are computed together.
TEXELS_AT_ONCE = 128
RINGS_81 = ((0, 1), (17, 8), (34, 16), (51, 24), (68, 32))
# Of the dome that the paper's measurements come from, without the offsets of its rings.
RINGS_151 = (
    (0, 1), (11, 6), (23.5, 12), (30, 12), (37.5, 12),
    (45, 18), (52.5, 18), (60, 24), (67.5, 24), (75, 24),
)  # fmt: skip


def dome_directions(rings: tuple[tuple[float, int], ...] = RINGS_81) -> Array:
    """Directions of a dome: polar angle in degrees and count of each ring."""
    parts = []
    for polar, count in rings:
        azimuth = 2 * np.pi * (np.arange(count) + 0.5 * (polar % 2)) / count
        theta = np.full(count, np.deg2rad(polar))
        parts.append(
            np.stack(
                [
                    np.sin(theta) * np.cos(azimuth),
                    np.sin(theta) * np.sin(azimuth),
                    np.cos(theta),
                ],
                axis=1,
            )
        )
    return np.concatenate(parts)


def relief_frames(width: int = 124, height: int = 90, slope: float = 0.6) -> Array:
    """Frames (n, 3, 3) of a raised ring with soft edges and cosine-modulated tangents."""
    x, y = np.meshgrid(np.linspace(-1.4, 1.4, width), np.linspace(-1.0, 1.0, height))
    radius = np.hypot(x, y)
    edge = np.exp(-(((radius - 0.7) / 0.12) ** 2)) - np.exp(-(((radius - 0.35) / 0.1) ** 2))
    bars = (
        np.exp(-((y / 0.08) ** 2))
        * np.exp(-((x / 0.9) ** 4))
        * np.sign(y)
        * np.minimum(1, np.abs(y) / 0.04)
    )
    gx, gy = (
        slope * edge * x / (radius + 1e-3),
        slope * (edge * y / (radius + 1e-3) + 0.7 * bars),
    )
    normal = np.stack([gx, gy, np.ones_like(gx)], axis=-1).reshape(-1, 3)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    angle = (0.6 * np.cos(3 * x) * np.cos(2.5 * y)).ravel()
    hint = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    return frames_from_normals(normal, hint)


def ashikhmin_shirley(
    view: Array,
    light: Array,
    nu: float = 8.0,
    nv: float = 60.0,
    diffuse: float = 0.2,
    specular: float = 0.1,
) -> Array:
    """Reflectance times cosine of local directions; 0 below the horizon."""
    half = view[..., :, None, :] + light[..., None, :, :]
    half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-12)
    nl, nv_ = light[..., None, :, 2], view[..., :, None, 2]
    hk = np.maximum(np.sum(half * view[..., :, None, :], axis=-1), 1e-6)
    hz = np.clip(half[..., 2], 0.0, 1.0)
    power = (nu * half[..., 0] ** 2 + nv * half[..., 1] ** 2) / np.maximum(1.0 - hz**2, 1e-12)
    fresnel = specular + (1 - specular) * (1 - hk) ** 5
    lobe = np.sqrt((nu + 1) * (nv + 1)) / (8 * np.pi) * hz**power
    gloss = lobe * fresnel / (hk * np.maximum(np.maximum(nl, nv_), 1e-3))
    matt = 28 * diffuse / (23 * np.pi) * (1 - specular)
    base = matt * (1 - (1 - nl / 2) ** 5) * (1 - (1 - nv_ / 2) ** 5)
    return np.where((nl > 0) & (nv_ > 0), (base + gloss) * nl, 0.0)


def sample_texels(
    frames: Array, views: Array, lights: Array, **material: float
) -> NDArray[np.float32]:
    """(n, n_views, n_lights) float32 samples of texels with the given frames."""
    parts = []
    for first in range(0, len(frames), TEXELS_AT_ONCE):
        part = frames[first : first + TEXELS_AT_ONCE]
        parts.append(
            ashikhmin_shirley(
                np.einsum("nij,vj->nvi", part, views),
                np.einsum("nij,lj->nli", part, lights),
                **material,
            ).astype(np.float32)
        )
    return np.concatenate(parts)


def with_the_truths_tangents(recovered: Array, truth: Array) -> Array:
    """Recovered frames, all turned alike about their normals so that tangents agree on average.

    Data determine the mean tangent of a material only up to such a turn, and this
    anisotropic one every tangent only up to a half turn.
    """
    sign = np.sign(np.sum(recovered[:, 0] * truth[:, 0], axis=1))
    folded = recovered * np.stack([sign, sign, np.ones_like(sign)], axis=1)[:, :, None]
    turn = np.einsum("nij,nkj->ik", truth, folded)
    angle = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ folded


def frame_errors(recovered: Array, truth: Array, half_turn: bool = True) -> tuple[Array, Array]:
    """Angles between normals and between tangents (as axes if `half_turn`), degrees."""
    normal = np.sum(recovered[:, 2] * truth[:, 2], axis=1)
    # Both tangents are compared in the plane of the true normal.
    t = recovered[:, 0] - np.sum(recovered[:, 0] * truth[:, 2], axis=1)[:, None] * truth[:, 2]
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    tangent = np.sum(t * truth[:, 0], axis=1)
    tangent = np.abs(tangent) if half_turn else tangent
    chord = np.linalg.norm(recovered[:, 2] - truth[:, 2], axis=1)
    normal_angle = np.where(
        normal > 0.9, 2 * np.arcsin(np.minimum(chord / 2, 1)), np.arccos(normal.clip(-1, 1))
    )
    return np.rad2deg(normal_angle), np.rad2deg(np.arccos(np.clip(tangent, -1, 1)))
