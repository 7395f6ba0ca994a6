r"""Which of many equivalent sets of frames is meant.

The target of a cluster may be rotated freely if all its frames rotate along. This ambiguity is
resolved so that the frames of each cluster are on average the base frames: neighbouring
clusters then agree. Where the target has a half-turn symmetry, as nearly all
reflectances have, its axis is the normal: it is known far better than the mean of tilted
frames. What the reflectance itself leaves undetermined about the normal is reduced to the
fundamental zone nearest to the base frame: the in-plane angle of an isotropic target, and the
sign of the tangent of one that a half turn leaves unchanged.

Where the view does not vary (RTI), samples are functions of the light alone, and those of an
isotropic reflectance differ by the azimuth of the view in the local frame: the in-plane angle
that the reflectance leaves free puts the view over the local x axis.
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

# Share of a target's energy that varies about the normal, below which it is noise.
ISOTROPIC_SHARE = 0.01
# Odd orders of a target with a half-turn symmetry vanish; what the horizon cuts off steep
# texels leaves a sixth of the even ones, and up to a third where there are many.
HALF_TURN_SHARE = 0.5
# Frames share no in-plane angle where the mean frame's second singular value is below this
# share of the first: tilts of 60 degrees with a common angle leave more than half.
UNDETERMINED_SHARE = 0.3
# Frames whose in-plane angles are undetermined have a mean normal with a chance error; the mean
# direction of the light in the target is believed instead where the two differ by more than
# this many of them.
CHANCE_ERRORS = 4.0
AXIS_STEPS = 20
# A symmetry axis farther from the mean normal is not the normal.
LARGEST_AXIS_TILT = np.deg2rad(40.0)
Z_AXIS = np.array([[0.0, 0.0, 1.0]])
X_AXIS = np.array([[1.0, 0.0, 0.0]])


@dataclass(frozen=True)
class Symmetry:
    """Rotations about the normal that leave a target unchanged: "none", "half" or "all"."""

    kind: str


def symmetry_about_normal(target: Coupled, angle_known: bool = False) -> Symmetry:
    """Symmetry of one target whose normal is z, from its energy per order.

    A target whose in-plane angle is known is not isotropic, however small the energy that
    varies.

    Examples
    --------
    >>> from reflfield.sphere.coupling import couple
    >>> symmetry_about_normal(couple(np.ones((1, 1, 1)))).kind
    'all'
    """
    energy = np.zeros(target.n_degrees)
    for j, block in enumerate(target.blocks):
        by_order = np.sum(block[0].astype(np.float64) ** 2, axis=1)
        energy[: j + 1] += by_order[j:]
        energy[1 : j + 1] += by_order[:j][::-1]
    varying, odd = energy[1:].sum(), energy[1::2].sum()
    if not angle_known and varying <= ISOTROPIC_SHARE * energy.sum():
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


def reduce_to_fundamental_zone(
    rotations: NDArray[np.float64], symmetry: Symmetry
) -> NDArray[np.float64]:
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
    >>> rotation = rotation_about(np.array([[0.0, 0.0, 1.0]]), 3.0)
    >>> twist(reduce_to_fundamental_zone(rotation, Symmetry("half"))).round(4)
    array([-0.1416])
    """
    if symmetry.kind == "none" or len(rotations) == 0:
        return rotations
    angle = twist(rotations)
    undo = -angle if symmetry.kind == "all" else np.where(np.abs(angle) > np.pi / 2, np.pi, 0)
    return rotations @ rotation_about(np.tile(Z_AXIS, (len(rotations), 1)), undo)


def reduce_by_cluster(
    rotations: NDArray[np.float64],
    cluster: NDArray[np.int32],
    symmetries: Sequence[Symmetry],
) -> NDArray[np.float64]:
    """Rotations (n, 3, 3) in the fundamental zone of the symmetry of each one's cluster."""
    reduced = rotations.copy()
    for k, symmetry in enumerate(symmetries):
        mine = cluster == k
        reduced[mine] = reduce_to_fundamental_zone(rotations[mine], symmetry)
    return reduced


def with_view_over_tangent(
    rotations: NDArray[np.float64],
    cluster: NDArray[np.int32],
    symmetries: Sequence[Symmetry],
    view: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Rotations whose free in-plane angle puts a constant view over the local x axis.

    Parameters
    ----------
    rotations : (n, 3, 3) float64
        `base_from_local`.
    cluster : (n,) int32
    symmetries : sequence of Symmetry
        Of each cluster's target; only the angles of isotropic ones are free.
    view : (3,) float64
        Unit vector in the base frames.

    Returns
    -------
    (n, 3, 3) float64

    Examples
    --------
    A normal tilted by .4 about x, seen from the base normal:

    >>> tilted = rotation_about(X_AXIS, 0.4)
    >>> turned = with_view_over_tangent(
    ...     tilted, np.zeros(1, np.int32), [Symmetry("all")], Z_AXIS[0]
    ... )
    >>> (turned[0].T @ Z_AXIS[0]).round(3) + 0.0
    array([0.389, 0.   , 0.921])
    """
    free = np.array([symmetry.kind == "all" for symmetry in symmetries], bool)[cluster]
    local = view @ rotations
    azimuth = np.where(free, np.arctan2(local[:, 1], local[:, 0]), 0.0)
    return rotations @ rotation_about(np.tile(Z_AXIS, (len(rotations), 1)), azimuth)


def in_plane_undetermined(rotations: NDArray[np.float64], weights: NDArray[np.float64]) -> bool:
    """Whether frames share no in-plane angle, only (on average) the normal.

    Examples
    --------
    >>> about = rotation_about(np.tile([0.0, 0.0, 1.0], (4, 1)), np.arange(4) * np.pi / 2)
    >>> in_plane_undetermined(about, np.ones(4)), in_plane_undetermined(about[:1], np.ones(1))
    (True, False)
    """
    shares = np.linalg.svd(np.einsum("n,nij->ij", weights, rotations))[1]
    return bool(shares[1] < UNDETERMINED_SHARE * shares[0])


def _rotation_to_light(target: Coupled) -> NDArray[np.float64]:
    """Rotation whose z is the target's mean light direction, its view's if that is constant.

    Light falls in by its cosine from one side only, so the mean direction of what is
    reflected is the normal for every reflectance that has a half turn or is isotropic.
    """
    coefficients = uncouple(target)[0]
    moment = coefficients[0, 1:4] if coefficients.shape[1] > 1 else coefficients[1:4, 0]
    # Real harmonics of degree 1 are in the order y, z, x.
    axis = moment[[2, 0, 1]].astype(np.float64)
    length = np.linalg.norm(axis)
    if not length > 0:
        return np.eye(3)
    return frames_from_normals(axis[None] / length, X_AXIS)[0].T


def _rotation_without_angle(
    target: Coupled, rotations: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rotation whose z is the normal of frames that share no in-plane angle.

    The mean of the base normals, seen in the frames, unless that differs from the
    target's mean light direction by more than chance: then the angles follow the tilts,
    and the mean leans that way.
    """
    to_light = _rotation_to_light(target)
    base_normals = rotations[:, 2, :] @ to_light  # seen in the frames
    total = weights.sum()
    lean = weights @ base_normals / total
    scatter = np.sqrt(weights**2 @ (base_normals[:, :2] ** 2)) / total
    if not np.all(np.abs(lean[:2]) <= CHANCE_ERRORS * scatter):
        return to_light
    normal = lean / np.linalg.norm(lean)
    return to_light @ frames_from_normals(normal[None], X_AXIS)[0].T


def _untwisting(
    rotations: NDArray[np.float64], weights: NDArray[np.float64], symmetry: Symmetry
) -> NDArray[np.float64]:
    """Rotation about z that undoes the mean twist, known up to the symmetry."""
    n_fold = 2.0 if symmetry.kind == "half" else 1.0
    phase = np.sum(weights * np.exp(1j * n_fold * twist(rotations)))
    angle = 0.0 if symmetry.kind == "all" else -float(np.angle(phase)) / n_fold
    return rotation_about(Z_AXIS, angle)[0]


@dataclass(frozen=True, eq=False)
class ResolvedFrames:
    """Targets and frames whose common rotation is resolved.

    Parameters
    ----------
    targets : Coupled
        One a cluster, normal z.
    rotations : (n, 3, 3) float64
        `base_from_local`.
    symmetries : tuple of Symmetry
        One a cluster.
    common : (n_clusters, 3, 3) float64
        What was multiplied to each cluster's rotations from the right, before the reduction
        to the fundamental zone.
    """

    targets: Coupled
    rotations: NDArray[np.float64]
    symmetries: tuple[Symmetry, ...]
    common: NDArray[np.float64]


def resolve_ambiguity(
    targets: Coupled,
    rotations: NDArray[np.float64],
    cluster: NDArray[np.int32],
    weights: NDArray[np.float64],
    angles_known: Sequence[bool] = (),
) -> ResolvedFrames:
    """Rotate each target so that its frames are on average the base frames.

    Parameters
    ----------
    targets : Coupled
        One a cluster.
    rotations : (n, 3, 3) float64
        `base_from_local`.
    cluster : (n,) int32
    weights : (n,) float64
        Of the frames in the average.
    angles_known : sequence of bool
        True for each target whose in-plane angles were measured by other means: it is not
        isotropic, however little it varies. Empty: none.

    Returns
    -------
    ResolvedFrames
    """
    rotations = rotations.copy()
    common = np.tile(np.eye(3), (len(targets), 1, 1))
    symmetries = []
    for k in range(len(targets)):
        mine = (cluster == k) & (weights > 0)
        kind = Symmetry("none")
        if mine.any():
            known = bool(angles_known) and angles_known[k]
            own = (targets[k : k + 1], rotations[mine], weights[mine])
            common[k], kind = _common_rotation(*own, known)
            rotations[cluster == k] = reduce_to_fundamental_zone(
                rotations[cluster == k] @ common[k], kind
            )
        symmetries.append(kind)
    return ResolvedFrames(rotate_targets(targets, common), rotations, tuple(symmetries), common)


def _common_rotation(
    target: Coupled,
    rotations: NDArray[np.float64],
    weights: NDArray[np.float64],
    angles_known: bool,
) -> tuple[NDArray[np.float64], Symmetry]:
    """What to multiply to the rotations of one cluster, and the symmetry of its target."""
    common = mean_rotation(rotations, weights).T
    if not angles_known and in_plane_undetermined(rotations, weights):
        common = _rotation_without_angle(target, rotations, weights)
    upright = common @ _rotation_to_symmetry_axis(rotate_targets(target, common[None]))
    kind = symmetry_about_normal(rotate_targets(target, upright[None]), angles_known)
    if kind.kind != "none":
        common = upright
    return common @ _untwisting(rotations @ common, weights, kind), kind


def rotate_targets(targets: Coupled, common: NDArray[np.float64]) -> Coupled:
    """Targets such that frames times `common` fit them as the frames did before."""
    blocks = rotation_blocks(np.swapaxes(common, 1, 2), targets.n_degrees, str(targets.dtype))
    return rotate_coupled(targets, blocks)


def _rotation_to_symmetry_axis(target: Coupled) -> NDArray[np.float64]:
    """Rotation that brings z to the axis of the target's half-turn symmetry, if near z.

    The symmetry is a maximum of the target's correlation with itself, half a turn away from
    the identity. Ascents begin with the half turns about z and about axes around it: texels
    steeper than the others can carry the mean normal many degrees away.
    """
    axes = _axes_around_z()
    half_turns = 2.0 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    series = spectrum(target, target)
    rows = np.zeros(len(axes), np.int64)
    rotations, maxima = follow(series, rows, half_turns, AXIS_STEPS)
    # Half turns are 2 u u^T - I.
    axis = np.linalg.eigh(rotations + np.swapaxes(rotations, 1, 2))[1][:, :, 2]
    axis *= np.where(axis[:, 2:] < 0, -1.0, 1.0)
    near = axis[:, 2] >= np.cos(LARGEST_AXIS_TILT)
    if not near.any():
        return np.eye(3)
    best = axis[near][np.argmax(maxima[near, 0])]
    return frames_from_normals(best[None], X_AXIS)[0].T


def _axes_around_z() -> NDArray[np.float64]:
    """The normal and two rings of axes around it, (19, 3)."""
    rings = ((0.0, 1), (0.4, 6), (0.75, 12))
    polar = np.repeat([r for r, _ in rings], [n for _, n in rings]) * LARGEST_AXIS_TILT
    azimuth = np.concatenate([2.0 * np.pi * np.arange(n) / n for _, n in rings])
    x, y = np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)
    return np.stack([x, y, np.cos(polar)], axis=1)
