"""The rotation about the normal, where band-limited correlation leaves it undetermined.

A reflectance that is nearly isotropic about its normal correlates best where the dome's horizon
cuts target and texel on the same side: the in-plane angle then follows the tilt and not the
material. On the samples both horizons are known. All angles are tried against the sharp target,
which begins with the texel that is tilted least and so breaks the symmetry; it is
then fitted to all texels again, alternating with their angles.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.frame_ambiguity import Symmetry, reduce_to_fundamental_zone
from reflfield.alignment.material_clusters import ENOUGH_SAMPLES, choose, one_round
from reflfield.alignment.material_distance import log_improvement, own_distance
from reflfield.alignment.refinement import (
    RefinementOptions,
    SharpAlignment,
    fit_sharp_targets,
)
from reflfield.alignment.rotation_search import rotation_about
from reflfield.alignment.sample_sources import SampleSet
from reflfield.sphere.rotations import Array

# Angles tried, 15 degrees apart: what counts as another maximum in the margin.
N_ANGLES = 24
# Rounds on the isotropic target, and of angles and target.
ISOTROPIC_ROUNDS = 4
ANGLE_ROUNDS = 4
# Angles and normals of a texel are improved in alternation so often.
ANGLE_PASSES = 3
# Angles are known if most texels are closer there than at the median of these others, by this
# much in the log of the distance. Isotropic targets reach .75, those of a pile that leans by a
# tenth 1.6 with 2 % of noise, by a fifth three; targets that fit few samples too closely (60
# texels at side 25) reach 1.3 to 1.5 although they are isotropic. The mean would follow the few
# texels whose few samples some angle explains entirely. Indices of the angles tried:
OTHER_ANGLES = [4, 8, 12, 16, 20]
LEAST_GAIN = 1.0


def distances_by_angle(
    data: SampleSet, state: SharpAlignment, floor: float, n_threads: int
) -> NDArray[np.float64]:
    """Distance of each texel to its own target after each rotation about its normal.

    Parameters
    ----------
    data : SampleSet
        n texels.
    state : SharpAlignment
    floor : float
        See `RefinementOptions`.
    n_threads : int

    Returns
    -------
    (n, N_ANGLES) float64
        The first column: no rotation. Some of the views suffice.
    """
    some = data.thinned(ENOUGH_SAMPLES)
    columns = [
        own_distance(some, state.rotated(rotation), floor, n_threads)
        for rotation in _rotations()
    ]
    return np.stack(columns, axis=1)


def _rotations() -> Array:
    axes = np.tile([0.0, 0.0, 1.0], (N_ANGLES, 1))
    return rotation_about(axes, 2 * np.pi * np.arange(N_ANGLES) / N_ANGLES)


def at_best_angles(
    data: SampleSet, state: SharpAlignment, floor: float, n_threads: int
) -> SharpAlignment:
    """Each frame rotated by the best of all angles about its normal."""
    best = np.argmin(distances_by_angle(data, state, floor, n_threads), axis=1)
    return state.rotated(_rotations()[best])


def angle_margin(
    data: SampleSet,
    state: SharpAlignment,
    floor: float,
    half_turn: bool,
    n_threads: int,
) -> NDArray[np.float64]:
    """Correlation on the samples less that at the best other angle, (n,); not negative.

    A half turn is no other angle if `half_turn` is True.
    """
    cosine = np.sqrt(1.0 - distances_by_angle(data, state, floor, n_threads))
    others = [k for k in range(1, N_ANGLES) if not (half_turn and k == N_ANGLES // 2)]
    return np.maximum(cosine[:, 0] - cosine[:, others].max(axis=1), 0.0)


def find_angles(
    data: SampleSet, state: SharpAlignment, options: RefinementOptions, n_threads: int
) -> tuple[SharpAlignment, bool]:
    """Frames and target of one material whose in-plane angles are undetermined.

    Parameters
    ----------
    data : SampleSet
        n texels.
    state : SharpAlignment
        One target; normals within some ten degrees, in-plane angles are not used.
    options : RefinementOptions
    n_threads : int

    Returns
    -------
    state : SharpAlignment
    known : bool
        False if angles explain too little to be known: the reflectance is isotropic, and the
        frames are rotated towards the base frames.
    """
    base_from_local = np.swapaxes(state.frames, 1, 2)
    untwisted = reduce_to_fundamental_zone(base_from_local, Symmetry("all"))
    state = state.rotated(np.swapaxes(untwisted, 1, 2) @ base_from_local)
    for _ in range(ISOTROPIC_ROUNDS):
        state = one_round(data, state, options, n_threads)
    anisotropic = replace(state, targets=_target_of_least_tilted(data, state, options).targets)
    for _ in range(ANGLE_ROUNDS):
        anisotropic = at_best_angles(data, anisotropic, options.floor, n_threads)
        anisotropic = one_round(data, anisotropic, options, n_threads)
    if not _gain_of_angles(data, anisotropic, options, n_threads) > LEAST_GAIN:
        return state, False
    for _ in range(options.rounds):
        anisotropic = one_round(data, anisotropic, options, n_threads)
    return anisotropic, True


def _gain_of_angles(
    data: SampleSet, state: SharpAlignment, options: RefinementOptions, n_threads: int
) -> float:
    """How much closer most texels are at their angles than at others, in the log distance.

    Normals are improved at every angle. The target's axis may be some degrees off z; rotations
    about z then tilt isotropic texels, which are farther at other angles for their normals.
    """
    some = data.thinned(ENOUGH_SAMPLES)

    def distance(rotation: Array) -> NDArray[np.float64]:
        improved = choose(some, state.rotated(rotation), options, options.steps, n_threads)
        return own_distance(some, improved, options.floor, n_threads)

    others = [distance(rotation) for rotation in _rotations()[OTHER_ANGLES]]
    gains = log_improvement(np.median(others, axis=0), distance(np.eye(3)))
    return float(np.median(gains))


def _target_of_least_tilted(
    data: SampleSet, state: SharpAlignment, options: RefinementOptions
) -> SharpAlignment:
    """The least tilted texel with its own target; where it sees nothing, with that of all."""
    height = np.where(state.brightness > 0, state.frames[:, 2, 2], -np.inf)
    first = np.array([np.argmax(height)])
    return fit_sharp_targets(data.part(first), state.part(first), options, 1)


def improve_with_angles(
    data: SampleSet,
    state: SharpAlignment,
    options: RefinementOptions,
    in_plane: NDArray[np.bool_],
    n_threads: int,
) -> SharpAlignment:
    """Frames against finished targets, after the best angles of clusters that are `in_plane`.

    Normals that are some degrees off hide the right angle, so both are found in alternation.
    """
    rows = np.flatnonzero(in_plane[state.cluster])
    if len(rows) > 0:
        some, own = data.part(rows), state.part(rows)
        for _ in range(ANGLE_PASSES):
            own = at_best_angles(some, own, options.floor, n_threads)
            own = choose(some, own, options, options.steps, n_threads)
        # Which material a texel is of is chosen once all frames are improved.
        state = state.with_part(rows, replace(own, cluster=state.cluster[rows]))
    return choose(data, state, options, options.last_steps, n_threads)
