"""Best rotation, and best target, of many functions: the E-step of the alignment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypedDict, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.alignment.candidate_ascent import (
    APPROACH_DEGREES,
    PEAK_DISTANCE,
    Candidates,
    Maxima,
    SearchRules,
    ascend_best,
)
from reflfield.alignment.coarse_search import coarse_peaks
from reflfield.alignment.correlation import degree_arrays, degrees_of, spectrum
from reflfield.alignment.newton_ascent import follow, lowest_z_of
from reflfield.errors import InputError
from reflfield.sphere.coupling import Coupled
from reflfield.util.blas_threads import one_core_blas, thread_pool
from reflfield.util.validation import check_shape

# Functions handled together: their series and coarse values stay within a few MB.
BLOCK = 256
# Of eight, a thousandth of tilted anisotropic ABRDFs miss the highest; of four, a fortieth.
N_PEAKS = 8
# Targets whose coarse peak is among the best few are searched with all degrees.
N_FINALISTS = 3
# Scores are at most 1 and rounded in float32: of targets that are alike but for this the first
# is taken, so that functions that are alike are of one cluster.
SAME_SCORE = 8.0 * float(np.finfo(np.float32).eps)
# Of a target that a half turn changes by less than this share of its energy, one of two
# candidates that differ by a half turn tells of both.
SYMMETRIC_SHARE = 1e-3
Result = TypeVar("Result")


class SearchOptions(TypedDict):
    """Options of `search` that all steps of an alignment share."""

    max_tilt: float | None
    n_threads: int


@dataclass(frozen=True, eq=False)
class SearchResult:
    r"""Where each function correlates best with the target.

    Parameters
    ----------
    rotations : (n, 3, 3) float64
        `base_from_local`: the source is the target rotated by this, :math:`a(\omega) \approx
        c(R^\top\omega)`. The identity where source or target is zero.
    score : (n,) float64
        Correlation over both norms, in [-1, 1]; 0 for a zero function.
    margin : (n,) float64
        Score gap to the best rotation at least 15 degrees away: another maximum, or the weakest
        direction of this one. Near 0 the rotation is not determined.
    cluster : (n,) int32
        Best target.
    """

    rotations: NDArray[np.float64]
    score: NDArray[np.float64]
    margin: NDArray[np.float64]
    cluster: NDArray[np.int32]


def search(
    source: Coupled,
    target: Coupled,
    *,
    start: ArrayLike | None = None,
    max_tilt: float | None = None,
    n_peaks: int = N_PEAKS,
    half_turns: Sequence[bool] = (),
    margins: bool = True,
    n_threads: int = 1,
) -> SearchResult:
    r"""Rotations that best carry a target onto each function; the best target if many.

    Parameters
    ----------
    source : Coupled
        n functions of two directions (`reflfield.sphere.coupling.couple`).
    target : Coupled
        One or more functions, same band limits; clusters if several.
    start : (n, 3, 3) array_like, optional
        Rotations to try as well (with every finalist target).
    max_tilt : float, optional
        Largest angle between z and the rotated z, radians. None: all rotations.
    n_peaks : int
        Local maxima of the coarse grid that are followed with all degrees.
    half_turns : sequence of bool
        True for each target that a half turn about z leaves unchanged: two rotations that
        differ by it then count as one in the margin. Empty: none.
    margins : bool
        False: leave the margins at 0, which saves a tenth of the time.
    n_threads : int
        Blocks worked on at once. The result does not depend on it.

    Returns
    -------
    SearchResult

    Raises
    ------
    InputError
        If band limits differ or an option is out of range.
    ShapeError
        If `start` does not fit.

    Examples
    --------
    A rotated function is found again:

    >>> from reflfield.sphere.coupling import couple, rotate_coupled
    >>> from scipy.spatial.transform import Rotation
    >>> from reflfield.sphere.wigner import rotation_blocks
    >>> rng = np.random.default_rng(0)
    >>> target = couple(rng.standard_normal((1, 9, 9)).astype(np.float32))
    >>> truth = Rotation.from_euler("ZYZ", [[0.3, 0.5, -0.2]]).as_matrix()
    >>> result = search(rotate_coupled(target, rotation_blocks(truth, 5)), target)
    >>> bool(np.abs(result.rotations - truth).max() < 1e-3), float(result.score[0].round(4))
    (True, 1.0)
    """
    _check_search(source, target, max_tilt, n_peaks)
    n = len(source)
    starts = None
    if start is not None:
        starts = np.asarray(start, dtype=np.float64)
        check_shape("start", starts, (n, 3, 3))
    unit = target.units()
    targets = [unit[k : k + 1] for k in range(len(target))]

    symmetric = tuple(odd_share(one) < SYMMETRIC_SHARE for one in targets)
    plan = _Plan(tuple(targets), tuple(half_turns), symmetric, max_tilt, n_peaks, margins)

    def block(rows: slice) -> SearchResult:
        extra = None if starts is None else starts[rows]
        return _search_block(source[rows], extra, plan)

    parts = map_blocks(block, n, BLOCK, n_threads)
    return SearchResult(
        rotations=np.concatenate([part.rotations for part in parts]),
        score=np.concatenate([part.score for part in parts]),
        margin=np.concatenate([part.margin for part in parts]),
        cluster=np.concatenate([part.cluster for part in parts]),
    )


def odd_share(target: Coupled) -> float:
    """Share of one function's energy that changes sign with a half turn about z.

    Examples
    --------
    >>> from reflfield.sphere.coupling import couple
    >>> along_z, along_x = np.zeros((2, 1, 4, 1))
    >>> along_z[0, 2], along_x[0, 3] = 1.0, 1.0
    >>> odd_share(couple(along_z)), odd_share(couple(along_x))
    (0.0, 1.0)
    """
    odd, total = 0.0, 0.0
    for j, block in enumerate(target.blocks):
        energy = np.sum(block[0].astype(np.float64) ** 2, axis=1)
        odd += float(energy[(j + 1) % 2 :: 2].sum())
        total += float(energy.sum())
    return odd / total if total > 0 else 0.0


def map_blocks(
    work: Callable[[slice], Result], n: int, size: int, n_threads: int
) -> list[Result]:
    """Results of `work` on consecutive blocks of rows, in order; one core a thread."""
    blocks = [slice(first, min(first + size, n)) for first in range(0, max(n, 1), size)]
    with one_core_blas():
        if n_threads == 1 or len(blocks) == 1:
            return [work(block) for block in blocks]
        with thread_pool(n_threads) as pool:
            return list(pool.map(work, blocks))


def _check_search(
    source: Coupled, target: Coupled, max_tilt: float | None, n_peaks: int
) -> None:
    if source.band_limits != target.band_limits:
        raise InputError(
            f"target: expected band limits {source.band_limits} like source, "
            f"received {target.band_limits}"
        )
    if max_tilt is not None and not 0.0 < max_tilt <= np.pi:
        raise InputError(f"max_tilt: expected radians in (0, pi], received {max_tilt}")
    if not 1 <= n_peaks <= 32:
        raise InputError(f"n_peaks: expected 1 to 32, received {n_peaks}")


@dataclass(frozen=True, eq=False)
class _Plan:
    """What all blocks of one search share: unit targets and options."""

    targets: tuple[Coupled, ...]
    half_turns: tuple[bool, ...]
    symmetric: tuple[bool, ...]
    max_tilt: float | None
    n_peaks: int
    margins: bool


def _search_block(
    source: Coupled, start: NDArray[np.float64] | None, plan: _Plan
) -> SearchResult:
    """Search of a few functions against all (unit) targets."""
    norms = source.norms()
    inverse = np.where(norms > 0, 1.0 / np.where(norms > 0, norms, 1.0), 0.0)
    # Unit series, so that the float32 kernels never meet 1e-12 or 1e12.
    series = [spectrum(source, target, inverse) for target in plan.targets]
    coarse = [coarse_peaks(s, source.n_degrees, plan.n_peaks, plan.max_tilt) for s in series]
    best = SearchResult(
        rotations=np.tile(np.eye(3), (len(source), 1, 1)),
        score=np.full(len(source), -np.inf),
        margin=np.zeros(len(source)),
        cluster=np.zeros(len(source), np.int32),
    )
    heights = np.stack([height for _, height in coarse])
    rank = np.argsort(np.argsort(-heights, axis=0, kind="stable"), axis=0, kind="stable")
    for k in range(len(plan.targets)):
        final = np.flatnonzero(rank[k] < N_FINALISTS)
        candidates = _candidates(coarse[k][0], final, start)
        _keep_better(best, series[k], candidates, k, plan)
    nothing = ~(norms > 0) | ~np.isfinite(best.score)
    best.score[nothing] = 0.0
    best.margin[nothing] = 0.0
    best.rotations[nothing] = np.eye(3)
    return best


def _candidates(
    peaks: NDArray[np.float64], final: NDArray[np.int64], start: NDArray[np.float64] | None
) -> Candidates:
    """All rotations to follow for the functions `final`."""
    every = peaks[final]
    if start is not None:
        every = np.concatenate([start[final][:, None], every], axis=1)
    flat = every.reshape(-1, 3, 3)
    real = np.isfinite(flat[:, 0, 0])
    counts = real.reshape(len(final), every.shape[1]).sum(axis=1)
    first = np.concatenate([[0], np.cumsum(counts)])
    return Candidates(final, first, flat[real])


def _keep_better(
    best: SearchResult,
    series: NDArray[np.floating],
    candidates: Candidates,
    k: int,
    plan: _Plan,
) -> None:
    """Update `best` in place with target k for the functions that have candidates."""
    who = candidates.rows
    if len(who) == 0:
        return
    n_degrees, dtype = degrees_of(series), str(series.dtype)
    rules = SearchRules(
        lowest_z_of(plan.max_tilt),
        bool(plan.half_turns and plan.half_turns[k]),
        bool(plan.symmetric[k]),
        degree_arrays(min(n_degrees, APPROACH_DEGREES), dtype),
        degree_arrays(n_degrees, dtype),
    )
    n = len(who)
    maxima = Maxima(np.zeros((n, 3, 3)), np.zeros((n, 11)), np.zeros(n))
    ascend_best(series, candidates, rules, maxima)
    top, at_top = maxima.rotations, maxima.derivatives
    better = at_top[:, 0] > best.score[who] + SAME_SCORE
    best.rotations[who[better]] = top[better]
    best.score[who[better]] = at_top[better, 0]
    best.cluster[who[better]] = k
    if plan.margins:
        weakest = _gap_of_weakest_rotation(series, who, top, at_top)
        gap = np.minimum(at_top[:, 0] - maxima.competing, weakest)
        best.margin[who[better]] = np.maximum(gap, 0.0)[better]


def _gap_of_weakest_rotation(
    series: NDArray[np.floating],
    who: NDArray[np.int64],
    top: NDArray[np.float64],
    at_top: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Height above the better of two rotations about the axis of least curvature."""
    hessian = at_top[:, [4, 7, 8, 7, 5, 9, 8, 9, 6]].reshape(-1, 3, 3)
    axis = np.linalg.eigh(hessian)[1][:, :, 2]
    rotated = [top @ rotation_about(axis, angle) for angle in (PEAK_DISTANCE, -PEAK_DISTANCE)]
    both = np.stack(rotated, axis=1).reshape(-1, 3, 3)
    values = follow(series, np.repeat(who, 2), both, 0)[1][:, 0]
    return at_top[:, 0] - values.reshape(-1, 2).max(axis=1)


def rotation_about(axis: NDArray[np.float64], angle: ArrayLike) -> NDArray[np.float64]:
    """Rotations by `angle` about unit axes, (n, 3, 3).

    Examples
    --------
    >>> rotation_about(np.array([[0.0, 0.0, 1.0]]), np.pi / 2).round(12)[0] + 0.0
    array([[ 0., -1.,  0.],
           [ 1.,  0.,  0.],
           [ 0.,  0.,  1.]])
    """
    angle = np.broadcast_to(angle, axis.shape[:1])[:, None, None]
    cross = np.zeros((len(axis), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = axis
    cross[:, [1, 2, 0], [2, 0, 1]] = -axis
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
