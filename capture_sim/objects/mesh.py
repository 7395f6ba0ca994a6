"""The triangle mesh that all simulated objects are, and its small tools."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from capture_sim.errors import scene_error
from capture_sim.inputs import check_memory

Array = NDArray[np.float64]
Faces = NDArray[np.int32]

# Relative to the size of the object: corners closer than this are one corner.
SAME_CORNER = 1e-9


# Memory that making an object takes for each triangle, measured.
BYTES_PER_FACE = 1000


def check_size(name: str, n_faces: int) -> None:
    """Demand that an object of so many triangles stays below the ceiling of memory.

    Raises
    ------
    SceneError
        See `capture_sim.inputs.check_memory`.
    """
    check_memory(f"{n_faces:,} triangles of {name}", BYTES_PER_FACE * n_faces)


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """The true surface of a simulated object.

    Vertices are repeated along seams of the texture coordinates and along creases,
    so that all arrays have one row per vertex.

    Parameters
    ----------
    vertices : (n, 3) float64
        Metres, world frame.
    faces : (m, 3) int32
        Counter-clockwise seen from outside.
    uv : (n, 2) float64
        Texture coordinates, v up; zeros if the object has none.
    normals : (n, 3) float64
        Unit smooth normals, outward.
    tangents : (n, 3) float64
        Unit directions of dP/du, orthogonal to the normals.
    convex : bool
        True if no point of the surface can shadow or hide another.
    has_uv : bool
        True if `uv` means anything.
    name : str
        Kind or file the mesh was made from.
    notes : tuple of str
        What was wrong with the file and has been repaired.
    """

    vertices: Array
    faces: Faces
    uv: Array
    normals: Array
    tangents: Array
    convex: bool = False
    has_uv: bool = True
    name: str = "object"
    notes: tuple[str, ...] = ()

    @cached_property
    def centre(self) -> Array:
        """Centre of the bounding box, (3,) float64."""
        return np.asarray((self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2.0)

    @cached_property
    def radius(self) -> float:
        """Radius of the sphere about `centre` that holds the object, metres."""
        return float(np.linalg.norm(self.vertices - self.centre, axis=1).max())

    def require_uv(self, reason: str) -> None:
        """Refuse the object if something needs texture coordinates it lacks.

        Parameters
        ----------
        reason : str
            Who needs them, for the message.

        Raises
        ------
        SceneError
            If `has_uv` is False.
        """
        if not self.has_uv:
            raise scene_error(
                f"object ({self.name})",
                f"texture coordinates, which {reason} needs",
                "a mesh without",
                "unwrap the mesh, or choose a material that is the same everywhere",
            )


def grid_faces(n_rows: int, n_columns: int) -> Faces:
    """Two triangles per cell of a grid of vertices, counter-clockwise in (u, v)."""
    row, column = np.mgrid[: n_rows - 1, : n_columns - 1]
    corner = (row * n_columns + column).ravel()
    right, above = corner + 1, corner + n_columns
    lower = np.stack([corner, right, above + 1], axis=1)
    upper = np.stack([corner, above + 1, above], axis=1)
    return np.concatenate([lower, upper]).astype(np.int32)


def without_slivers(vertices: Array, faces: Faces) -> Faces:
    """Faces whose three corners are apart; poles of grids leave others."""
    corners = vertices[faces]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return faces[sides.min(axis=1) > SAME_CORNER * np.ptp(vertices, axis=0).max()]


def joined(parts: list[SurfaceMesh], name: str) -> SurfaceMesh:
    """Several surfaces as one, not merged where they touch."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return SurfaceMesh(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)]).astype(
            np.int32
        ),
        uv=np.concatenate([part.uv for part in parts]),
        normals=np.concatenate([part.normals for part in parts]),
        tangents=np.concatenate([part.tangents for part in parts]),
        name=name,
    )


def unit(vectors: Array) -> Array:
    """Vectors divided by their lengths; zero vectors stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, np.finfo(np.float64).tiny))


def fan(rim: Array, normal: Array, tangent: Array, uv: Array | None = None) -> SurfaceMesh:
    """Flat star-shaped face about the mean of a closed rim.

    Parameters
    ----------
    rim : (n, 3) float64
        Points in order, either way round.
    normal, tangent : (3,) float64
        Unit vectors; the face is seen from where the normal points.
    uv : (n, 2) float64, optional
        Texture coordinates of the rim; zeros if not given.

    Returns
    -------
    SurfaceMesh

    Examples
    --------
    >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> fan(square, np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0])).faces[0]
    array([1, 0, 4], dtype=int32)
    """
    n, centre = len(rim), rim.mean(axis=0)
    first = np.arange(n)
    faces = np.stack([np.full(n, n), first, (first + 1) % n], axis=1)
    if np.cross(rim - centre, np.roll(rim, -1, axis=0) - centre).sum(axis=0) @ normal < 0.0:
        faces = faces[:, ::-1]
    coordinates = np.zeros((n, 2)) if uv is None else uv
    return SurfaceMesh(
        vertices=np.vstack([rim, centre]),
        faces=faces.astype(np.int32),
        uv=np.vstack([coordinates, coordinates.mean(axis=0)]),
        normals=np.tile(normal, (n + 1, 1)),
        tangents=np.tile(tangent, (n + 1, 1)),
    )
