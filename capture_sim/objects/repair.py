"""What can be wrong with the triangles of a mesh file, and what is done about it.

Repairs are stated: each leaves a line that `capture-sim` prints and the capture keeps.

* triangles without area and triangles that occur twice are removed;
* triangles that are turned against their neighbours are turned back, and closed parts
  whose triangles all face inwards are turned inside out;
* small holes, whose rim spans at most a fifth of the object, are closed by fans; wider
  openings are taken as meant, for a sheet or a bowl without thickness.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from capture_sim.objects.mesh import Array, Faces

# Relative to the size of the object: files store single precision or few digits.
SAME_PLACE = 1e-7
# Height of a triangle, as a part of the object's size, below which it has no area.
NO_HEIGHT = SAME_PLACE
# Holes whose rim spans less than this part of the object's size are closed.
SMALL_HOLE = 0.2


@dataclass(frozen=True)
class Triangles:
    """Triangles on their way from a file to a surface.

    Attributes
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    uv : (n, 2) float64 or None
        Texture coordinates.
    notes : tuple of str
        What was repaired.
    """

    vertices: Array
    faces: Faces
    uv: Array | None
    notes: tuple[str, ...] = ()


def places(vertices: Array) -> NDArray[np.intp]:
    """Number of the place of each vertex; seams have several vertices in one place.

    Parameters
    ----------
    vertices : (n, 3) float64

    Returns
    -------
    (n,) int

    Examples
    --------
    >>> places(np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 0]]))
    array([0, 1, 0])
    """
    size = np.ptp(vertices, axis=0).max()
    rounded = np.round(vertices / (SAME_PLACE * size))
    return np.asarray(np.unique(rounded, axis=0, return_inverse=True)[1].ravel())


def repaired(vertices: Array, faces: Faces, uv: Array | None) -> Triangles:
    """Repair what can be repaired, and say what was.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    uv : (n, 2) float64 or None

    Returns
    -------
    Triangles

    Examples
    --------
    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> repaired(corners, np.array([[0, 1, 2], [0, 0, 1]], np.int32), None).notes
    ('1 triangle without area dropped', '1 wide opening left open: taken as meant')
    """
    triangles = Triangles(vertices, faces, uv)
    for step in (_without_empty_faces, _turned_alike, _with_small_holes_closed):
        triangles = step(triangles)
    return triangles


def _counted(count: int, what: str, done: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'} {done}"


def _without_empty_faces(triangles: Triangles) -> Triangles:
    corners = triangles.vertices[triangles.faces]
    edges = corners - np.roll(corners, 1, axis=1)
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    doubled = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    size = np.ptp(triangles.vertices, axis=0).max()
    kept = doubled > NO_HEIGHT * size * longest
    notes = []
    if not kept.all():
        notes.append(_counted(int((~kept).sum()), "triangle", "without area dropped"))
    first = np.zeros(len(kept), dtype=bool)
    same = np.sort(places(triangles.vertices)[triangles.faces], axis=1)
    first[np.unique(np.where(kept[:, None], same, -1), axis=0, return_index=True)[1]] = True
    if twice := int((kept & ~first).sum()):
        notes.append(_counted(twice, "triangle", "that occur twice dropped"))
    faces = triangles.faces[kept & first]
    return replace(triangles, faces=faces, notes=(*triangles.notes, *notes))


def _turned_alike(triangles: Triangles) -> Triangles:
    """Neighbours wind alike, and closed parts face outwards."""
    if len(triangles.faces) == 0:
        return triangles
    place = places(triangles.vertices)
    _, one = np.unique(place, return_index=True)
    mesh = trimesh.Trimesh(triangles.vertices[one], place[triangles.faces], process=False)
    trimesh.repair.fix_winding(mesh)
    inwards = _facing_inwards(mesh)
    wanted = np.where(inwards[:, None], mesh.faces[:, ::-1], mesh.faces)
    turned = ~_same_turn(place[triangles.faces], wanted)
    faces = np.where(turned[:, None], triangles.faces[:, ::-1], triangles.faces).astype(
        np.int32
    )
    if not turned.any():
        return triangles
    note = _counted(int(turned.sum()), "triangle", "turned to face outwards")
    return replace(triangles, faces=faces, notes=(*triangles.notes, note))


def _same_turn(first: NDArray[np.integer], second: NDArray[np.integer]) -> NDArray[np.bool_]:
    """True where two triangles of the same corners run the same way round."""
    turns = [np.roll(second, shift, axis=1) for shift in range(3)]
    return np.asarray(np.any([(first == turn).all(axis=1) for turn in turns], axis=0))


def _facing_inwards(mesh: trimesh.Trimesh) -> NDArray[np.bool_]:
    """Triangles of closed parts whose volume is negative; (n_faces,)."""
    n_faces, pairs = len(mesh.faces), mesh.face_adjacency
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(n_faces, n_faces))
    part = connected_components(links, directed=False)[1]
    corners = mesh.vertices[mesh.faces] - mesh.vertices.mean(axis=0)
    volume = np.einsum("nc,nc->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    total = np.bincount(part, volume)
    # Every edge of a closed part has two triangles: three neighbours for each of its own.
    neighbours = np.bincount(part[pairs].ravel(), minlength=len(total))
    closed = neighbours == 3 * np.bincount(part)
    return np.asarray((closed & (total < 0.0))[part])


def open_edges(vertices: Array, faces: Faces) -> NDArray[np.int32]:
    """Edges that only one triangle has, as it runs through them.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32

    Returns
    -------
    (n_edges, 2) int32
        Vertices.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    same = np.sort(places(vertices)[edges], axis=1)
    _, group, count = np.unique(same, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(edges[count[group.ravel()] == 1])


def _with_small_holes_closed(triangles: Triangles) -> Triangles:
    if len(triangles.faces) == 0:
        return triangles
    edges = open_edges(triangles.vertices, triangles.faces)
    limit = SMALL_HOLE * np.ptp(triangles.vertices, axis=0).max()
    rims, wide = [], 0
    for rim in _rims(places(triangles.vertices), edges):
        corners = triangles.vertices[rim].reshape(-1, 3)
        if np.ptp(corners, axis=0).max() <= limit:
            rims.append(rim)
        else:
            wide += 1
    notes = [_counted(len(rims), "small hole", "closed")] if rims else []
    if wide:
        notes.append(_counted(wide, "wide opening", "left open: taken as meant"))
    closed = replace(triangles, notes=(*triangles.notes, *notes))
    for rim in rims:
        closed = _closed(closed, rim)
    return closed


def _rims(place: NDArray[np.intp], edges: NDArray[np.int32]) -> list[NDArray[np.int32]]:
    """Open edges that hang together, hole by hole."""
    if len(edges) == 0:
        return []
    ends = place[edges]
    n = int(place.max()) + 1
    links = coo_array((np.ones(len(ends)), ends.T), shape=(n, n))
    part = connected_components(links, directed=False)[1][ends[:, 0]]
    return [edges[part == which] for which in np.unique(part)]


def _closed(triangles: Triangles, rim: NDArray[np.int32]) -> Triangles:
    """Close a hole by a fan about the centroid of its rim."""
    middle = len(triangles.vertices)
    centre = triangles.vertices[rim[:, 0]].mean(axis=0, keepdims=True)
    fan = np.stack([rim[:, 1], rim[:, 0], np.full(len(rim), middle)], axis=1)
    uv = triangles.uv
    if uv is not None:
        uv = np.vstack([uv, uv[rim[:, 0]].mean(axis=0, keepdims=True)])
    return replace(
        triangles,
        vertices=np.vstack([triangles.vertices, centre]),
        faces=np.vstack([triangles.faces, fan]).astype(np.int32),
        uv=uv,
    )
