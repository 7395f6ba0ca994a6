"""Rays from pixels to texels, and from the surface to lights."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.capture.cameras import ORTHOGRAPHIC, Camera
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.field.texel_taps import texel_taps
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.occlusion import VisibilityOptions
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.texels import TexelTable, texel_table
from reflfield.geometry.uv_atlas import Atlas
from reflfield.render.footprints import Footprints, blended, merged_taps
from reflfield.util.late_import import LateImport

spatial: Any = LateImport("scipy.spatial")

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class SurfaceHits:
    """Where rays met the base mesh; rays that missed it are left out.

    Parameters
    ----------
    ray : (n,) int64
        Number of the ray, ascending.
    position, face_normal : (n, 3) float64
        Point and the normal of its triangle, world frame.
    uv : (n, 2) float64
        Texture coordinates.
    front : (n,) bool
        True where the ray met the outside of the surface.
    """

    ray: NDArray[np.int64]
    position: Array
    face_normal: Array
    uv: Array
    front: Bools


class FieldSurface:
    """The base mesh of a field, ready for rays.

    Parameters
    ----------
    field : ReflectanceField
        Its mesh, UVs and texels.
    threads : int
        Threads of one ray query.
    ray_offset : float
        Height at which shadow rays start above the surface, in diagonals of the
        mesh; by default as in the visibility that the field was made with.

    Attributes
    ----------
    lift : float
        That height, metres.
    """

    def __init__(
        self, field: ReflectanceField, threads: int = 1, ray_offset: float | None = None
    ) -> None:
        self.field = field
        self.mesh = Mesh(field.positions, field.faces)
        self.scene = RayScene(self.mesh, threads)
        share = VisibilityOptions().ray_offset if ray_offset is None else ray_offset
        self.lift = share * self.scene.diagonal
        self._uv = np.asarray(field.uv, np.float64)

    def first_hits(self, origins: Array, directions: Array) -> SurfaceHits:
        """Meet the surface.

        Parameters
        ----------
        origins, directions : (n, 3) float64
            Rays; those with a direction that is not finite miss.

        Returns
        -------
        SurfaceHits
        """
        usable = np.flatnonzero(np.isfinite(directions).all(axis=1))
        distance, face, barycentric = self.scene.first_hit(origins[usable], directions[usable])
        hit = np.flatnonzero(np.isfinite(distance))
        ray, face, barycentric = usable[hit], face[hit], barycentric[hit]
        normal = self.mesh.face_normals[face]
        corners = self.mesh.faces[face]
        return SurfaceHits(
            ray=ray,
            position=blended(self.mesh.vertices, corners, barycentric),
            face_normal=normal,
            uv=blended(self._uv, corners, barycentric),
            front=np.einsum("nd,nd->n", normal, directions[ray]) < 0,
        )

    def camera_rays(self, camera: Camera, pixels: Array) -> tuple[Array, Array]:
        """Rays of pixels, moved before the whole mesh for an orthographic camera."""
        origins, directions = camera.rays(pixels)
        if camera.kind == ORTHOGRAPHIC:
            ahead = (self.mesh.bounds.mean(axis=0) - origins) @ camera.forward
            origins = origins + np.outer(ahead - self.scene.diagonal, camera.forward)
        return origins, directions

    @cached_property
    def texel_width(self) -> float:
        """Typical side of a texel on the surface, metres."""
        return float(np.sqrt(self.mesh.area / self.field.n_texels))

    def transitions(self, camera: Camera, hits: SurfaceHits, rays_per_pixel: int) -> Array:
        """Width (n,) over which texels blend at each hit; see `texel_taps`.

        Pixels are p texels wide. Blended over 1 - p, the mean over a pixel is bilinear; blended
        over the cell of a ray, each texel has the weight of its area: exactly where the axes of
        texture and image agree, nearly elsewhere.
        """
        distance = np.ones(len(hits.ray))
        if camera.kind != ORTHOGRAPHIC:
            distance = np.linalg.norm(hits.position - camera.centre, axis=1)
        pixel_width = distance / max(camera.fl_x, camera.fl_y)
        ratio = pixel_width / self.texel_width
        return np.clip(np.maximum(1.0 - ratio, ratio / rays_per_pixel**0.5), 0.0, 1.0)

    def footprints(
        self, hits: SurfaceHits, pixel: NDArray[np.int64], transition: ArrayLike = 1.0
    ) -> Footprints:
        """Merge the texel taps of each pixel's hits.

        Parameters
        ----------
        hits : SurfaceHits
            Hits of a block of pixels.
        pixel : (n_hits,) int64
            Pixel of each hit, ascending.
        transition : float or (n_hits,) float
            Width over which texels blend; see `texel_taps`.

        Returns
        -------
        Footprints
            Hits on the inside of the surface leave no weight: they are black.

        Notes
        -----
        A texel that is larger than a pixel is read by many samples from the
        same direction. Merged, it is evaluated once a pixel.
        """
        texels, weights = texel_taps(self.field, hits.uv, transition)
        weights *= hits.front[:, None]
        return merged_taps(pixel, texels, weights, hits.position)

    def reached_by_light(
        self,
        positions: Array,
        face_normals: Array,
        directions: Array,
        distances: Array | None = None,
    ) -> Bools:
        """True where a light reaches the surface: facing it and not in its own shadow.

        Parameters
        ----------
        positions, face_normals : (n, 3) float64
            Points on the mesh and normals of their triangles.
        directions : (n, 3) float64
            Unit vectors to the light.
        distances : (n,) float64, optional
            Distances to a near light.

        Returns
        -------
        (n,) bool
        """
        reached = np.einsum("nd,nd->n", face_normals, directions) > 0
        rows = np.flatnonzero(reached)
        starts = positions[rows] + self.lift * face_normals[rows]
        limits = None if distances is None else distances[rows]
        reached[rows] = ~self.scene.occluded(starts, directions[rows], limits)
        return reached

    @cached_property
    def texels(self) -> TexelTable:
        """Texels of the field, in its order, as the mesh and its texture coordinates say."""
        table = texel_table(field_atlas(self.field, self.mesh.vertex_normals))
        return table.subset(_nearest_rows(self.field, table.pixel))

    @cached_property
    def texel_points(self) -> tuple[Array, Array]:
        """Positions and triangle normals of all texels, (n_texels, 3) each."""
        return self.texels.position, self.texels.face_normal.astype(np.float64)

    @cached_property
    def local_from_texture(self) -> Array:
        """Frames of texels from the axes of the texture there, (n_texels, 3, 3) float64.

        Those axes are the direction of u, the one across it, and the normal of the surface.
        """
        world_from_texture = np.swapaxes(self.texels.local_from_world.astype(np.float64), 1, 2)
        local: Array = self.field.local_from_world.astype(np.float64)
        return local @ world_from_texture


def field_atlas(field: ReflectanceField, vertex_normals: Array) -> Atlas:
    """Base mesh of a field with its texture coordinates, as one chart.

    Parameters
    ----------
    field : ReflectanceField
    vertex_normals : (n_vertices, 3) float64
        Unit vectors.
    """
    height, width = field.texel_of_pixel.shape
    return Atlas(
        positions=field.positions,
        faces=field.faces,
        uv=np.clip(field.uv, 0.0, 1.0).astype(np.float64),
        chart=np.zeros(len(field.faces), np.int32),
        normals=vertex_normals,
        height=height,
        width=width,
    )


def pixel_window(camera: Camera, mesh: Mesh) -> tuple[int, int, int, int]:
    """Rows and columns that may show the mesh: first row, end row, first column, end column.

    Lens distortion bows the edges of triangles; the margin allows for a tenth of
    the longest edge. Where a vertex has no image, the whole image is returned.
    """
    pixels, _ = camera.project(mesh.vertices)
    if not np.isfinite(pixels).all():
        return 0, camera.height, 0, camera.width
    margin = 1.0
    if not camera.keeps_lines_straight:
        edges = pixels[mesh.faces] - pixels[np.roll(mesh.faces, 1, axis=1)]
        margin += 0.1 * float(np.abs(edges).max(initial=0.0))
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(axis=0) - margin), 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0) + margin), low, size).astype(int)
    return int(low[1]), int(high[1]), int(low[0]), int(high[0])


def subpixel_offsets(samples_per_pixel: int) -> Array:
    """Centres of a regular grid of cells in the unit square, (n, 2).

    Examples
    --------
    >>> subpixel_offsets(4)
    array([[0.25, 0.25],
           [0.75, 0.25],
           [0.25, 0.75],
           [0.75, 0.75]])
    """
    side = round(samples_per_pixel**0.5)
    axis = (np.arange(side) + 0.5) / side
    y, x = np.meshgrid(axis, axis, indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _nearest_rows(
    field: ReflectanceField, covered_pixels: NDArray[np.int32]
) -> NDArray[np.int64]:
    """Row of `covered_pixels` for each texel: its own pixel, or the nearest to one of its."""
    row = np.full(field.n_texels, -1, np.int64)
    owner = field.texel_of_pixel[covered_pixels[:, 0], covered_pixels[:, 1]]
    numbers = np.arange(len(covered_pixels))
    row[owner[owner >= 0]] = numbers[owner >= 0]
    absent = row < 0
    if absent.any():
        # Slivers at chart borders: rounding of UVs may drop their centres.
        pixel = np.argwhere(field.texel_of_pixel >= 0)
        any_pixel = np.zeros((field.n_texels, 2), np.int64)
        any_pixel[field.texel_of_pixel[pixel[:, 0], pixel[:, 1]]] = pixel
        row[absent] = spatial.cKDTree(covered_pixels).query(any_pixel[absent])[1]
    return row
