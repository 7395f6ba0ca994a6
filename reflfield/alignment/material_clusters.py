r"""Materials told apart on the samples themselves.

Band-limited correlation (Eq. 12 of Müller, Sarlette and Klein, Eurographics 2006) tells
materials apart that differ much. What the horizon cuts off a tilted texel changes its
harmonics more than a similar material does, so similar ones are told apart by sharp
targets, which know both horizons (`reflfield.alignment.material_distance`).

The search begins with one target for all texels. Residuals of one material
agree in the texels' own frames, so a cluster is split in two where its residuals form two
groups; the cluster whose split promises most goes first, by the sum of the log distance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.frame_ambiguity import mean_rotation
from reflfield.alignment.material_distance import (
    NOISE_DISTANCE,
    distances,
    log_improvement,
    own_distance,
    residual_features,
)
from reflfield.alignment.refinement import (
    RefinementOptions,
    SharpAlignment,
    fit_sharp_targets,
    improve_frames,
)
from reflfield.alignment.sample_sources import SampleSet
from reflfield.alignment.spline_targets import SplineTargets
from reflfield.factorization.clustering import seeded_labels

# Rounds of target and frames before the first split, after each, and at the end.
FIRST_ROUNDS = 3
ROUNDS_PER_SPLIT = 2
LAST_ROUNDS = 3
# Splits that promise at least this share of the best are done at once.
SHARE_OF_BEST = 0.5
# Clusters dissolved at most, each for a better split of another.
MOST_EXCHANGES = 6
# Mean gain in log distance over all texels below which a split is noise.
LEAST_GAIN = 1e-3
# Texels that the materials are found on, per cluster and at least; samples of each.
TEXELS_PER_CLUSTER = 192
LEAST_TEXELS = 768
ENOUGH_SAMPLES = 2048
# A texel tries its second material where that is at most so many times as far.
AMBIGUOUS = 4.0
# Residuals are split in two by their values, and by their directions alone.
PROPOSALS = ("values", "directions")


def tell_apart(
    data: SampleSet,
    frames: NDArray[np.float64],
    n_clusters: int,
    options: RefinementOptions,
    rng: np.random.Generator,
    n_threads: int = 1,
) -> SharpAlignment:
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
        Of the splits' seeds.
    n_threads : int

    Returns
    -------
    SharpAlignment
    """
    some = spread_rows(len(frames), max(TEXELS_PER_CLUSTER * n_clusters, LEAST_TEXELS))
    own = data.part(some)
    work = _Work(own.thinned(ENOUGH_SAMPLES), options, rng, n_threads)
    materials = _divided(work, frames[some], n_clusters)
    # Where texels are few, targets fitted to some of the views are not determined between them.
    materials = one_round(own, materials, options, n_threads)
    # Targets and frames may have rotated together on the way; others begin where those that
    # took part have ended.
    rotations = materials.frames @ np.swapaxes(frames[some], 1, 2)
    common = mean_rotation(rotations, materials.brightness)
    everyone = SharpAlignment.begin(
        data, common @ frames, np.zeros(len(frames), np.int32), materials.targets
    ).with_part(some, materials)
    return choose(data, everyone, options, options.steps, n_threads)


def spread_rows(n: int, most: int) -> NDArray[np.int64]:
    """At most so many of n rows, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).astype(np.int64))


@dataclass(frozen=True, eq=False)
class _Work:
    """What every step of the division needs."""

    data: SampleSet
    options: RefinementOptions
    rng: np.random.Generator
    n_threads: int

    def own_distance(self, state: SharpAlignment) -> NDArray[np.float64]:
        """Distance of each texel to its own target."""
        return own_distance(self.data, state, self.options.floor, self.n_threads)

    def objective(self, state: SharpAlignment) -> float:
        """Mean log distance, which splits must lower."""
        distance = self.own_distance(state)[state.brightness > 0]
        return float(np.log(distance + NOISE_DISTANCE).sum() / max(len(distance), 1))

    def rounds(self, state: SharpAlignment, n_rounds: int) -> SharpAlignment:
        """Targets, then materials and frames, in alternation."""
        for _ in range(n_rounds):
            state = one_round(self.data, state, self.options, self.n_threads)
        return state


def _divided(work: _Work, frames: NDArray[np.float64], n_clusters: int) -> SharpAlignment:
    """Materials and frames, by splits and exchanges while the objective falls."""
    counts = work.data.samples.shape[1:]
    targets = SplineTargets.zeros(n_clusters, counts, work.options.side)
    cluster = np.zeros(len(frames), np.int32)
    state = SharpAlignment.begin(work.data, frames, cluster, targets)
    state = work.rounds(state, FIRST_ROUNDS)
    objective = work.objective(state)
    for _ in range(n_clusters - 1 + MOST_EXCHANGES):
        moved = _one_move(work, state)
        if moved is None:
            break
        moved = work.rounds(moved, ROUNDS_PER_SPLIT)
        reached = work.objective(moved)
        if reached >= objective:
            break
        state, objective = moved, reached
    return work.rounds(state, LAST_ROUNDS)


def _one_move(work: _Work, state: SharpAlignment) -> SharpAlignment | None:
    """Split the clusters that gain most; None if nothing is gained.

    Where no cluster is free, the one that is missed least is dissolved for a better split.
    """
    split, gains = _best_splits(work, state)
    size, noise = len(gains), LEAST_GAIN * len(state.frames)
    free = np.flatnonzero(np.bincount(state.cluster, minlength=size) == 0)
    order = np.argsort(-gains, kind="stable")
    chosen = order[gains[order] >= max(SHARE_OF_BEST * gains[order[0]], noise)]
    if len(chosen) == 0:
        return None
    cluster, values = state.cluster.copy(), state.targets.values.copy()
    if len(free) == 0:
        loss, second = _losses(work, state)
        loss[chosen[0]] = np.inf
        gone = int(np.argmin(loss))
        if not loss[gone] < gains[chosen[0]] - noise:
            return None
        cluster[state.cluster == gone] = second[state.cluster == gone]
        free, chosen = np.array([gone]), chosen[:1]
    for new, k in zip(free, chosen, strict=False):
        cluster[(state.cluster == k) & (split.cluster == size + k)] = new
        values[k], values[new] = split.targets.values[k], split.targets.values[size + k]
    return replace(state, cluster=cluster, targets=state.targets.replaced(values))


def _best_splits(
    work: _Work, state: SharpAlignment
) -> tuple[SharpAlignment, NDArray[np.float64]]:
    """Every cluster k in two, k and n_clusters + k, and how much log distance each split saves.

    Coarse residuals propose splits; fitted targets tell which is better.
    """
    size = len(state.targets.values)
    before, features = residual_features(work.data, state, work.options.floor, work.n_threads)
    values = np.concatenate([state.targets.values] * 2)
    best, most = replace(state, targets=state.targets.replaced(values)), np.zeros(size)
    for proposal in PROPOSALS:
        split = _split(work, state, features if proposal == "values" else _directions(features))
        gain = log_improvement(before, work.own_distance(split))
        gains = np.bincount(state.cluster, gain, size).astype(np.float64)
        better = gains > most
        most = np.where(better, gains, most)
        values = np.where(np.tile(better, 2)[:, None, None], split.targets.values, values)
        cluster = np.where(better[state.cluster], split.cluster, best.cluster)
        best = replace(best, cluster=cluster, targets=state.targets.replaced(values))
    return best, most


def _directions(features: NDArray[np.float32]) -> NDArray[np.float32]:
    size = np.linalg.norm(features, axis=1, keepdims=True)
    return features / np.maximum(size, np.float32(1e-15))


def _split(work: _Work, state: SharpAlignment, features: NDArray[np.float32]) -> SharpAlignment:
    """Every cluster in two groups of residuals, with fitted targets."""
    cluster, size = state.cluster.copy(), len(state.targets.values)
    for k in range(size):
        mine = np.flatnonzero((state.cluster == k) & (state.brightness > 0))
        if len(mine) > 1:
            cluster[mine] += size * seeded_labels(features[mine], 2, work.rng)
    doubled = state.targets.replaced(np.concatenate([state.targets.values] * 2))
    split = replace(state, targets=doubled, cluster=cluster)
    return fit_sharp_targets(work.data, split, work.options, work.n_threads)


def _losses(
    work: _Work, state: SharpAlignment
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """What dissolving each cluster adds to the log distance, and where its texels go."""
    here = distances(work.data, state, work.options.floor, work.n_threads)
    rows = np.arange(len(here))
    own = here[rows, state.cluster].copy()
    here[rows, state.cluster] = np.inf
    second = np.argmin(here, axis=1).astype(np.int32)
    loss = log_improvement(here[rows, second], own)
    return np.bincount(state.cluster, loss, here.shape[1]).astype(np.float64), second


def one_round(
    data: SampleSet, state: SharpAlignment, options: RefinementOptions, n_threads: int
) -> SharpAlignment:
    """Fit the targets, then give each texel the material and the frame that fit it best."""
    fitted = fit_sharp_targets(data, state, options, n_threads)
    return choose(data, fitted, options, 1, n_threads)


def choose(
    data: SampleSet,
    state: SharpAlignment,
    options: RefinementOptions,
    n_steps: int,
    n_threads: int,
) -> SharpAlignment:
    """Frames after Gauss-Newton steps against the two likeliest materials; the better one's.

    Parameters
    ----------
    data : SampleSet
        n texels.
    state : SharpAlignment
    options : RefinementOptions
    n_steps : int
        At most.
    n_threads : int

    Returns
    -------
    SharpAlignment
        With the same targets.
    """
    if len(state.targets.values) == 1:
        return improve_frames(data, state, options, n_steps, n_threads)
    here = distances(data, state, options.floor, n_threads)
    likeliest = np.argsort(here, axis=1, kind="stable")[:, :2].astype(np.int32)
    nearest = replace(state, cluster=np.ascontiguousarray(likeliest[:, 0]))
    best = improve_frames(data, nearest, options, n_steps, n_threads)
    first, second = np.take_along_axis(here, likeliest, axis=1).T
    doubtful = np.flatnonzero((second < AMBIGUOUS * first) & (state.brightness > 0))
    if len(doubtful) == 0:
        return best
    part, own = data.part(doubtful), best.part(doubtful)
    other = replace(state.part(doubtful), cluster=np.ascontiguousarray(likeliest[doubtful, 1]))
    other = improve_frames(part, other, options, n_steps, n_threads)
    better = own_distance(part, other, options.floor, n_threads) < own_distance(
        part, own, options.floor, n_threads
    )
    return best.with_part(doubtful[better], other.part(np.flatnonzero(better)))
