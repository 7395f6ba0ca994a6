"""Hollows that no silhouette shows, carved where photographs contradict the visual hull.

`geometry.depth_search` says where each view sees the surface inside of the hull. A point of the
hull's volume is empty where the views that see so far say on average that the surface lies
behind it: a signed distance, averaged over the views as in volumetric fusion. What no view
contradicts stays as the silhouettes have it.

References
----------
B. Curless and M. Levoy, "A volumetric method for building complex models from range images",
SIGGRAPH 1996.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, zoom

from reflfield.capture.cameras import Camera
from reflfield.errors import GeometryError
from reflfield.geometry.bounding_box import object_bounds
from reflfield.geometry.carving import Grid, carve
from reflfield.geometry.cones import View
from reflfield.geometry.depth_search import LEAST_INSIDE, ViewDepths, search_depths
from reflfield.geometry.light_stack import ReducedView
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.visual_hull import HullOptions, closed_surface

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

# At first every so many rows and columns are looked at.
GLANCE = 3
# Share of a view's pixels that must contradict the hull, and in how many views.
LEAST_SHARE, LEAST_VIEWS = 0.03, 3
# Voxels of the votes over voxels of the hull.
VOTE_STRIDE = 2
# Searches, each from the surface that the last has left.
ROUNDS = 3
# Distance beyond which a vote counts no more, voxels of the votes.
BAND = 3.0
# Standard deviation of a blur of the votes, in their voxels, and the weight from which the
# blurred votes count.
VOTE_BLUR, LEAST_WEIGHT = 1.0, 0.5
# Weight of a pixel that stays on the hull: nothing better was found, which is no proof.
UNMOVED = 0.5
# The error that remains on the new surface, over that on the hull, for it to be taken.
BETTER = 0.7


@dataclass(frozen=True, eq=False)
class CarvedHollows:
    """The hull without its hollows.

    Parameters
    ----------
    mesh : Mesh
        Closed, outward-facing, metres.
    share : float
        Of the hull's volume that was carved.
    views : tuple of str
        Names of the views that contradict the hull.
    """

    mesh: Mesh
    share: float
    views: tuple[str, ...]


def contradict(hull: Mesh, views: Sequence[ReducedView], n_threads: int = 1) -> bool:
    """Whether photographs clearly contradict a hull, by a glance at some pixels.

    Parameters
    ----------
    hull : Mesh
    views : sequence of ReducedView
        Photographs under the same lights, of which few suffice.
    n_threads : int
    """
    glance = search_depths(views, RayScene(hull), GLANCE, n_threads)
    return sum(_share(each, GLANCE) >= LEAST_SHARE for each in glance) >= LEAST_VIEWS


def carved_hollows(
    hull: Mesh,
    outlines: Sequence[View],
    views: Sequence[ReducedView],
    options: HullOptions,
    tolerance: int = 0,
    n_threads: int = 1,
) -> CarvedHollows | None:
    """Carve what photographs under several lights say is empty.

    Parameters
    ----------
    hull : Mesh
        As `visual_hull` makes it of the outlines.
    outlines : sequence of View
        Of the views that made the hull.
    views : sequence of ReducedView
        Photographs under the same lights; of some views or all.
    options : HullOptions
    tolerance : int
        Views that the hull lets disagree.
    n_threads : int

    Returns
    -------
    CarvedHollows or None
        None where the photographs do not clearly contradict the hull, or what they say makes
        no closed surface.
    """
    if not contradict(hull, views, n_threads):
        return None
    on_hull = depths = search_depths(views, RayScene(hull), 1, n_threads)
    grid = Grid.around(*hull_box(outlines, options, tolerance), options.resolution)
    volume, _ = carve(outlines, grid, tolerance, n_threads)
    kept = volume
    for again in reversed(range(ROUNDS)):
        kept = np.minimum(kept, _votes(kept, grid, depths))
        try:
            mesh = closed_surface(kept, grid, options, outlines)
        except GeometryError:
            return None
        if not again or not contradict(mesh, views, n_threads):
            break
        depths = search_depths(views, RayScene(mesh), 1, n_threads)
    if not _agrees_better(views, on_hull, mesh, n_threads):
        return None
    before, after = (int(np.count_nonzero(field > 0)) for field in (volume, kept))
    names = tuple(d.view.camera.id for d in on_hull if _share(d, 1) >= LEAST_SHARE)
    return CarvedHollows(mesh, 1.0 - after / before, names)


def hull_box(
    outlines: Sequence[View], options: HullOptions, tolerance: int
) -> tuple[Array, Array]:
    """Lowest and highest corner of the box that the hull was carved in, metres."""
    low, high = np.array(options.bounds or object_bounds(outlines, tolerance), np.float64)
    return low, high


def _share(depths: ViewDepths, every: int) -> float:
    """Of a view's pixels that were looked at, those that contradict the hull."""
    looked = int(np.count_nonzero(depths.view.covered[::every, ::every]))
    return int(np.count_nonzero(depths.moved)) / max(looked, 1)


def _votes(volume: Floats, grid: Grid, depths: Sequence[ViewDepths]) -> Floats:
    """Signed distance that the views see, in the hull's voxels: above 0 in the object.

    The band's width where no view sees anything.
    """
    stride = VOTE_STRIDE
    corners = np.argwhere(volume[::stride, ::stride, ::stride] > 0)
    points = grid.origin + corners * (grid.spacing * stride)
    total, weight = np.zeros(len(points)), np.zeros(len(points))
    band = BAND * stride * grid.spacing
    for each in depths:
        ahead, sure = _ahead(each, points)
        sure = np.where(ahead > -band, sure, 0.0)
        total += sure * np.clip(ahead / band, -1.0, 1.0)
        weight += sure
    shape = [-(-n // stride) for n in volume.shape]
    spread = [np.zeros(shape, np.float32) for _ in range(2)]
    for field, values in zip(spread, (total, weight), strict=True):
        field[tuple(corners.T)] = values
    # Noise of single pixels, averaged with the votes around.
    sums, weights = (gaussian_filter(field, VOTE_BLUR, mode="nearest") for field in spread)
    empty = np.where(weights > LEAST_WEIGHT, sums / np.maximum(weights, LEAST_WEIGHT), -1.0)
    fine = _refined(-empty.astype(np.float32), stride, volume.shape)
    return fine * np.float32(BAND * stride)


def _refined(coarse: Floats, stride: int, shape: tuple[int, ...]) -> Floats:
    """Values at all corners of the grid, linear between those at every so many."""
    padded = np.pad(coarse, [(0, 1)] * 3, mode="edge")
    wide = [(n - 1) * stride + 1 for n in padded.shape]
    factors = [w / n for w, n in zip(wide, padded.shape, strict=True)]
    fine = zoom(padded, factors, order=1, grid_mode=False)
    return np.asarray(fine[tuple(slice(n) for n in shape)], np.float32)


def _ahead(depths: ViewDepths, points: Array) -> tuple[Array, Array]:
    """How far before the surface a view sees points, metres, and how sure that is."""
    camera: Camera = depths.view.camera
    pixels, depth = camera.project(points)
    seen = np.flatnonzero(np.isfinite(pixels).all(axis=1) & camera.contains(pixels))
    column, row = pixels[seen].astype(int).T
    surface = depths.depth[row, column]
    known = np.isfinite(surface) & depths.view.covered[row, column]
    ahead, sure = np.zeros(len(points)), np.zeros(len(points))
    ahead[seen[known]] = surface[known] - depth[seen[known]]
    sure[seen[known]] = np.where(depths.moved[row, column][known], 1.0, UNMOVED)
    return ahead, sure


def _agrees_better(
    views: Sequence[ReducedView], before: Sequence[ViewDepths], mesh: Mesh, n_threads: int
) -> bool:
    """Whether views agree better about the new surface at the pixels that show another now."""
    after = search_depths(views, RayScene(mesh), GLANCE, n_threads)
    sums = np.zeros(2)
    for new, old in zip(after, before, strict=True):
        other = ~(np.abs(new.on_hull - old.on_hull) < LEAST_INSIDE * old.step)
        some = other & np.isfinite(old.error_on_hull) & np.isfinite(new.error_on_hull)
        sums += new.error_on_hull[some].sum(), old.error_on_hull[some].sum()
    return bool(sums[0] < BETTER * sums[1])
