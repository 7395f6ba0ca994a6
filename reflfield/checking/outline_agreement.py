"""Whether outlines agree with each other to the pixel.

Along the ray of each point of an outline lies a point of the object, which no other view
excludes. The point that the others exclude least tells by how many pixels they contradict, and
who. Where `geometry.contradictions` looks at areas on a grid of voxels, here only outlines are
looked at, as finely as they are drawn: a mask that is three pixels too large, or a camera that
is turned by a degree, moves its outline by little, but all of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reflfield.geometry.cones import View
from reflfield.geometry.contradictions import Evidence, Verdict, set_aside

Array = NDArray[np.float64]

# Points of each outline, samples along the ray of each, and finer ones beside the best; fewer
# of both where there are many views.
RAYS, SAMPLES, FINER = 120, 48, 12
# More others than this tell a view nothing more.
MANY_VIEWS = 60
# Distances are kept in quarters of a pixel, up to this many pixels.
_FARTHEST_PX, _STEPS = 31.0, 4.0
# An outline that is drawn to half a pixel on both sides is off by less than this, pixels.
TOLERANCE_PX = 1.0
# Share of an outline that others exclude by more than that, where they agree: thin parts and
# sharp corners, which samples miss.
USUAL_SHARE = 0.04
# The same of masks that are drawn roughly, at most.
ROUGH_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class OutlineAgreement:
    """How far the views exclude points along the rays of each other's outlines.

    Parameters
    ----------
    others : list of (n,) int
        For each view: those that it is compared with.
    outside : list of (rays, samples, n) int8
        For each view: quarters of a pixel by which each of those excludes each sample; 0 where
        it does not.
    """

    others: list[NDArray[np.intp]]
    outside: list[NDArray[np.int8]]

    def evidence(self, some: Sequence[int]) -> Evidence:
        """Evidence for and against some of the views."""
        n = len(some)
        blame, uncovered = np.zeros((n, n)), np.zeros(n)
        place = np.full(len(self.outside), -1)
        place[list(some)] = np.arange(n)
        for column, view in enumerate(some):
            row = place[self.others[view]]
            excluded = self._gaps(view, row >= 0) > TOLERANCE_PX
            weight = 1.0 / np.maximum(excluded.sum(axis=1), 1)
            blame[row[row >= 0], column] = (excluded * weight[:, None]).mean(axis=0)
            uncovered[column] = excluded.any(axis=1).mean()
        return Evidence(blame, uncovered)

    def _gaps(self, view: int, heard: NDArray[np.bool_]) -> Array:
        """Pixels (rays, n) by which some others exclude the best point of a view's rays."""
        outside = self.outside[view][..., heard]
        tolerated = np.maximum(outside.astype(np.int16) - int(TOLERANCE_PX * _STEPS), 0)
        best = tolerated.sum(axis=2).argmin(axis=1)
        return outside[np.arange(len(outside)), best] / _STEPS

    def verdict(self) -> Verdict:
        """Which views contradict the others."""
        n_views = len(self.outside)
        verdict = set_aside(n_views, self.evidence, USUAL_SHARE)
        if verdict.agree:
            return verdict
        # Where no few views are to blame, all may be drawn or calibrated less finely.
        usual = float(np.quantile(verdict.uncovered, 0.25))
        rougher = set_aside(n_views, self.evidence, min(1.5 * usual, ROUGH_SHARE))
        return rougher if rougher.agree else verdict


def outline_agreement(views: Sequence[View], low: Array, high: Array) -> OutlineAgreement:
    """Compare the outlines of views.

    Parameters
    ----------
    views : sequence of View
    low, high : (3,) float64
        Box that holds the object, metres.
    """
    fewer = min(1.0, MANY_VIEWS / len(views))
    n_rays, n_samples = max(40, int(RAYS * fewer)), max(32, int(SAMPLES * fewer))
    others = [_others_of(number, len(views)) for number in range(len(views))]
    return OutlineAgreement(
        others,
        [
            _outside(view, [views[i] for i in some], low, high, n_rays, n_samples)
            for view, some in zip(views, others, strict=True)
        ],
    )


def _others_of(number: int, n_views: int) -> NDArray[np.intp]:
    """Other views, of many some that are spread evenly over all."""
    n_others = min(n_views - 1, MANY_VIEWS)
    steps = 1 + np.arange(n_others) * (n_views - 1) // max(n_others, 1)
    return np.sort((number + steps) % n_views)


def outline_points(view: View, most: int) -> Array:
    """At most so many points of an outline, evenly spread, (n, 2)."""
    points = view.outline.outline
    middle = points.mean(axis=0)
    around = np.argsort(np.arctan2(*(points - middle).T), kind="stable")
    some = np.unique(np.linspace(0, len(points) - 1, min(most, len(points))).astype(int))
    return points[around[some]]


def _outside(
    view: View, others: Sequence[View], low: Array, high: Array, n_rays: int, n_samples: int
) -> NDArray[np.int8]:
    """Exclusion of samples along the rays of one view's outline by others."""
    origins, ways = view.camera.rays(outline_points(view, n_rays))
    near, far = _box_interval(origins, ways, low, high)
    at = near[:, None] + (far - near)[:, None] * (np.arange(n_samples) + 0.5) / n_samples
    coarse = _excluded(others, origins, ways, at)
    best = np.maximum(coarse.astype(np.int16) - int(TOLERANCE_PX * _STEPS), 0).sum(axis=2)
    centre = np.take_along_axis(at, best.argmin(axis=1)[:, None], axis=1)
    step = (far - near)[:, None] / n_samples
    finer = centre + step * np.linspace(-1, 1, FINER)
    return np.concatenate([coarse, _excluded(others, origins, ways, finer)], axis=1)


def _excluded(
    others: Sequence[View], origins: Array, ways: Array, at: Array
) -> NDArray[np.int8]:
    """Quarters of a pixel (rays, samples, n) by which views exclude samples of rays."""
    points = (origins[:, None] + at[..., None] * ways[:, None]).reshape(-1, 3)
    outside = np.zeros((len(points), len(others)), np.int8)
    for column, view in enumerate(others):
        outside[:, column] = np.rint(_STEPS * np.clip(-_pixels(view, points), 0, _FARTHEST_PX))
    return outside.reshape(*at.shape, len(others))


def _pixels(view: View, points: Array) -> Array:
    """Signed distance (n,) to an outline, pixels; positive inside."""
    pixels, depth = view.camera.project(points)
    imaged = np.isfinite(pixels).all(axis=1)
    if view.camera.kind != "orthographic":
        imaged &= depth > 0
    distance = np.full(len(points), np.inf if view.outline.leaves_image else -np.inf)
    distance[imaged] = view.outline.at(pixels[imaged])
    return distance


def _box_interval(origins: Array, ways: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Distances (n,) at which rays enter and leave a box; for a miss, beside its centre."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (low - origins) / ways, (high - origins) / ways
    near = np.nanmax(np.minimum(first, second), axis=1)
    far = np.nanmin(np.maximum(first, second), axis=1)
    radius = 0.5 * float(np.linalg.norm(high - low))
    centre = ((0.5 * (low + high) - origins) * ways).sum(axis=1)
    missed = ~(far > near)
    return np.where(missed, centre - radius, near), np.where(missed, centre + radius, far)


def outline_gaps(
    view: View, others: Sequence[View], low: Array, high: Array, n_rays: int = 60
) -> Array:
    """Pixels (rays,) by which the best point along each ray lies inside of all other views.

    Near zero where views agree: an outline touches the object. Negative where the others
    exclude what the view shows, positive where they leave room beyond it.

    Parameters
    ----------
    view : View
    others : sequence of View
    low, high : (3,) float64
        Box that holds the object, metres.
    n_rays : int
        Points of the outline.
    """
    origins, ways = view.camera.rays(outline_points(view, n_rays))
    near, far = _box_interval(origins, ways, low, high)
    at = near[:, None] + (far - near)[:, None] * (np.arange(SAMPLES) + 0.5) / SAMPLES
    step = (far - near)[:, None] / SAMPLES
    best = np.full(len(at), -np.inf)
    for _ in range(3):  # coarse, then twice finer beside the best
        points = (origins[:, None] + at[..., None] * ways[:, None]).reshape(-1, 3)
        inside = np.full(len(points), np.inf)
        for other in others:
            np.minimum(inside, _pixels(other, points), out=inside)
        of_rays = inside.reshape(at.shape)
        chosen = of_rays.argmax(axis=1)
        best = np.maximum(best, of_rays.max(axis=1))
        at = np.take_along_axis(at, chosen[:, None], axis=1) + step * np.linspace(-1, 1, 9)
        step = step / 4
    return best
