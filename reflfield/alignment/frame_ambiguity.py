r"""Which of many equivalent sets of frames is meant.

The target of a cluster may be turned freely if all its frames turn along. The
gauge makes the frames of each cluster on average the base frames, so that
neighbouring clusters agree. Where the target has a half-turn symmetry, as nearly all
reflectances have, its axis is the normal: it is known far better than the mean of tilted
frames. What the reflectance itself leaves open about the normal is chosen nearest to
the base frame: the turn of an isotropic target, and the sign of the tangent of one that a
half turn leaves unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.correlation import spectrum
from reflfield.alignment.newton_ascent import follow
from reflfield.alignment.rotation_search import rotation_about
from reflfield.sphere.coupling import Coupled, rotate_coupled, uncouple
from reflfield.sphere.rotations import frames_from_normals
from reflfield.sphere.wigner import rotation_blocks

# Share of a target's energy that varies about the normal, below which the turn is noise.
ISOTROPIC_SHARE = 0.01
# Odd orders of a target with a half-turn symmetry vanish; what the horizon cuts off steep
# texels leaves a sixth of the even ones, and up to a third where there are many.
HALF_TURN_SHARE = 0.5
# Frames share no turn where the mean frame's second singular value is below this share of the
# first: tilts of 60 degrees with a common turn leave more than half.
OPEN_SHARE = 0.3
# Frames whose turns are open have a mean normal with a chance error; the mean direction of the
# light in the target is believed instead where the two differ by more than this many of them.
CHANCE_ERRORS = 4.0
AXIS_STEPS = 20
# A symmetry axis farther from the mean normal is not the normal.
LARGEST_AXIS_TILT = np.deg2rad(40.0)


@dataclass(frozen=True)
class Symmetry:
    """Turns about the normal that leave a target unchanged: "none", "half" or "all"."""

    kind: str


def symmetry_about_normal(target: Coupled, turn_known: bool = False) -> Symmetry:
    """Symmetry of one target whose normal is z, from its energy per order.

    A target whose turn is known is not round, however small the energy that varies.

    Examples
    --------
    >>> from reflfield.sphere.coupling import couple
    >>> lobe = np.zeros((1, 9, 9)); lobe[0, :, 6] = 1.0
    >>> symmetry_about_normal(couple(np.ones((1, 1, 1)))).kind
    'all'
    """
    energy = np.zeros(target.n_degrees)
    for j, block in enumerate(target.blocks):
        by_order = np.sum(block[0].astype(np.float64) ** 2, axis=1)
        energy[: j + 1] += by_order[j:]
        energy[1 : j + 1] += by_order[:j][::-1]
    varying, odd = energy[1:].sum(), energy[1::2].sum()
    if not turn_known and varying <= ISOTROPIC_SHARE * energy.sum():
        return Symmetry("all")
    if odd <= HALF_TURN_SHARE * (varying - odd):
        return Symmetry("half")
    return Symmetry("none")


def mean_rotation(
    rotations: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rotation with the least squared chordal distance to many, (3, 3).

    Examples
    --------
    >>> about = rotation_about(np.array([[0.0, 0, 1], [0, 0, 1]]), [0.1, 0.3])
    >>> float(np.arcsin(mean_rotation(about, np.ones(2))[1, 0]).round(12))
    0.2
    """
    total = np.einsum("n,nij->ij", weights, rotations)
    u, _, vt = np.linalg.svd(total)
    sign = np.sign(np.linalg.det(u @ vt)) or 1.0
    return u @ np.diag([1.0, 1.0, sign]) @ vt


def twist(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle about z that brings each rotation closest to the identity, radians.

    Examples
    --------
    >>> twist(rotation_about(np.array([[0.0, 0.0, 1.0]]), 0.4)).round(12)
    array([0.4])
    """
    return np.arctan2(
        rotations[:, 1, 0] - rotations[:, 0, 1], rotations[:, 0, 0] + rotations[:, 1, 1]
    )


def fold(rotations: NDArray[np.float64], symmetry: Symmetry) -> NDArray[np.float64]:
    """Equivalent rotations nearest to the identity.

    Parameters
    ----------
    rotations : (n, 3, 3) float64
        `base_from_local`.
    symmetry : Symmetry
        Of the target.

    Returns
    -------
    (n, 3, 3) float64

    Examples
    --------
    >>> turn = rotation_about(np.array([[0.0, 0.0, 1.0]]), 3.0)
    >>> twist(fold(turn, Symmetry("half"))).round(4)
    array([-0.1416])
    """
    if symmetry.kind == "none" or len(rotations) == 0:
        return rotations
    angle = twist(rotations)
    undo = -angle if symmetry.kind == "all" else np.where(np.abs(angle) > np.pi / 2, np.pi, 0)
    axes = np.tile([0.0, 0.0, 1.0], (len(rotations), 1))
    return rotations @ rotation_about(axes, undo)


def turns_are_open(rotations: NDArray[np.float64], weights: NDArray[np.float64]) -> bool:
    """Whether frames share no turn about the normal, only (on average) the normal.

    Examples
    --------
    >>> about = rotation_about(np.tile([0.0, 0.0, 1.0], (4, 1)), np.arange(4) * np.pi / 2)
    >>> turns_are_open(about, np.ones(4)), turns_are_open(about[:1], np.ones(1))
    (True, False)
    """
    shares = np.linalg.svd(np.einsum("n,nij->ij", weights, rotations))[1]
    return bool(shares[1] < OPEN_SHARE * shares[0])


def _turn_to_light(target: Coupled) -> NDArray[np.float64]:
    """Rotation whose z is the target's mean light direction, its view's if that is constant.

    Light falls in by its cosine from one side only, so the mean direction of what is
    reflected is the normal for every reflectance that has a half turn or is round.
    """
    coefficients = uncouple(target)[0]
    moment = coefficients[0, 1:4] if coefficients.shape[1] > 1 else coefficients[1:4, 0]
    # Real harmonics of degree 1 are in the order y, z, x.
    axis = moment[[2, 0, 1]].astype(np.float64)
    length = np.linalg.norm(axis)
    if not length > 0:
        return np.eye(3)
    return frames_from_normals(axis[None] / length, np.array([[1.0, 0.0, 0.0]]))[0].T


def _turn_of_open_frames(
    target: Coupled, rotations: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rotation whose z is the normal of frames that share no turn.

    The mean of the base normals, seen in the frames, unless that differs from the
    target's mean light direction by more than chance: then the turns follow the tilts,
    and the mean leans that way.
    """
    to_light = _turn_to_light(target)
    base_normals = rotations[:, 2, :] @ to_light  # seen in the frames
    total = weights.sum()
    lean = weights @ base_normals / total
    scatter = np.sqrt(weights**2 @ (base_normals[:, :2] ** 2)) / total
    if not np.all(np.abs(lean[:2]) <= CHANCE_ERRORS * scatter):
        return to_light
    normal = lean / np.linalg.norm(lean)
    return to_light @ frames_from_normals(normal[None], np.array([[1.0, 0.0, 0.0]]))[0].T


def _gauge_turn(
    rotations: NDArray[np.float64], weights: NDArray[np.float64], symmetry: Symmetry
) -> NDArray[np.float64]:
    """Turn about z that undoes the mean twist, known up to the symmetry."""
    n_fold = 2.0 if symmetry.kind == "half" else 1.0
    phase = np.sum(weights * np.exp(1j * n_fold * twist(rotations)))
    angle = 0.0 if symmetry.kind == "all" else -float(np.angle(phase)) / n_fold
    return rotation_about(np.array([[0.0, 0.0, 1.0]]), angle)[0]


@dataclass(frozen=True, eq=False)
class Gauged:
    """Targets and frames after the gauge.

    Parameters
    ----------
    targets : Coupled
        One a cluster, normal z.
    rotations : (n, 3, 3) float64
        `base_from_local`.
    symmetries : tuple of Symmetry
        One a cluster.
    turns : (n_clusters, 3, 3) float64
        What was multiplied to each cluster's rotations from the right, before folding.
    """

    targets: Coupled
    rotations: NDArray[np.float64]
    symmetries: tuple[Symmetry, ...]
    turns: NDArray[np.float64]


def fix_gauge(
    targets: Coupled,
    rotations: NDArray[np.float64],
    cluster: NDArray[np.int32],
    weights: NDArray[np.float64],
    turns_known: Sequence[bool] = (),
) -> Gauged:
    """Turn each target so that its frames are on average the base frames.

    Parameters
    ----------
    targets : Coupled
        One a cluster.
    rotations : (n, 3, 3) float64
        `base_from_local`.
    cluster : (n,) int32
    weights : (n,) float64
        Of the frames in the average.
    turns_known : sequence of bool
        True for each target whose turn about the normal was found by other means: it is not
        round, however little it varies. Empty: none.

    Returns
    -------
    Gauged
    """
    rotations = rotations.copy()
    turns = np.tile(np.eye(3), (len(targets), 1, 1))
    symmetries = []
    for k in range(len(targets)):
        mine = (cluster == k) & (weights > 0)
        kind = Symmetry("none")
        if mine.any():
            known = bool(turns_known) and turns_known[k]
            turns[k] = mean_rotation(rotations[mine], weights[mine]).T
            if not known and turns_are_open(rotations[mine], weights[mine]):
                turns[k] = _turn_of_open_frames(
                    targets[k : k + 1], rotations[mine], weights[mine]
                )
            upright = turns[k] @ _normal_first(_turn_target(targets[k : k + 1], turns[k]))
            kind = symmetry_about_normal(_turn_target(targets[k : k + 1], upright), known)
            turns[k] = turns[k] if kind.kind == "none" else upright
            turns[k] = turns[k] @ _gauge_turn(rotations[mine] @ turns[k], weights[mine], kind)
            rotations[cluster == k] = fold(rotations[cluster == k] @ turns[k], kind)
        symmetries.append(kind)
    return Gauged(turn_targets(targets, turns), rotations, tuple(symmetries), turns)


def turn_targets(targets: Coupled, turns: NDArray[np.float64]) -> Coupled:
    """Targets such that frames times `turns` fit them as the frames did before."""
    blocks = rotation_blocks(np.swapaxes(turns, 1, 2), targets.n_degrees, str(targets.dtype))
    return rotate_coupled(targets, blocks)


def _normal_first(target: Coupled) -> NDArray[np.float64]:
    """Rotation that brings z to the axis of the target's half-turn symmetry, if near z.

    The symmetry is a peak of the target's correlation with itself, half a turn away from
    the identity. Climbs begin with the half turns about z and about axes around it: texels
    steeper than the others can carry the mean normal many degrees away.
    """
    axes = _axes_around_z()
    half_turns = 2.0 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    series = spectrum(target, target)
    rows = np.zeros(len(axes), np.int64)
    turns, found = follow(series, rows, half_turns, AXIS_STEPS)
    # Half turns are 2 u u^T - I.
    axis = np.linalg.eigh(turns + np.swapaxes(turns, 1, 2))[1][:, :, 2]
    axis *= np.where(axis[:, 2:] < 0, -1.0, 1.0)
    near = axis[:, 2] >= np.cos(LARGEST_AXIS_TILT)
    if not near.any():
        return np.eye(3)
    best = axis[near][np.argmax(found[near, 0])]
    return frames_from_normals(best[None], np.array([[1.0, 0.0, 0.0]]))[0].T


def _axes_around_z() -> NDArray[np.float64]:
    """The normal and two rings of axes around it, (19, 3)."""
    rings = ((0.0, 1), (0.4, 6), (0.75, 12))
    polar = np.repeat([r for r, _ in rings], [n for _, n in rings]) * LARGEST_AXIS_TILT
    azimuth = np.concatenate([2.0 * np.pi * np.arange(n) / n for _, n in rings])
    x, y = np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)
    return np.stack([x, y, np.cos(polar)], axis=1)


def _turn_target(target: Coupled, turn: NDArray[np.float64]) -> Coupled:
    blocks = rotation_blocks(turn.T[None], target.n_degrees, str(target.dtype))
    return rotate_coupled(target, blocks)
