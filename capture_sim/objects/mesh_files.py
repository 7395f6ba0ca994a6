"""Objects from mesh files, with the normals and tangents that they lack."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from capture_sim.errors import SceneError, scene_error
from capture_sim.inputs import check_memory, check_regular, read_bytes
from capture_sim.objects.gltf import FolderResolver, check_gltf
from capture_sim.objects.mesh import (
    Array,
    Faces,
    SurfaceMesh,
    check_size,
    unit,
    without_slivers,
)
from capture_sim.objects.repair import places, repaired
from capture_sim.objects.wavefront import plain_obj, rewritten_obj
from capture_sim.tables import TableReader

LARGEST_FILE = 4 << 30
# Memory that reading takes for each byte of a file of this kind, measured; text is taken apart.
BYTES_PER_BYTE = {"obj": 12, "ply": 14, "stl": 12, "off": 20, "glb": 12, "gltf": 12}
MOST_FACES = 20_000_000
_ELEMENTS = (b"vertex", b"face")


def mesh_from_file(reader: TableReader, folder: Path) -> SurfaceMesh:
    """Mesh file, turned, centred, scaled and moved."""
    path = reader.file("file", folder)
    parts = read_mesh(path)
    check_size(path.name, len(parts[1]))
    triangles = repaired(*parts)
    if len(triangles.faces) == 0:
        raise scene_error(reader.name("file"), "triangles with an area", f"none in {path}")
    vertices = triangles.vertices
    rotation = Rotation.from_euler(
        "xyz", reader.vector("rotation_deg", (0, 0, 0), low=-1e6, high=1e6), degrees=True
    )
    vertices = rotation.apply(vertices)
    if reader.flag("centre", True):
        vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    extent = float(np.ptp(vertices, axis=0).max())
    scale = reader.number("scale", 1.0, low=1e-9, high=1e9)
    size = reader.number("size", extent * scale, low=1e-9, high=1e9)
    vertices = vertices * (size / extent) + reader.vector(
        "position", (0, 0, 0), low=-1e9, high=1e9
    )
    smooth = reader.flag("smooth", True)
    mesh = finish_mesh(vertices, triangles.faces, triangles.uv, path.name, smooth=smooth)
    return replace(mesh, notes=tuple(f"{path.name}: {note}" for note in triangles.notes))


def read_mesh(path: Path) -> tuple[Array, Faces, Array | None]:
    """Vertices, faces and texture coordinates of a mesh file.

    Parameters
    ----------
    path : Path
        OBJ, PLY, STL, OFF or glTF file.

    Returns
    -------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    uv : (n, 2) float64 or None
        None if the file holds none.

    Raises
    ------
    SceneError
        If the file is of another kind, cannot be read, is empty or damaged, or holds values
        that are not finite.
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind not in BYTES_PER_BYTE:
        kinds = ", ".join(name.upper() for name in BYTES_PER_BYTE)
        raise scene_error(str(path), f"a mesh file ({kinds})", f"{kind.upper() or 'none'}")
    check_memory(str(path), BYTES_PER_BYTE[kind] * check_regular(path))
    content = read_bytes(path, LARGEST_FILE)
    mesh = _parsed(content, kind, path)
    vertices = np.array(mesh.vertices, np.float64).reshape(-1, 3)
    faces = np.array(getattr(mesh, "faces", ()), np.int64).reshape(-1, 3)
    if not 0 < len(faces) <= MOST_FACES:
        raise scene_error(str(path), f"1 to {MOST_FACES} triangles", len(faces))
    inside = (faces >= 0).all() and (faces < len(vertices)).all()
    if not inside or not np.isfinite(vertices).all() or not np.ptp(vertices):
        raise scene_error(str(path), "finite vertices and faces among them", "others")
    if kind in ("ply", "off"):
        _check_counts(content, kind, (len(vertices), len(faces)), path)
    return vertices, faces.astype(np.int32), _coordinates(mesh, len(vertices))


def _parsed(content: bytes, kind: str, path: Path) -> Any:
    """Mesh of the bytes of a file, by `trimesh`."""
    if kind == "obj":
        content = plain_obj(content, path)
    elif kind in ("glb", "gltf"):
        check_gltf(content, kind, path, MOST_FACES)
    try:
        return trimesh.load(
            io.BytesIO(content), file_type=kind, force="mesh", process=False,
            skip_materials=True, resolver=FolderResolver(path.parent),
        )  # fmt: skip
    except SceneError:
        raise
    except Exception as error:  # trimesh raises whatever its parsers meet
        if kind == "obj":
            rewritten_obj(content, path)  # names the line that is wrong
        raise scene_error(
            str(path),
            f"a whole {kind.upper()} file",
            f"a damaged, truncated or different one ({type(error).__name__})",
            "export it again",
        ) from error


def _check_counts(content: bytes, kind: str, mesh: tuple[int, int], path: Path) -> None:
    """Demand all vertices and faces that the header of a PLY or OFF file promises."""
    if kind == "ply":
        header = content[: content.find(b"end_header")]
        lines = [re.search(rb"element[ \t]+%s[ \t]+(\d{1,18})" % n, header) for n in _ELEMENTS]
        promised = tuple(0 if line is None else int(line[1]) for line in lines)
    else:
        counts = re.match(rb"\s*[A-Z]*OFF\s+(?:#.*\s+)*(\d{1,18})\s+(\d{1,18})", content)
        promised = (0, 0) if counts is None else (int(counts[1]), int(counts[2]))
    for name, wanted, count in zip(_ELEMENTS, promised, mesh, strict=True):
        if wanted > count:
            raise scene_error(
                str(path),
                f"{wanted} elements '{name.decode()}', as the header says",
                count,
                "the file is not whole: export it again",
            )


def _coordinates(mesh: Any, n_vertices: int) -> Array | None:
    """Texture coordinates of a mesh if it has a usable one for each vertex."""
    uv = getattr(mesh.visual, "uv", None)
    if uv is None or np.shape(uv) != (n_vertices, 2) or not np.isfinite(uv).all():
        return None
    return np.array(uv, np.float64)


def finish_mesh(
    vertices: Array, faces: Faces, uv: Array | None, name: str, *, smooth: bool = True
) -> SurfaceMesh:
    """Mesh with normals and tangents made from its triangles and coordinates.

    Parameters
    ----------
    vertices : (n, 3) float64
        Metres.
    faces : (m, 3) int32
        Counter-clockwise seen from outside.
    uv : (n, 2) float64, optional
        Texture coordinates.
    name : str
        Name of the mesh.
    smooth : bool
        True for angle-weighted mean normals over all vertices in one place (seams of
        the coordinates stay smooth), False for flat triangles.

    Returns
    -------
    SurfaceMesh

    Examples
    --------
    >>> corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    >>> flat = finish_mesh(corners, np.array([[0, 1, 2]], np.int32), corners[:, :2], "a")
    >>> flat.normals[0], flat.tangents[0]
    (array([0., 0., 1.]), array([1., 0., 0.]))
    """
    faces = without_slivers(vertices, faces)
    coordinates = np.zeros((len(vertices), 2)) if uv is None else uv
    if not smooth:  # no triangle shares a vertex with another
        vertices, coordinates = vertices[faces.ravel()], coordinates[faces.ravel()]
        faces = np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    normals = _normals(vertices, faces, places(vertices) if smooth else faces.ravel())
    return SurfaceMesh(
        vertices=vertices,
        faces=faces,
        uv=coordinates,
        normals=normals,
        tangents=_tangents(vertices, faces, coordinates, normals),
        has_uv=uv is not None,
        name=name,
    )


def _normals(vertices: Array, faces: Faces, places: NDArray[np.integer[Any]]) -> Array:
    """Angle-weighted normals, shared by all vertices of a place; (n, 3)."""
    corners = vertices[faces]
    ahead = unit(np.roll(corners, -1, axis=1) - corners)
    back = unit(np.roll(corners, 1, axis=1) - corners)
    angle = np.arccos(np.clip(np.sum(ahead * back, axis=2), -1.0, 1.0))
    normal = unit(np.cross(ahead[:, 0], back[:, 0]))
    total = _scatter(places[faces], normal[:, None] * angle[..., None], len(vertices))
    normals = unit(total[places])
    normals[np.linalg.norm(normals, axis=1) < 0.5] = [0.0, 0.0, 1.0]  # vertices of no face
    return normals


def _tangents(vertices: Array, faces: Faces, uv: Array, normals: Array) -> Array:
    """Area-weighted dP/du made orthogonal to the normals; any direction without it."""
    edges = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    steps = uv[faces[:, 1:]] - uv[faces[:, :1]]
    determinant = steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 1, 0] * steps[:, 0, 1]
    rise = edges[:, 0] * steps[:, 1, 1:] - edges[:, 1] * steps[:, 0, 1:]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1, keepdims=True)
    per_face = unit(rise) * np.sign(determinant)[:, None] * area
    total = _scatter(faces, np.repeat(per_face[:, None], 3, axis=1), len(vertices))
    tangents = total - np.sum(total * normals, axis=1, keepdims=True) * normals
    lost = np.linalg.norm(tangents, axis=1) <= 1e-6 * np.linalg.norm(total, axis=1)
    away = np.eye(3)[np.argmin(np.abs(normals[lost]), axis=1)]
    tangents[lost] = np.cross(away, normals[lost])
    return unit(tangents)


def _scatter(index: NDArray[np.integer[Any]], values: Array, n_rows: int) -> Array:
    """Sum of `values` (m, 3, 3) over equal entries of `index` (m, 3), (n_rows, 3)."""
    columns = values.reshape(-1, 3).T
    return np.stack([np.bincount(index.ravel(), c, n_rows) for c in columns], axis=1)
