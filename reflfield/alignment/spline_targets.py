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
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.sphere.hemisphere import LOWEST_Z

# Reordering of sums only: samples may be NaN, which full fast mathematics assumes away.
FAST = {"reassoc", "contract", "nsz", "arcp"}


@dataclass(frozen=True, eq=False)
class SplineTargets:
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

    @classmethod
    def zeros(cls, n_clusters: int, counts: tuple[int, ...], side: int) -> SplineTargets:
        """Empty targets for samples of so many views and lights."""
        view, light = (1 if count == 1 else side for count in counts)
        return cls(np.zeros((n_clusters, view**2, light**2), np.float32), view, light)

    @property
    def sides(self) -> tuple[int, int]:
        """Of view and light."""
        return self.view_side, self.light_side

    def of_cluster(self, k: int) -> SplineTargets:
        """Target of one cluster."""
        return self.replaced(self.values[k : k + 1])

    def replaced(self, values: NDArray[np.float32]) -> SplineTargets:
        """Other coefficients on the same nodes."""
        return SplineTargets(values, self.view_side, self.light_side)


class Texels(NamedTuple):
    """Samples of some texels as the kernels take them.

    Parameters
    ----------
    samples : (n, n_views, n_lights) float32
        Not finite where unobserved.
    views, lights : (1 or n, n_views, 3), (1 or n, n_lights, 3) float64
    frames : (n, 3, 3) float64
    brightness : (n,) float64
        Texels with 0 take no part.
    sides : (int, int)
        Of the target's nodes.
    floor : float
        See `RefinementOptions`.
    """

    samples: NDArray[np.float32]
    views: NDArray[np.float64]
    lights: NDArray[np.float64]
    frames: NDArray[np.float64]
    brightness: NDArray[np.float64]
    sides: tuple[int, int]
    floor: float


class Placement(NamedTuple):
    """Where directions fall on the nodes of a square.

    Parameters
    ----------
    side : int
    first : (k,) int64
        First node of each direction; -1 below the horizon.
    taps : (k, 4, 4) float32
        Weights and slopes along u, then along v.
    slopes : (k, 6) float32
        Derivatives of u, then of v, in nodes per radian of rotation about the three axes.
    """

    side: int
    first: NDArray[np.int64]
    taps: NDArray[np.float32]
    slopes: NDArray[np.float32]


@numba.njit(cache=True, nogil=True)
def empty_placement(n: int, side: int) -> Placement:
    """Arrays for the placement of n directions."""
    return Placement(
        side,
        np.zeros(n, np.int64),
        np.zeros((n, 4, 4), np.float32),
        np.zeros((n, 6), np.float32),
    )


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
def place(directions: NDArray[np.float64], frame: NDArray[np.float64], out: Placement) -> None:
    """Place directions (k, 3) in a frame (active rotation of its content in `slopes`)."""
    side, first, taps, slopes = out.side, out.first, out.taps, out.slopes
    scale = 0.5 * (side - 3)
    for i in range(directions.shape[0]):
        d0, d1, d2 = directions[i, 0], directions[i, 1], directions[i, 2]
        x = frame[0, 0] * d0 + frame[0, 1] * d1 + frame[0, 2] * d2
        y = frame[1, 0] * d0 + frame[1, 1] * d1 + frame[1, 2] * d2
        z = frame[2, 0] * d0 + frame[2, 1] * d1 + frame[2, 2] * d2
        if side == 1:
            first[i] = 0
            slopes[i] = 0.0
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
        # A rotation by w moves d by w x d; of 1 / sqrt(1 + z) the derivative is `bend`.
        bend = -0.5 * shrink / (1.0 + z)
        slopes[i, 0] = scale * x * bend * y
        slopes[i, 1] = scale * (z * shrink - x * bend * x)
        slopes[i, 2] = -scale * y * shrink
        slopes[i, 3] = scale * (y * bend * y - z * shrink)
        slopes[i, 4] = -scale * y * bend * x
        slopes[i, 5] = scale * x * shrink


@numba.njit(cache=True, nogil=True)
def place_texel(texels: Texels, i: int, views: Placement, lights: Placement) -> None:
    """Place the directions of one texel in its frame."""
    place(texels.views[i % len(texels.views)], texels.frames[i], views)
    place(texels.lights[i % len(texels.lights)], texels.frames[i], lights)


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
def scatter_row(row: NDArray[np.float32], lights: Placement, out: NDArray[np.float32]) -> None:
    """Adjoint of `value_at`: one view's values to the light nodes; NaN is left out."""
    out[:] = 0.0
    count = 4 if lights.side > 1 else 1
    for k in range(row.shape[0]):
        value, first = row[k], lights.first[k]
        if first < 0 or np.isnan(value):
            continue
        u, v = lights.taps[k, 0], lights.taps[k, 2]
        for a in range(count):
            start, p = first + a * lights.side, v[a] * value
            part = out[start : start + count]
            for b in range(count):
                part[b] += p * u[b]


@numba.njit(cache=True, nogil=True)
def scatter_view(
    out: NDArray[np.float32], views: Placement, v: int, sums: NDArray[np.float64]
) -> None:
    """Add values on the light nodes to the nodes of one view."""
    count, taps = 4 if views.side > 1 else 1, views.taps[v]
    for a in range(count):
        for b in range(count):
            w, into = taps[2, a] * taps[0, b], sums[views.first[v] + a * views.side + b]
            for k in range(out.shape[0]):
                into[k] += w * out[k]


@numba.njit(cache=True, nogil=True)
def _weighted_residuals(
    row: NDArray[np.float32],
    line: NDArray[np.float32],
    scale_and_floor: tuple[float, float],
    with_samples: bool,
    lights: Placement,
    rows: NDArray[np.float32],
) -> None:
    """S w (y - s T c), and s s w, of one view's samples; NaN where unobserved."""
    scale, floor = scale_and_floor
    for k in range(row.shape[0]):
        value, first = row[k], lights.first[k]
        rows[0, k] = rows[1, k] = np.nan
        if first < 0 or not np.isfinite(value):
            continue
        taps = lights.taps[k]
        rest = -scale * value_at(line, first, lights.side, taps[0], taps[2])
        weight = scale / (floor + abs(value))
        if with_samples:
            rest += value
        rows[0, k], rows[1, k] = np.float32(weight * rest), np.float32(weight * scale)


@numba.njit(cache=True, nogil=True)
def back_project(
    texels: Texels,
    values: NDArray[np.float32],
    with_samples: bool,
    sums: NDArray[np.float64],
    touched: NDArray[np.float64],
) -> None:
    """Add sum_i s_i T_i^T w_i (y_i - s_i T_i c) to `sums`, and s_i^2 T_i^T w_i to `touched`.

    Without samples y counts as 0 where it is observed, and `touched` is left alone.
    """
    n_views, n_lights = texels.samples.shape[1:]
    views = empty_placement(n_views, texels.sides[0])
    lights = empty_placement(n_lights, texels.sides[1])
    line, out = np.zeros(values.shape[1], np.float32), np.zeros(values.shape[1], np.float32)
    rows = np.zeros((2, n_lights), np.float32)
    for i in range(texels.samples.shape[0]):
        scale = texels.brightness[i]
        if scale <= 0.0:
            continue
        place_texel(texels, i, views, lights)
        levels = (scale, texels.floor * scale)
        for v in range(n_views):
            if views.first[v] < 0:
                continue
            blend_value(values, views.first[v], views.side, views.taps[v], line)
            _weighted_residuals(texels.samples[i, v], line, levels, with_samples, lights, rows)
            scatter_row(rows[0], lights, out)
            scatter_view(out, views, v, sums)
            if with_samples:
                scatter_row(rows[1], lights, out)
                scatter_view(out, views, v, touched)


@numba.njit(cache=True, nogil=True)
def expect(
    values: NDArray[np.float32],
    views: Placement,
    lights: Placement,
    line: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Target at all pairs of directions of one texel; NaN below a horizon."""
    for v in range(out.shape[0]):
        if views.first[v] < 0:
            out[v] = np.nan
            continue
        blend_value(values, views.first[v], views.side, views.taps[v], line)
        for k in range(out.shape[1]):
            first, taps = lights.first[k], lights.taps[k]
            out[v, k] = np.nan
            if first >= 0:
                out[v, k] = value_at(line, first, lights.side, taps[0], taps[2])
