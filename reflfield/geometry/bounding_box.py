"""Box around the object, from the straight lines that bound its silhouettes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from reflfield.capture.cameras import ORTHOGRAPHIC
from reflfield.errors import GeometryError
from reflfield.geometry.carving import refuse_empty
from reflfield.geometry.cones import View, normalised
from reflfield.util.blas_threads import thread_pool
from reflfield.util.quoting import listed

Array = NDArray[np.float64]

# Directions in which each silhouette is bounded by a straight line when the box is sought.
_N_TANGENTS = 16

# Boxes so many times larger than the median are those of views that hardly meet.
_OVERSIZE = 4.0

# Cameras that differ by less, relative to their coordinates, differ by rounding.
_ONE_PLACE = 1e-12


def object_bounds(views: Sequence[View], tolerance: int) -> tuple[Array, Array]:
    r"""Box around everything that at most `tolerance` views contradict.

    Among ``tolerance + 1`` groups of views at least one has no view that contradicts
    a point of the hull, so the boxes of the groups' own hulls together hold it.
    """
    _check_places(views)
    origin, scale = _whereabouts(views)
    n_groups = tolerance + 1
    boxes = [_box(views[group::n_groups], origin, scale) for group in range(n_groups)]
    known = [box for box in boxes if box is not None]
    if not known:
        _refuse_contradiction(views, origin, scale)
    low = np.min([box[0] for box in known], axis=0)
    high = np.max([box[1] for box in known], axis=0)
    return origin + scale * low, origin + scale * high


def robust_bounds(views: Sequence[View], workers: int = 1) -> tuple[Array, Array] | None:
    """Box around the object though a few views may be wrong; None if there is none.

    The boxes of several groups of views, and of all views but one group, are joined: at
    least one of them knows no wrong view, if these are few. `workers` are threads.
    """
    origin, scale = _whereabouts(views)
    with thread_pool(workers) as pool:
        of_subsets = pool.map(lambda some: _box_if_any(some, origin, scale), _subsets(views))
        boxes = [box for box in of_subsets if box]
    sizes = [float(np.max(high - low)) for low, high in boxes]
    if not sizes or not max(sizes) > 0.0:
        return None
    usual = float(np.median([size for size in sizes if size > 0.0]))
    boxes = [
        box for box, size in zip(boxes, sizes, strict=True) if 0.0 < size <= _OVERSIZE * usual
    ]
    low = np.min([box[0] for box in boxes], axis=0)
    high = np.max([box[1] for box in boxes], axis=0)
    return origin + scale * low, origin + scale * high


def _subsets(views: Sequence[View]) -> Iterator[Sequence[View]]:
    """All views, several groups of them, and all but one group."""
    yield views
    n_groups = min(len(views) // 4, 4)
    yield from (views[group::n_groups] for group in range(n_groups) if n_groups > 1)
    n_folds = min(len(views), 8)
    for fold in range(n_folds):
        yield [view for i, view in enumerate(views) if i % n_folds != fold]


def _box_if_any(
    views: Sequence[View], origin: Array, scale: float
) -> tuple[Array, Array] | None:
    """Box of some views; None where they leave a side open, too."""
    try:
        return _box(views, origin, scale) if views else None
    except GeometryError:
        return None


def _whereabouts(views: Sequence[View]) -> tuple[Array, float]:
    """Rough centre and size of the object: where rays through the silhouettes' middles meet.

    The box is sought in these units, in which the solver's tolerances make sense.
    """
    normal_matrix, right_side = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        middle = 0.5 * (view.outline.outline.min(axis=0) + view.outline.outline.max(axis=0))
        start, towards = (ray[0] for ray in view.camera.rays(middle[None]))
        across = np.eye(3) - np.outer(towards, towards)
        normal_matrix += across
        right_side += across @ start
    solution = np.linalg.lstsq(normal_matrix, right_side, rcond=1e-9)[0]
    centre = np.asarray(solution, dtype=np.float64)
    sizes = [_size_at(view, centre) for view in views]
    return centre, float(np.median(sizes))


def _check_places(views: Sequence[View]) -> None:
    """Refuse cameras that all stand at one place: only the place itself is in all cones."""
    centres = np.array(
        [view.camera.centre for view in views if view.camera.kind != ORTHOGRAPHIC]
    )
    if len(centres) != len(views) or len(views) < 2:
        return
    if np.ptp(centres, axis=0).max() <= _ONE_PLACE * np.abs(centres).max():
        raise GeometryError(
            f"cameras: expected views from several places, received {len(views)} that all "
            f"stand at {np.round(centres[0], 4).tolist()}; give the translations of their poses"
        )


def _size_at(view: View, centre: Array) -> float:
    """Length that the silhouette's larger side has at the depth of a point, metres."""
    extent = np.ptp(view.outline.outline, axis=0).max() + 1.0
    if view.camera.kind == ORTHOGRAPHIC:
        return float(extent / view.camera.fl_x)
    # A point in the camera itself would give size zero.
    distance = max(np.linalg.norm(view.camera.centre - centre), np.finfo(np.float64).tiny)
    return float(extent * distance / view.camera.fl_x)


def _box(views: Sequence[View], origin: Array, scale: float) -> tuple[Array, Array] | None:
    """Box of the intersection of the views' outlines' cones, in units of the whereabouts.

    None if there is no such point.
    """
    planes = [_half_spaces(view, origin, scale) for view in views]
    normals = np.concatenate([normal for normal, _ in planes])
    offsets = np.concatenate([offset for _, offset in planes])
    extremes = np.zeros((2, 3))
    for axis in range(3):
        for side, sign in enumerate((1.0, -1.0)):
            solution = linprog(
                sign * np.eye(3)[axis], A_ub=normals, b_ub=offsets, bounds=(None, None)
            )
            if solution.status == 2:
                return None
            if solution.status != 0:
                _refuse_unbounded(axis, views)
            extremes[side, axis] = sign * solution.fun
    return extremes[0], extremes[1]


def _half_spaces(view: View, origin: Array, scale: float) -> tuple[Array, Array]:
    """Half spaces ``normals @ x <= offsets`` that hold the silhouette's cone.

    A side on which the object leaves the frame is not bounded.
    """
    camera = view.camera
    outline, rim = (
        normalised(camera, points) for points in (view.outline.outline, view.outline.rim)
    )
    angles = 2.0 * np.pi * np.arange(_N_TANGENTS) / _N_TANGENTS
    tangents = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    pixel = 1.0 / min(camera.fl_x, camera.fl_y)
    reach = (outline @ tangents.T).max(axis=0) + pixel
    rim_reach = (rim @ tangents.T).max(axis=0, initial=-np.inf)
    bounded = rim_reach < reach - 2.0 * pixel
    tangents, reach = tangents[bounded], reach[bounded]
    rotation, shift = camera.rotation, camera.camera_from_world[:3, 3]
    if camera.kind == ORTHOGRAPHIC:
        normals = tangents @ rotation[:2]
        offsets = reach - tangents @ shift[:2]
    else:
        # tangent . (X, Y) <= reach * Z, and Z >= 0
        in_camera = np.concatenate([tangents, -reach[:, None]], axis=1)
        in_camera = np.concatenate([in_camera, [[0.0, 0.0, -1.0]]])
        normals, offsets = in_camera @ rotation, -in_camera @ shift
    lengths = np.linalg.norm(normals, axis=1)
    return normals / lengths[:, None], (offsets - normals @ origin) / lengths / scale


def _refuse_unbounded(axis: int, views: Sequence[View]) -> None:
    cut = listed([view.camera.id for view in views if view.outline.leaves_image])
    seen = f" (the object is cut off by the border of the image in {cut})" if cut else ""
    raise GeometryError(
        f"hull: expected silhouettes that bound the object on all sides, received views that "
        f"leave it open along world {'xyz'[axis]}{seen}; add views from other sides, give "
        "hull.bounds, or use the base geometry 'plane' for a single view"
    )


def _refuse_contradiction(views: Sequence[View], origin: Array, scale: float) -> None:
    """Name the first view whose cone misses the intersection of those before it."""
    planes = [_half_spaces(view, origin, scale) for view in views]
    for number in range(1, len(views) + 1):
        normals, offsets = (np.concatenate(part) for part in zip(*planes[:number], strict=True))
        solution = linprog(np.zeros(3), A_ub=normals, b_ub=offsets, bounds=(None, None))
        if solution.status == 2:
            refuse_empty(views[number - 1])
    refuse_empty(views[-1])
