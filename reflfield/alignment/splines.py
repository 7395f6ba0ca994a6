r"""Sharp targets: functions of view and light as products of cubic B-splines.

Each direction (x, y, z) of the upper hemisphere is placed on a square by Lambert's
equal-area map,

.. math:: (u, v) = (x, y) / \sqrt{1 + z},

which is smooth everywhere, the horizon being the unit circle; four uniform cubic B-splines
an axis make 16 taps a direction and 256 a sample. With 10 degrees between nodes this follows
lobes for which bilinear interpolation needs nodes four times as dense, so that
every node is determined by many texels, and none can hold on to its own wrong frame.

The target of a cluster minimises the weighted squares of :math:`y_i - s_i T_i c` over the
samples of all its texels, :math:`T_i` interpolating at the sample directions in the frame of
texel i and :math:`s_i` being its brightness, by conjugate gradients preconditioned with
:math:`\sum_i s_i^2 T_i^\top w_i`, where :math:`w = 1 / (\mathrm{floor} + |y|)`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.sphere.hemisphere import LOWEST_Z

# Reordering of sums only: samples may be NaN, which full fast mathematics assumes away.
FAST = {"reassoc", "contract", "nsz", "arcp"}


@dataclass(frozen=True, eq=False)
class NodeTargets:
    """Sharp targets of all clusters by the coefficients of their splines.

    Parameters
    ----------
    values : (n_clusters, view_side**2, light_side**2) float32
    view_side, light_side : int
        Nodes along each side of the square, one beyond the circle at each end; 1: that
        direction does not vary.
    """

    values: NDArray[np.float32]
    view_side: int
    light_side: int

    @property
    def sides(self) -> tuple[int, int]:
        """Of view and light."""
        return self.view_side, self.light_side


@numba.njit(cache=True, nogil=True)
def _taps(position: float, weights: NDArray[np.float32], slopes: NDArray[np.float32]) -> int:
    """First of four nodes, B-splines there and their derivatives per node."""
    first = math.floor(position) - 1
    t = position - math.floor(position)
    r = 1.0 - t
    weights[0], weights[3] = r * r * r / 6.0, t * t * t / 6.0
    weights[1] = 2.0 / 3.0 - t * t * (1.0 - 0.5 * t)
    weights[2] = 2.0 / 3.0 - r * r * (1.0 - 0.5 * r)
    slopes[0], slopes[3] = -0.5 * r * r, 0.5 * t * t
    slopes[1], slopes[2] = t * (1.5 * t - 2.0), r * (2.0 - 1.5 * r)
    return first


@numba.njit(cache=True, nogil=True)
def place(
    directions: NDArray[np.float64],
    frame: NDArray[np.float64],
    side: int,
    first: NDArray[np.int64],
    taps: NDArray[np.float32],
    turns: NDArray[np.float32],
) -> None:
    """Taps of directions in a frame, and how turning the frame's content moves them.

    `first` (k,) receives the first node, -1 below the horizon; `taps` (k, 4, 4) weights and
    slopes along u, then along v; `turns` (k, 6) the derivatives of u, then of v, in
    nodes per radian about the three axes.
    """
    scale = 0.5 * (side - 3)
    for i in range(directions.shape[0]):
        d0, d1, d2 = directions[i, 0], directions[i, 1], directions[i, 2]
        x = frame[0, 0] * d0 + frame[0, 1] * d1 + frame[0, 2] * d2
        y = frame[1, 0] * d0 + frame[1, 1] * d1 + frame[1, 2] * d2
        z = frame[2, 0] * d0 + frame[2, 1] * d1 + frame[2, 2] * d2
        if side == 1:
            first[i] = 0
            turns[i] = 0.0
            taps[i] = 0.0
            taps[i, 0, 0] = taps[i, 2, 0] = 1.0
            continue
        if z < LOWEST_Z:
            first[i] = -1
            continue
        shrink = 1.0 / np.sqrt(1.0 + z)
        column = _taps(1.0 + scale * (1.0 + x * shrink), taps[i, 0], taps[i, 1])
        row = _taps(1.0 + scale * (1.0 + y * shrink), taps[i, 2], taps[i, 3])
        first[i] = row * side + column
        # Turning by w moves d by w x d; of 1 / sqrt(1 + z) the derivative is `bend`.
        bend = -0.5 * shrink / (1.0 + z)
        turns[i, 0] = scale * x * bend * y
        turns[i, 1] = scale * (z * shrink - x * bend * x)
        turns[i, 2] = -scale * y * shrink
        turns[i, 3] = scale * (y * bend * y - z * shrink)
        turns[i, 4] = -scale * y * bend * x
        turns[i, 5] = scale * x * shrink


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def blend_view(
    nodes: NDArray[np.float32],
    first: int,
    side: int,
    taps: NDArray[np.float32],
    lines: NDArray[np.float32],
) -> None:
    """Light nodes of the target at one view: value and derivatives along u and v."""
    lines[:] = 0.0
    n, count = nodes.shape[1], 4 if side > 1 else 1
    value, along, across = lines[0], lines[1], lines[2]
    for a in range(count):
        for b in range(count):
            row = nodes[first + a * side + b]
            w, s, t = taps[2, a] * taps[0, b], taps[2, a] * taps[1, b], taps[3, a] * taps[0, b]
            for k in range(n):
                value[k] += w * row[k]
                along[k] += s * row[k]
                across[k] += t * row[k]


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def blend_value(
    nodes: NDArray[np.float32],
    first: int,
    side: int,
    taps: NDArray[np.float32],
    line: NDArray[np.float32],
) -> None:
    """Light nodes of the target at one view."""
    line[:] = 0.0
    count = 4 if side > 1 else 1
    for a in range(count):
        for b in range(count):
            row, w = nodes[first + a * side + b], taps[2, a] * taps[0, b]
            for k in range(nodes.shape[1]):
                line[k] += w * row[k]


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def value_at(
    line: NDArray[np.float32],
    first: int,
    side: int,
    u: NDArray[np.float32],
    v: NDArray[np.float32],
) -> np.float32:
    """Blend of the light nodes with weights u and v."""
    if side == 1:
        return np.float32(line[0] * u[0] * v[0])
    total = np.float32(0.0)
    for a in range(4):
        row = line[first + a * side : first + a * side + 4]
        total += v[a] * (u[0] * row[0] + u[1] * row[1] + u[2] * row[2] + u[3] * row[3])
    return np.float32(total)


@numba.njit(cache=True, nogil=True)
def _gather_row(
    row: NDArray[np.float32],
    line: NDArray[np.float32],
    scale: float,
    floor: float,
    with_samples: bool,
    first: NDArray[np.int64],
    taps: NDArray[np.float32],
    side: int,
    out: NDArray[np.float32],
    touch: NDArray[np.float32],
) -> None:
    """Scatter one view's weighted residuals, and weights, to the light nodes."""
    out[:] = 0.0
    touch[:] = 0.0
    count = 4 if side > 1 else 1
    for k in range(row.shape[0]):
        value = row[k]
        if first[k] < 0 or not np.isfinite(value):
            continue
        u, v = taps[k, 0], taps[k, 2]
        rest = -scale * value_at(line, first[k], side, u, v)
        weight = scale / (floor + abs(value))
        if with_samples:
            rest += value
        push, power = np.float32(weight * rest), np.float32(weight * scale)
        for a in range(count):
            start = first[k] + a * side
            part, hit = out[start : start + count], touch[start : start + count]
            p, q = v[a] * push, v[a] * power
            for b in range(count):
                part[b] += p * u[b]
            if with_samples:
                for b in range(count):
                    hit[b] += q * u[b]


@numba.njit(cache=True, nogil=True)
def _spread_view(
    out: NDArray[np.float32],
    first: int,
    side: int,
    taps: NDArray[np.float32],
    sums: NDArray[np.float64],
) -> None:
    """Add values on the light nodes to the view nodes that made them."""
    count = 4 if side > 1 else 1
    for a in range(count):
        for b in range(count):
            w, into = taps[2, a] * taps[0, b], sums[first + a * side + b]
            for k in range(out.shape[0]):
                into[k] += w * out[k]


@numba.njit(cache=True, nogil=True)
def back_project(
    samples: NDArray[np.float32],
    views: NDArray[np.float64],
    lights: NDArray[np.float64],
    frames: NDArray[np.float64],
    brightness: NDArray[np.float64],
    values: NDArray[np.float32],
    sides: tuple[int, int],
    relative_floor: float,
    with_samples: bool,
    sums: NDArray[np.float64],
    touched: NDArray[np.float64],
) -> None:
    """Add sum_i s_i T_i^T w_i (y_i - s_i T_i c) to `sums`, and s_i^2 T_i^T w_i to `touched`.

    Without samples y counts as 0 where it is observed, and `touched` is left alone.
    """
    n_views, n_lights = samples.shape[1:]
    v_first, l_first = np.zeros(n_views, np.int64), np.zeros(n_lights, np.int64)
    v_taps = np.zeros((n_views, 4, 4), np.float32)
    l_taps = np.zeros((n_lights, 4, 4), np.float32)
    v_turns = np.zeros((n_views, 6), np.float32)
    l_turns = np.zeros((n_lights, 6), np.float32)
    line = np.zeros(values.shape[1], np.float32)
    out, touch = np.zeros_like(line), np.zeros_like(line)
    for i in range(samples.shape[0]):
        if brightness[i] <= 0.0:
            continue
        place(views[i % len(views)], frames[i], sides[0], v_first, v_taps, v_turns)
        place(lights[i % len(lights)], frames[i], sides[1], l_first, l_taps, l_turns)
        floor = relative_floor * brightness[i]
        for v in range(n_views):
            if v_first[v] < 0:
                continue
            blend_value(values, v_first[v], sides[0], v_taps[v], line)
            _gather_row(
                samples[i, v],
                line,
                brightness[i],
                floor,
                with_samples,
                l_first,
                l_taps,
                sides[1],
                out,
                touch,
            )
            _spread_view(out, v_first[v], sides[0], v_taps[v], sums)
            if with_samples:
                _spread_view(touch, v_first[v], sides[0], v_taps[v], touched)


@numba.njit(cache=True, nogil=True)
def expect(
    values: NDArray[np.float32],
    sides: tuple[int, int],
    first: tuple[NDArray[np.int64], NDArray[np.int64]],
    taps: tuple[NDArray[np.float32], NDArray[np.float32]],
    line: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Target at all pairs of directions of one texel, from `place`; NaN below a horizon."""
    for v in range(out.shape[0]):
        if first[0][v] < 0:
            out[v] = np.nan
            continue
        blend_value(values, first[0][v], sides[0], taps[0][v], line)
        for k in range(out.shape[1]):
            start = first[1][k]
            out[v, k] = np.nan
            if start >= 0:
                out[v, k] = value_at(line, start, sides[1], taps[1][k, 0], taps[1][k, 2])
