"""Whether masks end where the object ends in the photographs.

Before an even backdrop the mean photograph of a view tells backdrop from object. Pixels at each
signed distance to the outline of the mask are one or the other; the mask is too large by the
distance at which they change, if they change all along the outline, and has a hole or misses a
part where many pixels in one place are what the mask says that they are not.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from reflfield.capture.color_spaces import LUMINANCE
from reflfield.checking.checked_views import CheckedView

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

# Distances to the outline at which pixels are compared, pixels.
REACH_PX = 8.0
# The backdrop is even if nearly all of it is darker than this share of what the object shows.
DARKEST_OBJECT = 0.25
# What lies so deep is object even where the mask is too large, and the share of the outline
# that must show it.
CORE_PX, LEAST_CLEAR = 4.5, 0.2
# Pixels at the outline are blurred: what lies deeper says something of a part.
DEEP_PX = 1.5


@dataclass(frozen=True, eq=False)
class MaskEdge:
    """How a mask agrees with the photographs of its view.

    Parameters
    ----------
    too_large : float
        Pixels (of the reduced image) by which the outline lies outside of the object's.
    missed : float
        Share of the object, as the photographs show it, that the mask leaves out.
    added : float
        Share of the mask in which the photographs show backdrop.
    hole : float
        Share of the object in enclosed holes of the mask in which the photographs show it.
    shown : (rows, columns) bool
        Where the photographs show the object.
    """

    too_large: float
    missed: float
    added: float
    hole: float
    shown: Bool


def mask_edge(view: CheckedView, mean: Float32) -> MaskEdge | None:
    """Compare a mask with the mean photograph of its view; None before an uneven backdrop."""
    if mean.shape[:2] != view.coverage.shape:
        return None
    shown = object_pixels(mean, view.coverage)
    if shown is None:
        return None
    distance = view.cone.outline.values
    inside = distance > 0
    deep = np.abs(distance) > DEEP_PX
    area = max(int(inside.sum()), 1)
    hole = _enclosed(inside) & deep & shown
    return MaskEdge(
        too_large=_crossing(distance, shown, _clear(distance, shown)),
        missed=float((~inside & shown & deep).sum() / area),
        added=float((inside & ~shown & deep).sum() / area),
        hole=float(hole.sum() / area),
        shown=shown,
    )


def object_pixels(mean: Float32, coverage: Float32) -> Bool | None:
    """Pixels that differ from the backdrop; None where that is not even and dark or bright.

    The backdrop is what lies far outside of the mask, or in the border of the image where the
    mask leaves it nothing else.
    """
    bright = np.sqrt(np.maximum(mean @ LUMINANCE, 0))
    border = np.ones(bright.shape, bool)
    n = max(1, round(0.03 * max(bright.shape)))
    border[n:-n, n:-n] = False
    inside = coverage >= 0.5
    backdrop = border & ~inside
    if backdrop.sum() < 0.2 * border.sum():
        return None
    level = float(np.median(bright[backdrop]))
    spread = float(np.quantile(np.abs(bright[backdrop] - level), 0.95))
    contrast = float(np.quantile(np.abs(bright[inside] - level), 0.75))
    threshold = max(3 * spread, 0.06 * contrast)
    if threshold > DARKEST_OBJECT * contrast:
        return None
    return np.asarray(np.abs(bright - level) > threshold)


def _clear(distance: Float32, shown: Bool) -> Bool:
    """Pixels beside parts of the object that are no darker than the backdrop."""
    size = 2 * int(REACH_PX + CORE_PX) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    seen = (shown & (distance >= CORE_PX)).astype(np.uint8)
    # Dark parts that are as near leave it open where the object ends.
    dark = (~shown & (distance >= CORE_PX)).astype(np.uint8)
    return np.asarray((cv2.dilate(seen, disc) > 0) & (cv2.dilate(dark, disc) == 0))


def _crossing(distance: Float32, shown: Bool, clear: Bool) -> float:
    """Distance to the outline, pixels, at which backdrop turns into object; 0 if unclear."""
    outline = np.abs(distance) < 1
    if (outline & clear).sum() < max(LEAST_CLEAR * outline.sum(), 8):
        return 0.0
    distance, shown = distance[clear], shown[clear]
    steps = np.arange(-REACH_PX, REACH_PX)
    total = 0.0
    for step in steps:
        at_step = shown[(distance >= step) & (distance < step + 1)]
        if at_step.size:
            total += float((1 - at_step.mean()) if step >= 0 else -at_step.mean())
    return total


def _enclosed(inside: Bool) -> Bool:
    """Pixels outside of a mask that it surrounds."""
    _, labels = cv2.connectedComponents((~inside).astype(np.uint8), connectivity=4)
    edge = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    return ~inside & ~np.isin(labels, edge)
