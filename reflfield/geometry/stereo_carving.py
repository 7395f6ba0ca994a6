"""The hull without what stereo shows to be empty; for lights too few for `hollow_carving`.

Depths by patches (`geometry.patch_stereo`) are fused into the hull's volume
(`geometry.depth_fusion`), and found again around the surface that this leaves, twice. The
result is taken where the views agree much better about it than about the hull; of textureless
or glossy objects, whose patches look alike nowhere, they do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import GeometryError
from reflfield.geometry.carving import Grid, carve
from reflfield.geometry.cones import View
from reflfield.geometry.depth_fusion import carved_by_depths
from reflfield.geometry.hollow_carving import CarvedHollows, hull_box
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.patch_stereo import PatchStereo, PatchView, spread_views
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.visual_hull import HullOptions, closed_surface

Floats = NDArray[np.float32]

# Views whose depths are found at most, evenly around the object.
MOST_VIEWS = 40
# Times that depths are found: in all of the hull, then around the surface of the last time.
ROUNDS = 3
# Depths that differ by less than this share of the object's diagonal are the same.
SAME_DEPTH = 0.01
# Share of a view's pixels that must show another depth, and in how many views.
LEAST_SHARE, LEAST_VIEWS = 0.03, 3
# Mean cost of those pixels over that on the hull, from which the hull is kept.
BETTER = 0.7


def carved_by_stereo(
    hull: Mesh,
    outlines: Sequence[View],
    views: Sequence[PatchView],
    options: HullOptions,
    tolerance: int = 0,
    n_threads: int = 1,
) -> CarvedHollows | None:
    """Carve what patches of photographs say is empty.

    Parameters
    ----------
    hull : Mesh
        As `visual_hull` makes it of the outlines.
    outlines : sequence of View
        Of the views that made the hull.
    views : sequence of PatchView
        Of the same cameras.
    options : HullOptions
    tolerance : int
        Views that the hull lets disagree.
    n_threads : int

    Returns
    -------
    CarvedHollows or None
        None where the views do not agree clearly better about another surface than the hull.
    """
    scene = RayScene(hull)
    middle = hull.bounds.mean(axis=0)[None]
    towards = np.concatenate([view.camera.view_directions(middle) for view in views])
    stereo = PatchStereo(views, scene, spread_views(towards, MOST_VIEWS), n_threads)
    grid = Grid.around(*hull_box(outlines, options, tolerance), options.resolution)
    volume, _ = carve(outlines, grid, tolerance, n_threads)
    mesh = None
    # Fewer triangles are of use to the charts alone.
    fine = replace(options, n_triangles=0)
    for number in range(ROUNDS):
        around = None if mesh is None else RayScene(mesh)
        seen = stereo.depths(around, f"stereo, round {number + 1} of {ROUNDS}")
        left = carved_by_depths(volume, grid, seen, n_threads)
        try:
            last = number == ROUNDS - 1
            mesh = closed_surface(left, grid, options if last else fine, outlines)
        except GeometryError:
            return None
    assert mesh is not None
    names = _views_that_agree_better(stereo, mesh)
    if len(names) < LEAST_VIEWS:
        return None
    before, after = (int(np.count_nonzero(field > 0)) for field in (volume, left))
    return CarvedHollows(mesh, 1.0 - after / before, names)


def _views_that_agree_better(stereo: PatchStereo, mesh: Mesh) -> tuple[str, ...]:
    """Views that show another depth; none if they agree about it no better than on the hull."""
    least = SAME_DEPTH * stereo.hull.diagonal
    before, after = stereo.costs(stereo.hull), stereo.costs(RayScene(mesh))
    sums, names = np.zeros(2), []
    for number, (on_hull, costs_there), (now, costs) in zip(
        stereo.chosen, before, after, strict=True
    ):
        other = np.abs(now - on_hull) > least
        sums += costs[other].sum(dtype=np.float64), costs_there[other].sum(dtype=np.float64)
        view = stereo.views[number]
        if np.count_nonzero(other) >= LEAST_SHARE * np.count_nonzero(view.covered):
            names.append(view.camera.id)
    return tuple(names) if sums[0] < BETTER * sums[1] else ()
