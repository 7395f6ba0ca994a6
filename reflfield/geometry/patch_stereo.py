r"""Depths of views whose patches look alike in other views, where lights are too few.

Surfaces are swept along the rays of a view [1]_: planes through all of the visual hull, or
moved copies of a surface that is nearly right. The patch of pixels around each is compared
with what other views show of its piece of the surface, by normalised cross-correlation of
brightness in cube roots,

.. math:: c = 1 - \frac{\mathrm{cov}(a, b)}
          {\sqrt{(\mathrm{var}\,a + \sigma^2)(\mathrm{var}\,b + \sigma^2)}},

the mean over the two views that agree best: others may be hidden. Views may differ in
exposure, and in their lights as far as texture outweighs shading. Patches without contrast
cost 1 everywhere; their neighbours decide, by semi-global matching [2]_. Other views confirm a
depth that they have, too.

References
----------
.. [1] R. Collins, "A space-sweep approach to true multi-image matching", CVPR 1996.
.. [2] H. Hirschmüller, "Stereo processing by semiglobal matching and mutual information",
   IEEE Transactions on Pattern Analysis and Machine Intelligence 30, 2008.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import ORTHOGRAPHIC, Camera
from reflfield.geometry.light_stack import ReducedView, pixel_centres, projection_matrix
from reflfield.geometry.patch_costs import (
    OwnImage,
    PackedImages,
    Sweep,
    aggregated,
    least_offsets,
    patch_costs,
)
from reflfield.geometry.ray_scene import RayScene
from reflfield.util.blas_threads import thread_pool
from reflfield.util.progress import track

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

# Other views that a view is compared with, and the angle between them, degrees.
OTHERS, CLOSEST_DEG, FARTHEST_DEG = 6, 4.0, 50.0
# Of those, the nearest, in which a surface moves by so many pixels from one to the next; and
# how many surfaces at most.
NEAREST, SURFACE_PX, MOST_SURFACES = 2, 0.5, 256
# Surfaces before the hull: noise that went inwards only would move every surface inwards.
BEFORE = 3
# Around a surface that is nearly right: spacing over that of planes, and so many to each side.
FINER, BESIDE = 0.5, 12
# Spacings by which a depth and that of another view may differ for it to be confirmed.
CONFIRMED = 2.0


@dataclass(frozen=True, eq=False)
class PatchView:
    """A view without its lens's distortion, of one brightness.

    Parameters
    ----------
    camera : Camera
    covered : (h, w) bool
        Pixels that show the object alone.
    grey : (h, w) float32
        Cube roots of linear radiance, averaged over channels and photographs; root mean
        square of the covered pixels: 1.
    """

    camera: Camera
    covered: NDArray[np.bool_]
    grey: Floats

    @classmethod
    def of(cls, view: ReducedView) -> PatchView:
        """Averages of a view's photographs, as far as they were measured."""
        known = view.values >= 0
        total = np.where(known, view.values, 0).sum(axis=(2, 3), dtype=np.float32)
        grey = total / np.maximum(known.sum(axis=(2, 3)), 1).astype(np.float32)
        shown = grey[view.covered].astype(np.float64)
        level = np.sqrt(np.square(shown).sum() / max(len(shown), 1))
        scaled = grey / np.float32(level) if level > 0 else grey
        return cls(view.camera, view.covered, np.ascontiguousarray(scaled))


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """Surface as one view sees it.

    Parameters
    ----------
    camera : Camera
    depth : (h, w) float64
        Along the optical axis, metres; NaN where unknown.
    confirmed : (h, w) bool
        Whether other views have that depth, too.
    spacing : float
        To which depths are known, metres.
    """

    camera: Camera
    depth: Array
    confirmed: NDArray[np.bool_]
    spacing: float


@dataclass(frozen=True, eq=False)
class PatchStereo:
    """Views to be compared, in the hull of one object.

    Parameters
    ----------
    views : sequence of PatchView
    hull : RayScene
        That the object lies within.
    chosen : sequence of int
        Views whose depths are found; all others are compared with them.
    n_threads : int
    """

    views: Sequence[PatchView]
    hull: RayScene
    chosen: Sequence[int]
    n_threads: int = 1

    def depths(self, surface: RayScene | None, words: str) -> list[SeenSurface]:
        """Depths of the chosen views, the same for any number of threads.

        Parameters
        ----------
        surface : RayScene, optional
            Near which the object's surface lies; without one it may lie anywhere in the hull.
        words : str
            What progress is reported of.
        """
        images, towards = self._images(), self._towards()

        def one(index: int) -> SeenSurface:
            others = neighbours(towards, index)
            return _seen_surface(self.views[index], images, (self.hull, surface), others)

        with thread_pool(self.n_threads) as pool:
            seen = list(track(pool.map(one, self.chosen), len(self.chosen), words))
            among = towards[list(self.chosen)]
            confirmed = partial(_confirmed, seen)
            numbers = range(len(seen))
            return list(pool.map(confirmed, numbers, (neighbours(among, i) for i in numbers)))

    def costs(self, surface: RayScene) -> list[tuple[Array, Floats]]:
        """Depth of a surface in each chosen view, (h, w), NaN off it, and costs there."""
        images, towards = self._images(), self._towards()

        def one(index: int) -> tuple[Array, Floats]:
            view, others = self.views[index], neighbours(towards, index)
            rays = _PixelRays.of(view, self.hull)
            depth = rays.through(surface)[0].reshape(view.covered.shape)
            known = np.isfinite(depth)
            zeros = np.zeros(depth.shape, np.int64)
            front = np.where(known, depth, 0.0)
            on = Sweep(*rays.by_pixel, front, np.zeros(1), zeros, np.where(known, 0, -1))
            own = OwnImage(view.grey - _mean(view), view.covered & known)
            return depth, patch_costs(images, on, own, others)[..., 0]

        with thread_pool(self.n_threads) as pool:
            return list(pool.map(one, self.chosen))

    def _images(self) -> PackedImages:
        lengths = np.array([view.grey.size for view in self.views], np.int64)
        return PackedImages(
            np.concatenate([view.grey.reshape(-1) for view in self.views]),
            np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64),
            np.array([view.grey.shape for view in self.views], np.int64),
            np.stack([projection_matrix(view.camera) for view in self.views]),
        )

    def _towards(self) -> Array:
        """Unit directions from the middle of the object to the cameras, (n_views, 3)."""
        middle = self.hull.mesh.bounds.mean(axis=0)[None]
        return np.concatenate([view.camera.view_directions(middle) for view in self.views])


def neighbours(towards: Array, index: int) -> Indices:
    """Views that one is compared with, the nearest first.

    Examples
    --------
    >>> angles = np.radians([0.0, 20.0, -10.0, 1.0, 90.0])
    >>> towards = np.stack([np.cos(angles), np.sin(angles), np.zeros(5)], axis=1)
    >>> neighbours(towards, 0).tolist()
    [2, 1]
    """
    cosine = towards @ towards[index]
    order = np.argsort(-cosine, kind="stable")
    angle = np.degrees(np.arccos(np.clip(cosine[order], -1, 1)))
    near = order[(order != index) & (angle > CLOSEST_DEG) & (angle < FARTHEST_DEG)]
    return near[:OTHERS].astype(np.int64)


def spread_views(towards: Array, most: int) -> list[int]:
    """Numbers of views that lie evenly around the object, the first among them.

    Examples
    --------
    >>> spread_views(np.array([[1.0, 0, 0], [0.9, 0.1, 0], [-1, 0, 0], [0, 1, 0]]), 3)
    [0, 2, 3]
    """
    chosen = [0]
    farthest = np.linalg.norm(towards - towards[0], axis=1)
    while len(chosen) < min(most, len(towards)) and farthest.max() > 0:
        chosen.append(int(farthest.argmax()))
        farthest = np.minimum(farthest, np.linalg.norm(towards - towards[chosen[-1]], axis=1))
    return sorted(chosen)


def _mean(view: PatchView) -> np.float32:
    return np.float32(view.grey[view.covered].mean()) if view.covered.any() else np.float32(0)


def _seen_surface(
    view: PatchView,
    images: PackedImages,
    scenes: tuple[RayScene, RayScene | None],
    others: Indices,
) -> SeenSurface:
    shape = view.covered.shape
    sweep = _sweep(view, images, scenes, others) if len(others) else None
    if sweep is None:
        nowhere = np.full(shape, np.nan)
        return SeenSurface(view.camera, nowhere, np.zeros(shape, np.bool_), 0.0)
    own = OwnImage(view.grey - _mean(view), view.covered)
    total = aggregated(patch_costs(images, sweep, own, others), sweep.low, sweep.high)
    offset = least_offsets(total, sweep.offsets, sweep.low, sweep.high)
    spacing = float(sweep.offsets[1] - sweep.offsets[0])
    return SeenSurface(view.camera, sweep.front + offset, np.isfinite(offset), spacing)


def _sweep(
    view: PatchView,
    images: PackedImages,
    scenes: tuple[RayScene, RayScene | None],
    others: Indices,
) -> Sweep | None:
    """Planes through the hull, or copies of a surface moved along the rays; None off it."""
    hull, surface = scenes
    rays = _PixelRays.of(view, hull)
    front, behind = rays.through(hull)
    inside = np.isfinite(front) & (behind > front)
    if not inside.any():
        return None
    at = np.flatnonzero(inside)[inside.sum() // 2]
    point = rays.origins[at] + front[at] * rays.rays[at]
    spacing = _spacing(images, others, point, view.camera.forward)
    if surface is None:
        swept = _planes(front, behind, inside, spacing)
    else:
        near = rays.through(surface)[0]
        swept = _copies(np.where(np.isfinite(near), near, front), FINER * spacing)
    base, offsets, first, last = swept
    shape = view.covered.shape
    return Sweep(
        *rays.by_pixel,
        np.where(inside, base, 0.0).reshape(shape),
        offsets,
        np.where(inside, first, 0).reshape(shape),
        np.where(inside, np.minimum(last, len(offsets) - 1), -1).reshape(shape),
    )


def _planes(
    front: Array, behind: Array, inside: NDArray[np.bool_], spacing: float
) -> tuple[NDArray[Any], NDArray[Any], Indices, Indices]:
    """Base and offsets of planes, and which of them lie in the hull or little before it."""
    lowest, highest = front[inside].min(), behind[inside].max()
    spacing = max(spacing, (highest - lowest) / MOST_SURFACES)
    steps = np.arange(-BEFORE - 1, int(np.ceil((highest - lowest) / spacing)) + 1)
    known_front, known_behind = (
        np.where(inside, front, lowest),
        np.where(inside, behind, lowest),
    )
    first = np.floor((known_front - lowest) / spacing).astype(np.int64) + 1
    last = np.ceil((known_behind - lowest) / spacing).astype(np.int64) + 1 + BEFORE
    return np.full(len(front), lowest), spacing * steps, first, last


def _copies(base: Array, spacing: float) -> tuple[NDArray[Any], NDArray[Any], Indices, Indices]:
    """Base and offsets of moved copies of a surface, all of which each pixel may lie on."""
    steps = np.arange(-BESIDE, BESIDE + 1)
    first = np.zeros(len(base), np.int64)
    return base, spacing * steps, first, np.full_like(first, len(steps) - 1)


def _spacing(images: PackedImages, others: Indices, point: Array, forward: Array) -> float:
    """Change of depth that moves a point by `SURFACE_PX` in a near view at most, metres."""
    slowest = np.inf
    for j in others[:NEAREST]:
        u, v, w = images.matrices[j] @ np.append(point, 1.0)
        du, dv, dw = images.matrices[j][:, :3] @ forward
        moved = np.hypot(du - u / w * dw, dv - v / w * dw) / abs(w)
        slowest = min(slowest, SURFACE_PX / moved if moved > 0 else np.inf)
    return float(slowest)


@dataclass(frozen=True, eq=False)
class _PixelRays:
    """Rays of all pixels of a view; origins + z * rays has the depth z.

    Parameters
    ----------
    origins, rays : (n, 3) float64
    covered : (h, w) bool
    before : float
        Depth before the object, at which rays begin to be traced.
    """

    origins: Array
    rays: Array
    covered: NDArray[np.bool_]
    before: float

    @classmethod
    def of(cls, view: PatchView, hull: RayScene) -> _PixelRays:
        """Rays through the middles of pixels."""
        camera = view.camera
        origins, directions = camera.rays(pixel_centres(camera).reshape(-1, 2))
        rays = directions / (directions @ camera.forward)[:, None]
        start = (origins - camera.centre) @ camera.forward
        before = 0.0
        if camera.kind == ORTHOGRAPHIC:
            middle = (hull.mesh.bounds.mean(axis=0) - camera.centre) @ camera.forward
            before = float(middle - hull.diagonal)
        return cls(origins - start[:, None] * rays, rays, view.covered, before)

    @property
    def by_pixel(self) -> tuple[Array, Array]:
        """Origins and rays, each (h, w, 3)."""
        shape = (*self.covered.shape, 3)
        return self.origins.reshape(shape), self.rays.reshape(shape)

    def through(self, scene: RayScene) -> tuple[Array, Array]:
        """Depths where rays enter a mesh, and leave it for good; NaN where they miss it."""
        enter, leave = np.full((2, len(self.rays)), np.nan)
        at = np.flatnonzero(self.covered)
        length = np.linalg.norm(self.rays[at], axis=1)
        directions = self.rays[at] / length[:, None]
        origins = self.origins[at] + self.before * self.rays[at]
        near = scene.first_hit(origins, directions)[0]
        hit = np.isfinite(near)
        far = np.where(hit, near, 0.0) + 2.0 * scene.diagonal
        back = scene.first_hit(origins + far[:, None] * directions, -directions)[0]
        enter[at[hit]] = near[hit] / length[hit] + self.before
        leave[at[hit]] = (far - back)[hit] / length[hit] + self.before
        return enter, leave


def _confirmed(seen: Sequence[SeenSurface], index: int, others: Indices) -> SeenSurface:
    """The depths of a view, with the pixels that another view confirms."""
    each = seen[index]
    row, column = np.nonzero(np.isfinite(each.depth))
    origins, directions = each.camera.rays(np.stack([column, row], axis=1) + 0.5)
    start = (origins - each.camera.centre) @ each.camera.forward
    along = (each.depth[row, column] - start) / (directions @ each.camera.forward)
    points = origins + along[:, None] * directions
    confirmed = np.zeros(each.depth.shape, np.bool_)
    for j in others:
        other = seen[j]
        pixels, depth = other.camera.project(points)
        at = np.flatnonzero(np.isfinite(pixels).all(axis=1) & other.camera.contains(pixels))
        x, y = pixels[at].astype(int).T
        near = CONFIRMED * max(other.spacing, each.spacing)
        alike = at[np.abs(other.depth[y, x] - depth[at]) < near]
        confirmed[row[alike], column[alike]] = True
    return replace(each, confirmed=confirmed)
