"""Which silhouettes contradict the others.

Silhouettes of one object agree: along the ray of every pixel that one shows as object there
is a point that no other view excludes. Where there is none, the point that the fewest views
exclude tells who contradicts whom. A wrong view contradicts most of the others, a good one
the wrong ones alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reflfield.geometry.cones import View
from reflfield.util.blas_threads import thread_pool

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Share of a silhouette along whose rays nothing is left, above which views contradict each
# other. Measured on captures without a fault (largest over the views): 0 for the simulated
# ones, .0024 (dinoSparseRing), .0099 (66 photographs of a head, masked by hand) and .0168
# (templeSparseRing); one mask shifted by an eighth of the object's width: .043 to .12.
CONTRADICTION = 0.03

# Voxels along the longest side of the box, as fine as pixels within these limits, and views
# times voxels.
_COARSEST = 32
FINEST_VOTES = 96
_MOST_TESTS = 25_000_000
# Rays of all views together, and samples of them at a time.
_RAYS = 20_000
_SAMPLES_AT_ONCE = 1 << 20
# Width of the outline that photographs leave open, pixels.
_NOISE_PX = 0.5
# More views than this share cannot all be wrong while the others are right.
_LARGEST_MINORITY = 0.25
# Of so many views one is set aside at a time.
_VIEWS_PER_STEP = 60
# Fewer views than this always agree, or cannot tell which of them is wrong.
_SMALLEST_MAJORITY = 3


@dataclass(frozen=True, eq=False)
class Votes:
    """Voxels of a box, and which views exclude them.

    Parameters
    ----------
    low : (3,) float64
        Corner of the box, metres.
    spacing : float
        Side of a voxel, metres.
    shape : tuple of int
        Voxels along x, y and z.
    excluded : (n_views, n_voxels) bool
        True where a voxel lies outside of a silhouette's cone by its size and half a pixel.
    nearest : (n_voxels,) float32
        Smallest signed distance to a cone, metres.
    """

    low: Array
    spacing: float
    shape: tuple[int, ...]
    excluded: Bool
    nearest: NDArray[np.float32]

    def of(self, some: Sequence[int]) -> Bool:
        """Rows of some views."""
        rows: Bool = self.excluded[list(some)]
        return rows


@dataclass(frozen=True, eq=False)
class Evidence:
    """Who excludes what the others show.

    Parameters
    ----------
    blame : (n_views, n_views) float64
        Share of the silhouette of view w (column) along whose rays no point is left, and
        whose best point view u (row) excludes, divided by the number of views that do.
    uncovered : (n_views,) float64
        Share of each silhouette along whose rays every point is excluded by some view.
    """

    blame: Array
    uncovered: Array


@dataclass(frozen=True, eq=False)
class Verdict:
    """What the silhouettes say about each other.

    Parameters
    ----------
    outliers : tuple of int
        Views without which the others agree; empty if all agree, or if no few views are
        to blame.
    agree : bool
        True if the views agree that are no outliers.
    uncovered : (n_views,) float64
        Share of each silhouette that the others exclude, all views considered.
    excluded : (n_views,) float64
        Mean share of the other silhouettes that a view alone excludes.
    """

    outliers: tuple[int, ...]
    agree: bool
    uncovered: Array
    excluded: Array


def judge(views: Sequence[View], low: Array, high: Array) -> Verdict:
    """Find the views that contradict all others.

    The view with the largest share in all contradictions is set aside until the rest
    agrees; then each that would not disturb the rest is taken back.

    Parameters
    ----------
    views : sequence of View
    low, high : (3,) float64
        Box that holds the object, metres.

    Returns
    -------
    Verdict
    """
    votes = votes_of(views, low, high)
    return set_aside(len(views), lambda some: gather(views, votes, some), CONTRADICTION)


def set_aside(
    n_views: int, evidence_of: Callable[[Sequence[int]], Evidence], most_uncovered: float
) -> Verdict:
    """Find the views that contradict all others, by evidence of any kind.

    Parameters
    ----------
    n_views : int
    evidence_of : callable
        ``evidence_of(some)``: evidence of some of the views, in their order.
    most_uncovered : float
        Share that other views exclude of one which agrees with them.

    Returns
    -------
    Verdict
    """
    everyone = list(range(n_views))
    evidence = first = evidence_of(everyone)
    kept, aside = everyone, list[int]()
    most = min(int(max(1, _LARGEST_MINORITY * n_views)), n_views - _SMALLEST_MAJORITY)
    while evidence.uncovered.max() > most_uncovered and len(aside) < most:
        share = evidence.blame.sum(axis=0) + evidence.blame.sum(axis=1)
        n_next = min(max(1, n_views // _VIEWS_PER_STEP), most - len(aside))
        aside += [kept[i] for i in np.argsort(-share, kind="stable")[:n_next]]
        kept = [i for i in everyone if i not in aside]
        evidence = evidence_of(kept)
    agree = bool(evidence.uncovered.max() <= most_uncovered)
    outliers = aside if agree else []
    for view in list(outliers) if len(outliers) > 1 else []:
        some = sorted([*kept, view])
        if evidence_of(some).uncovered.max() <= most_uncovered:
            outliers.remove(view)
            kept = some
    others = max(n_views - 1, 1)
    excluded = (first.blame.sum(axis=1) - np.diag(first.blame)) / others
    return Verdict(tuple(sorted(outliers)), agree, first.uncovered, excluded)


def votes_of(views: Sequence[View], low: Array, high: Array, workers: int = 1) -> Votes:
    """Which views exclude which voxels of a box.

    A voxel is excluded if it lies farther outside of a cone than its size and half a pixel, so
    that neither the grid nor noisy outlines exclude anything. The votes do not depend on the
    number of threads.
    """
    longest = float((high - low).max())
    filled = float(np.prod((high - low) / longest))
    affordable = (_MOST_TESTS / len(views) / filled) ** (1.0 / 3.0)
    pixel = np.median(
        [view.distance_and_pixel(0.5 * (low + high)[None])[1][0] for view in views]
    )
    useful = max(longest / max(float(pixel), longest / FINEST_VOTES), _COARSEST)
    spacing = longest / min(FINEST_VOTES, int(affordable), int(useful))
    shape = tuple(int(n) for n in np.ceil((high - low) / spacing - 1e-9))
    centres = low + spacing * (np.indices(shape).reshape(3, -1).T + 0.5)
    excluded = np.zeros((len(views), len(centres)), dtype=bool)
    nearest = np.full(len(centres), np.inf, dtype=np.float32)

    def vote(number: int) -> Array:
        distance, pixel = views[number].distance_and_pixel(centres)
        excluded[number] = distance < -(spacing + _NOISE_PX * pixel)
        return distance

    with thread_pool(workers) as pool:
        for first in range(0, len(views), 2 * max(workers, 1)):
            some = range(first, min(first + 2 * max(workers, 1), len(views)))
            for distance in pool.map(vote, some):
                np.minimum(nearest, distance, out=nearest)
    return Votes(low, spacing, shape, excluded, nearest)


def gather(views: Sequence[View], votes: Votes, some: Sequence[int]) -> Evidence:
    """Evidence for and against some of the views, in their order."""
    excluded = votes.of(some)
    score = best_score(votes, excluded)
    n = len(some)
    blame, uncovered = np.zeros((n, n)), np.zeros(n)
    for number, view in enumerate(some):
        pixels = views[view].covered_pixels(max(_RAYS // n, 100))
        best = best_on_rays(views[view], pixels, votes, score)
        against = excluded[:, best[best >= 0]]
        weight = 1.0 / np.maximum(against.sum(axis=0), 1)
        blame[:, number] = (against * weight).sum(axis=1) / max(len(best), 1)
        lost = int(against.any(axis=0).sum()) + int((best < 0).sum())
        uncovered[number] = lost / max(len(best), 1)
    return Evidence(blame, uncovered)


def best_score(votes: Votes, excluded: Bool) -> NDArray[np.float32]:
    """Number of views that exclude each voxel, less where it is closer to all cones.

    One element more than there are voxels, infinite: what lies outside of the box.
    """
    size = votes.spacing * max(votes.shape)
    score = excluded.sum(axis=0) - np.clip(votes.nearest / size, -0.49, 0.49)
    return np.append(score, np.inf).astype(np.float32)


def best_on_rays(
    view: View, pixels: Array, votes: Votes, score: NDArray[np.float32]
) -> NDArray[np.intp]:
    """Voxel of the lowest score on the ray of each pixel, (n,); -1 if it misses the box."""
    origins, ways = view.camera.rays(pixels)
    side = votes.spacing * np.array(votes.shape)
    reach = 0.5 * float(np.linalg.norm(side))
    along = ((votes.low + 0.5 * side - origins) * ways).sum(axis=1)
    steps = np.arange(-reach, reach, 0.9 * votes.spacing)
    best = np.full(len(pixels), -1)
    at_once = max(1, _SAMPLES_AT_ONCE // len(steps))
    for begin in range(0, len(pixels), at_once):
        part = slice(begin, begin + at_once)
        distance = along[part, None] + steps
        voxel = _voxels(origins[part, None] + distance[..., None] * ways[part, None], votes)
        if view.camera.kind != "orthographic":
            voxel[distance <= 0.0] = len(score) - 1
        chosen = voxel[np.arange(len(voxel)), score[voxel].argmin(axis=1)]
        best[part] = np.where(chosen == len(score) - 1, -1, chosen)
    return best


def _voxels(points: Array, votes: Votes) -> NDArray[np.intp]:
    """Index of the voxel that holds each point, one past the last for none."""
    cell = np.floor((points - votes.low) / votes.spacing).astype(np.intp)
    shape = np.array(votes.shape)
    inside = ((cell >= 0) & (cell < shape)).all(axis=-1)
    index = (cell[..., 0] * shape[1] + cell[..., 1]) * shape[2] + cell[..., 2]
    return np.where(inside, index, int(shape.prod()))
