"""Triangle meshes: checks, normals, cleaning, smoothing, decimation, PLY files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.errors import GeometryError, InputError
from reflfield.geometry.open3d_library import open3d
from reflfield.util.files import replacing
from reflfield.util.late_import import LateImport
from reflfield.util.validation import check_shape

sparse: Any = LateImport("scipy.sparse")
csgraph: Any = LateImport("scipy.sparse.csgraph")
trimesh: Any = LateImport("trimesh")

Array = NDArray[np.float64]
Faces = NDArray[np.int32]

# Taubin's pass-band pair: lambda > 0 smooths, mu < -lambda undoes the shrinking;
# 1/lambda + 1/mu = 0.1 keeps wavelengths longer than about 20 edges (Taubin 1995).
_TAUBIN_LAMBDA = 0.5
_TAUBIN_MU = 1.0 / (0.1 - 1.0 / _TAUBIN_LAMBDA)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with shared vertices, counter-clockwise seen from outside.

    Parameters
    ----------
    vertices : (n, 3) float64
        Positions in the world, metres.
    faces : (m, 3) int32
        Vertex indices of each triangle.

    Raises
    ------
    ShapeError
        If an array has another shape.
    InputError
        If a vertex is not finite or a face names a vertex that does not exist.

    Examples
    --------
    >>> triangle = Mesh([[0, 0, 0], [2, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    >>> triangle.area
    1.0
    >>> triangle.face_normals
    array([[0., 0., 1.]])
    """

    vertices: Array
    faces: Faces

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int32)
        check_shape("vertices", vertices, (None, 3))
        check_shape("faces", faces, (None, 3))
        if not np.isfinite(vertices).all():
            row = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
            raise InputError(
                f"vertices: expected finite positions, received {vertices[row]} in row {row}; "
                "remove or repair the vertex"
            )
        if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise InputError(
                f"faces: expected vertex indices in [0, {len(vertices)}), received "
                f"{faces.min()} .. {faces.max()}; the arrays do not belong together"
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    @cached_property
    def corners(self) -> Array:
        """Vertex positions of each face, (m, 3 corners, 3)."""
        return self.vertices[self.faces]

    @cached_property
    def face_areas(self) -> Array:
        """Area of each face, (m,), square metres."""
        return 0.5 * np.linalg.norm(self._doubled_area_vectors, axis=1)

    @cached_property
    def face_normals(self) -> Array:
        """Outward unit normals, (m, 3); zero where the face has no area."""
        return unit_or_zero(self._doubled_area_vectors)

    @cached_property
    def vertex_normals(self) -> Array:
        """Unit normals, (n, 3): face normals weighted by the corner angle.

        The weight makes the result independent of how a flat region is
        triangulated. Vertices without a face of positive area get +Z.
        """
        weighted = self._corner_angles[:, :, None] * self.face_normals[:, None, :]
        total = np.stack(
            [
                np.bincount(
                    self.faces.ravel(),
                    weighted[..., axis].ravel(),
                    minlength=len(self.vertices),
                )
                for axis in range(3)
            ],
            axis=1,
        )
        normals = unit_or_zero(total)
        normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)
        return normals

    @property
    def area(self) -> float:
        """Total area, square metres."""
        return float(self.face_areas.sum())

    @property
    def volume(self) -> float:
        """Enclosed volume, cubic metres; meaningful for watertight meshes."""
        centred = self.corners - self.bounds.mean(axis=0)
        return float(np.linalg.det(centred).sum() / 6.0)

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest corner of the axis-parallel bounding box, (2, 3)."""
        if not len(self.vertices):
            raise GeometryError("mesh: expected vertices, received none; it has no bounds")
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def diagonal(self) -> float:
        """Length of the diagonal of the bounding box, metres."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    @cached_property
    def watertight(self) -> bool:
        """True if every edge joins exactly two faces of opposite direction."""
        forward, backward = (np.sort(keys) for keys in _edge_keys(self))
        once = (np.diff(forward) > 0).all()
        return len(self.faces) > 0 and bool(once) and np.array_equal(forward, backward)

    @cached_property
    def _doubled_area_vectors(self) -> Array:
        first, second, third = np.moveaxis(self.corners, 1, 0)
        return np.cross(second - first, third - first)

    @cached_property
    def _corner_angles(self) -> Array:
        to_next = unit_or_zero(np.roll(self.corners, -1, axis=1) - self.corners)
        to_previous = unit_or_zero(np.roll(self.corners, 1, axis=1) - self.corners)
        cosine = np.einsum("fki,fki->fk", to_next, to_previous)
        return np.arccos(np.clip(cosine, -1.0, 1.0))


def unit_or_zero(vectors: ArrayLike) -> Array:
    """Vectors divided by their length; null vectors stay null.

    Parameters
    ----------
    vectors : (..., 3) array_like

    Returns
    -------
    (..., 3) float64

    Examples
    --------
    >>> unit_or_zero([[0, 0, 4], [0, 0, 0]])
    array([[0., 0., 1.],
           [0., 0., 0.]])
    """
    array = np.asarray(vectors, dtype=np.float64)
    lengths = np.linalg.norm(array, axis=-1, keepdims=True)
    return array / np.where(lengths > 0.0, lengths, 1.0)


def _edge_keys(mesh: Mesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """One number for each directed edge, and that of the opposite edge; (3 m,) each."""
    start = mesh.faces.ravel().astype(np.int64)
    end = np.roll(mesh.faces, -1, axis=1).ravel().astype(np.int64)
    n = len(mesh.vertices)
    return start * n + end, end * n + start


def without_unused_vertices(mesh: Mesh) -> Mesh:
    """Drop vertices that no face uses; the order of the others stays.

    Examples
    --------
    >>> mesh = Mesh([[9, 9, 9], [0, 0, 0], [2, 0, 0], [0, 1, 0]], [[1, 2, 3]])
    >>> without_unused_vertices(mesh).faces
    array([[0, 1, 2]], dtype=int32)
    """
    used, renumbered = np.unique(mesh.faces, return_inverse=True)
    return Mesh(mesh.vertices[used], renumbered.reshape(-1, 3).astype(np.int32))


def welded(mesh: Mesh) -> tuple[Mesh, NDArray[np.intp]]:
    """Join vertices at the same place, such as the two sides of a seam of texture coordinates.

    Returns
    -------
    Mesh
        Same faces, in the same order.
    joined : (n,) intp
        Its vertex for each vertex of the given mesh.

    Examples
    --------
    >>> fold = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]],
    ...             [[0, 1, 2], [3, 5, 4]])
    >>> len(welded(fold)[0].vertices)
    4
    """
    places, numbers = np.unique(mesh.vertices, axis=0, return_inverse=True)
    joined = numbers.reshape(-1)
    return Mesh(places, joined[mesh.faces].astype(np.int32)), joined


def without_degenerate_faces(mesh: Mesh) -> Mesh:
    """Drop faces that name a vertex twice and vertices left unused."""
    a, b, c = mesh.faces.T
    distinct = (a != b) & (b != c) & (c != a)
    return without_unused_vertices(Mesh(mesh.vertices, mesh.faces[distinct]))


def face_components(mesh: Mesh) -> NDArray[np.int32]:
    """Number of the connected component of each face, (m,) int32.

    Faces are connected when they share a vertex.

    Examples
    --------
    >>> two = Mesh(np.eye(3).repeat(2, axis=0), [[0, 2, 4], [1, 3, 5]])
    >>> face_components(two)
    array([0, 1], dtype=int32)
    """
    n = len(mesh.vertices)
    start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    graph = sparse.coo_array((np.ones(len(start), np.int8), (start, end)), shape=(n, n))
    of_vertex = csgraph.connected_components(graph.tocsr(), directed=False)[1]
    labels = np.unique(of_vertex[mesh.faces[:, 0]], return_inverse=True)[1]
    return labels.astype(np.int32)


def keep_large_components(mesh: Mesh, minimum_share: float = 0.01) -> Mesh:
    """Keep components that hold at least a share of the largest one's area.

    Parameters
    ----------
    mesh : Mesh
    minimum_share : float
        In [0, 1]; 1 keeps the largest component alone (and its equals).

    Returns
    -------
    Mesh
        Without the vertices of what was removed.
    """
    labels = face_components(mesh)
    areas = np.bincount(labels, mesh.face_areas)
    kept = areas >= minimum_share * areas.max()
    return without_unused_vertices(Mesh(mesh.vertices, mesh.faces[kept[labels]]))


def smooth(mesh: Mesh, iterations: int) -> Mesh:
    r"""Taubin's smoothing: removes ripples shorter than a few edges.

    Each iteration applies :math:`x \leftarrow x + \lambda L x` and
    :math:`x \leftarrow x + \mu L x` with the umbrella operator
    :math:`(Lx)_i = \mathrm{mean}_{j \in N(i)} x_j - x_i`, so that long
    wavelengths, and with them the volume, are kept.

    Parameters
    ----------
    mesh : Mesh
    iterations : int
        Pairs of steps; 0 returns the mesh as it is.

    Returns
    -------
    Mesh
        Same faces.

    References
    ----------
    G. Taubin, "A signal processing approach to fair surface design",
    SIGGRAPH 1995.
    """
    if iterations == 0:
        return mesh
    # Centred, so that a far origin costs no digits.
    origin = mesh.bounds.mean(axis=0)
    smoothed = trimesh.Trimesh(mesh.vertices - origin, mesh.faces, process=False)
    trimesh.smoothing.filter_taubin(
        smoothed, lamb=_TAUBIN_LAMBDA, nu=-_TAUBIN_MU, iterations=2 * iterations
    )
    return Mesh(np.asarray(smoothed.vertices) + origin, mesh.faces)


def decimate(mesh: Mesh, n_triangles: int) -> Mesh:
    """Fewer triangles by quadric edge collapse; a closed mesh stays closed.

    Open3D's collapse is taken: the ten times faster one of `fast-simplification` pinched
    ridges into edges of four faces and folded triangles over (14 on a hull of 20,000,
    which cost 18 charts more). Should the result be open, the mesh is returned as it came.

    Parameters
    ----------
    mesh : Mesh
    n_triangles : int
        Wanted number of faces; meshes that have no more are returned as they are.

    Returns
    -------
    Mesh

    References
    ----------
    M. Garland, P. Heckbert, "Surface simplification using quadric error
    metrics", SIGGRAPH 1997.
    """
    if len(mesh.faces) <= n_triangles:
        return mesh
    # Moved to a unit box at the origin, so that tolerances inside do not matter.
    origin, scale = mesh.bounds.mean(axis=0), mesh.diagonal
    dense = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector((mesh.vertices - origin) / scale),
        open3d.utility.Vector3iVector(mesh.faces),
    )
    reduced = dense.simplify_quadric_decimation(n_triangles)
    points = np.asarray(reduced.vertices) * scale + origin
    smaller = without_degenerate_faces(Mesh(points, np.asarray(reduced.triangles)))
    if len(smaller.faces) and (smaller.watertight or not mesh.watertight):
        return smaller
    return mesh


def write_ply(path: Path | str, mesh: Mesh) -> None:
    """Write vertices (double), normals (float) and faces as binary PLY.

    The file appears under its name only when complete. trimesh's writer is not used: it stores
    positions in single precision, which moves a georeferenced mesh (UTM) by up to 0.25 m.

    Parameters
    ----------
    path : Path or str
    mesh : Mesh
    """
    properties = dict(zip("xyz", mesh.vertices.T, strict=True))
    normals = dict(
        zip(("nx", "ny", "nz"), mesh.vertex_normals.T.astype(np.float32), strict=True)
    )
    comment = "metres, right-handed world, counter-clockwise from outside"
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as partial:
        partial.write_bytes(ply_bytes(properties | normals, mesh.faces, comment))


def ply_bytes(properties: Mapping[str, NDArray[Any]], faces: Faces, comment: str = "") -> bytes:
    """Content of a binary PLY file.

    Parameters
    ----------
    properties : mapping of str to (n,) float32 or float64
        Of the vertices.
    faces : (m, 3) int32
    comment : str
    """
    kinds = {
        name: "double" if v.dtype == np.float64 else "float" for name, v in properties.items()
    }
    stored = {"double": "<f8", "float": "<f4"}
    count = len(next(iter(properties.values())))
    vertices = np.zeros(count, [(name, stored[kind]) for name, kind in kinds.items()])
    for name, values in properties.items():
        vertices[name] = values
    corners = np.zeros(len(faces), [("count", "u1"), ("index", "<i4", 3)])
    corners["count"], corners["index"] = 3, faces
    header = [
        *(
            "ply",
            "format binary_little_endian 1.0",
            *([f"comment {comment}"] if comment else []),
        ),
        f"element vertex {count}",
        *(f"property {kind} {name}" for name, kind in kinds.items()),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    return "\n".join(header).encode("ascii") + vertices.tobytes() + corners.tobytes()


def read_ply(path: Path | str) -> Mesh:
    """Read the triangles of a PLY file, ASCII or binary.

    Raises
    ------
    InputError
        If the file is missing, is not a PLY file or holds no triangles.
    """
    try:
        loaded = trimesh.load_mesh(str(path), file_type="ply", process=False)
        vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces)
    except Exception as error:  # trimesh raises whatever its parser met
        raise InputError(
            f"{path}: expected a PLY mesh, received {type(error).__name__}: {error}; "
            "write the mesh again"
        ) from error
    if not len(faces):
        raise InputError(f"{path}: expected triangles, received none; write the mesh again")
    return Mesh(vertices, faces)
