"""How far the visual hull lies from the true surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.errors import InputError
from reflfield.geometry.open3d_library import open3d
from reflfield.util.validation import check_shape

Array = NDArray[np.float64]

# Enough for percentiles to one part in a hundred; a second of work.
HULL_SAMPLES = 20_000


@dataclass(frozen=True, eq=False)
class HullDistance:
    """Signed distances of points on the hull from the true surface, metres.

    Attributes
    ----------
    signed : (n_samples,) float64
        Positive outside of the object.
    voxel : float or None
        Edge of the hull's finest grid cell, metres.
    """

    signed: Array
    voxel: float | None = None

    @property
    def outside(self) -> float:
        """Share of the hull's area that lies outside of the object."""
        return float((self.signed > 0).mean())

    def summary(self) -> dict[str, float]:
        """Mean, RMS, 95th percentile and maximum distance; shares of either side."""
        size = np.abs(self.signed)
        in_metres = {
            "mean": size.mean(),
            "rms": np.sqrt(np.mean(size**2)),
            "p95": np.percentile(size, 95),
            "max": size.max(),
        }
        summary = {f"{name}_mm": float(v * 1e3) for name, v in in_metres.items()}
        if self.voxel is not None:
            summary |= {
                f"{name}_voxels": float(v / self.voxel) for name, v in in_metres.items()
            }
        return summary | {"outside_share": self.outside, "inside_share": 1.0 - self.outside}


def hull_distance(
    hull: tuple[ArrayLike, ArrayLike],
    truth: tuple[ArrayLike, ArrayLike],
    *,
    voxel: float | None = None,
    n_samples: int = HULL_SAMPLES,
    seed: int = 0,
) -> HullDistance:
    """Distance of the hull's surface from the true surface.

    Parameters
    ----------
    hull, truth : ((n, 3) float, (m, 3) int)
        Vertices (metres) and faces. Faces of the truth are counter-clockwise
        seen from outside; it need not be closed.
    voxel : float, optional
        Edge of the hull's grid cell, metres, to express the distances in.
    n_samples : int
        Points drawn on the hull, uniform by area.
    seed : int
        Of the draw.

    Returns
    -------
    HullDistance

    Raises
    ------
    InputError
        If a mesh has no face or no area, or `voxel` is not positive.

    Notes
    -----
    Inside or outside is decided by the true surface's interpolated vertex
    normal at the nearest point. Counting crossings would need a closed mesh.

    Examples
    --------
    A cube of edge 2.2 around a cube of edge 2: everything outside, .1 away from
    the faces, up to .1 * sqrt(3) near the corners:

    >>> import trimesh
    >>> cubes = [trimesh.creation.box([edge] * 3) for edge in (2.2, 2.0)]
    >>> d = hull_distance(*((c.vertices, c.faces) for c in cubes))
    >>> float(np.median(d.signed).round(6)), d.outside
    (0.1, 1.0)
    """
    if voxel is not None and not voxel > 0.0:
        raise InputError(f"voxel: expected a positive length in metres, received {voxel}")
    points = _points_on(*_checked_mesh("hull", hull), n_samples, seed)
    return HullDistance(_signed_distances(points, *_checked_mesh("truth", truth)), voxel)


def _checked_mesh(
    name: str, mesh: tuple[ArrayLike, ArrayLike]
) -> tuple[Array, NDArray[np.int64]]:
    vertices = np.asarray(mesh[0], dtype=np.float64)
    faces = np.asarray(mesh[1], dtype=np.int64)
    check_shape(f"{name} vertices", vertices, (None, 3))
    check_shape(f"{name} faces", faces, (None, 3))
    if not len(faces):
        raise InputError(f"{name}: expected a mesh with faces, received none")
    return vertices, faces


def _face_vectors(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """Twice the area times the normal of each face."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def _points_on(vertices: Array, faces: NDArray[np.int64], n_samples: int, seed: int) -> Array:
    area = np.linalg.norm(_face_vectors(vertices, faces), axis=1)
    if not area.sum() > 0.0:
        raise InputError("hull: expected faces with an area, received degenerate ones only")
    rng = np.random.default_rng(seed)
    # One draw per equal slice of area: even coverage, and less noise than free draws.
    share = (np.arange(n_samples) + rng.uniform(size=n_samples)) / n_samples
    face = np.searchsorted(np.cumsum(area) / area.sum(), share, side="right")
    u, v = rng.uniform(size=(2, n_samples))
    root = np.sqrt(u)
    weights = np.stack([1.0 - root, root * (1.0 - v), root * v], axis=1)
    corners = vertices[faces[np.minimum(face, len(faces) - 1)]]
    return np.einsum("nk,nkd->nd", weights, corners)


def _signed_distances(points: Array, vertices: Array, faces: NDArray[np.int64]) -> Array:
    scene = open3d.t.geometry.RaycastingScene()
    # Embree works in float32: measured from the mesh's own centre and in its own size.
    centre, size = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max())
    scene.add_triangles(
        open3d.core.Tensor(((vertices - centre) / size).astype(np.float32)),
        open3d.core.Tensor(faces.astype(np.uint32)),
    )
    query = open3d.core.Tensor(((points - centre) / size).astype(np.float32))
    closest = scene.compute_closest_points(query)
    face = closest["primitive_ids"].numpy().astype(np.int64)
    uv = closest["primitive_uvs"].numpy().astype(np.float64)
    weights = np.stack([1.0 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
    nearest = np.einsum("nk,nkd->nd", weights, vertices[faces[face]])
    normal = np.einsum("nk,nkd->nd", weights, _vertex_normals(vertices, faces)[faces[face]])
    offset = points - nearest
    sign = np.where(np.einsum("nd,nd->n", offset, normal) < 0.0, -1.0, 1.0)
    return sign * np.linalg.norm(offset, axis=1)


def _vertex_normals(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """Unit mean of the faces' unit normals, weighted by the angle at the vertex."""
    corners = vertices[faces]
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    cosine = np.einsum("fkd,fkd->fk", ahead, behind)
    sine = np.linalg.norm(np.cross(ahead, behind), axis=2)
    vectors = _face_vectors(vertices, faces)
    unit = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
    normals = np.zeros_like(vertices)
    np.add.at(normals, faces, np.arctan2(sine, cosine)[..., None] * unit[:, None])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
