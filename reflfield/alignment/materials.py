r"""Materials told apart on the samples themselves.

Band-limited correlation (Eq. 12 of Müller, Sarlette and Klein, Eurographics 2006) tells
materials apart that differ much. What the horizon cuts off a tilted texel changes its
harmonics more than a similar material does, so similar ones are told apart by sharp
targets, which know both horizons. The distance stays that of Eq. 12, on the observed
samples: with :math:`y` the samples of a texel and :math:`m_k` the target of cluster k
at its sample directions in its frame,

.. math::

    e_k = 1 - \frac{(\sum w\, y\, m_k)^2}{\sum w\, y^2\, \sum w\, m_k^2},
    \qquad w = 1 / (\mathrm{floor} + |y|) .

The search begins with one target for all texels. Residuals of one material
agree in the texels' own frames, so a cluster is split in two where its residuals form two
groups; the cluster whose split promises most goes first, by the sum of
:math:`\log e`, in which rough fits and close ones count alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.frame_ambiguity import mean_rotation
from reflfield.alignment.refinement import (
    BLOCK,
    RefinementOptions,
    SampleSet,
    fit_nodes,
    improve_frames,
)
from reflfield.alignment.rotation_search import map_blocks
from reflfield.alignment.splines import NodeTargets, expect, place
from reflfield.sphere.hemisphere import LOWEST_Z, first_tap, square_from_xyz

# Nodes along each side of the grids on which residuals are compared.
RESIDUAL_SIDE = 7
# Rounds of target and frames before the first split, after each, and at the end.
FIRST_ROUNDS = 3
ROUNDS_PER_SPLIT = 2
LAST_ROUNDS = 3
# Splits that promise at least this share of the best are done at once.
WORTHY = 0.5
# The two groups of a split: starts tried, rounds each.
SPLIT_TRIES = 6
# Clusters dissolved at most, each for a better division of another.
MOST_EXCHANGES = 6
# Mean gain in log distance over all texels below which a division is noise.
LEAST_GAIN = 1e-3
# Distance that does not speak for a wrong material: 2 % of noise, or frames not yet exact.
FORGIVEN = 4e-4
MOST_GROUPS = (2, 2, 3, 3, 4, 4)
SPLIT_ROUNDS = 12
# Texels that the materials are found on, per cluster and at least; samples of each.
TEXELS_PER_CLUSTER = 192
LEAST_TEXELS = 768
ENOUGH_SAMPLES = 2048
# A texel tries its second material where that is at most so many times as far.
AMBIGUOUS = 4.0
# The grid of the residuals is coarse: what it explains is never all.
UNEXPLAINED = 0.05


# Which texels of a cluster leave it, from their residuals and distances.
Proposal = Callable[
    [NDArray[np.float32], NDArray[np.float64], np.random.Generator], NDArray[np.bool_]
]


@dataclass(frozen=True, eq=False)
class Materials:
    """Sharp targets of all materials, and where each texel stands.

    Parameters
    ----------
    targets : NodeTargets
        One a cluster; zero for those that no texel belongs to.
    frames : (n, 3, 3) float64
        `local_from_base`.
    brightness : (n,) float64
        Factor of the target; 0 where nothing is observed.
    cluster : (n,) int32
    """

    targets: NodeTargets
    frames: NDArray[np.float64]
    brightness: NDArray[np.float64]
    cluster: NDArray[np.int32]

    def part(self, rows: NDArray[np.int64]) -> Materials:
        """Some of the texels, with all targets."""
        return Materials(
            self.targets, self.frames[rows], self.brightness[rows], self.cluster[rows]
        )


@numba.njit(cache=True, nogil=True)
def _taps(
    directions: NDArray[np.float64],
    frame: NDArray[np.float64],
    side: int,
    nodes: NDArray[np.int64],
    shares: NDArray[np.float64],
) -> None:
    """First node (-1 below the horizon) and the two shares of each direction."""
    for i in range(directions.shape[0]):
        nodes[i] = 0
        shares[i] = 0.0
        if side == 1:
            continue
        x, y, z = directions[i]
        up = frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z
        if up < LOWEST_Z:
            nodes[i] = -1
            continue
        along = frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z
        across = frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z
        u, v = square_from_xyz(along, across, up)
        column, shares[i, 0] = first_tap(u, side)
        row, shares[i, 1] = first_tap(v, side)
        nodes[i] = row * side + column


@numba.njit(cache=True, nogil=True)
def _moments(
    samples: NDArray[np.float32], expected: NDArray[np.float32], floor: float
) -> tuple[float, float, float]:
    """Weighted sums of y y, y m and m m over the observed samples above both horizons."""
    yy, ym, mm = 0.0, 0.0, 0.0
    for v in range(samples.shape[0]):
        for k in range(samples.shape[1]):
            y, m = float(samples[v, k]), float(expected[v, k])
            if np.isfinite(y) and np.isfinite(m):
                weight = 1.0 / (floor + abs(y))
                yy += weight * y * y
                ym += weight * y * m
                mm += weight * m * m
    return yy, ym, mm


@numba.njit(cache=True, nogil=True)
def _misfits(
    samples: NDArray[np.float32],
    views: NDArray[np.float64],
    lights: NDArray[np.float64],
    frames: NDArray[np.float64],
    floors: NDArray[np.float64],
    targets: NDArray[np.float32],
    sides: tuple[int, int],
    out: NDArray[np.float64],
) -> None:
    """Distance of each texel to each target; 1 where either is zero."""
    n_views, n_lights = samples.shape[1:]
    first = (np.zeros(n_views, np.int64), np.zeros(n_lights, np.int64))
    taps = (np.zeros((n_views, 4, 4), np.float32), np.zeros((n_lights, 4, 4), np.float32))
    turns = (np.zeros((n_views, 6), np.float32), np.zeros((n_lights, 6), np.float32))
    line = np.zeros(targets.shape[2], np.float32)
    expected = np.zeros((n_views, n_lights), np.float32)
    for i in range(samples.shape[0]):
        out[i] = 1.0
        if floors[i] <= 0.0:
            continue
        place(views[i % len(views)], frames[i], sides[0], first[0], taps[0], turns[0])
        place(lights[i % len(lights)], frames[i], sides[1], first[1], taps[1], turns[1])
        for k in range(targets.shape[0]):
            expect(targets[k], sides, first, taps, line, expected)
            yy, ym, mm = _moments(samples[i], expected, floors[i])
            if ym > 0.0:
                out[i, k] = max(1.0 - (ym / yy) * (ym / mm), 0.0)


@numba.njit(cache=True, nogil=True)
def _scatter(
    samples: NDArray[np.float32],
    expected: NDArray[np.float32],
    scale: float,
    floor: float,
    nodes: tuple[NDArray[np.int64], NDArray[np.int64]],
    shares: tuple[NDArray[np.float64], NDArray[np.float64]],
    sides: tuple[int, int],
    sums: NDArray[np.float64],
) -> None:
    """Add weighted residuals (first) and weights (second) of one texel to coarse nodes."""
    right, up = (1, sides[0]) if sides[0] > 1 else (0, 0)
    l_right, l_up = (1, sides[1]) if sides[1] > 1 else (0, 0)
    line = np.zeros((2, sums.shape[2]))
    for v in range(samples.shape[0]):
        node = nodes[0][v]
        if node < 0:
            continue
        line[:] = 0.0
        for k in range(samples.shape[1]):
            rest = samples[v, k] - scale * expected[v, k]
            if not np.isfinite(rest):
                continue
            tap, a, b = nodes[1][k], shares[1][k, 0], shares[1][k, 1]
            weight = 1.0 / (floor + abs(samples[v, k]))
            for n, value in enumerate((weight * rest, weight)):
                line[n, tap] += (1 - a) * (1 - b) * value
                line[n, tap + l_right] += a * (1 - b) * value
                line[n, tap + l_up] += (1 - a) * b * value
                line[n, tap + l_up + l_right] += a * b * value
        s, t = shares[0][v, 0], shares[0][v, 1]
        for n in range(2):
            for k in range(line.shape[1]):
                sums[n, node, k] += (1 - s) * (1 - t) * line[n, k]
                sums[n, node + right, k] += s * (1 - t) * line[n, k]
                sums[n, node + up, k] += (1 - s) * t * line[n, k]
                sums[n, node + up + right, k] += s * t * line[n, k]


@numba.njit(cache=True, nogil=True)
def _features(
    samples: NDArray[np.float32],
    views: NDArray[np.float64],
    lights: NDArray[np.float64],
    frames: NDArray[np.float64],
    floors: NDArray[np.float64],
    cluster: NDArray[np.int32],
    targets: NDArray[np.float32],
    sides: tuple[int, int],
    coarse: tuple[int, int],
    distance: NDArray[np.float64],
    out: NDArray[np.float32],
) -> None:
    """Distance to the own target, and the residual on coarse nodes, a part of it."""
    n_views, n_lights = samples.shape[1:]
    nodes = (np.zeros(n_views, np.int64), np.zeros(n_lights, np.int64))
    shares = (np.zeros((n_views, 2)), np.zeros((n_lights, 2)))
    taps = (np.zeros((n_views, 4, 4), np.float32), np.zeros((n_lights, 4, 4), np.float32))
    turns = (np.zeros((n_views, 6), np.float32), np.zeros((n_lights, 6), np.float32))
    line = np.zeros(targets.shape[2], np.float32)
    expected = np.zeros((n_views, n_lights), np.float32)
    sums = np.zeros((2, coarse[0] ** 2, coarse[1] ** 2))
    for i in range(samples.shape[0]):
        distance[i] = 1.0
        if floors[i] <= 0.0:
            continue
        view, light = views[i % len(views)], lights[i % len(lights)]
        place(view, frames[i], sides[0], nodes[0], taps[0], turns[0])
        place(light, frames[i], sides[1], nodes[1], taps[1], turns[1])
        expect(targets[cluster[i]], sides, nodes, taps, line, expected)
        yy, ym, mm = _moments(samples[i], expected, floors[i])
        if not ym > 0.0:
            continue
        distance[i] = max(1.0 - (ym / yy) * (ym / mm), 0.0)
        _taps(view, frames[i], coarse[0], nodes[0], shares[0])
        _taps(light, frames[i], coarse[1], nodes[1], shares[1])
        sums[:] = 0.0
        _scatter(samples[i], expected, ym / mm, floors[i], nodes, shares, coarse, sums)
        for a in range(sums.shape[1]):
            for b in range(sums.shape[2]):
                weight = sums[1, a, b]
                if weight > 0.0:
                    out[i, a * sums.shape[2] + b] = sums[0, a, b] / np.sqrt(weight * yy)


def misfits(
    data: SampleSet,
    frames: NDArray[np.float64],
    targets: NodeTargets,
    floor: float,
    n_threads: int,
) -> NDArray[np.float64]:
    """Distance of each texel to each target in its present frame.

    Parameters
    ----------
    data : SampleSet
        n texels.
    frames : (n, 3, 3) float64
        `local_from_base`.
    targets : NodeTargets
    floor : float
        See `RefinementOptions`.
    n_threads : int

    Returns
    -------
    (n, n_targets) float64
        0 .. 1; 1 where nothing is observed or the target is zero.
    """
    floors = floor * data.brightness()
    sides = (targets.view_side, targets.light_side)

    def block(rows: slice) -> NDArray[np.float64]:
        part = data.part(rows)
        out = np.zeros((len(part.samples), len(targets.values)))
        _misfits(
            part.samples,
            *part.directions(),
            frames[rows],
            floors[rows],
            targets.values,
            sides,
            out,
        )
        return out

    return np.concatenate(map_blocks(block, len(frames), BLOCK, n_threads))


def residual_features(
    data: SampleSet, state: Materials, floor: float, n_threads: int
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """How far each texel is from its own target, and in which way.

    Parameters
    ----------
    data : SampleSet
        n texels.
    state : Materials
    floor : float
        See `RefinementOptions`.
    n_threads : int

    Returns
    -------
    distance : (n,) float64
        See `misfits`.
    features : (n, n_nodes) float32
        Residual on coarse nodes of the texel's frame; the squares add up to the part of the
        distance that the nodes resolve.
    """
    targets, floors = state.targets, floor * data.brightness()
    sides = (targets.view_side, targets.light_side)
    coarse = (min(RESIDUAL_SIDE, sides[0]), min(RESIDUAL_SIDE, sides[1]))
    distance = np.zeros(len(floors))
    features = np.zeros((len(floors), coarse[0] ** 2 * coarse[1] ** 2), np.float32)

    def block(rows: slice) -> None:
        part = data.part(rows)
        _features(
            part.samples,
            *part.directions(),
            state.frames[rows],
            floors[rows],
            state.cluster[rows],
            targets.values,
            sides,
            coarse,
            distance[rows],
            features[rows],
        )

    map_blocks(block, len(floors), BLOCK, n_threads)
    return distance, features


def tell_apart(
    data: SampleSet,
    frames: NDArray[np.float64],
    n_clusters: int,
    options: RefinementOptions,
    rng: np.random.Generator,
    n_threads: int = 1,
) -> Materials:
    """Split texels whose frames are roughly known into materials.

    Parameters
    ----------
    data : SampleSet
        n texels.
    frames : (n, 3, 3) float64
        `local_from_base` by one target common to all.
    n_clusters : int
        Clusters at most; fewer where no split explains anything.
    options : RefinementOptions
    rng : numpy.random.Generator
        Of the splits' starts.
    n_threads : int

    Returns
    -------
    Materials
    """
    few = spread_rows(len(frames), max(TEXELS_PER_CLUSTER * n_clusters, LEAST_TEXELS))
    work = _Work(thinned(data.part(few)), options, rng, n_threads)
    found = _divided(work, frames[few], n_clusters)
    # Where texels are few, targets fitted to some of the views are not determined between them.
    found = one_round(data.part(few), found, options, n_threads)
    # Targets and frames may have turned together on the way; others begin where those that
    # took part have ended.
    turns = found.frames @ np.swapaxes(frames[few], 1, 2)
    common = mean_rotation(turns, found.brightness)
    everyone = Materials(
        found.targets, common @ frames, data.brightness(), np.zeros(len(frames), np.int32)
    )
    everyone.frames[few], everyone.cluster[few] = found.frames, found.cluster
    return choose(data, everyone, options, options.steps, n_threads)


def spread_rows(n: int, most: int) -> NDArray[np.int64]:
    """At most so many of n rows, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).astype(np.int64))


def thinned(data: SampleSet) -> SampleSet:
    """Every so many views of each texel: enough samples to choose among materials."""
    n_views, n_lights = data.samples.shape[1:]
    stride = max(1, n_views * n_lights // ENOUGH_SAMPLES)
    return SampleSet(
        np.ascontiguousarray(data.samples[:, ::stride]),
        np.ascontiguousarray(data.views[..., ::stride, :]),
        data.lights,
    )


def _divided(work: _Work, frames: NDArray[np.float64], n_clusters: int) -> Materials:
    """Materials and frames, by divisions and exchanges while the objective falls."""
    sides = [1 if count == 1 else work.options.side for count in work.data.samples.shape[1:]]
    empty = np.zeros((n_clusters, sides[0] ** 2, sides[1] ** 2), np.float32)
    state = Materials(
        NodeTargets(empty, sides[0], sides[1]),
        frames.copy(),
        work.data.brightness(),
        np.zeros(len(frames), np.int32),
    )
    state = _rounds(work, state, FIRST_ROUNDS)
    objective = work.objective(state)
    for _ in range(n_clusters - 1 + MOST_EXCHANGES):
        moved = _one_move(work, state)
        if moved is None:
            break
        moved = _rounds(work, moved, ROUNDS_PER_SPLIT)
        reached = work.objective(moved)
        if reached >= objective:
            break
        state, objective = moved, reached
    return _rounds(work, state, LAST_ROUNDS)


@dataclass(frozen=True, eq=False)
class _Work:
    """What every step of the division needs."""

    data: SampleSet
    options: RefinementOptions
    rng: np.random.Generator
    n_threads: int

    def objective(self, state: Materials) -> float:
        """What divisions must lower."""
        return mean_log_misfit(self.data, state, self.options.floor, self.n_threads)


def _rounds(work: _Work, state: Materials, n_rounds: int) -> Materials:
    for _ in range(n_rounds):
        state = one_round(work.data, state, work.options, work.n_threads)
    return state


def _one_move(work: _Work, state: Materials) -> Materials | None:
    """Divide the clusters that gain most; None if nothing is gained.

    Where no cluster is free, the one that is missed least is dissolved for a better division.
    """
    trial, gains = _divide(work, state)
    size = len(gains)
    free = np.flatnonzero(np.bincount(state.cluster, minlength=size) == 0)
    order = np.argsort(-gains, kind="stable")
    worthy = order[
        gains[order] >= max(WORTHY * gains[order[0]], LEAST_GAIN * len(state.frames))
    ]
    if len(worthy) == 0:
        return None
    cluster = state.cluster.copy()
    values = state.targets.values.copy()
    if len(free) == 0:
        loss, second = _losses(work, state)
        loss[worthy[0]] = np.inf
        gone = int(np.argmin(loss))
        if not loss[gone] < gains[worthy[0]] - LEAST_GAIN * len(state.frames):
            return None
        cluster[state.cluster == gone] = second[state.cluster == gone]
        free, worthy = np.array([gone]), worthy[:1]
    for new, k in zip(free, worthy, strict=False):
        cluster[(state.cluster == k) & (trial.cluster == size + k)] = new
        values[k], values[new] = trial.targets.values[k], trial.targets.values[size + k]
    targets = NodeTargets(values, state.targets.view_side, state.targets.light_side)
    return Materials(targets, state.frames, state.brightness, cluster)


def _divide(work: _Work, state: Materials) -> tuple[Materials, NDArray[np.float64]]:
    """Every cluster in two, and how much each division takes from the sum of log distance.

    Coarse residuals propose divisions in several ways; fitted targets tell which is best.
    """
    size = len(state.targets.values)
    before, features = residual_features(work.data, state, work.options.floor, work.n_threads)
    best, most = state, np.zeros(size)
    for propose in (_most_promising, _two_means, _two_directions):
        trial, after = _divided_by(work, state, propose, before, features)
        gain = np.log((before + FORGIVEN) / (after + FORGIVEN))
        gains = np.bincount(state.cluster, gain, size).astype(np.float64)
        better = gains > most
        most = np.where(better, gains, most)
        best = _joined(best, trial, better, state.cluster)
    return best, most


def _divided_by(
    work: _Work,
    state: Materials,
    propose: Proposal,
    before: NDArray[np.float64],
    features: NDArray[np.float32],
) -> tuple[Materials, NDArray[np.float64]]:
    """Every cluster in two as proposed, with fitted targets; each texel's distance then."""
    size = len(state.targets.values)
    cluster = state.cluster.copy()
    for k in range(size):
        mine = np.flatnonzero((state.cluster == k) & (state.brightness > 0))
        cluster[mine[propose(features[mine], before[mine], work.rng)]] += size
    t = state.targets
    doubled = NodeTargets(np.concatenate([t.values, t.values]), t.view_side, t.light_side)
    targets = fit_nodes(
        work.data,
        state.frames,
        state.brightness,
        cluster,
        doubled,
        work.options,
        work.n_threads,
    )
    trial = Materials(targets, state.frames, state.brightness, cluster)
    return trial, own_misfit(work.data, trial, work.options.floor, work.n_threads)


def _joined(
    best: Materials,
    trial: Materials,
    better: NDArray[np.bool_],
    parent: NDArray[np.int32],
) -> Materials:
    """`best` with the divisions of `trial` for those clusters where they are better."""
    t, size = trial.targets, len(better)
    values = t.values.copy()
    if len(best.targets.values) == 2 * size:
        kept = np.tile(~better, 2)
        values[kept] = best.targets.values[kept]
    cluster = np.where(better[parent], trial.cluster, best.cluster)
    targets = NodeTargets(values, t.view_side, t.light_side)
    return Materials(targets, trial.frames, trial.brightness, cluster)


def _losses(work: _Work, state: Materials) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """What dissolving each cluster adds to the sum of log distance, and where its texels go."""
    here = misfits(work.data, state.frames, state.targets, work.options.floor, work.n_threads)
    rows = np.arange(len(here))
    own = here[rows, state.cluster].copy()
    here[rows, state.cluster] = np.inf
    second = np.argmin(here, axis=1).astype(np.int32)
    loss = np.log((here[rows, second] + FORGIVEN) / (own + FORGIVEN))
    return np.bincount(state.cluster, loss, here.shape[1]).astype(np.float64), second


def one_round(
    data: SampleSet, state: Materials, options: RefinementOptions, n_threads: int
) -> Materials:
    """Fit the targets, then give each texel the material and the frame that fit it best."""
    targets = fit_nodes(
        data,
        state.frames,
        state.brightness,
        state.cluster,
        state.targets,
        options,
        n_threads,
    )
    fitted = Materials(targets, state.frames, state.brightness, state.cluster)
    return choose(data, fitted, options, 1, n_threads)


def choose(
    data: SampleSet,
    state: Materials,
    options: RefinementOptions,
    n_steps: int,
    n_threads: int,
) -> Materials:
    """Frames after Gauss-Newton steps against the two likeliest materials; the better one's."""
    targets = state.targets
    if len(targets.values) == 1:
        return _improved(data, state, state.cluster, options, n_steps, n_threads)
    here = misfits(data, state.frames, targets, options.floor, n_threads)
    likeliest = np.argsort(here, axis=1, kind="stable")[:, :2].astype(np.int32)
    best = _improved(data, state, likeliest[:, 0], options, n_steps, n_threads)
    first, second = np.take_along_axis(here, likeliest, axis=1).T
    doubtful = np.flatnonzero((second < AMBIGUOUS * first) & (state.brightness > 0))
    if len(doubtful) == 0:
        return best
    part = data.part(doubtful)
    other = _improved(
        part, state.part(doubtful), likeliest[doubtful, 1], options, n_steps, n_threads
    )
    least = own_misfit(part, best.part(doubtful), options.floor, n_threads)
    better = own_misfit(part, other, options.floor, n_threads) < least
    rows = doubtful[better]
    best.frames[rows], best.brightness[rows] = other.frames[better], other.brightness[better]
    best.cluster[rows] = other.cluster[better]
    return best


def _improved(
    data: SampleSet,
    state: Materials,
    cluster: NDArray[np.int32],
    options: RefinementOptions,
    n_steps: int,
    n_threads: int,
) -> Materials:
    """Frames and brightness after Gauss-Newton steps against the given materials."""
    moved = Materials(
        state.targets,
        state.frames.copy(),
        state.brightness.copy(),
        np.ascontiguousarray(cluster),
    )
    improve_frames(
        data,
        moved.frames,
        moved.brightness,
        moved.cluster,
        moved.targets,
        options,
        n_steps,
        n_threads,
    )
    return moved


def own_misfit(
    data: SampleSet, state: Materials, floor: float, n_threads: int
) -> NDArray[np.float64]:
    """Distance of each texel to its own target, (n,); parameters as `misfits`."""
    out = np.zeros(len(state.frames))
    t = state.targets
    for k in np.unique(state.cluster):
        mine = np.flatnonzero(state.cluster == k)
        one = NodeTargets(t.values[k : k + 1], t.view_side, t.light_side)
        out[mine] = misfits(data.part(mine), state.frames[mine], one, floor, n_threads)[:, 0]
    return out


def mean_log_misfit(data: SampleSet, state: Materials, floor: float, n_threads: int) -> float:
    """Mean over the texels of the log distance to their own targets; as `misfits`."""
    seen = state.brightness > 0
    distance = own_misfit(data, state, floor, n_threads)[seen]
    return float(np.log(distance + FORGIVEN).sum() / max(len(distance), 1))


def _most_promising(
    features: NDArray[np.float32], distance: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Group that gains most from a target of its own: who is in it."""
    best, most = np.zeros(len(features), bool), 0.0
    size = np.linalg.norm(features, axis=1, keepdims=True)
    for trial in range(SPLIT_TRIES if len(features) > 1 else 0):
        # Every other try compares directions only, so that no few texels dominate.
        x = features / np.maximum(size, 1e-15) if trial % 2 else features
        labels = _means(x, MOST_GROUPS[trial % len(MOST_GROUPS)], rng)
        for k in range(int(labels.max()) + 1):
            group = labels == k
            if group.all() or not group.any():
                continue
            gain = _promise(features[group], distance[group])
            gain += max(_promise(features[~group], distance[~group]), 0.0)
            if gain > most:
                best, most = group, gain
    return best


def _two_means(
    features: NDArray[np.float32], distance: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Second of two groups of residuals."""
    if len(features) < 2:
        return np.zeros(len(distance), bool)
    return _means(features, 2, rng) == 1


def _two_directions(
    features: NDArray[np.float32], distance: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Second of two groups of residuals, whatever their size."""
    size = np.linalg.norm(features, axis=1, keepdims=True)
    return _two_means(features / np.maximum(size, 1e-15), distance, rng)


def _means(
    x: NDArray[np.float32], n_groups: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Labels of k-means, seeded far apart (k-means++)."""
    squares = np.einsum("nf,nf->n", x, x)
    centres = x[rng.integers(len(x), size=1)]
    labels = np.zeros(len(x), np.int64)
    for _ in range(SPLIT_ROUNDS):
        away = squares[:, None] - 2 * x @ centres.T + np.einsum("kf,kf->k", centres, centres)
        if len(centres) < n_groups:
            chance = np.maximum(away.min(axis=1), 0.0).astype(np.float64)
            if not chance.sum() > 0:
                break
            new = rng.choice(len(x), p=chance / chance.sum())
            centres = np.concatenate([centres, x[new : new + 1]])
            continue
        now = np.argmin(away, axis=1)
        if np.array_equal(now, labels):
            break
        labels = now
        centres = np.stack(
            [
                x[labels == k].mean(axis=0) if (labels == k).any() else centres[k]
                for k in range(n_groups)
            ]
        )
    return labels


def _promise(features: NDArray[np.float32], distance: NDArray[np.float64]) -> float:
    """Sum of log distance that the mean residual of a group takes away."""
    mean = features.mean(axis=0)
    left = np.maximum(distance - 2 * features @ mean + mean @ mean, UNEXPLAINED * distance)
    return float(np.sum(np.log((distance + FORGIVEN) / (left + FORGIVEN))))
