r"""How far the outlines of two views disagree, by the planes that touch the object.

Of the planes through the centres of two cameras two touch an object between them. Both views
see the object on the same side of each, and each outline touches both planes. The angles of
these planes about the line between the centres, as either outline tells them, are thus equal
where silhouettes and poses are right: two equations for each pair of views, of which nothing
is known but outlines. [1]_

References
----------
.. [1] C. Hernandez, F. Schmitt and R. Cipolla, "Silhouette coherence for camera calibration
   under circular motion", IEEE TPAMI 29(2), 2007.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from reflfield.capture.inspect import spread_evenly
from reflfield.geometry.cones import View, normalised

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Views that each view is compared with, at most.
MOST_PARTNERS = 24
# Half the angle between the touching planes, radians, from which the line between the centres
# may run through the object; and least sine of the angle between that line and a ray.
WIDEST, LEAST_SINE = np.radians(75.0), 0.1


@dataclass(frozen=True, eq=False)
class ConvexOutlines:
    """Rays to the corners of the convex hulls of outlines, in camera axes.

    Parameters
    ----------
    rays : (n_views, n_corners, 3) float64
        Unit vectors; corners are repeated where an outline has fewer.
    on_border : (n_views, n_corners) bool
        Whether the image ends there, and the outline does not.
    focal : (n_views,) float64
        Pixels.
    """

    rays: Array
    on_border: Bools
    focal: Array


def convex_outlines(views: Sequence[View]) -> ConvexOutlines:
    """Corners of the outlines that planes can touch, at least three of each view."""
    corners = [_corners(view) for view in views]
    most = max(len(rays) for rays, _ in corners)
    padded = [np.arange(most) % len(rays) for rays, _ in corners]
    pairs = list(zip(corners, padded, strict=True))
    return ConvexOutlines(
        np.array([rays[i] for (rays, _), i in pairs]),
        np.array([border[i] for (_, border), i in pairs]),
        np.array([0.5 * (v.camera.fl_x + v.camera.fl_y) for v in views]),
    )


def _corners(view: View) -> tuple[Array, Bools]:
    points = np.concatenate([view.outline.outline, view.outline.rim])
    flat = normalised(view.camera, points)
    some = ConvexHull(flat).vertices
    rays = np.column_stack([flat[some], np.ones(len(some))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), some >= len(view.outline.outline)


@dataclass(frozen=True, eq=False)
class TangentPlanes:
    """Pairs of views whose outlines are compared, and how much each plane tells.

    Parameters
    ----------
    outlines : ConvexOutlines
    first, second : (n_pairs,) int
        Views.
    weight : (n_pairs, 2) float64
        Pixels per radian of the upper and the lower plane; 0 where a plane tells nothing.
    """

    outlines: ConvexOutlines
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    weight: Array

    @classmethod
    def of(cls, outlines: ConvexOutlines, camera_from_world: Array) -> TangentPlanes:
        """Choose the pairs, and weigh planes, with poses (n_views, 4, 4)."""
        first, second = _pairs(len(camera_from_world))
        planes = cls(outlines, first, second, np.ones((len(first), 2)))
        sides = planes._sides(camera_from_world[first], camera_from_world[second])
        focal = outlines.focal[[first, second]][..., None]
        sine = np.maximum(np.stack([side.sine for side in sides]), 1e-9)
        weight = np.sqrt(2.0 / np.square(1.0 / (focal * sine)).sum(axis=0))
        tells = np.all([side.tells for side in sides], axis=0)
        return cls(outlines, first, second, np.where(tells, weight, 0.0))

    def gaps(self, first_pose: Array, second_pose: Array) -> Array:
        """Distances (n_pairs, 2) between the planes that the two outlines touch, pixels.

        Parameters
        ----------
        first_pose, second_pose : (n_pairs, 4, 4) float64
            ``camera_from_world`` of the views of each pair.
        """
        one, other = self._sides(first_pose, second_pose)
        return (one.angle - other.angle) * self.weight

    def _sides(self, first_pose: Array, second_pose: Array) -> tuple[_Side, _Side]:
        """What either view tells of the two planes of each pair."""
        centres = [-np.einsum("pji,pj->pi", p[:, :3, :3], p[:, :3, 3]) for p in
                   (first_pose, second_pose)]  # fmt: skip
        rays = [
            np.einsum("pji,pmj->pmi", pose[:, :3, :3], self.outlines.rays[view])
            for pose, view in ((first_pose, self.first), (second_pose, self.second))
        ]
        along = _unit(centres[1] - centres[0])
        ahead = rays[0].mean(axis=1) + rays[1].mean(axis=1)
        ahead = _unit(ahead - (ahead * along).sum(axis=1, keepdims=True) * along)
        axes = np.stack([ahead, np.cross(along, ahead), along], axis=2)
        one, other = (
            _side(ray @ axes, self.outlines.on_border[view])
            for ray, view in zip(rays, (self.first, self.second), strict=True)
        )
        return one, other


@dataclass(frozen=True, eq=False)
class _Side:
    """The planes that touch one outline of each pair, (n_pairs, 2) each."""

    angle: Array
    sine: Array  # of the angle between the touching ray and the line between the centres
    tells: Bools


def _side(rays: Array, on_border: Bools) -> _Side:
    """Planes from rays (n_pairs, n_corners, 3) in axes whose last is the line of centres."""
    angles = np.arctan2(rays[..., 1], rays[..., 0])
    touching = np.stack([angles.argmax(axis=1), angles.argmin(axis=1)], axis=1)
    angle = np.take_along_axis(angles, touching, axis=1)
    sine = np.take_along_axis(np.hypot(rays[..., 0], rays[..., 1]), touching, axis=1)
    beside = (np.abs(angle) < WIDEST).all(axis=1, keepdims=True)
    cut = np.take_along_axis(on_border, touching, axis=1)
    return _Side(angle, sine, beside & (sine > LEAST_SINE) & ~cut)


def _pairs(n_views: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of views, each once, of each view with at most `MOST_PARTNERS` that follow it."""
    steps = np.array(spread_evenly(n_views - 1, MOST_PARTNERS), dtype=np.int64) + 1
    first = np.repeat(np.arange(n_views), len(steps))
    second = (first + np.tile(steps, n_views)) % n_views
    both = np.unique(np.sort(np.stack([first, second], axis=1), axis=1), axis=0)
    return both[:, 0], both[:, 1]


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.maximum(length, np.finfo(np.float64).tiny)
