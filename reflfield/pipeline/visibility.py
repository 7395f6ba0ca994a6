"""Stage "visibility": which camera and which light each texel sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.errors import InputError
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.occlusion import (
    VisibilityOptions,
    depth_edges,
    light_visibility,
    view_visibility,
)
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.texels import TexelTable
from reflfield.pipeline import results
from reflfield.pipeline.context import Context
from reflfield.pipeline.memory import readers_at_once
from reflfield.pipeline.view_store import (
    EDGES,
    name_of,
    packed_mask,
    store_views,
    unpacked_mask,
)
from reflfield.util.blas_threads import thread_pool
from reflfield.util.dask_cluster import threads_here

# Views, or lights, of one block; what a block calls the texels that they see.
DIRECTIONS_AT_ONCE, SEEN = 8, "seen"


def write_visibility(context: Context, folder: Path) -> dict[str, Any]:
    """Which camera and which light each texel sees."""
    capture, texels = context.training, results.texels(context)
    # Depths of an image take what reading a photograph does.
    at_once = readers_at_once(context)
    shared = VisibilityRays(
        capture,
        texels,
        results.atlas(context).mesh,
        context.options.visibility,
        [None] * capture.n_views if context.is_plane else covered_pixels(context),
        context.resources.workers if at_once == 1 else 1,
    )
    view_runs, light_runs = runs(capture.n_views), runs(capture.n_lights)
    named = [("views", run) for run in view_runs] + [("lights", run) for run in light_runs]
    parts = context.blocks(folder).map(
        "visibility", visibility_block, shared, named, at_once=at_once
    )
    columns = [arrays[SEEN] for arrays in parts]
    views = np.concatenate(columns[: len(view_runs)], axis=1)
    lights = np.concatenate(columns[len(view_runs) :], axis=1)
    if not views.any():
        raise InputError(
            "cameras: expected at least one that sees the surface, found none; check the "
            "calibration against the silhouettes"
        )
    np.savez(
        folder / "visibility.npz",
        views=np.packbits(views, axis=1),
        lights=np.packbits(lights, axis=1),
    )
    named_edges = (named for part in parts for named in part.items() if named[0] != SEEN)
    store_views(folder / EDGES, named_edges)
    return {
        "texels": len(texels),
        "texels that no camera sees": int((~views.any(axis=1)).sum()),
        "views per texel": float(views.sum(axis=1).mean()),
        "lights per texel": float(lights.sum(axis=1).mean()),
    }


@dataclass(frozen=True, eq=False)
class VisibilityRays:
    """Scene of the rays that find which texels views and lights reach; all blocks share it.

    Parameters
    ----------
    capture : Capture
    texels : TexelTable
    mesh : Mesh
    options : VisibilityOptions
    covered : sequence of (n,) uint8 or None
        Pixels of the views that the object covers, row by row, eight in a byte.
    threads : int
        For the rays of a block; a cluster's worker uses its own number.
    """

    capture: Capture
    texels: TexelTable
    mesh: Mesh
    options: VisibilityOptions
    covered: Sequence[NDArray[np.uint8] | None]
    threads: int

    def silhouette(self, view: int) -> NDArray[np.bool_] | None:
        """Pixels (h, w) of a view that the object covers."""
        bits, camera = self.covered[view], self.capture.cameras[view]
        return None if bits is None else unpacked_mask(bits, camera)


def visibility_block(shared: VisibilityRays, block: tuple[str, range]) -> dict[str, Any]:
    """Which texels some views or lights see, (n_texels, k); depth edges of the views."""
    kind, some = block
    scene = RayScene(shared.mesh, threads=threads_here(shared.threads))
    capture, texels, options = shared.capture, shared.texels, shared.options
    if kind == "lights":
        columns = [light_visibility(texels, scene, capture.lights[i], options) for i in some]
        return {SEEN: np.stack(columns, axis=1)}
    columns, edges = [], {}
    for i in some:
        camera, silhouette = capture.cameras[i], shared.silhouette(i)
        of_view = depth_edges(scene, camera, options)
        columns.append(
            view_visibility(
                texels, scene, camera, options, edges=of_view, silhouette=silhouette
            )
        )
        edges[name_of(i)] = packed_mask(of_view)
    return {SEEN: np.stack(columns, axis=1), **edges}


def covered_pixels(context: Context) -> list[NDArray[np.uint8]]:
    """Pixels of each view that count as covered by the object, eight in a byte."""
    least, silhouettes = context.options.visibility.coverage, results.silhouettes(context)
    with thread_pool(min(context.resources.workers, readers_at_once(context))) as pool:
        views = range(len(silhouettes))
        return list(pool.map(lambda view: packed_mask(silhouettes[view] >= least), views))


def runs(n: int) -> list[range]:
    """Views or lights that are handled together.

    Examples
    --------
    >>> runs(20)
    [range(0, 8), range(8, 16), range(16, 20)]
    """
    return [range(i, min(i + DIRECTIONS_AT_ONCE, n)) for i in range(0, n, DIRECTIONS_AT_ONCE)]
