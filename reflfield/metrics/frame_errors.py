"""Angles between recovered and true normals and tangents."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from reflfield.metrics.truth_files import TruthView
from reflfield.util.validation import check_shape

Array = NDArray[np.float64]

# Frames between surface points: a line through that many, of one material and
# no farther apart in angle than a curved surface is between pixels.
FRAME_NEIGHBOURS = 12
NEIGHBOUR_COSINE = 0.85
TEXELS_PER_BLOCK = 16_384
# Surface points kept of all views together to match texels with.
MAX_SURFACE_POINTS = 1_000_000


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of the true surface that some view sees, to match texels with.

    Attributes
    ----------
    position, normal, tangent : (n, 3) float64
    label : (n,) int64
    """

    position: Array
    normal: Array
    tangent: Array
    label: NDArray[np.int64]


def surface_points(
    views: Sequence[TruthView] | Iterator[TruthView], max_points: int = MAX_SURFACE_POINTS
) -> SurfacePoints:
    """True surface points with their shading frames, from the pixels of views.

    Parameters
    ----------
    views : iterable of TruthView
        Read once.
    max_points : int
        Evenly thinned to at most about this many.

    Returns
    -------
    SurfacePoints
        Pixels that miss the surface or have no frame are left out.
    """
    parts = [_seen_pixels(view) for view in views]
    columns = [np.concatenate(part) for part in zip(*parts, strict=True)]
    if not columns:
        columns = [np.zeros((0, 3))] * 3 + [np.zeros(0, np.int64)]
    step = max(1, math.ceil(len(columns[0]) / max_points))
    position, normal, tangent, label = (column[::step] for column in columns)
    return SurfacePoints(position, normal, tangent, label)


@dataclass(frozen=True)
class UndeterminedRotation:
    r"""Rotation about the normal that the reflectance does not determine.

    The tangent of a target is arbitrary: rotated together with all of its frames it fits the
    samples equally well. For every target, and every material aligned to it, the rotation
    :math:`\frac12 \arg \sum_i e^{2 i \varphi_i}` is removed, :math:`\varphi_i` being the angle
    from the true to the recovered tangent; doubled, because tangents are compared as lines.

    Attributes
    ----------
    target, label : int
        Target of the alignment, and true material.
    degrees : float
        -90 to 90.
    n_texels : int
    """

    target: int
    label: int
    degrees: float
    n_texels: int


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """Angles between recovered and true frames, degrees.

    Attributes
    ----------
    texel : (n_matched,) int64
        Texels that have a true frame near them.
    normal, tangent : (n_matched,) float64
        Angle between normals, and between the *lines* of the tangents: rotating
        a tangent by 180 degrees does not change an anisotropic reflectance.
        One rotation about the normal is undetermined for each target and material, and removed.
    label : (n_matched,) int64
        Material of the matched surface point.
    rotations : tuple of UndeterminedRotation
        What was removed; empty if no targets were named.
    """

    texel: NDArray[np.int64]
    normal: Array
    tangent: Array
    label: NDArray[np.int64]
    rotations: tuple[UndeterminedRotation, ...] = ()

    def of_material(self, label: int) -> FrameErrors:
        """Errors of the texels of one material."""
        mine = self.label == label
        rotations = tuple(rotation for rotation in self.rotations if rotation.label == label)
        return FrameErrors(
            self.texel[mine], self.normal[mine], self.tangent[mine], self.label[mine], rotations
        )

    def summary(self) -> dict[str, float]:
        """Mean, median and 95th percentile of both angles, degrees, and the count."""
        statistics: dict[str, float] = {"n_texels": float(len(self.texel))}
        for name, angles in (("normal", self.normal), ("tangent", self.tangent)):
            known = angles if angles.size else np.array([math.nan])
            statistics[f"{name}_mean_deg"] = float(np.mean(known))
            statistics[f"{name}_median_deg"] = float(np.median(known))
            statistics[f"{name}_p95_deg"] = float(np.percentile(known, 95))
        return statistics


@dataclass(frozen=True, eq=False)
class TrueFrames:
    """True normals and tangents at texels that the true surface is near to.

    Parameters
    ----------
    n_texels : int
        All texels, matched or not.
    texel : (n_matched,) int64
        Texels that have a true frame near them.
    normal, tangent : (n_matched, 3) float64
        World frame; unit vectors up to interpolation.
    label : (n_matched,) int64
        Material of the nearest surface point.
    """

    n_texels: int
    texel: NDArray[np.int64]
    normal: Array
    tangent: Array
    label: NDArray[np.int64]

    def of(self, chosen: NDArray[np.bool_]) -> TrueFrames:
        """Those of some of the matched texels."""
        return TrueFrames(
            self.n_texels,
            self.texel[chosen],
            self.normal[chosen],
            self.tangent[chosen],
            self.label[chosen],
        )


def true_frames(
    positions: ArrayLike, surface: SurfacePoints, max_distance: float
) -> TrueFrames:
    """True shading frames nearest to texels.

    Parameters
    ----------
    positions : (n_texels, 3) array_like
        Metres, world frame.
    surface : SurfacePoints
        From `surface_points`. Between its points normals and tangents are
        interpolated linearly, within one material.
    max_distance : float
        Texels farther than this from any true point are left out, metres: where
        the hull bridges a hollow, no texel shows one point of the surface.

    Returns
    -------
    TrueFrames

    Raises
    ------
    ShapeError
        If the positions are not (n_texels, 3).
    """
    texels = np.asarray(positions, dtype=np.float64)
    check_shape("positions", texels, (None, 3))
    nothing = np.zeros(0, np.int64)
    if not len(surface.position):
        return TrueFrames(len(texels), nothing, np.zeros((0, 3)), np.zeros((0, 3)), nothing)
    tree = cKDTree(surface.position)
    distance, nearest = tree.query(texels)
    matched = np.flatnonzero(distance <= max_distance)
    true = [(np.zeros((0, 3)), np.zeros((0, 3)))]
    for first in range(0, len(matched), TEXELS_PER_BLOCK):
        block = matched[first : first + TEXELS_PER_BLOCK]
        true.append(_interpolated_frames(tree, surface, texels[block]))
    normal, tangent = (np.concatenate(part) for part in zip(*true, strict=True))
    return TrueFrames(len(texels), matched, normal, tangent, surface.label[nearest[matched]])


def frame_errors(
    true: TrueFrames, local_from_world: ArrayLike, targets: ArrayLike | None = None
) -> FrameErrors:
    """Angles of texel frames to the true shading frames nearest to them.

    Parameters
    ----------
    true : TrueFrames
        From `true_frames`, for the same texels.
    local_from_world : (n_texels, 3, 3) array_like
        Rows tangent, binormal, normal: recovered frames, or base frames for
        comparison. Frames that are not finite are left out.
    targets : (n_texels,) array_like of int, optional
        Target that each texel was aligned to: one rotation about the normal is removed for
        each of them and each material, see `UndeterminedRotation`. None removes nothing.

    Returns
    -------
    FrameErrors

    Raises
    ------
    ShapeError
        If the arrays do not belong together.

    Examples
    --------
    A frame turned by 180 degrees about its normal is right; one tilted by 90
    degrees about its tangent has the right tangent and a wrong normal:

    >>> point = SurfacePoints(*np.eye(3)[[0, 2, 0], None], np.zeros(1, int))
    >>> turned = np.diag([-1.0, -1.0, 1.0])
    >>> tilted = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    >>> true = true_frames(np.eye(3)[[0, 0]], point, 0.1)
    >>> errors = frame_errors(true, np.stack([turned, tilted]))
    >>> errors.normal.round(9).tolist(), errors.tangent.round(9).tolist()
    ([0.0, 90.0], [0.0, 0.0])
    """
    frames = np.asarray(local_from_world, dtype=np.float64)
    check_shape("local_from_world", frames, (true.n_texels, 3, 3))
    true = true.of(np.asarray(np.isfinite(frames[true.texel]).all(axis=(1, 2))))
    frames = frames[true.texel]
    rotations: tuple[UndeterminedRotation, ...] = ()
    tangent = frames[:, 0]
    if targets is not None:
        target = np.asarray(targets)
        check_shape("targets", target, (true.n_texels,))
        rotations, tangent = _without_undetermined_rotations(
            frames, true.normal, true.tangent, target[true.texel], true.label
        )
    return FrameErrors(
        true.texel,
        angle_deg(frames[:, 2], true.normal),
        _line_angle_deg(tangent, true.tangent),
        true.label,
        rotations,
    )


def _without_undetermined_rotations(
    frames: Array,
    normal: Array,
    tangent: Array,
    target: NDArray[np.integer[Any]],
    label: NDArray[np.int64],
) -> tuple[tuple[UndeterminedRotation, ...], Array]:
    """Undetermined rotations, and the tangents (n, 3) without them."""
    # The doubled angle in the plane of the true normal.
    across = np.cross(normal, tangent)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    tangent = np.cross(across, normal)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-300)
    along, aside = (np.einsum("nd,nd->n", frames[:, 0], axis) for axis in (tangent, across))
    doubled = np.exp(2j * np.arctan2(aside, along))
    rotations, angle = [], np.zeros(len(frames))
    for key in np.unique(np.stack([target, label], axis=1), axis=0):
        mine = (target == key[0]) & (label == key[1])
        angle[mine] = 0.5 * np.angle(doubled[mine].sum())
        degrees = float(np.degrees(angle[mine][0]))
        rotations.append(
            UndeterminedRotation(int(key[0]), int(key[1]), degrees, int(mine.sum()))
        )
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return tuple(rotations), c * frames[:, 0] - s * frames[:, 1]


def angle_deg(a: ArrayLike, b: ArrayLike) -> Array:
    r"""Angle between vectors, degrees, accurate near 0 and 180.

    :math:`2 \arctan(|a' - b'| / |a' + b'|)` with unit :math:`a', b'` (Kahan).

    Parameters
    ----------
    a, b : (..., 3) array_like
        Not zero.

    Returns
    -------
    (...) float64

    Examples
    --------
    >>> angle_deg([[1, 0, 0], [1, 0, 0]], [[0, 2, 0], [1, 1e-9, 0]]).round(9).tolist()
    [90.0, 5.7e-08]
    """
    first, second = (np.asarray(v, dtype=np.float64) for v in (a, b))
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    second = second / np.linalg.norm(second, axis=-1, keepdims=True)
    apart = np.linalg.norm(first - second, axis=-1)
    return np.degrees(2.0 * np.arctan2(apart, np.linalg.norm(first + second, axis=-1)))


def _seen_pixels(view: TruthView) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    frames = np.concatenate([view.position, view.normal, view.tangent], axis=-1)
    seen = (view.label >= 0) & np.isfinite(view.depth) & np.isfinite(frames).all(axis=-1)
    seen &= (np.abs(view.normal).max(axis=-1) > 0) & (np.abs(view.tangent).max(axis=-1) > 0)
    position, normal, tangent = (
        a[seen].astype(np.float64) for a in (view.position, view.normal, view.tangent)
    )
    return position, normal, tangent, view.label[seen].astype(np.int64)


def _interpolated_frames(
    tree: cKDTree, surface: SurfacePoints, positions: Array
) -> tuple[Array, Array]:
    """Normals and tangents of the surface at positions between its points."""
    count = min(FRAME_NEIGHBOURS, len(surface.position))
    distance, near = tree.query(positions, k=range(1, count + 1))
    offset = surface.position[near] - positions[:, None]
    normal, tangent = surface.normal[near], surface.tangent[near]
    alike = (surface.label[near] == surface.label[near[:, :1]]) & (
        np.einsum("nkd,nd->nk", normal, normal[:, 0]) > NEIGHBOUR_COSINE
    )
    reach = np.maximum(distance[:, -1:], 1e-300)
    weight = alike * np.exp(-2.0 * (distance / reach) ** 2)
    # Tangents are lines: flip all to the side of the nearest.
    side = np.where(np.einsum("nkd,nd->nk", tangent, tangent[:, 0]) < 0.0, -1.0, 1.0)
    vectors = np.concatenate([normal, side[..., None] * tangent], axis=2)
    fitted = _value_at_origin(offset / reach[..., None], vectors, weight)
    return fitted[:, :3], fitted[:, 3:]


def _value_at_origin(offset: Array, values: Array, weight: Array) -> Array:
    r"""Constant part of a weighted linear fit, for every row.

    Minimises :math:`\sum_k w_k |v_k - a - B x_k|^2 + \epsilon |B|^2`; the second
    term keeps slopes at 0 in directions without points, such as the normal.

    Parameters
    ----------
    offset : (n, k, 3) float64
    values : (n, k, d) float64
    weight : (n, k) float64

    Returns
    -------
    (n, d) float64
    """
    design = np.concatenate([np.ones_like(offset[..., :1]), offset], axis=2)
    weighted = weight[..., None] * design
    gram = np.einsum("nki,nkj->nij", weighted, design)
    gram[:, [1, 2, 3], [1, 2, 3]] += 1e-6 * gram[:, :1, 0]
    solved = np.linalg.solve(gram, np.einsum("nki,nkd->nid", weighted, values))
    return np.asarray(solved[:, 0])


def _line_angle_deg(a: Array, b: Array) -> Array:
    angle = angle_deg(a, b)
    return np.minimum(angle, 180.0 - angle)
