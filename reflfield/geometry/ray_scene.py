"""Rays against a triangle mesh: first hits, occlusion, inside and outside."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.capture.cameras import OPENCV, ORTHOGRAPHIC, Camera
from reflfield.errors import ShapeError
from reflfield.geometry.mesh import Mesh, unit_or_zero
from reflfield.geometry.open3d_library import open3d
from reflfield.geometry.ray_kernels import draw_nearest, pack_rays
from reflfield.options import available_cores
from reflfield.util.validation import check_shape

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Rays of the pixels of an image that are traced together: 150 MB.
RAYS_AT_ONCE = 1 << 19


class RayScene:
    """Ray queries against a triangle mesh, in Open3D's Embree scene.

    Embree works in single precision; the mesh is moved to the origin and scaled to
    unit diagonal first, so that answers do not depend on where or how large it is.

    Parameters
    ----------
    mesh : Mesh
    threads : int
        Threads used by one query, no more than there are cores; 0 takes all. Answers do not
        depend on it.

    Examples
    --------
    >>> square = Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    >>> scene = RayScene(square)
    >>> distance, face, _ = scene.first_hit([[0.6, 0.2, 3.0], [5, 5, 3]], [[0, 0, -1]] * 2)
    >>> distance, face
    (array([ 3., inf]), array([ 0, -1], dtype=int32))
    """

    def __init__(self, mesh: Mesh, threads: int = 0) -> None:
        if not len(mesh.faces):
            raise ShapeError("mesh: expected at least one triangle, received none")
        self.mesh = mesh
        self._threads = min(threads, available_cores())
        self._origin = mesh.bounds.mean(axis=0)
        self._scale = mesh.diagonal
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=self._threads)
        self._scene.add_triangles(
            open3d.core.Tensor(self._local(mesh.vertices)),
            open3d.core.Tensor(mesh.faces.astype(np.uint32)),
        )

    @property
    def diagonal(self) -> float:
        """Diagonal of the mesh's bounding box, metres."""
        return self._scale

    def first_hit(
        self, origins: ArrayLike, directions: ArrayLike
    ) -> tuple[Array, NDArray[np.int32], Array]:
        """Nearest intersection of each ray.

        Parameters
        ----------
        origins : (n, 3) array_like
            Metres.
        directions : (n, 3) array_like
            Unit vectors.

        Returns
        -------
        distance : (n,) float64
            Metres along the ray; inf where nothing is hit.
        face : (n,) int32
            Triangle; -1 where nothing is hit.
        barycentric : (n, 3) float64
            Weights of the triangle's corners; zero where nothing is hit.
        """
        rays, skipped = self._rays(origins, directions)
        answer = self._scene.cast_rays(open3d.core.Tensor(rays), nthreads=self._threads)
        travelled = answer["t_hit"].numpy().astype(np.float64)
        missed = ~np.isfinite(travelled)
        face = answer["primitive_ids"].numpy().astype(np.int64)
        second, third = answer["primitive_uvs"].numpy().astype(np.float64).T
        barycentric = np.stack([1.0 - second - third, second, third], axis=1)
        barycentric[missed] = 0.0
        distance = travelled * self._scale + skipped
        return distance, np.where(missed, -1, face).astype(np.int32), barycentric

    def occluded(
        self, origins: ArrayLike, directions: ArrayLike, distances: ArrayLike | None = None
    ) -> Bools:
        """True where the mesh blocks a ray.

        Parameters
        ----------
        origins, directions : (n, 3) array_like
            Metres; unit vectors.
        distances : (n,) array_like, optional
            Length of each ray, metres; infinite by default.

        Returns
        -------
        (n,) bool
        """
        rays, skipped = self._rays(origins, directions)
        limit = np.full(len(rays), np.inf, dtype=np.float32)
        if distances is not None:
            reach = (np.asarray(distances, dtype=np.float64) - skipped) / self._scale
            limit = reach.astype(np.float32)
        lengths = np.where(limit > 0.0, limit, 0.0).astype(np.float32)
        answer = self._rays_blocked(rays, lengths)
        return answer & (limit > 0.0)

    def pixel_depths(self, camera: Camera, pixels: ArrayLike) -> Array:
        """Distance (n,) to the surface along the rays of pixels (n, 2).

        Metres along the ray from the camera; for an orthographic camera from a common
        plane before the mesh. inf where the ray misses or the lens has no ray.
        """
        origins, directions = self._camera_rays(camera, pixels)
        usable = np.isfinite(directions).all(axis=1)
        depth = np.full(len(origins), np.inf)
        depth[usable] = self.first_hit(origins[usable], directions[usable])[0]
        return depth

    def _camera_rays(self, camera: Camera, pixels: ArrayLike) -> tuple[Array, Array]:
        """Rays of pixels; parallel ones, which have no start, begin before the whole mesh."""
        origins, directions = camera.rays(pixels)
        if camera.kind == ORTHOGRAPHIC:
            ahead = (self._origin - origins) @ camera.forward
            origins = origins + np.outer(ahead - self._scale, camera.forward)
        return origins, directions

    def facing(self, camera: Camera, step: int = 1) -> Array:
        """Cosines between rays of every so many pixels and the smooth normals they meet.

        Parameters
        ----------
        camera : Camera
        step : int
            Of rows and columns, from the first of each.

        Returns
        -------
        (ceil(height / step), ceil(width / step)) float64
            NaN beside the mesh.
        """
        column, row = np.meshgrid(
            np.arange(0, camera.width, step) + 0.5, np.arange(0, camera.height, step) + 0.5
        )
        pixels = np.stack([column.ravel(), row.ravel()], axis=1)
        origins, directions = self._camera_rays(camera, pixels)
        cosines = np.full(len(pixels), np.nan)
        usable = np.flatnonzero(np.isfinite(directions).all(axis=1))
        _, face, weights = self.first_hit(origins[usable], directions[usable])
        at = usable[face >= 0]
        corners = self.mesh.vertex_normals[self.mesh.faces[face[face >= 0]]]
        normals = unit_or_zero((corners * weights[face >= 0][..., None]).sum(axis=1))
        cosines[at] = np.abs((normals * directions[at]).sum(axis=1))
        return cosines.reshape(column.shape)

    def row_depths(self, camera: Camera, first: int, end: int) -> Array:
        """`pixel_depths` at the centres of all pixels of some rows, (end - first, width)."""
        depth = np.full((end - first, camera.width), np.inf)
        rows, columns = self._window(camera)
        rows = range(max(rows.start, first), min(rows.stop, end))
        if rows and columns:
            inside = slice(rows.start - first, rows.stop - first)
            draws = self._is_drawn(camera)
            of_window = self._drawn_depths if draws else self._traced_depths
            depth[inside, columns.start : columns.stop] = of_window(camera, rows, columns)
        return depth

    def _traced_depths(self, camera: Camera, rows: range, columns: range) -> Array:
        row, column = np.meshgrid(np.array(rows) + 0.5, np.array(columns) + 0.5, indexing="ij")
        pixels = np.stack([column.ravel(), row.ravel()], axis=1)
        return self.pixel_depths(camera, pixels).reshape(row.shape)

    def _is_drawn(self, camera: Camera) -> bool:
        """Whether a camera's image is drawn triangle by triangle, which takes a straight lens.

        All of the mesh must be before the camera.
        """
        return (
            camera.kind == OPENCV and camera.keeps_lines_straight and self._all_before(camera)
        )

    def _drawn_depths(self, camera: Camera, rows: range, columns: range) -> Array:
        """Depths of some rows and columns without rays."""
        pixels, depth = camera.project(self.mesh.vertices)
        corners = np.concatenate([pixels, 1.0 / depth[:, None]], axis=1)
        nearness = np.zeros((len(rows), len(columns)))
        draw_nearest(corners, self.mesh.faces, rows.start, columns.start, nearness)
        down = (np.array(rows) + (0.5 - camera.cy)) / camera.fl_y
        across = (np.array(columns) + (0.5 - camera.cx)) / camera.fl_x
        slant = np.sqrt(1.0 + across**2 + down[:, None] ** 2)
        shown = nearness > 0.0
        return np.divide(slant, nearness, out=np.full(slant.shape, np.inf), where=shown)

    def _window(self, camera: Camera) -> tuple[range, range]:
        """Rows and columns of a camera's image that may show the mesh.

        Where straight lines stay straight a triangle lies between its corners.
        """
        whole = range(camera.height), range(camera.width)
        if not camera.keeps_lines_straight:
            return whole
        if camera.kind != ORTHOGRAPHIC and not self._all_before(camera):
            return whole
        pixels, _ = camera.project(self.mesh.vertices)
        size = (camera.width, camera.height)
        # A pixel more, for rounding.
        low = np.clip(np.floor(pixels.min(axis=0)) - 1, 0, size).astype(int)
        high = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, size).astype(int)
        columns, rows = (range(*ends) for ends in zip(low.tolist(), high.tolist(), strict=True))
        return rows, columns

    def _all_before(self, camera: Camera) -> bool:
        """Whether all of the mesh is before a camera."""
        ahead = (self.mesh.vertices - camera.centre) @ camera.forward
        return bool((ahead > 0.0).all())

    def silhouette(self, camera: Camera) -> Bools:
        """True at the pixels of a camera whose centres show the mesh, (height, width)."""
        covered = np.zeros((camera.height, camera.width), dtype=bool)
        for first, end in row_strips(camera):
            covered[first:end] = np.isfinite(self.row_depths(camera, first, end))
        return covered

    def inside(self, points: ArrayLike) -> Bools:
        """True for points (n, 3) enclosed by a watertight mesh; never for an open one."""
        array = np.asarray(points, dtype=np.float64)
        check_shape("points", array, (None, 3))
        if not self.mesh.watertight:
            return np.zeros(len(array), dtype=bool)
        # Far points lose digits in single precision and cannot be inside anyway.
        near = ((array >= self.mesh.bounds[0]) & (array <= self.mesh.bounds[1])).all(axis=1)
        enclosed = near.copy()
        query = open3d.core.Tensor(self._local(array[near]))
        # Three rays vote, so that one that grazes an edge does not decide.
        answer = self._scene.compute_occupancy(query, nthreads=self._threads, nsamples=3)
        enclosed[near] = answer.numpy() > 0.5
        return enclosed

    def _rays_blocked(self, rays: NDArray[np.float32], lengths: NDArray[np.float32]) -> Bools:
        # Open3D takes one limit for all rays: the length of the direction carries ours.
        limited = np.isfinite(lengths)
        if limited.all():
            rays[:, 3:] *= lengths[:, None]
            return self._blocked_within(rays, 1.0)
        blocked = self._blocked_within(rays, np.inf)
        if limited.any():
            blocked[limited] = self._rays_blocked(rays[limited], lengths[limited])
        return blocked

    def _blocked_within(self, rays: NDArray[np.float32], far: float) -> Bools:
        """Whether something is hit before so many lengths of the rays' directions."""
        answer = self._scene.test_occlusions(
            open3d.core.Tensor(rays), 0.0, far, nthreads=self._threads
        )
        return np.array(answer.numpy())

    def _local(self, points: Array) -> NDArray[np.float32]:
        """World to scene coordinates: bounding box at the origin, diagonal 1."""
        return ((points - self._origin) / self._scale).astype(np.float32)

    def _rays(
        self, origins: ArrayLike, directions: ArrayLike
    ) -> tuple[NDArray[np.float32], Array]:
        """Rays in scene coordinates, and the distance skipped at their start.

        A start far from the mesh is moved up to two diagonals before its centre:
        single precision would otherwise lose the digits of the hit.
        """
        start = np.ascontiguousarray(origins, dtype=np.float64)
        towards = np.ascontiguousarray(directions, dtype=np.float64)
        check_shape("origins", start, (None, 3))
        check_shape("directions", towards, start.shape)
        rays, skipped = np.zeros((len(start), 6), np.float32), np.zeros(len(start))
        pack_rays(start, towards, self._origin, self._scale, rays, skipped)
        return rays, skipped


def row_strips(camera: Camera) -> list[tuple[int, int]]:
    """First and end row of the strips of an image whose rays are traced together.

    Examples
    --------
    >>> camera = Camera("v", "opencv", 4096, 300, 99.0, 99.0, 2048.0, 150.0, np.eye(4))
    >>> row_strips(camera)
    [(0, 128), (128, 256), (256, 300)]
    """
    n_rows = max(1, RAYS_AT_ONCE // camera.width)
    starts = range(0, camera.height, n_rows)
    return [(first, min(first + n_rows, camera.height)) for first in starts]
