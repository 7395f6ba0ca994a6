"""Stage "hollows": the hull without hollows that photographs show, and silhouettes do not."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.geometry.cones import measured_views
from reflfield.geometry.depth_search import LEAST_LIGHTS
from reflfield.geometry.hollow_carving import CarvedHollows, carved_hollows, contradict
from reflfield.geometry.light_stack import ReducedView, reduced_view
from reflfield.geometry.mesh import write_ply
from reflfield.geometry.specks import without_specks
from reflfield.pipeline import results
from reflfield.pipeline.context import Context
from reflfield.util.progress import track

# Lights that are compared, and those that a glance needs; spread evenly over the list.
MOST_LIGHTS, GLANCE_LIGHTS = 32, 12
# Longest side of the object in a reduced view, pixels: finer ones show a hollow no better.
LONGEST_PX = 160
# Share of the memory that the reduced views may take.
MEMORY_SHARE = 1 / 8
# Views that must have a photograph under a light for it to count as common to them.
LEAST_VIEWS = 6
# Of the hull's volume, and what the stage writes where there is something to carve.
SHARE, CARVED = "share of the volume carved", "carved.ply"


def has_common_lights(context: Context) -> bool:
    """Whether enough views were photographed under the same lights to compare them."""
    if context.is_plane or not context.options.hull.hollows:
        return False
    pairs = context.training.photograph_index >= 0
    lights = np.count_nonzero(pairs.sum(axis=0) >= LEAST_VIEWS)
    return bool(lights >= LEAST_LIGHTS)


def write_hollows(context: Context, folder: Path) -> dict[str, Any]:
    """Carve hollows out of the hull; its file is only there where there are some."""
    hull = results.hull_mesh(context)
    views = _views_of_hull(context)
    some = _stacked(context, views, GLANCE_LIGHTS)
    contradicted = contradict(hull, some, context.resources.workers)
    carved = _carved(context, views) if contradicted else None
    if carved is None:
        return {SHARE: 0.0}
    write_ply(folder / CARVED, carved.mesh)
    return {
        SHARE: carved.share,
        "views that contradict the hull": list(carved.views),
        "triangles": len(carved.mesh.faces),
    }


def _views_of_hull(context: Context) -> NDArray[np.intp]:
    """Views that the hull is made of."""
    details = json.loads(results.file(context, "hull", "hull.json").read_text())
    left_out = set(details.get("left_out", ()))
    names = [camera.id for camera in context.training.cameras]
    return np.flatnonzero([name not in left_out for name in names])


def _carved(context: Context, views: NDArray[np.intp]) -> CarvedHollows | None:
    details = json.loads(results.file(context, "hull", "hull.json").read_text())
    silhouettes = results.silhouettes(context)
    cameras = [context.training.cameras[i] for i in views]
    outlines = measured_views(cameras, [silhouettes[i] for i in views])
    outlines, _, _ = without_specks(outlines, [silhouettes[i] for i in views], None)
    return carved_hollows(
        results.hull_mesh(context),
        outlines,
        _stacked(context, views, MOST_LIGHTS),
        context.options.hull,
        int(details.get("tolerance", 0)),
        context.resources.workers,
    )


def _stacked(context: Context, views: NDArray[np.intp], most: int) -> list[ReducedView]:
    """Reduced photographs of some views under some of the lights that most of them share."""
    index = context.training.photograph_index[views]
    common = np.flatnonzero((index >= 0).sum(axis=0) >= LEAST_VIEWS)
    lights = common[np.unique(np.linspace(0, len(common) - 1, most).astype(int))]
    factor = _factor(context, views, len(lights))
    one = partial(_reduced, context, index[:, lights], views, factor)
    with ThreadPoolExecutor(context.resources.workers) as pool:
        return list(track(pool.map(one, range(len(views))), len(views), "views reduced"))


def _reduced(
    context: Context,
    index: NDArray[np.int64],
    views: NDArray[np.intp],
    factor: int,
    number: int,
) -> ReducedView:
    view, training = int(views[number]), context.training
    photographs = (None if i < 0 else training.read_photograph(i) for i in index[number])
    silhouette = results.silhouettes(context)[view]
    return reduced_view(training.cameras[view], silhouette, photographs, factor)


def _factor(context: Context, views: NDArray[np.intp], n_lights: int) -> int:
    """Factor by which photographs are reduced: to the pixels that suffice and find room."""
    silhouettes = results.silhouettes(context)
    sides = []
    for view in views:
        rows, columns = np.nonzero(silhouettes[view] >= 0.5)
        sides.append((np.ptp(rows) + 5, np.ptp(columns) + 5))
    pixels = np.array(sides, np.float64)
    fine = np.median(pixels.max(axis=1)) / LONGEST_PX
    size = 12.0 * n_lights * pixels.prod(axis=1).sum()
    room = np.sqrt(size / (MEMORY_SHARE * context.resources.max_memory))
    return int(max(np.ceil(fine), np.ceil(room), 1))
