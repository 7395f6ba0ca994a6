r"""Depth at which other views agree with a pixel about what it shows under all lights.

Along the ray of each pixel, from the visual hull inwards, a point is compared with what other
views show in its place, light by light:

.. math:: e(t) = \frac{\sum_l \min(|a_l - b_l(t)|, \tau)}{\sum_l \max(a_l, b_l(t))},

a and b cube roots of radiance of the pixel and of the other view, the mean over the two views
that agree best: others may be hidden. Matt surfaces have a sharp minimum where the ray meets
them, without windows around pixels, because the lights, and the shadows that they cast, tell
points apart. Metals have none that is much lower than elsewhere, and stay where they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import generic_filter, median_filter

from reflfield.capture.cameras import ORTHOGRAPHIC
from reflfield.geometry.light_stack import ReducedView, pixel_centres, projection_matrix
from reflfield.geometry.ray_scene import RayScene
from reflfield.util.blas_threads import thread_pool
from reflfield.util.progress import track

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

# Reordering of sums only.
FAST = {"reassoc", "contract", "nsz", "arcp"}
# Other views that a view is compared with, and the angle between them, degrees.
OTHERS, CLOSEST_DEG, FARTHEST_DEG = 6, 3.0, 75.0
# Of those, the ones that agree best.
AGREEING = 2
# Differences count up to this share of the root mean square of all views.
TRUNCATION = 0.3
# Steps along a ray, pixels; and how many at most.
STEP_PX, MOST_STEPS = 0.75, 256
# Lights that two views must have in common.
LEAST_LIGHTS = 8
# Error from which views contradict the hull; share of it below which an error inside says where
# the surface is instead, and how many steps it must lie inside.
CONTRADICTION = 0.02
CLEARLY_LESS, LEAST_INSIDE = 0.5, 3.0
# Error up to which views show the same. Where they do, it is .01 of simulated clay, .05 of
# glaze and .08 of gold (`tests/benchmarks/bench_hollows.py`).
ALIKE = 0.045
# Of the root mean square of all views: a pixel whose mean over the lights is below is too dark
# to be compared.
DARK = 0.4
# Pixels of the 8 around it that a moved pixel must agree with, within so many steps.
SUPPORT, SUPPORT_STEPS = 3, 8.0


@dataclass(frozen=True, eq=False)
class ViewDepths:
    """Surface as one view sees it.

    Parameters
    ----------
    view : ReducedView
    on_hull : (h, w) float64
        Depth of the hull along the optical axis, metres; NaN off the object.
    depth : (h, w) float64
        Of the surface: the hull's, or where `moved`, further inside.
    moved : (h, w) bool
        Where photographs of other views clearly contradict the hull.
    error_on_hull : (h, w) float64
        By how much other views differ there, infinite where that cannot be told; NaN where it
        was not looked at.
    step : float
        Along the rays, metres.
    """

    view: ReducedView
    on_hull: Array
    depth: Array
    moved: NDArray[np.bool_]
    error_on_hull: Array
    step: float


class _Views(NamedTuple):
    """Reduced views for the kernel: their values in one array, one after the other."""

    values: Floats
    first: NDArray[np.int64]
    sizes: NDArray[np.int64]
    matrices: Array
    n_lights: int
    truncation: float


class _Rays(NamedTuple):
    """Rays of some pixels of one view: X = origin + t direction, t from `start` in steps."""

    pixels: NDArray[np.int64]
    origins: Array
    directions: Array
    starts: Array
    step: Array
    n_steps: NDArray[np.int64]


def search_depths(
    views: Sequence[ReducedView], scene: RayScene, every: int = 1, n_threads: int = 1
) -> list[ViewDepths]:
    """Depths of all views.

    Parameters
    ----------
    views : sequence of ReducedView
        With values under the same lights.
    scene : RayScene
        Of the visual hull.
    every : int
        Look at every so many rows and columns only; the others stay on the hull.
    n_threads : int

    Returns
    -------
    list of ViewDepths
        One for each view, in their order, whatever the number of threads.
    """
    packed = _packed(views)
    towards = np.stack([_towards(view, scene) for view in views])

    def one(index: int) -> ViewDepths:
        return _depths_of(views[index], packed, scene, _others(towards, index), every)

    with thread_pool(n_threads) as pool:
        return list(track(pool.map(one, range(len(views))), len(views), "depths by light"))


def _packed(views: Sequence[ReducedView]) -> _Views:
    sizes = np.array([view.covered.shape for view in views], np.int64)
    lengths = np.array([view.values.size for view in views], np.int64)
    sums = np.zeros(2)
    for view in views:
        shown = view.values[view.covered]
        shown = shown[shown >= 0]
        sums += float(np.square(shown).sum(dtype=np.float64)), shown.size
    level = np.sqrt(sums[0] / max(sums[1], 1.0))
    return _Views(
        np.concatenate([view.values.reshape(-1) for view in views]),
        np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64),
        sizes,
        np.stack([projection_matrix(view.camera) for view in views]),
        views[0].values.shape[2],
        TRUNCATION * float(level),
    )


def _towards(view: ReducedView, scene: RayScene) -> Array:
    """Unit direction from the middle of the object to a camera."""
    return view.camera.view_directions(scene.mesh.bounds.mean(axis=0)[None])[0]


def _others(towards: Array, index: int) -> NDArray[np.int64]:
    """Views that one is compared with, the nearest first."""
    cosine = towards @ towards[index]
    order = np.argsort(-cosine, kind="stable")
    angle = np.degrees(np.arccos(np.clip(cosine[order], -1, 1)))
    near = order[(order != index) & (angle > CLOSEST_DEG) & (angle < FARTHEST_DEG)]
    return near[:OTHERS].astype(np.int64)


def _depths_of(
    view: ReducedView, packed: _Views, scene: RayScene, others: NDArray[np.int64], every: int
) -> ViewDepths:
    height, width = view.covered.shape
    on_hull = np.full((height, width), np.nan)
    looked = np.zeros_like(view.covered)
    looked[::every, ::every] = view.covered[::every, ::every]
    row, column = np.nonzero(view.covered)
    origins, directions = _before_mesh(view, scene, pixel_centres(view.camera)[row, column])
    enter = scene.first_hit(origins, directions)[0]
    along = directions @ view.camera.forward
    start = (origins - view.camera.centre) @ view.camera.forward
    on_hull[row, column] = np.where(np.isfinite(enter), enter * along + start, np.nan)
    depth, moved = on_hull.copy(), np.zeros_like(view.covered)
    error = np.full((height, width), np.nan)
    some = np.flatnonzero(looked[row, column] & np.isfinite(enter))
    if len(others) < AGREEING or not len(some):
        return ViewDepths(view, on_hull, depth, moved, error, 0.0)
    rays = _rays(view, scene, (row, column), (origins, directions, enter), some)
    own = view.values.reshape(height * width, -1)[rays.pixels]
    inside, at_hull, least = _search(packed, rays, own, others)
    error[row[some], column[some]] = at_hull
    deeper = (at_hull > CONTRADICTION) & (inside > LEAST_INSIDE * rays.step)
    deeper &= least < np.minimum(CLEARLY_LESS * at_hull, ALIKE)
    at = row[some[deeper]], column[some[deeper]]
    moved[at] = True
    depth[at] += inside[deeper] * along[some[deeper]]
    step = float(np.median(rays.step))
    if every == 1:
        moved, depth = _supported(moved, depth, on_hull, step)
    return ViewDepths(view, on_hull, depth, moved, error, step)


def _before_mesh(view: ReducedView, scene: RayScene, centres: Array) -> tuple[Array, Array]:
    """Rays through pixels; parallel ones, which have no start, begin before the object."""
    origins, directions = view.camera.rays(centres)
    if view.camera.kind == ORTHOGRAPHIC:
        ahead = (scene.mesh.bounds.mean(axis=0) - origins) @ view.camera.forward
        origins = origins + np.outer(ahead - scene.diagonal, view.camera.forward)
    return origins, directions


def _rays(
    view: ReducedView,
    scene: RayScene,
    at: tuple[NDArray[np.intp], NDArray[np.intp]],
    geometry: tuple[Array, Array, Array],
    some: NDArray[np.intp],
) -> _Rays:
    """Rays of some pixels from where they enter the hull to where they leave it for good."""
    row, column = at
    origins, directions, enter = (part[some] for part in geometry)
    camera = view.camera
    focal = 0.5 * (camera.fl_x + camera.fl_y)
    footprint = np.full(len(some), 1.0) if camera.kind == ORTHOGRAPHIC else enter
    step = STEP_PX / focal * footprint
    far = 2.0 * scene.diagonal
    back = scene.first_hit(origins + (enter + far)[:, None] * directions, -directions)[0]
    chord = np.clip(np.where(np.isfinite(back), far - back, 0.0), 0.0, far)
    step = np.maximum(step, chord / MOST_STEPS)
    n_steps = np.maximum((chord / step).astype(np.int64), 1)
    pixels = (row * view.covered.shape[1] + column)[some].astype(np.int64)
    return _Rays(pixels, origins, directions, enter, step, n_steps)


def _supported(
    moved: NDArray[np.bool_], depth: Array, on_hull: Array, step: float
) -> tuple[NDArray[np.bool_], Array]:
    """Moved pixels that enough of those around them agree with, at the median of these."""
    inside = np.where(moved, depth - on_hull, -1e30)

    def support(values: Array) -> float:
        middle = values[4]
        return float(np.count_nonzero(np.abs(values - middle) < SUPPORT_STEPS * step) - 1)

    kept = moved & (generic_filter(inside, support, 3, mode="nearest") >= SUPPORT)
    smooth = median_filter(np.where(kept, depth, np.inf), 3, mode="nearest")
    smooth = np.where(np.isfinite(smooth), smooth, depth)
    return kept, np.where(kept, smooth, on_hull)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _search(
    views: _Views,
    rays: _Rays,
    own: Floats,
    others: NDArray[np.int64],
) -> tuple[Array, Array, Array]:
    """Distance inside the hull of the least error, the error on the hull, and the least."""
    n = len(rays.pixels)
    inside, at_hull, least = np.zeros(n), np.full(n, np.inf), np.full(n, np.inf)
    errors = np.zeros(MOST_STEPS + 2)
    for i in range(n):
        n_steps = min(rays.n_steps[i], MOST_STEPS) + 1
        best = 0
        for k in range(n_steps):
            t = rays.starts[i] + k * rays.step[i]
            errors[k] = _error(views, rays, own, others, i, t)
            if errors[k] < errors[best]:
                best = k
        at_hull[i] = min(errors[0], errors[min(1, n_steps - 1)])
        least[i] = errors[best]
        inside[i] = best * rays.step[i]
        if 0 < best < n_steps - 1:
            before, after = errors[best - 1], errors[best + 1]
            bend = before + after - 2.0 * errors[best]
            if 0.0 < bend < np.inf:
                inside[i] += 0.5 * (before - after) / bend * rays.step[i]
    return inside, at_hull, least


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _error(
    views: _Views,
    rays: _Rays,
    own: Floats,
    others: NDArray[np.int64],
    i: int,
    t: float,
) -> float:
    """Mean error of the two views that agree best with a ray's pixel at a point of it."""
    lowest, second = np.inf, np.inf
    x = rays.origins[i, 0] + t * rays.directions[i, 0]
    y = rays.origins[i, 1] + t * rays.directions[i, 1]
    z = rays.origins[i, 2] + t * rays.directions[i, 2]
    for j in others:
        m = views.matrices[j]
        w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        if not w > 0.0:
            continue
        u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / w - 0.5
        v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / w - 0.5
        height, width = views.sizes[j]
        if not (u >= 0.0 and v >= 0.0 and u < width - 1 and v < height - 1):
            continue
        error = _difference(views, own[i], j, u, v)
        if error < lowest:
            lowest, second = error, lowest
        elif error < second:
            second = error
    return 0.5 * (lowest + second)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _difference(views: _Views, own: Floats, j: int, u: float, v: float) -> float:
    """Error between a pixel's values and those of another view at a place in it."""
    column, row = int(u), int(v)
    a, b = np.float32(u - column), np.float32(v - row)
    size, truncation = 3 * views.n_lights, np.float32(views.truncation)
    first = views.first[j] + (row * views.sizes[j, 1] + column) * size
    below = first + views.sizes[j, 1] * size
    total, weight, n = np.float32(0), np.float32(0), 0
    for q in range(size):
        mine = own[q]
        p00, p01 = views.values[first + q], views.values[first + size + q]
        p10, p11 = views.values[below + q], views.values[below + size + q]
        if mine < 0 or p00 < 0 or p01 < 0 or p10 < 0 or p11 < 0:
            continue
        other = (1 - b) * ((1 - a) * p00 + a * p01) + b * ((1 - a) * p10 + a * p11)
        total += min(abs(mine - other), truncation)
        weight += max(mine, other)
        n += 1
    # Too few lights in common, or too little light, say nothing.
    if n < 3 * LEAST_LIGHTS or not weight > DARK / TRUNCATION * truncation * n:
        return np.inf
    return float(total / weight)
