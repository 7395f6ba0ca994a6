"""Points of the true surface with all that shading needs.

Frames have the rows tangent, binormal, normal, are orthonormal and
right-handed. The surface frame follows the interpolated normals and tangents
of the mesh; the shading frame adds what the material does to it (bumps,
brushed direction).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from capture_sim.materials import Material
from capture_sim.objects import SurfaceMesh

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SurfacePoints:
    """Points on the surface.

    Attributes
    ----------
    position : (n, 3) float64
        On the mesh, world, metres.
    start : (n, 3) float64
        Where shadow rays begin: the position lifted to the smooth surface
        that the interpolated normals describe.
    face_normal : (n, 3) float64
        Unit normal of the triangle.
    surface_from_world, shading_from_world : (n, 3, 3) float64
        Rows tangent, binormal, normal.
    uv : (n, 2) float64
        Texture coordinates.
    label : (n,) int16
        Index of the material.
    face : (n,) int64
        Triangle.
    barycentric : (n, 3) float64
        Weights of the triangle's corners.
    """

    position: Array
    start: Array
    face_normal: Array
    surface_from_world: Array
    shading_from_world: Array
    uv: Array
    label: NDArray[np.int16]
    face: NDArray[np.int64]
    barycentric: Array

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, selection: slice | NDArray[np.generic]) -> SurfacePoints:
        """Points chosen by a slice, an index array or a boolean array."""
        return SurfacePoints(*(getattr(self, field.name)[selection] for field in fields(self)))


def surface_points(
    mesh: SurfaceMesh, material: Material, face: NDArray[np.int64], barycentric: Array
) -> SurfacePoints:
    """Interpolate the mesh at barycentric positions and ask the material.

    Parameters
    ----------
    mesh : SurfaceMesh
        The true surface.
    material : Material
        Gives the shading frame and the label.
    face : (n,) int
        Triangles.
    barycentric : (n, 3) float
        Weights of the triangles' corners.

    Returns
    -------
    SurfacePoints
    """
    corners = mesh.faces[face]
    corner_positions = mesh.vertices[corners]
    corner_normals = mesh.normals[corners]
    position = _interpolated(corner_positions, barycentric)
    uv = _interpolated(mesh.uv[corners], barycentric)
    surface_from_world = orthonormal_frames(
        _interpolated(corner_normals, barycentric),
        _interpolated(mesh.tangents[corners], barycentric),
    )
    return SurfacePoints(
        position=position,
        start=_lifted(position, corner_positions, corner_normals, barycentric),
        face_normal=_face_normals(corner_positions),
        surface_from_world=surface_from_world,
        shading_from_world=material.frame_change(uv) @ surface_from_world,
        uv=uv,
        label=material.label(uv).astype(np.int16),
        face=face,
        barycentric=barycentric,
    )


def spread_points(
    mesh: SurfaceMesh, n: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Array]:
    """Random points, equally dense everywhere on a surface.

    Parameters
    ----------
    mesh : SurfaceMesh
    n : int
        Number of points.
    rng : numpy.random.Generator

    Returns
    -------
    face : (n,) int64
        Triangles.
    barycentric : (n, 3) float64
        Weights of the triangles' corners.
    """
    corners = mesh.vertices[mesh.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(doubled, axis=1)
    face = rng.choice(len(area), size=n, p=area / area.sum())
    # The square root makes the density even: R. Turk, Graphics Gems, 1990.
    root, second = np.sqrt(rng.random(n)), rng.random(n)
    barycentric = np.stack([1.0 - root, root * (1.0 - second), root * second], axis=1)
    return face.astype(np.int64), barycentric


def shadow_starts(
    mesh: SurfaceMesh, face: NDArray[np.int64], barycentric: Array, offset: float
) -> tuple[Array, Array]:
    """Where shadow rays begin, and the smooth normals there.

    Parameters
    ----------
    mesh : SurfaceMesh
        The true surface.
    face : (n,) int
        Triangles.
    barycentric : (n, 3) float
        Weights of the triangles' corners.
    offset : float
        Metres above the smooth surface, along the normals of the triangles.

    Returns
    -------
    starts, normals : (n, 3) float64
        World; normals need not be unit.
    """
    corners = mesh.faces[face]
    corner_positions, corner_normals = mesh.vertices[corners], mesh.normals[corners]
    position = _interpolated(corner_positions, barycentric)
    lifted = _lifted(position, corner_positions, corner_normals, barycentric)
    starts = lifted + offset * _face_normals(corner_positions)
    return starts, _interpolated(corner_normals, barycentric)


def orthonormal_frames(normals: Array, tangents: Array) -> Array:
    """Right-handed frames from normals and approximate tangents.

    Parameters
    ----------
    normals : (n, 3) float
        Kept up to length.
    tangents : (n, 3) float
        Made orthogonal to the normals; replaced by an arbitrary direction
        where (nearly) parallel to them.

    Returns
    -------
    (n, 3, 3) float64
        Rows tangent, binormal, normal.

    Examples
    --------
    >>> orthonormal_frames(np.array([[0.0, 0.0, 2.0]]), np.array([[1.0, 0.0, 1.0]]))[0]
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    fallback = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    tangents = _orthogonal_part(tangents, normals)
    lengths = np.linalg.norm(tangents, axis=1, keepdims=True)
    tangents = np.where(lengths > 1e-6, tangents, _orthogonal_part(fallback, normals))
    tangents = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
    return np.stack([tangents, np.cross(normals, tangents), normals], axis=1)


def _orthogonal_part(vectors: Array, normals: Array) -> Array:
    return np.asarray(vectors - (vectors * normals).sum(axis=1, keepdims=True) * normals)


def _interpolated(corner_values: Array, barycentric: Array) -> Array:
    return np.einsum("nkc,nk->nc", corner_values, barycentric)


def _face_normals(corners: Array) -> Array:
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.maximum(lengths, np.finfo(float).tiny))


def _lifted(position: Array, corners: Array, normals: Array, barycentric: Array) -> Array:
    """Lift points of flat triangles to the smooth surface.

    A shadow ray from the flat triangle starts inside the curved surface it
    stands for and draws the triangles' outline along the terminator. The point
    is projected to the three corners' tangent planes where it lies below them.
    J. Hanika, "Hacking the Shadow Terminator", Ray Tracing Gems II, 2021.
    """
    offsets = position[:, None] - corners
    below = np.minimum(np.einsum("nkc,nkc->nk", offsets, normals), 0.0)
    return position - np.einsum("nk,nkc,nk->nc", below, normals, barycentric)
