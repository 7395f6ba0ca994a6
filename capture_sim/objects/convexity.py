"""Whether a surface is convex: found from its triangles, not assumed from its name."""

from __future__ import annotations

import numpy as np
import trimesh

from capture_sim.objects.mesh import Array, SurfaceMesh
from capture_sim.objects.repair import open_edges, places

# Vertices may stand this far above the plane of a triangle, as a part of the object's size.
FLAT = 1e-6
# Planes that are tried first: nearly every surface that is not convex shows it there.
_TRIED = 256
# Planes whose heights are held at the same time.
_AT_ONCE = 16


def is_convex(mesh: SurfaceMesh) -> bool:
    """Tell whether no point of a surface can hide another from a light.

    That is so where the whole surface lies on or below the plane of each of its
    triangles: for flat sheets, and for single closed surfaces that bend inwards at no
    edge. Open surfaces that are not flat are never called convex.

    Parameters
    ----------
    mesh : SurfaceMesh

    Returns
    -------
    bool

    Examples
    --------
    >>> from capture_sim.objects import make_object
    >>> is_convex(make_object({"preset": "sphere", "around": 16}))
    True
    >>> is_convex(make_object({"preset": "vase", "around": 16, "along": 16}))
    False
    """
    limit = FLAT * 2.0 * mesh.radius
    some = np.linspace(0, len(mesh.faces) - 1, min(_TRIED, len(mesh.faces))).astype(int)
    flat = True
    for block in np.array_split(some, -(-len(some) // _AT_ONCE)):
        heights = _heights(mesh, block)
        if heights.max() > limit:
            return False
        flat = flat and bool(heights.min() >= -limit)
    if flat:  # all in one plane, seen from one side
        return True
    return _bends_outwards(mesh, limit)


def _heights(mesh: SurfaceMesh, some: Array) -> Array:
    """Heights of the vertices over the planes of some triangles, (n_some, n_vertices)."""
    corners = mesh.vertices[mesh.faces[some]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(lengths, np.finfo(float).tiny)
    offsets = np.einsum("nc,nc->n", normals, corners[:, 0])
    return np.asarray(normals @ mesh.vertices.T - offsets[:, None])


def _bends_outwards(mesh: SurfaceMesh, limit: float) -> bool:
    """A single closed surface whose neighbours all lie below each other's planes."""
    if len(open_edges(mesh.vertices, mesh.faces)):
        return False
    place = places(mesh.vertices)
    _, one = np.unique(place, return_index=True)
    merged = trimesh.Trimesh(mesh.vertices[one], place[mesh.faces], process=False)
    return bool(merged.body_count == 1 and merged.face_adjacency_projections.max() <= limit)
