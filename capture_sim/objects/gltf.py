"""What a glTF file asks for, looked at before its parser gives it.

An accessor without data stands for zeros, as many as it says; nodes may show one mesh many
times; buffers may be other files. A few bytes could ask for all memory, or for any file.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from trimesh.resolvers import Resolver

from capture_sim.errors import scene_error
from capture_sim.inputs import read_bytes

# Of a buffer in a file of its own, and of the description of the whole.
LARGEST_BUFFER = 4 << 30
LARGEST_DESCRIPTION = 64 << 20
_VALUES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def check_gltf(content: bytes, kind: str, path: Path, most_faces: int) -> None:
    """Demand a description of a mesh of bounded size.

    Parameters
    ----------
    content : bytes
    kind : {"glb", "gltf"}
    path : Path
        Named in messages.
    most_faces : int
        Of all nodes together.

    Raises
    ------
    SceneError
        If the file is damaged or too large.
    """
    try:
        tree = json.loads(_description(content) if kind == "glb" else content)
        n_faces = _faces_shown(tree)
        n_values = sum(
            int(a["count"]) * _VALUES[a["type"]] for a in _entries(tree, "accessors")
        )
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError,
            OverflowError, struct.error) as error:  # fmt: skip
        raise scene_error(
            str(path),
            f"a whole {kind.upper()} file",
            "a damaged, truncated or different one",
            "export it again",
        ) from error
    if n_faces > most_faces:
        raise scene_error(str(path), f"1 to {most_faces} triangles", f"{n_faces}")
    # Three corners, each of position, normal, coordinates and more: 48 values a triangle.
    if n_values > 48 * most_faces:
        raise scene_error(str(path), f"at most {48 * most_faces} values", f"{n_values}")


def _description(content: bytes) -> bytes:
    """JSON of a binary glTF file of version 2."""
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", content)
    if magic != b"glTF" or version != 2 or length > len(content) or kind != b"JSON":
        raise ValueError("no binary glTF 2")
    if size > min(LARGEST_DESCRIPTION, len(content) - 20):
        raise ValueError("longer than the file")
    return content[20 : 20 + size]


def _entries(tree: Mapping[str, Any], key: str) -> list[Any]:
    entries = tree.get(key, [])
    if not isinstance(entries, list):
        raise TypeError(key)
    return entries


def _faces_shown(tree: Mapping[str, Any]) -> int:
    """Triangles of all nodes together."""
    accessors = _entries(tree, "accessors")
    per_mesh = [
        sum(_faces(primitive, accessors) for primitive in mesh["primitives"])
        for mesh in _entries(tree, "meshes")
    ]
    shown = [node["mesh"] for node in _entries(tree, "nodes") if "mesh" in node]
    return sum(per_mesh[index] for index in shown)


def _faces(primitive: Mapping[str, Any], accessors: list[Any]) -> int:
    index = primitive.get("indices", primitive["attributes"].get("POSITION"))
    count = 0 if index is None else accessors[index]["count"]
    if count < 0 or count != math.floor(count):
        raise ValueError("count")
    return int(count) // 3


class FolderResolver(Resolver):  # type: ignore[misc]  # trimesh carries no types
    """Files beside a mesh that it names: regular ones, inside its folder.

    Parameters
    ----------
    folder : Path
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, key: str) -> bytes:
        """Bytes of a file by its name relative to the folder."""
        path = self._folder / unquote(key)
        if not path.resolve().is_relative_to(self._folder.resolve()):
            raise scene_error(str(path), "a file inside the mesh's folder", "one outside")
        return read_bytes(path, LARGEST_BUFFER)

    def keys(self) -> list[str]:
        """No names are offered: meshes name what they need."""
        return []

    def namespaced(self, namespace: str) -> FolderResolver:
        """Resolver of a folder inside."""
        return FolderResolver(self._folder / namespace)

    def write(self, name: str, data: Any) -> None:
        """Refuse: meshes are only read."""
        raise scene_error(
            str(self._folder / name), "a mesh that is only read", "one that writes files"
        )
