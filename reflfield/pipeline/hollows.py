"""Stage "hollows": the hull without hollows that photographs show, and silhouettes do not."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.geometry.cones import View, measured_views
from reflfield.geometry.depth_search import AGREEING, LEAST_LIGHTS
from reflfield.geometry.hollow_carving import CarvedHollows, carved_hollows, contradict
from reflfield.geometry.light_stack import ReducedView, reduced_view
from reflfield.geometry.mesh import write_ply
from reflfield.geometry.patch_stereo import (
    MOST_SURFACES,
    PatchView,
    neighbours,
    spread_views,
)
from reflfield.geometry.specks import without_specks
from reflfield.geometry.stereo_carving import MOST_VIEWS, carved_by_stereo
from reflfield.pipeline import results
from reflfield.pipeline.context import Context
from reflfield.pipeline.memory import readers_at_once
from reflfield.util.blas_threads import thread_pool
from reflfield.util.progress import track

# Lights that are compared, and those that a glance needs; spread evenly over the list.
MOST_LIGHTS, GLANCE_LIGHTS = 32, 12
# Longest side of the object in a reduced view, pixels: finer ones show a hollow no better.
LONGEST_PX = 160
# The same where patches are compared, and photographs of a view that are taken together.
STEREO_PX, MOST_PHOTOGRAPHS = 240, 8
# Share of the memory that the reduced views may take.
MEMORY_SHARE = 1 / 8
# Views that must have a photograph under a light for it to count as common to them, or
# neighbours.
LEAST_VIEWS = 6
# Of the hull's volume, and what the stage writes where there is something to carve.
SHARE, CARVED = "share of the volume carved", "carved.ply"


def is_searched(context: Context) -> bool:
    """Whether hollows are looked for: with common lights, or with views that are neighbours."""
    if context.is_plane or not context.options.hull.hollows:
        return False
    return has_common_lights(context) or has_neighbours(context)


def has_common_lights(context: Context) -> bool:
    """Whether enough views were photographed under the same lights to compare these."""
    pairs = context.training.photograph_index >= 0
    lights = np.count_nonzero(pairs.sum(axis=0) >= LEAST_VIEWS)
    return bool(lights >= LEAST_LIGHTS)


def has_neighbours(context: Context) -> bool:
    """Whether enough views have two others near enough to compare patches with."""
    # The object is not known yet; cameras look at it.
    axes = np.array([camera.forward for camera in context.training.cameras])
    counts = [len(neighbours(axes, i)) for i in range(len(axes))]
    return bool(np.count_nonzero(np.array(counts) >= AGREEING) >= LEAST_VIEWS)


def write_hollows(context: Context, folder: Path) -> dict[str, Any]:
    """Carve hollows out of the hull; its file is only there where there are some."""
    carve = _carved_by_lights if has_common_lights(context) else _carved_by_stereo
    carved = carve(context, _hull_views(context))
    if carved is None:
        return {SHARE: 0.0}
    write_ply(folder / CARVED, carved.mesh)
    return {
        SHARE: carved.share,
        "views that contradict the hull": list(carved.views),
        "triangles": len(carved.mesh.faces),
    }


@dataclass(frozen=True, eq=False)
class HullViews:
    """Views that the hull is made of.

    Parameters
    ----------
    numbers : (n,) int
    tolerance : int
        Of them that it lets disagree.
    """

    numbers: NDArray[np.intp]
    tolerance: int

    def outlines(self, context: Context) -> list[View]:
        """As the hull was carved by."""
        silhouettes = results.silhouettes(context)
        chosen = [silhouettes[i] for i in self.numbers]
        cameras = [context.training.cameras[i] for i in self.numbers]
        workers = min(context.resources.workers, readers_at_once(context))
        views = measured_views(cameras, chosen, workers=workers)
        return list(without_specks(views, chosen, workers=workers)[0])


def _hull_views(context: Context) -> HullViews:
    details = json.loads(results.file(context, "hull", "hull.json").read_text())
    left_out = set(details.get("left_out", ()))
    names = [camera.id for camera in context.training.cameras]
    numbers = np.flatnonzero([name not in left_out for name in names])
    return HullViews(numbers, int(details.get("tolerance", 0)))


def _carved_by_lights(context: Context, views: HullViews) -> CarvedHollows | None:
    hull, workers = results.hull_mesh(context), context.resources.workers
    axes = np.array([context.training.cameras[i].forward for i in views.numbers])
    some = views.numbers[spread_views(axes, MOST_VIEWS)]
    if not contradict(hull, _stacked(context, some, GLANCE_LIGHTS), workers):
        return None
    return carved_hollows(
        hull,
        views.outlines(context),
        _stacked(context, some, MOST_LIGHTS),
        context.options.hull,
        views.tolerance,
        workers,
    )


def _carved_by_stereo(context: Context, views: HullViews) -> CarvedHollows | None:
    index = context.training.photograph_index[views.numbers]
    photographed = HullViews(views.numbers[(index >= 0).any(axis=1)], views.tolerance)
    if len(photographed.numbers) < LEAST_VIEWS:
        return None
    return carved_by_stereo(
        results.hull_mesh(context),
        views.outlines(context),
        _patch_views(context, photographed.numbers),
        context.options.hull,
        views.tolerance,
        context.resources.workers,
    )


def _patch_views(context: Context, views: NDArray[np.intp]) -> list[PatchView]:
    """Reduced views, each with some of its photographs together."""
    # Of each thread: costs, and their sums along paths.
    n_bytes = 8 * MOST_SURFACES * context.resources.workers
    factor = _factor(context, views, n_bytes, STEREO_PX)

    def one(view: np.intp) -> PatchView:
        index = context.training.photograph_index[view]
        some = np.flatnonzero(index >= 0)
        some = some[np.unique(np.linspace(0, len(some) - 1, MOST_PHOTOGRAPHS).astype(int))]
        return PatchView.of(_reduced(context, int(view), index[some], factor))

    with thread_pool(context.resources.workers) as pool:
        return list(track(pool.map(one, views), len(views), "views reduced"))


def _stacked(context: Context, views: NDArray[np.intp], most: int) -> list[ReducedView]:
    """Reduced photographs of some views under some of the lights that most of them share."""
    index = context.training.photograph_index[views]
    common = np.flatnonzero((index >= 0).sum(axis=0) >= LEAST_VIEWS)
    lights = common[np.unique(np.linspace(0, len(common) - 1, most).astype(int))]
    # Of all views together.
    factor = _factor(context, views, 12 * len(lights) * len(views), LONGEST_PX)

    def one(number: int) -> ReducedView:
        return _reduced(context, int(views[number]), index[number, lights], factor)

    with thread_pool(context.resources.workers) as pool:
        return list(track(pool.map(one, range(len(views))), len(views), "views reduced"))


def _reduced(
    context: Context, view: int, numbers: NDArray[np.int64], factor: int
) -> ReducedView:
    training = context.training
    photographs = (None if i < 0 else training.read_photograph(int(i)) for i in numbers)
    silhouette = results.silhouettes(context)[view]
    return reduced_view(training.cameras[view], silhouette, photographs, factor)


def _factor(context: Context, views: NDArray[np.intp], n_bytes: int, longest: int) -> int:
    """Factor by which photographs are reduced: to the pixels that suffice and find room.

    Parameters
    ----------
    n_bytes : int
        Memory of a pixel.
    longest : int
        Side of the object that suffices, pixels.
    """
    silhouettes = results.silhouettes(context)
    sides = []
    for view in views:
        rows, columns = np.nonzero(silhouettes[view] >= 0.5)
        sides.append((np.ptp(rows) + 5, np.ptp(columns) + 5))
    pixels = np.array(sides, np.float64)
    fine = np.median(pixels.max(axis=1)) / longest
    size = n_bytes * pixels.prod(axis=1).mean()
    room = np.sqrt(size / (MEMORY_SHARE * context.resources.max_memory))
    return int(max(np.ceil(fine), np.ceil(room), 1))
