r"""Gauss-Newton steps of a texel's frame and brightness on its own samples.

The weighted squares of :math:`y - s T c` are minimised over the frame and log s; samples below
either horizon of the frame are left out. A Gaussian prior may hold each frame to one that is
known: with :math:`\omega` the rotation between them, :math:`v |\omega|^2 / \text{spread}^2` is
added to the squares, :math:`v` being the texel's weighted squared residual per sample.
Rotations are active and act from the left: ``exp(w) @ local_from_base``.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.rotation_steps import copy_matrix, rotate_right, scale_vector
from reflfield.alignment.spline_targets import (
    FAST,
    Placement,
    Texels,
    blend_view,
    empty_placement,
    place,
    value_at,
)
from reflfield.util.cholesky import cholesky_factor

LONGEST_STEP = np.deg2rad(4.0)
SHORT_STEP = np.deg2rad(0.01)
DAMPING = 1e-4


class FramePrior(NamedTuple):
    """Frames (n, 3, 3) that a Gaussian prior holds to, and its spread in radians."""

    frames: NDArray[np.float64]
    spread: float


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _add_row(
    row: NDArray[np.float32],
    lines: NDArray[np.float32],
    view_slopes: NDArray[np.float32],
    lights: Placement,
    scale_and_floor: tuple[float, float],
    normal: NDArray[np.float64],
) -> None:
    """Add one view's samples to the normal equations of (w, log s), cost and weight."""
    jacobian = np.zeros(5)
    scale, floor = scale_and_floor
    side = lights.side
    for k in range(row.shape[0]):
        value, first = row[k], lights.first[k]
        if first < 0 or not np.isfinite(value):
            continue
        taps, light_slopes = lights.taps[k], lights.slopes[k]
        u, du, v, dv = taps[0], taps[1], taps[2], taps[3]
        expected = value_at(lines[0], first, side, u, v)
        view_u = value_at(lines[1], first, side, u, v)
        view_v = value_at(lines[2], first, side, u, v)
        light_u = value_at(lines[0], first, side, du, v)
        light_v = value_at(lines[0], first, side, u, dv)
        for n in range(3):
            jacobian[n] = scale * (
                view_u * view_slopes[n]
                + view_v * view_slopes[3 + n]
                + light_u * light_slopes[n]
                + light_v * light_slopes[3 + n]
            )
        jacobian[3] = scale * expected
        jacobian[4] = value - scale * expected
        weight = 1.0 / (floor + abs(value))
        for n in range(5):
            for m in range(n + 1):
                normal[n, m] += weight * jacobian[n] * jacobian[m]
        # The otherwise unused upper triangle: sum of weights, and count.
        normal[0, 4] += weight
        normal[1, 4] += 1.0


@numba.njit(cache=True, nogil=True)
def _add_views(
    samples: NDArray[np.float32],
    target: NDArray[np.float32],
    placements: tuple[Placement, Placement],
    scale_and_floor: tuple[float, float],
    lines: NDArray[np.float32],
    normal: NDArray[np.float64],
) -> None:
    """Add one texel's samples to its normal equations; `lines` is scratch."""
    views, lights = placements
    for v in range(samples.shape[0]):
        if views.first[v] >= 0:
            blend_view(target, views.first[v], views.side, views.taps[v], lines)
            _add_row(samples[v], lines, views.slopes[v], lights, scale_and_floor, normal)


@numba.njit(cache=True, nogil=True)
def hold(
    frame: NDArray[np.float64],
    start: NDArray[np.float64],
    strength: float,
    normal: NDArray[np.float64],
) -> None:
    """Add the prior on the rotation from `start` to `frame` to the normal equations."""
    away = np.zeros(3)
    for k in range(3):
        # Rotations of a few degrees: their vector is the skew part of frame @ start^T.
        a, b = (k + 1) % 3, (k + 2) % 3
        for c in range(3):
            away[k] += 0.5 * (frame[b, c] * start[a, c] - frame[a, c] * start[b, c])
        normal[k, k] += strength
        normal[4, k] -= strength * away[k]
        normal[4, 4] += strength * away[k] * away[k]


@numba.njit(cache=True, nogil=True)
def solve_step(normal: NDArray[np.float64], step: NDArray[np.float64]) -> bool:
    """Damped solution of the 4x4 normal equations, limited in length; False if singular."""
    largest = max(normal[0, 0], normal[1, 1], normal[2, 2])
    if not (largest > 0.0 and normal[3, 3] > 0.0):
        return False
    for n in range(3):
        normal[n, n] += DAMPING * largest
    normal[3, 3] *= 1.0 + DAMPING
    # Row 4, the right side, is carried along.
    if not cholesky_factor(normal, 4):
        return False
    for n in range(3, -1, -1):
        step[n] = normal[4, n]
        for m in range(n + 1, 4):
            step[n] -= normal[m, n] * step[m]
        step[n] /= normal[n, n]
    length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    if length > LONGEST_STEP:
        scale_vector(step, 3, LONGEST_STEP / length)
    step[3] = min(max(step[3], -0.5), 0.5)
    return bool(np.isfinite(length))


@numba.njit(cache=True, nogil=True)
def rotate_left(
    frame: NDArray[np.float64],
    w: NDArray[np.float64],
    scratch: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """``exp(w) @ frame``; `scratch` is (3, 3)."""
    for k in range(9):
        out[k // 3, k % 3] = 1.0 if k % 4 == 0 else 0.0
    rotate_right(out, w, scratch)
    for r in range(3):
        for c in range(3):
            out[r, c] = scratch[r, 0] * frame[0, c] + scratch[r, 1] * frame[1, c]
            out[r, c] += scratch[r, 2] * frame[2, c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def improve(
    texels: Texels, target: NDArray[np.float32], prior: FramePrior, n_steps: int
) -> None:
    """Gauss-Newton steps of frames and brightness of some texels, in place.

    The prior weighs against the samples by their weighted squared residual at first, over
    the samples less the four unknowns.
    """
    n_views, n_lights = texels.samples.shape[1:]
    views = empty_placement(n_views, texels.sides[0])
    lights = empty_placement(n_lights, texels.sides[1])
    frames, brightness = texels.frames, texels.brightness
    lines = np.zeros((3, target.shape[1]), np.float32)
    normal, step, scratch = np.zeros((5, 5)), np.zeros(4), np.zeros((3, 3))
    frame, scale_factor = np.zeros((3, 3)), 1.0
    for i in range(texels.samples.shape[0]):
        if brightness[i] <= 0.0:
            continue
        floor, least, strength = texels.floor * brightness[i], np.inf, 0.0
        copy_matrix(frames[i], frame)
        for n in range(n_steps + 1):
            normal[:] = 0.0
            scale = brightness[i] * scale_factor if n > 0 else brightness[i]
            place(texels.views[i % len(texels.views)], frame, views)
            place(texels.lights[i % len(texels.lights)], frame, lights)
            levels = (scale, floor)
            _add_views(texels.samples[i], target, (views, lights), levels, lines, normal)
            if n == 0:
                strength = normal[4, 4] / max(normal[1, 4] - 4.0, 1.0) / prior.spread**2
            hold(frame, prior.frames[i], strength, normal)
            cost = normal[4, 4] / max(normal[0, 4], 1e-300)
            if cost < least:
                least = cost
                copy_matrix(frame, frames[i])
                brightness[i] = scale
                if not solve_step(normal, step):
                    break
            else:
                scale_vector(step, 4, 0.25)
            rotate_left(frames[i], step, scratch, frame)
            scale_factor = np.exp(step[3])
            if max(abs(step[0]), abs(step[1]), abs(step[2])) < SHORT_STEP:
                # Too short to be worth an evaluation, but free to take.
                copy_matrix(frame, frames[i])
                break
