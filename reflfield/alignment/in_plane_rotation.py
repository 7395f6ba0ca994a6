"""The turn about the normal, where band-limited correlation leaves it open.

A reflectance that is nearly round about its normal correlates best where the dome's horizon
cuts target and texel on the same side: the turn then follows the tilt and not the
material. On the samples both horizons are known. All turns are tried against the sharp target,
which begins with the texel that is tilted least and so breaks the symmetry; it is
then fitted to all texels again, in turn with their turns.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.frame_ambiguity import Symmetry, fold
from reflfield.alignment.materials import (
    FORGIVEN,
    Materials,
    one_round,
    own_misfit,
    thinned,
)
from reflfield.alignment.refinement import RefinementOptions, SampleSet, fit_nodes
from reflfield.alignment.rotation_search import rotation_about
from reflfield.sphere.rotations import Array

# Turns tried, 15 degrees apart: what counts as another peak in the margin.
N_TURNS = 24
# Rounds on the round target, and of turns and target.
ROUND_ROUNDS = 4
TURN_ROUNDS = 4
# Turns are known if the best ones are closer than others by this much in the log of the
# distance. Round ones reach a third where the axis is known roughly, weak ones three.
LEAST_GAIN = 1.0


def turn_misfits(
    data: SampleSet, state: Materials, floor: float, n_threads: int
) -> NDArray[np.float64]:
    """Distance of each texel to its own target after each turn about its normal.

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
    (n, N_TURNS) float64
        The first column: no turn. Some of the views suffice.
    """
    data, columns = thinned(data), []
    for turn in _turns():
        turned = Materials(state.targets, turn @ state.frames, state.brightness, state.cluster)
        columns.append(own_misfit(data, turned, floor, n_threads))
    return np.stack(columns, axis=1)


def _turns() -> Array:
    axes = np.tile([0.0, 0.0, 1.0], (N_TURNS, 1))
    return rotation_about(axes, 2 * np.pi * np.arange(N_TURNS) / N_TURNS)


def best_turns(data: SampleSet, state: Materials, floor: float, n_threads: int) -> Materials:
    """State with each frame at the best of all turns about its normal."""
    best = np.argmin(turn_misfits(data, state, floor, n_threads), axis=1)
    return Materials(
        state.targets, _turns()[best] @ state.frames, state.brightness, state.cluster
    )


def turn_margin(
    data: SampleSet,
    state: Materials,
    floor: float,
    half_turn: bool,
    n_threads: int,
) -> NDArray[np.float64]:
    """Correlation on the samples less that of the best other turn, (n,); not negative.

    A half turn is no other turn if `half_turn` is True.
    """
    cosine = np.sqrt(1.0 - turn_misfits(data, state, floor, n_threads))
    others = [k for k in range(1, N_TURNS) if not (half_turn and k == N_TURNS // 2)]
    return np.maximum(cosine[:, 0] - cosine[:, others].max(axis=1), 0.0)


def find_turns(
    data: SampleSet, state: Materials, options: RefinementOptions, n_threads: int
) -> tuple[Materials, bool]:
    """Frames and target of one material whose turns about the normal are open.

    Parameters
    ----------
    data : SampleSet
        n texels.
    state : Materials
        One target; normals within some ten degrees, turns of no account.
    options : RefinementOptions
    n_threads : int

    Returns
    -------
    state : Materials
    known : bool
        False if turns explain too little to be known: the reflectance is round, and the
        frames are turned towards the base frames.
    """
    upright = fold(np.swapaxes(state.frames, 1, 2), Symmetry("all"))
    state = Materials(
        state.targets,
        np.ascontiguousarray(np.swapaxes(upright, 1, 2)),
        state.brightness.copy(),
        state.cluster,
    )
    for _ in range(ROUND_ROUNDS):
        state = one_round(data, state, options, n_threads)
    begun = _begun_with_least_tilted(data, state, options)
    for _ in range(TURN_ROUNDS):
        turned = best_turns(data, begun, options.floor, n_threads)
        begun = one_round(data, turned, options, n_threads)
    misfit = np.log(turn_misfits(data, begun, options.floor, n_threads) + FORGIVEN)
    gain = np.mean(np.median(misfit, axis=1) - misfit[:, 0])
    return (begun, True) if gain > LEAST_GAIN else (state, False)


def _begun_with_least_tilted(
    data: SampleSet, state: Materials, options: RefinementOptions
) -> Materials:
    """Target of the least tilted texel where that is seen, of all texels elsewhere."""
    height = np.where(state.brightness > 0, state.frames[:, 2, 2], -np.inf)
    first = np.array([np.argmax(height)])
    alone = state.part(first)
    targets = fit_nodes(
        data.part(first),
        alone.frames,
        alone.brightness,
        alone.cluster,
        state.targets,
        options,
        1,
    )
    return Materials(targets, state.frames, state.brightness, state.cluster)
