r"""Targets and rotations of many ABRDFs together: expectation maximisation.

Algorithm 1 and section 4.3 of Müller, Sarlette and Klein (Eurographics
2006) with the mean formed exactly, in coefficient space: for the functions of
one cluster :math:`c = \sum_i w_i \Delta(R_i)^\top A_i` is a plain matrix product over
all of them.
Targets have unit norm, so each step can only raise

.. math::  \sum_i w_i \langle A_i, \Delta(R_i)\, c_{k(i)} \rangle .
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.correlation import spectrum
from reflfield.alignment.newton_ascent import follow
from reflfield.alignment.rotation_search import (
    SearchOptions,
    SearchResult,
    map_blocks,
    search,
)
from reflfield.sphere.coupling import Coupled, join_coupled
from reflfield.sphere.wigner import block_offsets, rotation_blocks
from reflfield.util.progress import report

# Functions that the seeding compares with, and candidates for the first target.
SEEDING_SAMPLE = 256
SEEDING_TRIALS = 6
# A function this many times brighter than the median weighs no more in the mean.
WEIGHT_LIMIT = 4.0
# Newton steps from the rotation of the iteration before.
ASCENT_STEPS = 8
# The accumulated correlation has converged when it grows by less than this share.
CONVERGED_GAIN = 1e-6
MEAN_BLOCK = 256


@dataclass(frozen=True, eq=False)
class TargetFit:
    """Targets, and how each training function fits them.

    Parameters
    ----------
    targets : Coupled
        One unit function a cluster.
    matches : SearchResult
        Rotation, score, margin and cluster of each function.
    history : (k,) float64
        Weighted mean of the correlations with unit targets, over the largest possible: 1 if all
        functions are rotated copies. Never falls.
    """

    targets: Coupled
    matches: SearchResult
    history: NDArray[np.float64]


def fit_targets(
    source: Coupled,
    *,
    n_clusters: int,
    iterations: int,
    rng: np.random.Generator,
    max_tilt: float | None = None,
    n_threads: int = 1,
) -> TargetFit:
    """Targets of `n_clusters` clusters, with rotations and labels of the functions.

    Parameters
    ----------
    source : Coupled
        n functions. Zero functions take no part.
    n_clusters : int
        At most as many targets as there are functions that are not zero; at least one.
    iterations : int
        Rounds of search and mean; fewer if the correlation stops growing.
    rng : numpy.random.Generator
        Of the seeding.
    max_tilt : float, optional
        See `search`.
    n_threads : int
        See `search`.

    Returns
    -------
    TargetFit
    """
    norms = source.norms()
    weights = mean_weights(norms)
    units = source.units()
    options: SearchOptions = {"max_tilt": max_tilt, "n_threads": n_threads}
    targets = seed_targets(units, weights, n_clusters, rng, options)
    history: list[float] = []
    matches: SearchResult | None = None
    for iteration in range(iterations):
        report("aligning", iteration, iterations)
        matches = _expectation(units, targets, matches, options)
        history.append(float(weights @ matches.score / max(weights.sum(), 1e-300)))
        if len(history) > 1 and history[-1] - history[-2] <= CONVERGED_GAIN * abs(history[-1]):
            break
        targets = mean_targets(units, weights, matches, len(targets))
        targets = _reseed_empty(targets, units, weights, matches)
    report("aligning", iterations, iterations)
    if matches is None:
        matches = search(units, targets, **options)
    return TargetFit(targets, matches, np.array(history))


def mean_weights(norms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weight of each unit function in the mean: its norm, limited."""
    positive = norms[norms > 0]
    if len(positive) == 0:
        return np.zeros_like(norms)
    median = float(np.median(positive))
    return np.minimum(norms / median, WEIGHT_LIMIT)


def _expectation(
    units: Coupled, targets: Coupled, before: SearchResult | None, options: SearchOptions
) -> SearchResult:
    """Best rotation and target; from the earlier rotation first, where one is known."""
    if before is None or len(targets) > 1:
        matches = search(units, targets, margins=False, **options)
        return (
            matches if before is None else _not_worse(units, targets, matches, before, options)
        )
    near = ascend_near(units, targets, before, ASCENT_STEPS, options)
    fell = np.flatnonzero(near.score < before.score)
    if len(fell) > 0:
        start = near.rotations[fell]
        again = search(units[fell], targets, start=start, margins=False, **options)
        for name in ("rotations", "score", "margin", "cluster"):
            getattr(near, name)[fell] = getattr(again, name)
    return near


def ascend_near(
    units: Coupled,
    targets: Coupled,
    before: SearchResult,
    n_steps: int,
    options: SearchOptions,
) -> SearchResult:
    """Newton ascent from known rotations, each function towards its own target.

    Parameters
    ----------
    units : Coupled
        n unit functions.
    targets : Coupled
        One unit function per cluster.
    before : SearchResult
        Of the n functions; clusters and margins stay.
    n_steps : int
        Newton steps at most, besides a short last one.
    options : SearchOptions

    Returns
    -------
    SearchResult
    """

    def block(rows: slice) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        part, labels = units[rows], before.cluster[rows]
        rotations = before.rotations[rows].copy()
        score = np.zeros(len(part))
        for k in np.unique(labels):
            mine = np.flatnonzero(labels == k)
            series = spectrum(part[mine], targets[k : k + 1])
            rotations[mine], at = follow(
                series, np.arange(len(mine)), rotations[mine], n_steps, options["max_tilt"]
            )
            score[mine] = at[:, 0]
        return rotations, score

    parts = map_blocks(block, len(units), MEAN_BLOCK, options["n_threads"])
    rotations = np.concatenate([part[0] for part in parts])
    return replace(before, rotations=rotations, score=np.concatenate([p[1] for p in parts]))


def _not_worse(
    units: Coupled,
    targets: Coupled,
    matches: SearchResult,
    before: SearchResult,
    options: SearchOptions,
) -> SearchResult:
    """Keep the earlier cluster and rotation where the search found nothing better."""
    near = ascend_near(units, targets, before, ASCENT_STEPS, options)
    better = near.score > matches.score
    for name in ("rotations", "score", "cluster"):
        getattr(matches, name)[better] = getattr(near, name)[better]
    return matches


def mean_targets(
    units: Coupled, weights: NDArray[np.float64], matches: SearchResult, n_targets: int
) -> Coupled:
    """Unit mean of each cluster's functions, rotated back into the common frame.

    Returns
    -------
    Coupled
        `n_targets` functions; zero where a cluster is empty.
    """
    totals = [_rotated_sum(units, weights, matches, k) for k in range(n_targets)]
    return join_coupled(totals).units()


def _rotated_sum(
    units: Coupled, weights: NDArray[np.float64], matches: SearchResult, k: int
) -> Coupled:
    """Sum of w_i Delta(R_i)^T A_i over a cluster, one product per degree and block."""
    offsets = block_offsets(units.n_degrees)
    totals = [np.zeros(block.shape[1:], np.float64) for block in units.blocks]
    members = np.flatnonzero((matches.cluster == k) & (weights > 0))
    for first in range(0, len(members), MEAN_BLOCK):
        rows = members[first : first + MEAN_BLOCK]
        matrices = rotation_blocks(matches.rotations[rows], units.n_degrees, str(units.dtype))
        matrices *= weights[rows, None].astype(matrices.dtype)
        for j, block in enumerate(units.blocks):
            size = 2 * j + 1
            delta = matrices[:, offsets[j] : offsets[j + 1]].reshape(-1, size)
            totals[j] += delta.T @ block[rows].reshape(-1, block.shape[2])
    blocks = tuple(total[None].astype(units.dtype) for total in totals)
    return Coupled(units.band_limits, blocks)


def _reseed_empty(
    targets: Coupled, units: Coupled, weights: NDArray[np.float64], matches: SearchResult
) -> Coupled:
    """Give each empty cluster the function that fits its own cluster worst."""
    empty = np.flatnonzero(~(targets.norms() > 0))
    if len(empty) == 0:
        return targets
    loss = weights * (1.0 - matches.score)
    worst = np.argsort(-loss, kind="stable")[: len(empty)]
    parts = [targets[k : k + 1] for k in range(len(targets))]
    for k, i in zip(empty, worst, strict=False):
        if weights[i] > 0:
            parts[k] = units[i : i + 1]
    return join_coupled(parts)


def seed_targets(
    units: Coupled,
    weights: NDArray[np.float64],
    n_clusters: int,
    rng: np.random.Generator,
    options: SearchOptions,
) -> Coupled:
    """First targets: k-means++ by the distance that no rotation changes (Eq. 12).

    The first is the most central of a few functions drawn at random; each further one is
    drawn with probability proportional to its distance from those before.
    """
    alive = np.flatnonzero(weights > 0)
    if len(alive) == 0:
        return units[:1]
    drawn = rng.choice(alive, min(SEEDING_SAMPLE * max(1, n_clusters // 4), len(alive)), False)
    drawn = np.sort(drawn)
    sample, weight = units[drawn], weights[drawn]
    chance = weight / weight.sum()
    tries = rng.choice(len(drawn), min(SEEDING_TRIALS, len(drawn)), False, chance)
    probe = slice(0, len(sample), max(1, len(sample) // 64))
    closeness = [
        weight[probe] @ search(sample[probe], sample[i : i + 1], margins=False, **options).score
        for i in tries
    ]
    chosen = [int(tries[int(np.argmax(closeness))])]
    nearest = search(sample, sample[chosen[0] : chosen[0] + 1], margins=False, **options).score
    while len(chosen) < min(n_clusters, len(sample)):
        distance = np.maximum(1.0 - nearest, 0.0) * weight
        distance[chosen] = 0.0
        if not distance.sum() > 0:
            break
        # Of a few drawn, the one that leaves the others nearest.
        n_drawn = min(SEEDING_TRIALS, int(np.count_nonzero(distance)))
        tries = rng.choice(len(sample), n_drawn, False, distance / distance.sum())
        scores = [
            np.maximum(
                nearest, search(sample, sample[i : i + 1], margins=False, **options).score
            )
            for i in tries
        ]
        best = int(np.argmax([weight @ score for score in scores]))
        chosen.append(int(tries[best]))
        nearest = scores[best]
    return sample[np.array(chosen)]
