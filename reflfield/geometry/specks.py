"""Small parts of a silhouette that no other view supports."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from reflfield.capture.names import listed
from reflfield.errors import GeometryError
from reflfield.geometry.bounding_box import robust_bounds
from reflfield.geometry.cones import View
from reflfield.geometry.contradictions import best_on_rays, best_score, votes_of
from reflfield.geometry.silhouettes import signed_distance

Array = NDArray[np.float64]

# Parts below this share of the largest part's area are looked at.
SMALL_PART = 0.01


def without_specks(
    views: Sequence[View], silhouettes: Sequence[NDArray[np.floating]]
) -> tuple[list[View], list[NDArray[np.floating]], dict[str, int]]:
    """Views without the small parts of silhouettes that all other views exclude.

    A part is removed if its area is below `SMALL_PART` of the largest part's and if some
    other view excludes every point along the rays of its pixels. Small parts of the object
    that the other views show as well (what lies behind a thin gap, the tip of a wire) stay.

    Parameters
    ----------
    views : sequence of View
    silhouettes : sequence of (height, width) float
        Coverage, one for each view.

    Returns
    -------
    views : list of View
    silhouettes : list of (height, width) float
    removed : dict of str to int
        Number of parts removed, by the names of the cameras; without views that lost none.

    Notes
    -----
    Where no silhouette has small parts, nothing is computed.
    """
    small = [_small_parts(view) for view in views]
    if not any(count for count, _ in small):
        return list(views), list(silhouettes), {}
    inner = [
        _without_rim(view, labels) if count else view
        for view, (count, labels) in zip(views, small, strict=True)
    ]
    box = robust_bounds(inner)
    if box is None:
        return list(views), list(silhouettes), {}
    votes = votes_of(inner, *box)
    kept_views, kept_silhouettes, removed = list(views), list(silhouettes), dict[str, int]()
    for number, (count, labels) in enumerate(small):
        if not count:
            continue
        others = [i for i in range(len(views)) if i != number]
        score = best_score(votes, votes.of(others))
        row, col = np.nonzero(labels)
        pixels: Array = np.stack([col, row], axis=1).astype(np.float64) + 0.5
        best = best_on_rays(views[number], pixels, votes, score)
        supported = (best >= 0) & (score[best] < 0.5)
        lost = np.ones(labels.max() + 1, dtype=bool)
        lost[np.unique(labels[row, col][supported])] = False
        lost[0] = False
        if lost.any():
            name = views[number].camera.id
            removed[name] = int(lost.sum())
            clean = np.where(_with_fringe(lost[labels]), 0.0, silhouettes[number])
            kept_silhouettes[number] = clean
            outline = signed_distance(clean, f"silhouette of view {name!r}")
            kept_views[number] = replace(views[number], outline=outline)
    return kept_views, kept_silhouettes, removed


def specks_words(removed: Mapping[str, int]) -> tuple[str, ...]:
    """Sentence on what was removed, without its end, if anything was.

    Examples
    --------
    >>> specks_words({"v001": 3, "v004": 1})
    ('4 small parts of silhouettes that no other view supports were left out: v001 3, v004 1',)
    """
    if not removed:
        return ()
    shown = listed([f"{name} {count}" for name, count in removed.items()])
    what = (
        "small part of a silhouette"
        if sum(removed.values()) == 1
        else "small parts of silhouettes"
    )
    were = "was" if sum(removed.values()) == 1 else "were"
    return (
        f"{sum(removed.values())} {what} that no other view supports {were} left out: {shown}",
    )


@contextmanager
def noting_small_parts(views: Sequence[View]) -> Iterator[None]:
    """Note on an error how many small parts the silhouettes have, if they have any."""
    try:
        yield
    except GeometryError as error:
        counts = {view.camera.id: _small_parts(view)[0] for view in views}
        shown = [f"{name} {count}" for name, count in counts.items() if count]
        if shown:
            error.add_note(
                "the silhouettes have small parts beside the object, as noise has "
                f"({listed(shown)}); clean the masks"
            )
        raise


def _small_parts(view: View) -> tuple[int, NDArray[np.int32]]:
    """Number of small parts, and an image of their numbers from 1; 0 elsewhere."""
    covered = (view.outline.values > 0.0).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(covered, connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA]
    small = area < SMALL_PART * area[1:].max(initial=0)
    small[0] = False
    numbers = np.cumsum(small).astype(np.int32) * small
    return int(small.sum()), numbers[labels] if count > 1 else labels


def _without_rim(view: View, labels: NDArray[np.int32]) -> View:
    """View whose small parts do not make it one that the object leaves."""
    height, width = labels.shape
    col = np.clip(np.floor(view.outline.rim[:, 0]).astype(int), 0, width - 1)
    row = np.clip(np.floor(view.outline.rim[:, 1]).astype(int), 0, height - 1)
    rim = view.outline.rim[labels[row, col] == 0]
    return replace(view, outline=replace(view.outline, rim=rim))


def _with_fringe(part: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels of parts and the half-covered ones beside them."""
    grown = cv2.dilate(part.astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(grown > 0)
