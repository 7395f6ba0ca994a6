"""The highest of several maxima: candidates approached with few degrees, then pruned."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.correlation import (
    ComplexSeries,
    DegreeArrays,
    complex_spectrum,
    empty_series,
)
from reflfield.alignment.newton_ascent import AscentLimits, ascend
from reflfield.alignment.rotation_steps import (
    copy_matrix,
    copy_nearest,
    copy_vector,
    cosine_between,
    half_turn_about_z,
)

# Two rotations closer than this are the same maximum.
PEAK_DISTANCE = np.deg2rad(15.0)
# Before all degrees are used, each maximum is approached with those below this.
APPROACH_DEGREES = 8
APPROACH_STEPS = 3
# Half a coarse spacing is gone after a step this short.
APPROACHED_STEP = 0.1
ASCENT_STEPS = 12
# A step of Newton's this short leaves an error of a few of its squares: .01 degrees.
CONVERGED_STEP = 6e-3
# Candidates that rise less than this share of the highest above the mean are pruned.
PRUNED_SHARE = 0.8
EQUAL_SHARE = 1e-3
# Cosine of an angle within which two candidates begin at the same rotation.
SAME_START = np.cos(1e-3)


class Candidates(NamedTuple):
    """Rotations in question: those of function ``rows[i]`` are ``first[i] .. first[i + 1]``.

    Parameters
    ----------
    rows : (k,) int64
    first : (k + 1,) int64
    rotations : (first[k], 3, 3) float64
        Moved in place.
    """

    rows: NDArray[np.int64]
    first: NDArray[np.int64]
    rotations: NDArray[np.float64]


class SearchRules(NamedTuple):
    """What holds for all candidates of one target.

    Parameters
    ----------
    lowest_z : float
        Least `R[2, 2]`.
    half_turn : bool
        Rotations that differ by a half turn about z count as one among competing maxima.
    symmetric : bool
        The series hardly change with that half turn: of two such candidates only one is
        followed, and both sides of the best are looked at in the end.
    low, full : DegreeArrays
        Of the approach, and of all degrees.
    """

    lowest_z: float
    half_turn: bool
    symmetric: bool
    low: DegreeArrays
    full: DegreeArrays


class Maxima(NamedTuple):
    """Highest maximum of each series.

    Parameters
    ----------
    rotations : (k, 3, 3) float64
    derivatives : (k, 11) float64
        See `ascend`.
    competing : (k,) float64
        Highest value that ended at another maximum.
    """

    rotations: NDArray[np.float64]
    derivatives: NDArray[np.float64]
    competing: NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def _next_candidate(
    heights: NDArray[np.float64], done: NDArray[np.bool_], mean: float, best: float
) -> int:
    """Highest candidate not yet followed, -1 if none comes near the best."""
    choice = -1
    for c in range(heights.shape[0]):
        if not done[c] and (choice < 0 or heights[c] > heights[choice]):
            choice = c
    near = choice >= 0 and heights[choice] - mean >= PRUNED_SHARE * (best - mean)
    return choice if near or not np.any(done) else -1


@numba.njit(cache=True, nogil=True)
def _already_there(
    rotations: NDArray[np.float64],
    done: NDArray[np.bool_],
    values: NDArray[np.float64],
    c: int,
    symmetric: bool,
) -> bool:
    """Whether a followed candidate ended where this one heads; takes over its value then."""
    near = np.cos(0.5 * PEAK_DISTANCE)
    for other in range(len(values)):
        if done[other] and cosine_between(rotations[c], rotations[other], symmetric) > near:
            copy_nearest(rotations[other], symmetric, rotations[c])
            values[c] = values[other]
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _partner(starts: NDArray[np.float64], c: int) -> int:
    """Earlier candidate that begins where this one does, but for a half turn about z; or -1."""
    for other in range(c):
        if cosine_between(starts[c], starts[other], True) > SAME_START:
            return other
    return -1


@numba.njit(cache=True, nogil=True)
def _highest_elsewhere(
    rotations: NDArray[np.float64],
    values: NDArray[np.float64],
    best: NDArray[np.float64],
    half_turn: bool,
) -> float:
    """Highest value of the candidates that ended at another maximum than the best."""
    highest = -np.inf
    for c in range(len(values)):
        if cosine_between(rotations[c], best, half_turn) < np.cos(PEAK_DISTANCE):
            highest = max(highest, values[c])
    return highest


@numba.njit(cache=True, nogil=True, inline="always")
def _approach(
    series: ComplexSeries,
    mean: float,
    rules: SearchRules,
    mine: NDArray[np.float64],
    values: NDArray[np.float64],
) -> float:
    """Move the candidates towards their maxima; the value of the highest."""
    starts = mine.copy() if rules.symmetric else mine
    at, top = np.zeros(11), -np.inf
    for c in range(len(mine)):
        partner = _partner(starts, c) if rules.symmetric else -1
        if partner >= 0:
            copy_nearest(mine[partner], True, mine[c])
            values[c] = values[partner]
            continue
        least = mean + PRUNED_SHARE * (top - mean)
        limits = AscentLimits(APPROACH_STEPS, APPROACHED_STEP, rules.lowest_z, least)
        ascend(mine[c], series, limits, at)
        values[c] = at[0]
        top = max(top, at[0])
    return top


@numba.njit(cache=True, nogil=True, inline="always")
def _ascend_candidates(
    series: ComplexSeries,
    levels: tuple[float, float],
    rules: SearchRules,
    mine: NDArray[np.float64],
    values: NDArray[np.float64],
    best: NDArray[np.float64],
    maximum: NDArray[np.float64],
) -> None:
    """Follow candidates, from the highest on, while they may still be the best.

    `levels`: the mean of the series, and the highest value so far.
    """
    mean, top = levels
    heights, done, at = values.copy(), np.zeros(len(mine), np.bool_), np.zeros(11)
    maximum[0] = -np.inf
    while True:
        c = _next_candidate(heights, done, mean, top)
        if c < 0:
            break
        if not _already_there(mine, done, values, c, rules.symmetric):
            # A maximum that is equal but for rounding, as symmetry makes them, is no better.
            least = maximum[0] + EQUAL_SHARE * (maximum[0] - mean)
            limits = AscentLimits(ASCENT_STEPS, CONVERGED_STEP, rules.lowest_z, least)
            ascend(mine[c], series, limits, at)
            values[c] = at[0]
            if at[0] > least:
                copy_vector(at, maximum)
                copy_matrix(mine[c], best)
        done[c] = True


@numba.njit(cache=True, nogil=True, inline="always")
def _try_half_turn(
    series: ComplexSeries,
    lowest_z: float,
    mine: NDArray[np.float64],
    values: NDArray[np.float64],
    best: NDArray[np.float64],
    maximum: NDArray[np.float64],
) -> None:
    """Ascend from the best half turned about z; what little the sides differ by decides."""
    at, other = np.zeros(11), best.copy()
    half_turn_about_z(other)
    begun = other.copy()
    limits = AscentLimits(ASCENT_STEPS, CONVERGED_STEP, lowest_z, maximum[0])
    ascend(other, series, limits, at)
    for c in range(len(mine)):
        if cosine_between(mine[c], begun, False) > np.cos(0.5 * PEAK_DISTANCE):
            values[c] = at[0]
    if at[0] > maximum[0]:
        copy_vector(at, maximum)
        copy_matrix(other, best)


@numba.njit(cache=True, nogil=True)
def ascend_best(
    series: NDArray[np.floating], candidates: Candidates, rules: SearchRules, out: Maxima
) -> None:
    """Best maximum of each series, from candidates that are pruned on the way.

    All are approached with the low degrees; then, from the highest on, followed with all
    degrees while they may still be the best.
    """
    full, low = empty_series(rules.full, series), empty_series(rules.low, series)
    for i in range(candidates.rows.shape[0]):
        mine = candidates.rotations[candidates.first[i] : candidates.first[i + 1]]
        own, best, maximum = series[candidates.rows[i]], out.rotations[i], out.derivatives[i]
        values, mean = np.zeros(len(mine)), float(own[0])
        complex_spectrum(own, low)
        top = _approach(low, mean, rules, mine, values)
        complex_spectrum(own, full)
        _ascend_candidates(full, (mean, top), rules, mine, values, best, maximum)
        if rules.symmetric:
            _try_half_turn(full, rules.lowest_z, mine, values, best, maximum)
        out.competing[i] = _highest_elsewhere(mine, values, best, rules.half_turn)
