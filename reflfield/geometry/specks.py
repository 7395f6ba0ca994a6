"""Small parts of a silhouette that no other view supports."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reflfield.errors import GeometryError
from reflfield.geometry.bounding_box import robust_bounds
from reflfield.geometry.cones import View
from reflfield.geometry.contradictions import Votes, best_on_rays, best_score, votes_of
from reflfield.geometry.silhouette_distance import signed_distance
from reflfield.util.blas_threads import thread_pool
from reflfield.util.quoting import listed

Array = NDArray[np.float64]

# Parts below this share of the largest part's area are looked at.
SMALL_PART = 0.01


@dataclass(frozen=True, eq=False)
class Cleaned(Sequence[NDArray[np.floating]]):
    """Silhouettes without some of their pixels, each when it is asked for.

    Parameters
    ----------
    silhouettes : sequence of (height, width) float
    removed : dict of int to (n,) int
        Pixels, row by row, that become empty, by the number of the silhouette.
    """

    silhouettes: Sequence[NDArray[np.floating]]
    removed: dict[int, NDArray[np.intp]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.silhouettes)

    def __getitem__(self, view: Any) -> Any:
        silhouette = self.silhouettes[view]
        if view not in self.removed:
            return silhouette
        clean = np.array(silhouette)
        clean.ravel()[self.removed[view]] = 0.0
        return clean


def without_specks(
    views: Sequence[View],
    silhouettes: Sequence[NDArray[np.floating]],
    scratch: Path | None = None,
    workers: int = 1,
) -> tuple[list[View], Sequence[NDArray[np.floating]], dict[str, int]]:
    """Views without the small parts of silhouettes that all other views exclude.

    A part is removed if its area is below `SMALL_PART` of the largest part's and if some
    other view excludes every point along the rays of its pixels. Small parts of the object
    that the other views show as well (what lies behind a thin gap, the tip of a wire) stay.

    Parameters
    ----------
    views : sequence of View
    silhouettes : sequence of (height, width) float
        Coverage, one for each view.
    scratch : Path, optional
        Folder for files in which distances are kept instead of in memory.
    workers : int
        Threads.

    Returns
    -------
    views : list of View
    silhouettes : sequence of (height, width) float
    removed : dict of str to int
        Number of parts removed, by the names of the cameras; without views that lost none.

    Notes
    -----
    Where no silhouette has small parts, nothing is computed.
    """
    with thread_pool(workers) as pool:
        small = list(pool.map(_small_parts, views))
    marked = [number for number, parts in enumerate(small) if parts.count]
    kept_views, clean = list(views), Cleaned(silhouettes)
    inner = [
        _without_rim(view, parts) if parts.count else view
        for view, parts in zip(views, small, strict=True)
    ]
    box = robust_bounds(inner, workers) if marked else None
    if box is None:
        return kept_views, silhouettes, {}
    votes = votes_of(inner, *box, workers)

    def cleaned(number: int) -> int:
        """Number of parts of a view that are removed."""
        lost = _unsupported(views[number], small[number], votes, number, len(views))
        if lost.any():
            clean.removed[number] = _pixels_of(views[number], small[number], lost)
            name = f"silhouette of view {views[number].camera.id!r}"
            outline = signed_distance(clean[number], name)
            if scratch is not None:
                outline = outline.moved_to(scratch / f"distances{number}.npy")
            kept_views[number] = replace(views[number], outline=outline)
        return int(lost.sum())

    with thread_pool(workers) as pool:
        counts = dict(zip(marked, pool.map(cleaned, marked), strict=True))
    removed = {views[number].camera.id: count for number, count in counts.items() if count}
    return kept_views, clean, removed


def _unsupported(
    view: View, parts: _SmallParts, votes: Votes, number: int, n_views: int
) -> NDArray[np.bool_]:
    """True (n_parts + 1,) for the parts of a view that the other views exclude."""
    score = best_score(votes, votes.of([i for i in range(n_views) if i != number]))
    row, col = np.divmod(parts.pixels, view.camera.width)
    pixels: Array = np.stack([col, row], axis=1).astype(np.float64) + 0.5
    best = best_on_rays(view, pixels, votes, score)
    supported = (best >= 0) & (score[best] < 0.5)
    lost = np.ones(parts.count + 1, dtype=bool)
    lost[np.unique(parts.number[supported])] = False
    lost[0] = False
    return lost


def _pixels_of(view: View, parts: _SmallParts, lost: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Pixels, row by row, of some parts of a silhouette, and those beside them."""
    gone = np.zeros((view.camera.height, view.camera.width), dtype=bool)
    gone.ravel()[parts.pixels[lost[parts.number]]] = True
    return np.flatnonzero(_with_fringe(gone))


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
        counts = {view.camera.id: _small_parts(view).count for view in views}
        shown = [f"{name} {count}" for name, count in counts.items() if count]
        if shown:
            error.add_note(
                "the silhouettes have small parts beside the object, as noise has "
                f"({listed(shown)}); clean the masks"
            )
        raise


@dataclass(frozen=True, eq=False)
class _SmallParts:
    """Small parts of one silhouette: how many, their pixels, their numbers from 1."""

    count: int
    pixels: NDArray[np.intp]
    number: NDArray[np.int64]


def _small_parts(view: View) -> _SmallParts:
    covered = (view.outline.values > 0.0).view(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(covered, connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA]
    small = area < SMALL_PART * area[1:].max(initial=0)
    small[0] = False
    if not small.any():
        return _SmallParts(0, np.zeros(0, np.intp), np.zeros(0, np.int64))
    pixels = np.flatnonzero(small[labels])
    numbers = np.cumsum(small)
    return _SmallParts(int(small.sum()), pixels, numbers[labels.ravel()[pixels]])


def _without_rim(view: View, parts: _SmallParts) -> View:
    """View whose small parts do not make it one that the object leaves."""
    height, width = view.camera.height, view.camera.width
    col = np.clip(np.floor(view.outline.rim[:, 0]).astype(int), 0, width - 1)
    row = np.clip(np.floor(view.outline.rim[:, 1]).astype(int), 0, height - 1)
    rim = view.outline.rim[~np.isin(row * width + col, parts.pixels)]
    return replace(view, outline=replace(view.outline, rim=rim))


def _with_fringe(part: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels of parts and the half-covered ones beside them."""
    grown = cv2.dilate(part.astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(grown > 0)
