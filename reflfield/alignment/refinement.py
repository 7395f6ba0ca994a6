r"""Frames refined on the samples themselves.

The aligned texels sample one reflectance far more densely than any of them, so
a sharp target exists (see `reflfield.alignment.splines`), fitted to the samples of all
texels. Frames and brightness of each texel then follow by Gauss-Newton steps on the same
weighted squares of :math:`y_i - s_i T_i c`; samples below either horizon of the frame are left
out. Both are repeated. A Gaussian prior may hold each frame to the one
given: with :math:`\omega` the turn between them, :math:`v |\omega|^2 / \text{spread}^2` is
added to the squares, :math:`v` being the texel's weighted squared residual per sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.newton_ascent import copy_matrix, turned
from reflfield.alignment.newton_ascent import scale as shrink
from reflfield.alignment.rotation_search import map_blocks
from reflfield.alignment.splines import (
    FAST,
    NodeTargets,
    back_project,
    blend_view,
    place,
    value_at,
)
from reflfield.errors import InputError
from reflfield.util.validation import check_shape

LONGEST_STEP = np.deg2rad(4.0)
SHORT_STEP = np.deg2rad(0.01)
DAMPING = 1e-4
BLOCK = 128
# Parts that the samples are summed in: their sums are held together.
FIT_PARTS = 8
# Weight of the mean node in the preconditioner: nodes that hardly any sample touches stay.
LEAST_TOUCH = 1e-3


@dataclass(frozen=True)
class RefinementOptions:
    """How frames are refined on the samples.

    Parameters
    ----------
    side : int
        Nodes along the side of each square of directions, 5 at least. Two of them stand
        outside the hemisphere.
    rounds : int
        Rounds of target and frames.
    fit_steps : int
        Steps of conjugate gradients of the target fit per round. More let the target
        follow the wrong frames.
    steps : int
        Gauss-Newton steps per round, at most.
    last_steps : int
        Gauss-Newton steps of all texels against the finished targets, at most.
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
    rounds: int = 4
    fit_steps: int = 6
    steps: int = 2
    last_steps: int = 6
    floor: float = 0.3
    texels_per_cluster: int = 1024
    spread: float = math.inf

    def __post_init__(self) -> None:
        if self.side < 5:
            raise InputError(f"side: expected at least 5 nodes, received {self.side}")
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


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _add_row(
    row: NDArray[np.float32],
    lines: NDArray[np.float32],
    v_turns: NDArray[np.float32],
    l_first: NDArray[np.int64],
    l_taps: NDArray[np.float32],
    l_turns: NDArray[np.float32],
    side: int,
    scale: float,
    floor: float,
    normal: NDArray[np.float64],
) -> None:
    """Add one view's samples to the normal equations of (w, log s), cost and weight."""
    jacobian = np.zeros(5)
    for k in range(row.shape[0]):
        value, first = row[k], l_first[k]
        if first < 0 or not np.isfinite(value):
            continue
        u, du, v, dv = l_taps[k, 0], l_taps[k, 1], l_taps[k, 2], l_taps[k, 3]
        expected = value_at(lines[0], first, side, u, v)
        view_u = value_at(lines[1], first, side, u, v)
        view_v = value_at(lines[2], first, side, u, v)
        light_u = value_at(lines[0], first, side, du, v)
        light_v = value_at(lines[0], first, side, u, dv)
        for n in range(3):
            jacobian[n] = scale * (
                view_u * v_turns[n]
                + view_v * v_turns[3 + n]
                + light_u * l_turns[k, n]
                + light_v * l_turns[k, 3 + n]
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
    first: tuple[NDArray[np.int64], NDArray[np.int64]],
    taps: tuple[NDArray[np.float32], NDArray[np.float32]],
    turns: tuple[NDArray[np.float32], NDArray[np.float32]],
    sides: tuple[int, int],
    scale_and_floor: tuple[float, float],
    lines: NDArray[np.float32],
    normal: NDArray[np.float64],
) -> None:
    """Add one texel's samples to its normal equations; `lines` is scratch."""
    scale, floor = scale_and_floor
    for v in range(samples.shape[0]):
        if first[0][v] >= 0:
            blend_view(target, first[0][v], sides[0], taps[0][v], lines)
            _add_row(
                samples[v],
                lines,
                turns[0][v],
                first[1],
                taps[1],
                turns[1],
                sides[1],
                scale,
                floor,
                normal,
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
    v_first, l_first = np.zeros(n_views, np.int64), np.zeros(n_lights, np.int64)
    v_taps = np.zeros((n_views, 4, 4), np.float32)
    l_taps = np.zeros((n_lights, 4, 4), np.float32)
    v_turns = np.zeros((n_views, 6), np.float32)
    l_turns = np.zeros((n_lights, 6), np.float32)
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
            place(views[i % len(views)], frame, sides[0], v_first, v_taps, v_turns)
            place(lights[i % len(lights)], frame, sides[1], l_first, l_taps, l_turns)
            _add_views(
                samples[i],
                target,
                (v_first, l_first),
                (v_taps, l_taps),
                (v_turns, l_turns),
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
            if max(abs(step[0]), abs(step[1]), abs(step[2])) < SHORT_STEP:
                # Too short to be worth an evaluation, but free to take.
                copy_matrix(frame, frames[i])
                break


def fit_nodes(
    data: SampleSet,
    frames: NDArray[np.float64],
    brightness: NDArray[np.float64],
    cluster: NDArray[np.int32],
    targets: NodeTargets,
    options: RefinementOptions,
    n_threads: int,
) -> NodeTargets:
    """Targets after some steps of conjugate gradients towards the samples.

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
    for k in range(len(values)):
        mine = np.flatnonzero((cluster == k) & (brightness > 0))
        if len(mine):
            fit = _Fit(data, mine, frames, brightness, targets.sides, options.floor, n_threads)
            values[k] = fit.solve(values[k], options.fit_steps)
    return NodeTargets(values, *targets.sides)


@dataclass(frozen=True, eq=False)
class _Fit:
    """The normal equations of one cluster's nodes, by sums over its texels `rows`."""

    data: SampleSet
    rows: NDArray[np.int64]
    frames: NDArray[np.float64]
    brightness: NDArray[np.float64]
    sides: tuple[int, int]
    floor: float
    n_threads: int

    def solve(self, values: NDArray[np.float32], n_steps: int) -> NDArray[np.float32]:
        """Nodes after some steps of preconditioned conjugate gradients from `values`."""
        nodes = values.astype(np.float64)
        rest, touched = self.sums(values, with_samples=True)
        scale = 1.0 / (touched + LEAST_TOUCH * touched.mean() + 1e-300)
        direction = scale * rest
        power = np.vdot(rest, direction)
        for _ in range(n_steps):
            product, _ = self.sums(direction.astype(np.float32), with_samples=False)
            curvature = -np.vdot(direction, product)
            if not curvature > 0.0:
                break
            nodes += (power / curvature) * direction
            rest += (power / curvature) * product
            before, power = power, np.vdot(rest, scale * rest)
            direction = scale * rest + (power / before) * direction
        return nodes.astype(np.float32)

    def sums(
        self, values: NDArray[np.float32], with_samples: bool
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Backprojected residuals and, with samples, the weight on each node."""

        def block(rows: slice) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            own = self.rows[rows]
            part = self.data.part(own)
            sums, touched = np.zeros(values.shape), np.zeros(values.shape)
            back_project(
                part.samples,
                *part.directions(),
                self.frames[own],
                self.brightness[own],
                values,
                self.sides,
                self.floor,
                with_samples,
                sums,
                touched,
            )
            return sums, touched

        size = max(BLOCK // 2, -(-len(self.rows) // FIT_PARTS))
        parts = map_blocks(block, len(self.rows), size, self.n_threads)
        return np.sum([p[0] for p in parts], axis=0), np.sum([p[1] for p in parts], axis=0)


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
    sides = targets.sides

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
