"""Meshes with texture coordinates, from files of other software."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.geometry.mesh import Mesh, welded
from reflfield.util.files import read_bytes
from reflfield.util.late_import import LateImport
from reflfield.util.validation import check_shape

trimesh: Any = LateImport("trimesh")

SUFFIXES = (".obj", ".glb")
MOST_BYTES = 1 << 30


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A mesh whose triangles lie on a texture.

    Parameters
    ----------
    mesh : Mesh
        Vertices at one place are one.
    corner_uv : (n_faces, 3, 2) float64
        Texture coordinates of each corner, v up; any numbers.
    """

    mesh: Mesh
    corner_uv: NDArray[np.float64]

    def __post_init__(self) -> None:
        check_shape("corner_uv", self.corner_uv, (len(self.mesh.faces), 3, 2))
        if not np.isfinite(self.corner_uv).all():
            raise InputError("corner_uv: expected finite texture coordinates")


def read_textured_mesh(path: Path | str) -> TexturedMesh:
    """Read the triangles of a Wavefront or binary glTF file, all its parts as one.

    Files that it names, such as textures, are not opened.

    Raises
    ------
    InputError
        If the file is missing, of another kind, or holds no triangles or no texture
        coordinates.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{file}: expected a mesh as {' or '.join(SUFFIXES)}")
    content = read_bytes(file, MOST_BYTES)
    try:
        scene = trimesh.load_scene(io.BytesIO(content), file_type=suffix[1:], process=False)
        parts = [one for one in scene.dump() if isinstance(one, trimesh.Trimesh)]
        corners = [np.asarray(one.triangles, np.float64) for one in parts]
        uv = [_uv(one)[np.asarray(one.faces)] for one in parts]
    except Exception as error:  # trimesh raises whatever its parser met
        raise InputError(
            f"{file}: expected a mesh with texture coordinates, received "
            f"{type(error).__name__}: {error}; write it again with UVs"
        ) from error
    if not sum(map(len, corners)):
        raise InputError(f"{file}: expected triangles, received none")
    points = np.concatenate(corners).reshape(-1, 3)
    apart = Mesh(points, np.arange(len(points)).reshape(-1, 3).astype(np.int32))
    return TexturedMesh(welded(apart)[0], np.concatenate(uv).astype(np.float64))


def _uv(part: Any) -> NDArray[np.float64]:
    uv = getattr(part.visual, "uv", None)
    if uv is None or len(uv) != len(part.vertices):
        raise ValueError("no texture coordinates")
    return np.asarray(uv, np.float64)
