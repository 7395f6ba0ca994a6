r"""Frames refined on the samples themselves.

The aligned texels sample one reflectance far more densely than any of them, so
a sharp target exists: values on the nodes of two hemisphere grids (views and lights,
bilinear, 16 taps a sample), fitted to the samples of all texels by normalised
backprojection,

.. math::

    c \leftarrow c + \frac{\sum_i s_i T_i^\top (y_i - s_i T_i c)}{\sum_i s_i^2 T_i^\top 1},

where :math:`T_i` interpolates at the sample directions in the frame of texel i and
:math:`s_i` is its brightness. Frames and brightness then follow by Gauss-Newton steps
on the weighted squares of :math:`y_i - s_i T_i c`; samples below either horizon of
the frame are left out. Both are repeated. A Gaussian prior may hold each frame to the one
given: with :math:`\omega` the turn between them, :math:`v |\omega|^2 / \text{spread}^2` is
added to the squares, :math:`v` being the texel's weighted squared residual per sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.climbing import copy_matrix, turned
from reflfield.alignment.climbing import scale as shrink
from reflfield.alignment.searching import map_blocks
from reflfield.checks import check_shape
from reflfield.errors import InputError
from reflfield.sphere.hemisphere import first_tap, square_from_xyz

# Half of the step by which the taps' positions are differenced, radians: well below the
# six degrees between nodes, well above the rounding of float32.
HALF_STEP = np.deg2rad(0.25)
# Directions this close to the frame's horizon are left out: their taps would leave the grid
# within one step.
LOWEST_Z = float(np.sin(np.deg2rad(1.0)))
# Reordering of sums only: samples may be NaN, which full fast mathematics assumes away.
FAST = {"reassoc", "contract", "nsz", "arcp"}
LONGEST_STEP = np.deg2rad(4.0)
DAMPING = 1e-4
BLOCK = 128


@dataclass(frozen=True)
class RefinementOptions:
    """How frames are refined on the samples.

    Parameters
    ----------
    side : int
        Nodes along the side of each hemisphere grid.
    rounds : int
        Rounds of target and frames.
    backprojections : int
        Steps of the target fit per round.
    steps : int
        Gauss-Newton steps per round.
    last_steps : int
        Gauss-Newton steps of all texels against the finished targets.
    floor : float
        Added to |sample| in the weight 1 / (floor + |sample|), relative to the
        texel's root mean square.
    texels_per_cluster : int
        Texels that the target is fitted to.
    spread : float
        Standard deviation of the frames given about the true ones, radians: a Gaussian
        prior holds texels there that few or noisy samples say little about. Infinite: none.
    """

    side: int = 25
    rounds: int = 6
    backprojections: int = 4
    steps: int = 2
    last_steps: int = 5
    floor: float = 0.3
    texels_per_cluster: int = 2048
    spread: float = math.inf

    def __post_init__(self) -> None:
        if not self.spread > 0:
            raise InputError(f"spread: expected radians > 0, received {self.spread}")


@dataclass(frozen=True, eq=False)
class SampleSet:
    """Samples of some texels with their directions in the base frames.

    Parameters
    ----------
    samples : (n, n_views, n_lights) float32
        Not finite where unobserved.
    views : (n_views, 3) or (n, n_views, 3) float64
        Unit vectors: the same for all texels, or each texel its own.
    lights : (n_lights, 3) or (n, n_lights, 3) float64

    Raises
    ------
    ShapeError
        If directions do not belong to the samples.
    """

    samples: NDArray[np.float32]
    views: NDArray[np.float64]
    lights: NDArray[np.float64]

    def __post_init__(self) -> None:
        n, *counts = self.samples.shape
        for name, directions, count in zip(
            ("views", "lights"), (self.views, self.lights), counts, strict=True
        ):
            own = (n,) if directions.ndim == 3 else ()
            check_shape(name, directions, (*own, count, 3))

    def part(self, rows: slice | NDArray[np.int64]) -> SampleSet:
        """Samples of some of the texels."""
        views, lights = (
            directions[rows] if directions.ndim == 3 else directions
            for directions in (self.views, self.lights)
        )
        return SampleSet(self.samples[rows], views, lights)

    def directions(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Views and lights with a leading axis: one entry for all texels, or one for each."""
        views, lights = (d if d.ndim == 3 else d[None] for d in (self.views, self.lights))
        return views, lights

    def brightness(self) -> NDArray[np.float64]:
        """(n,) root mean square of the observed samples; 0 where there is none."""
        observed = np.isfinite(self.samples)
        squares = np.where(observed, self.samples, 0).astype(np.float64) ** 2
        count = np.maximum(observed.sum(axis=(1, 2)), 1)
        return np.sqrt(squares.sum(axis=(1, 2)) / count)


@dataclass(frozen=True, eq=False)
class NodeTargets:
    """Sharp targets on hemisphere nodes.

    Parameters
    ----------
    values : (n_clusters, view_side**2, light_side**2) float32
    view_side, light_side : int
        1: that direction does not vary.
    """

    values: NDArray[np.float32]
    view_side: int
    light_side: int


@numba.njit(cache=True, nogil=True)
def place_directions(
    directions: NDArray[np.float64],
    frame: NDArray[np.float64],
    side: int,
    nodes: NDArray[np.int64],
    places: NDArray[np.float64],
) -> None:
    """First node (-1 below the horizon), shares s and t, and their six derivatives."""
    local, other = np.zeros(3), np.zeros(3)
    scale = 0.5 * (side - 1) / (2.0 * HALF_STEP)
    for i in range(directions.shape[0]):
        for k in range(3):
            local[k] = (
                frame[k, 0] * directions[i, 0]
                + frame[k, 1] * directions[i, 1]
                + frame[k, 2] * directions[i, 2]
            )
        if side == 1:
            nodes[i] = 0
            places[i] = 0.0
            continue
        if local[2] < LOWEST_Z:
            nodes[i] = -1
            continue
        u, v = square_from_xyz(local[0], local[1], local[2])
        column, places[i, 0] = first_tap(u, side)
        row, places[i, 1] = first_tap(v, side)
        nodes[i] = row * side + column
        for k in range(3):
            # Turning by w about axis k moves d by w x d.
            a, b = (k + 1) % 3, (k + 2) % 3
            other[0], other[1], other[2] = local[0], local[1], local[2]
            other[a], other[b] = (
                local[a] - HALF_STEP * local[b],
                local[b] + HALF_STEP * local[a],
            )
            u1, v1 = square_from_xyz(other[0], other[1], other[2])
            other[a], other[b] = (
                local[a] + HALF_STEP * local[b],
                local[b] - HALF_STEP * local[a],
            )
            u0, v0 = square_from_xyz(other[0], other[1], other[2])
            places[i, 2 + k] = (u1 - u0) * scale
            places[i, 5 + k] = (v1 - v0) * scale


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _blend(
    target: NDArray[np.float32],
    node: int,
    side: int,
    s: float,
    t: float,
    lines: NDArray[np.float32],
) -> None:
    """Rows of the target at one view: interpolated, and differentiated in s and t."""
    right, up = (1, side) if side > 1 else (0, 0)
    a, b = np.float32(s), np.float32(t)
    one = np.float32(1.0)
    for k in range(target.shape[1]):
        low = target[node, k] + a * (target[node + right, k] - target[node, k])
        rise = target[node + up + right, k] - target[node + up, k]
        high = target[node + up, k] + a * rise
        lines[0, k] = low + b * (high - low)
        lines[1, k] = (one - b) * (target[node + right, k] - target[node, k]) + b * rise
        lines[2, k] = high - low


@numba.njit(cache=True, nogil=True)
def _spread_row(
    row: NDArray[np.float32],
    scale: float,
    expected: NDArray[np.float32],
    l_nodes: NDArray[np.int64],
    l_places: NDArray[np.float64],
    side: int,
    out: NDArray[np.float64],
) -> None:
    """Scatter one view's residuals and weights to the light nodes, interleaved."""
    right, up = (1, side) if side > 1 else (0, 0)
    out[:] = 0.0
    for k in range(row.shape[0]):
        node, value = l_nodes[k], row[k]
        if node < 0 or not np.isfinite(value):
            continue
        a, b = l_places[k, 0], l_places[k, 1]
        w0, w1, w2, w3 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
        model = w0 * expected[node] + w1 * expected[node + right]
        model += w2 * expected[node + up] + w3 * expected[node + up + right]
        rest = scale * (value - scale * model)
        power = scale * scale
        out[2 * node] += w0 * rest
        out[2 * node + 1] += w0 * power
        out[2 * (node + right)] += w1 * rest
        out[2 * (node + right) + 1] += w1 * power
        out[2 * (node + up)] += w2 * rest
        out[2 * (node + up) + 1] += w2 * power
        out[2 * (node + up + right)] += w3 * rest
        out[2 * (node + up + right) + 1] += w3 * power


@numba.njit(cache=True, nogil=True)
def spread(
    samples: NDArray[np.float32],
    views: NDArray[np.float64],
    lights: NDArray[np.float64],
    frames: NDArray[np.float64],
    brightness: NDArray[np.float64],
    target: NDArray[np.float32],
    sides: tuple[int, int],
    sums: NDArray[np.float64],
) -> None:
    """Add numerator and denominator of the backprojection of some texels to `sums`.

    They are interleaved along the light nodes: (view nodes, 2 * light nodes).
    """
    n_views, n_lights = samples.shape[1:]
    v_nodes, v_places = np.zeros(n_views, np.int64), np.zeros((n_views, 8))
    l_nodes, l_places = np.zeros(n_lights, np.int64), np.zeros((n_lights, 8))
    lines = np.zeros((3, target.shape[1]), np.float32)
    out = np.zeros(2 * target.shape[1])
    right, up = (1, sides[0]) if sides[0] > 1 else (0, 0)
    for i in range(samples.shape[0]):
        if brightness[i] <= 0.0:
            continue
        place_directions(views[i % len(views)], frames[i], sides[0], v_nodes, v_places)
        place_directions(lights[i % len(lights)], frames[i], sides[1], l_nodes, l_places)
        for v in range(n_views):
            node = v_nodes[v]
            if node < 0:
                continue
            s, t = v_places[v, 0], v_places[v, 1]
            _blend(target, node, sides[0], s, t, lines)
            _spread_row(
                samples[i, v], brightness[i], lines[0], l_nodes, l_places, sides[1], out
            )
            w0, w1, w2, w3 = (1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t
            for k in range(out.shape[0]):
                sums[node, k] += w0 * out[k]
                sums[node + right, k] += w1 * out[k]
                sums[node + up, k] += w2 * out[k]
                sums[node + up + right, k] += w3 * out[k]


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _add_row(
    row: NDArray[np.float32],
    place: NDArray[np.float64],
    lines: NDArray[np.float32],
    l_nodes: NDArray[np.int64],
    l_places: NDArray[np.float64],
    side: int,
    scale: float,
    floor: float,
    normal: NDArray[np.float64],
) -> None:
    """Add one view's samples to the normal equations of (w, log s), cost and weight."""
    right, up = (1, side) if side > 1 else (0, 0)
    jacobian = np.zeros(5)
    for k in range(row.shape[0]):
        node, value = l_nodes[k], row[k]
        if node < 0 or not np.isfinite(value):
            continue
        a, b = l_places[k, 0], l_places[k, 1]
        p0, p1 = lines[0, node], lines[0, node + right]
        p2, p3 = lines[0, node + up], lines[0, node + up + right]
        low, high = p0 + a * (p1 - p0), p2 + a * (p3 - p2)
        expected = low + b * (high - low)
        in_s, in_t = (1 - b) * (p1 - p0) + b * (p3 - p2), high - low
        w0, w1, w2, w3 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
        view_s = w0 * lines[1, node] + w1 * lines[1, node + right]
        view_s += w2 * lines[1, node + up] + w3 * lines[1, node + up + right]
        view_t = w0 * lines[2, node] + w1 * lines[2, node + right]
        view_t += w2 * lines[2, node + up] + w3 * lines[2, node + up + right]
        for n in range(3):
            jacobian[n] = scale * (
                view_s * place[2 + n]
                + view_t * place[5 + n]
                + in_s * l_places[k, 2 + n]
                + in_t * l_places[k, 5 + n]
            )
        jacobian[3] = scale * expected
        jacobian[4] = value - scale * expected
        weight = 1.0 / (floor + np.abs(value))
        for n in range(5):
            for m in range(n + 1):
                normal[n, m] += weight * jacobian[n] * jacobian[m]
        normal[0, 4] += weight
        normal[1, 4] += 1.0


@numba.njit(cache=True, nogil=True)
def _add_views(
    samples: NDArray[np.float32],
    target: NDArray[np.float32],
    nodes: tuple[NDArray[np.int64], NDArray[np.int64]],
    places: tuple[NDArray[np.float64], NDArray[np.float64]],
    sides: tuple[int, int],
    scale_and_floor: tuple[float, float],
    lines: NDArray[np.float32],
    normal: NDArray[np.float64],
) -> None:
    """Add one texel's samples to its normal equations; `lines` is scratch."""
    scale, floor = scale_and_floor
    for v in range(samples.shape[0]):
        if nodes[0][v] >= 0:
            place = places[0][v]
            _blend(target, nodes[0][v], sides[0], place[0], place[1], lines)
            _add_row(
                samples[v], place, lines, nodes[1], places[1], sides[1], scale, floor, normal
            )


@numba.njit(cache=True, nogil=True)
def hold(
    frame: NDArray[np.float64],
    start: NDArray[np.float64],
    strength: float,
    normal: NDArray[np.float64],
) -> None:
    """Add the prior on the turn from `start` to `frame` to the normal equations."""
    away = np.zeros(3)
    for k in range(3):
        # Turns of a few degrees: their vector is the skew part of frame @ start^T.
        a, b = (k + 1) % 3, (k + 2) % 3
        for c in range(3):
            away[k] += 0.5 * (frame[b, c] * start[a, c] - frame[a, c] * start[b, c])
        normal[k, k] += strength
        normal[4, k] -= strength * away[k]
        normal[4, 4] += strength * away[k] * away[k]


@numba.njit(cache=True, nogil=True)
def _factor(normal: NDArray[np.float64]) -> bool:
    """Cholesky factor of rows 0 .. 3 in place; row 4, the right side, is carried along."""
    for n in range(4):
        for k in range(n):
            normal[n, n] -= normal[n, k] * normal[n, k]
        if not normal[n, n] > 0.0:
            return False
        normal[n, n] = np.sqrt(normal[n, n])
        for m in range(n + 1, 5):
            for k in range(n):
                normal[m, n] -= normal[m, k] * normal[n, k]
            normal[m, n] /= normal[n, n]
    return True


@numba.njit(cache=True, nogil=True)
def solve_step(normal: NDArray[np.float64], step: NDArray[np.float64]) -> bool:
    """Damped solution of the 4x4 normal equations, limited in length; False if singular."""
    largest = max(normal[0, 0], normal[1, 1], normal[2, 2])
    if not (largest > 0.0 and normal[3, 3] > 0.0):
        return False
    for n in range(3):
        normal[n, n] += DAMPING * largest
    normal[3, 3] *= 1.0 + DAMPING
    if not _factor(normal):
        return False
    for n in range(3, -1, -1):
        step[n] = normal[4, n]
        for m in range(n + 1, 4):
            step[n] -= normal[m, n] * step[m]
        step[n] /= normal[n, n]
    length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    if length > LONGEST_STEP:
        shrink(step, 3, LONGEST_STEP / length)
    step[3] = min(max(step[3], -0.5), 0.5)
    return bool(np.isfinite(length))


@numba.njit(cache=True, nogil=True)
def turn_frame(
    frame: NDArray[np.float64],
    w: NDArray[np.float64],
    turn: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """``exp(w) @ frame``; `turn` is scratch."""
    for k in range(9):
        out[k // 3, k % 3] = 1.0 if k % 4 == 0 else 0.0
    turned(out, w, turn)
    for r in range(3):
        for c in range(3):
            out[r, c] = turn[r, 0] * frame[0, c] + turn[r, 1] * frame[1, c]
            out[r, c] += turn[r, 2] * frame[2, c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def improve(
    samples: NDArray[np.float32],
    views: NDArray[np.float64],
    lights: NDArray[np.float64],
    frames: NDArray[np.float64],
    brightness: NDArray[np.float64],
    target: NDArray[np.float32],
    sides: tuple[int, int],
    relative_floor: float,
    starts: NDArray[np.float64],
    spread: float,
    n_steps: int,
) -> None:
    """Gauss-Newton steps of frames and brightness of some texels, in place.

    The prior weighs against the samples by their weighted squared residual at first, over
    the samples less the four unknowns.
    """
    n_views, n_lights = samples.shape[1:]
    v_nodes, v_places = np.zeros(n_views, np.int64), np.zeros((n_views, 8))
    l_nodes, l_places = np.zeros(n_lights, np.int64), np.zeros((n_lights, 8))
    lines = np.zeros((3, target.shape[1]), np.float32)
    normal, step, turn = np.zeros((5, 5)), np.zeros(4), np.zeros((3, 3))
    frame, scale_factor = np.zeros((3, 3)), 1.0
    for i in range(samples.shape[0]):
        if brightness[i] <= 0.0:
            continue
        floor, least, strength = relative_floor * brightness[i], np.inf, 0.0
        copy_matrix(frames[i], frame)
        for n in range(n_steps + 1):
            normal[:] = 0.0
            scale = brightness[i] * scale_factor if n > 0 else brightness[i]
            place_directions(views[i % len(views)], frame, sides[0], v_nodes, v_places)
            place_directions(lights[i % len(lights)], frame, sides[1], l_nodes, l_places)
            _add_views(
                samples[i],
                target,
                (v_nodes, l_nodes),
                (v_places, l_places),
                sides,
                (scale, floor),
                lines,
                normal,
            )
            if n == 0:
                strength = normal[4, 4] / max(normal[1, 4] - 4.0, 1.0) / (spread * spread)
            hold(frame, starts[i], strength, normal)
            cost = normal[4, 4] / max(normal[0, 4], 1e-300)
            if cost < least:
                least = cost
                copy_matrix(frame, frames[i])
                brightness[i] = scale
                if not solve_step(normal, step):
                    break
            else:
                shrink(step, 4, 0.25)
            turn_frame(frames[i], step, turn, frame)
            scale_factor = np.exp(step[3])


def fit_nodes(
    data: SampleSet,
    frames: NDArray[np.float64],
    brightness: NDArray[np.float64],
    cluster: NDArray[np.int32],
    targets: NodeTargets,
    options: RefinementOptions,
    n_threads: int,
) -> NodeTargets:
    """Targets after some steps of normalised backprojection.

    Parameters
    ----------
    data : SampleSet
        n texels.
    frames : (n, 3, 3) float64
        `local_from_base`.
    brightness : (n,) float64
        Texels with 0 take no part.
    cluster : (n,) int32
    targets : NodeTargets
        Where to begin.
    options : RefinementOptions
    n_threads : int

    Returns
    -------
    NodeTargets
    """
    values = targets.values.copy()
    sides = (targets.view_side, targets.light_side)
    for k in range(len(values)):
        mine = np.flatnonzero(cluster == k)

        def block(
            rows: slice, k: int = k, mine: NDArray[np.int64] = mine
        ) -> NDArray[np.float64]:
            sums = np.zeros((values[k].shape[0], 2 * values[k].shape[1]))
            own = mine[rows]
            part = data.part(own)
            spread(
                part.samples,
                *part.directions(),
                frames[own],
                brightness[own],
                values[k],
                sides,
                sums,
            )
            return sums

        for _ in range(options.backprojections if len(mine) else 0):
            sums = np.sum(map_blocks(block, len(mine), 2 * BLOCK, n_threads), axis=0)
            # Nodes that hardly any sample touches stay where they are.
            weight = sums[:, 1::2]
            touched = weight + 1e-3 * weight.mean() + 1e-300
            values[k] += (sums[:, ::2] / touched).astype(np.float32)
    return NodeTargets(values, *sides)


def improve_frames(
    data: SampleSet,
    frames: NDArray[np.float64],
    brightness: NDArray[np.float64],
    cluster: NDArray[np.int32],
    targets: NodeTargets,
    options: RefinementOptions,
    n_steps: int,
    n_threads: int,
    starts: NDArray[np.float64] | None = None,
) -> None:
    """Gauss-Newton steps of frames and brightness, in place; parameters as `fit_nodes`.

    The prior, if any, holds the frames to `starts`, (n, 3, 3), or to where they are.
    """
    starts = frames.copy() if starts is None else starts
    sides = (targets.view_side, targets.light_side)

    def block(rows: slice) -> None:
        for k in np.unique(cluster[rows]):
            own = np.flatnonzero(cluster[rows] == k) + rows.start
            part = data.part(own)
            frame, bright = frames[own], brightness[own]
            improve(
                part.samples,
                *part.directions(),
                frame,
                bright,
                targets.values[k],
                sides,
                options.floor,
                starts[own],
                options.spread,
                n_steps,
            )
            frames[own], brightness[own] = frame, bright

    map_blocks(block, len(frames), BLOCK, n_threads)


def refine_targets(
    data: SampleSet,
    frames: NDArray[np.float64],
    cluster: NDArray[np.int32],
    n_clusters: int,
    options: RefinementOptions,
    n_threads: int = 1,
) -> tuple[NodeTargets, NDArray[np.float64]]:
    """Sharp targets and frames of the texels that they are fitted to.

    Parameters
    ----------
    data : SampleSet
        n texels.
    frames : (n, 3, 3) float64
        `local_from_base` of the harmonic search.
    cluster : (n,) int32
    n_clusters : int
    options : RefinementOptions
    n_threads : int

    Returns
    -------
    targets : NodeTargets
    frames : (n, 3, 3) float64
    """
    starts, frames, brightness = frames, frames.copy(), data.brightness()
    sides = [1 if count == 1 else options.side for count in data.samples.shape[1:]]
    empty = np.zeros((n_clusters, sides[0] ** 2, sides[1] ** 2), np.float32)
    targets = NodeTargets(empty, sides[0], sides[1])
    for _ in range(options.rounds):
        targets = fit_nodes(data, frames, brightness, cluster, targets, options, n_threads)
        improve_frames(
            data,
            frames,
            brightness,
            cluster,
            targets,
            options,
            options.steps,
            n_threads,
            starts,
        )
    return targets, frames
