"""Which small error of cameras explains that outlines do not agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from reflfield.capture.cameras import Camera
from reflfield.capture.inspect import spread_evenly
from reflfield.checking.outline_agreement import outline_gaps
from reflfield.geometry.cones import View

Array = NDArray[np.float64]

# Factors of all focal lengths that are tried, and views and rays that tell.
FACTORS = (0.9, 0.95, 1.0, 1.05, 1.1)
MOST_VIEWS, RAYS = 24, 48
FEWEST_VIEWS = 8
# Gaps beyond this, pixels, count as much as it: of thin parts, that samples miss.
FARTHEST_PX = 4.0
# Focal lengths are named if they are off by so much, and by so many standard errors.
LEAST_OFF, ERRORS = 0.015, 5.0
# A turn explains a contradiction if it leaves this share of the squared gaps.
SHARE_LEFT = 0.35
MOST_EVALUATIONS = 120


@dataclass(frozen=True)
class FocalScale:
    """The factor of all focal lengths at which outlines agree best.

    Parameters
    ----------
    factor, error : float
        And its standard error.
    """

    factor: float
    error: float

    @property
    def is_off(self) -> bool:
        """Whether the lengths as described are plainly not the best."""
        off = abs(self.factor - 1)
        return off > LEAST_OFF and off > ERRORS * self.error


def focal_scale(views: Sequence[View], low: Array, high: Array) -> FocalScale | None:
    r"""Find the factor of all focal lengths for which outlines agree best.

    The sum of squared negative gaps over a few factors is fitted by a parabola; leaving out
    one view after the other (jackknife) gives the standard error of its lowest point.
    """
    some = [views[i] for i in spread_evenly(len(views), MOST_VIEWS)]
    if len(some) < FEWEST_VIEWS:
        return None
    squares = np.array([_squares(some, factor, low, high) for factor in FACTORS])
    best = _lowest(squares.sum(axis=1))
    if best is None:
        return None
    without = [_lowest(np.delete(squares, i, axis=1).sum(axis=1)) for i in range(len(some))]
    known = np.array([1.0 if w is None else w for w in without])
    n = len(known)
    error = float(np.sqrt((n - 1) / n * np.square(known - known.mean()).sum()))
    return FocalScale(best, error)


def _squares(views: Sequence[View], factor: float, low: Array, high: Array) -> Array:
    """Mean squared negative gap of each view, all focal lengths multiplied by a factor."""
    scaled = [View(_with_focal(view.camera, factor), view.outline) for view in views]
    margin = 0.1 * (high - low)
    return np.array(
        [
            np.square(
                np.clip(
                    outline_gaps(
                        view, [o for o in scaled if o is not view], low - margin,
                        high + margin, RAYS,
                    ),
                    -FARTHEST_PX,
                    0,
                )
            ).mean()
            for view in scaled
        ]
    )  # fmt: skip


def _lowest(totals: Array) -> float | None:
    """Where a parabola through values at `FACTORS` is lowest; None if it has no low point."""
    curvature, slope, _ = np.polyfit(np.array(FACTORS) - 1, totals, 2)
    if curvature <= 0:
        return None
    return float(np.clip(1 - slope / (2 * curvature), FACTORS[0], FACTORS[-1]))


def _with_focal(camera: Camera, factor: float) -> Camera:
    return replace(camera, fl_x=camera.fl_x * factor, fl_y=camera.fl_y * factor)


@dataclass(frozen=True)
class CameraError:
    """A small error of one camera that explains its contradiction.

    Parameters
    ----------
    kind : {"turned", "focal length"}
    amount : float
        Degrees, or the factor by which the focal length is too large.
    before, after : float
        Root mean square of the gaps, pixels, as described and corrected.
    """

    kind: str
    amount: float
    before: float
    after: float


def camera_error(
    view: View, others: Sequence[View], low: Array, high: Array
) -> CameraError | None:
    """The turn, or else the focal length, that makes a view agree with the others."""

    def cost(parameters: Array, kind: str) -> float:
        gaps = outline_gaps(_moved(view, parameters, kind), others, low, high, RAYS)
        return float(np.square(np.clip(gaps, -FARTHEST_PX * 2, FARTHEST_PX * 2)).mean())

    before = cost(np.zeros(3), "turned")
    outcomes = []
    for kind, size, first in (("focal length", 1, 0.04), ("turned", 3, 0.01)):
        simplex = np.vstack([np.zeros(size), first * np.eye(size)])
        solution = minimize(
            cost,
            np.zeros(size),
            args=(kind,),
            method="Nelder-Mead",
            options={
                "initial_simplex": simplex,
                "maxfev": MOST_EVALUATIONS,
                "xatol": 1e-4,
                "fatol": 1e-4 * before,
            },
        )
        amount = float(np.linalg.norm(solution.x)) if kind == "turned" else solution.x[0]
        outcomes.append((float(solution.fun), kind, amount))
    # One number that explains as much as three does so better.
    focal, turned = outcomes
    after, kind, amount = focal if focal[0] < 1.5 * turned[0] else turned
    if after > SHARE_LEFT * before:
        return None
    shown = np.degrees(amount) if kind == "turned" else float(np.exp(-amount))
    return CameraError(kind, float(shown), float(np.sqrt(before)), float(np.sqrt(after)))


def _moved(view: View, parameters: Array, kind: str) -> View:
    camera = view.camera
    if kind == "focal length":
        return View(_with_focal(camera, float(np.exp(parameters[0]))), view.outline)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(parameters).as_matrix()
    moved = replace(camera, camera_from_world=pose @ camera.camera_from_world)
    return View(moved, view.outline)
