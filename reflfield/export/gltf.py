"""The base mesh with a material of textures as one binary glTF 2.0 file."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation

from reflfield.errors import InputError
from reflfield.geometry.mesh import unit_or_zero
from reflfield.geometry.texels import frames, texture_axes
from reflfield.geometry.uv_atlas import Atlas
from reflfield.util.files import replacing
from reflfield.util.validation import check_shape

_FLOAT, _UINT = 5126, 5125
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views: what a GPU binds them as
# glTF holds single precision: beyond so many extents of the mesh from the origin its rounding
# would exceed a tenth of the step of a field's positions.
FAR_EXTENTS = 100.0
# Heights over the extent below which an object counts as flat, and radians that are no turn.
FLAT_EXTENTS, SMALLEST_TURN = 1e-3, 1e-12


@dataclass(frozen=True, eq=False)
class GltfMaterial:
    """A material as glTF describes it, with its textures.

    Parameters
    ----------
    description : dict
        The material; textures by their numbers in `textures`.
    textures : tuple of (height, width, 3 or 4) uint8
        Row 0 at v = 1; any size.
    extras : dict
        On the whole file, for `asset.extras`: plain JSON values.
    """

    description: dict[str, Any]
    textures: tuple[NDArray[np.uint8], ...]
    extras: dict[str, Any] = field(default_factory=dict)


def colour_material(
    base_colour: NDArray[np.uint8], name: str = "mean of all photographs", *, lit: bool = True
) -> GltfMaterial:
    """Rough dielectric of one texture of colours, or the colours as they are, not `lit`.

    Parameters
    ----------
    base_colour : (height, width, 3) uint8
        sRGB encoded, row 0 at v = 1; any size.
    name : str
    lit : bool
        Whether viewers light it.

    Raises
    ------
    InputError
        If the texture is not an 8-bit RGB image.
    """
    check_shape("base_colour", base_colour, (None, None, 3))
    if base_colour.dtype != np.uint8:
        raise InputError(
            f"base_colour: expected sRGB-encoded uint8, received {base_colour.dtype}; encode it"
        )
    surface = {
        "baseColorTexture": {"index": 0},
        "metallicFactor": 0.0,
        "roughnessFactor": 0.8,
    }
    description: dict[str, Any] = {"name": name, "pbrMetallicRoughness": surface}
    if not lit:
        description["extensions"] = {"KHR_materials_unlit": {}}
    return GltfMaterial(description, (base_colour,))


def write_glb(
    path: Path | str,
    atlas: Atlas,
    material: GltfMaterial,
    name: str = "reflfield",
    up: ArrayLike = (0.0, 1.0, 0.0),
) -> None:
    """Write mesh, normals, tangents, texture coordinates and a material.

    Opens in any glTF viewer. Texture coordinates are turned to glTF's convention
    (v downwards); tangents run along u, their fourth component is -1 in mirrored charts. The
    node turns the object to stand upright there, where +Y is up; a flat one that is seen from
    above faces the viewer, +Z. Of a mesh far from the origin, as in a survey's coordinates, the
    node's translation holds where its centre is.

    Parameters
    ----------
    path : Path or str
        Appears only when complete.
    atlas : Atlas
    material : GltfMaterial
    name : str
        Name of the node and mesh.
    up : (3,) array_like
        Direction that is up, in the mesh's coordinates.

    References
    ----------
    Khronos Group, "glTF 2.0 Specification", sections 3.7 and 4.
    """
    buffer = _Buffer()
    origin = far_origin(atlas.positions)
    attributes = {
        "POSITION": buffer.add((atlas.positions - origin).astype("<f4"), "VEC3", bounds=True),
        "NORMAL": buffer.add(unit_or_zero(atlas.normals).astype("<f4"), "VEC3"),
        "TANGENT": buffer.add(vertex_tangents(atlas).astype("<f4"), "VEC4"),
        "TEXCOORD_0": buffer.add((atlas.uv * [1.0, -1.0] + [0.0, 1.0]).astype("<f4"), "VEC2"),
    }
    indices = buffer.add(atlas.faces.astype("<u4").ravel(), "SCALAR", target=_INDICES)
    images = [buffer.add_bytes(_png(texture)) for texture in material.textures]
    document = _document(name, attributes, indices, images, _placed(atlas.positions, up))
    _add_material(document, material)
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as partial:
        partial.write_bytes(_glb(document | buffer.description(), bytes(buffer.content)))


def filled_texture(
    texel_of_pixel: NDArray[np.integer], values: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Texture (height, width, k) of a value per texel, the nearest one between charts."""
    nearest = ndimage.distance_transform_edt(
        texel_of_pixel < 0, return_distances=False, return_indices=True
    )
    return np.ascontiguousarray(values[texel_of_pixel[tuple(nearest)]])


def far_origin(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Translation of the mesh's node: zero, or the centre where single precision needs it.

    Examples
    --------
    >>> corners = np.array([[0.0, 0, 0], [2.0, 2, 2]])
    >>> far_origin(corners), far_origin(corners + 1e6)
    (array([0., 0., 0.]), array([1000001., 1000001., 1000001.]))
    """
    low, high = positions.min(axis=0), positions.max(axis=0)
    extent = float((high - low).max())
    is_far = np.abs(positions).max() > FAR_EXTENTS * extent
    return 0.5 * (low + high) if is_far else np.zeros(3)


def _placed(positions: NDArray[np.float64], up: ArrayLike) -> dict[str, list[float]]:
    """Rotation and translation of the node; without those that change nothing."""
    axis = np.asarray(up, dtype=np.float64)
    axis = axis / np.linalg.norm(axis)
    heights = (positions - positions.mean(axis=0)) @ axis
    is_flat = np.ptp(heights) < FLAT_EXTENTS * np.ptp(positions, axis=0).max()
    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0] if is_flat else [0.0, 1.0, 0.0]], [axis])
    placed = {"rotation": turn.as_quat(), "translation": turn.apply(far_origin(positions))}
    if turn.magnitude() < SMALLEST_TURN:
        del placed["rotation"]
    return {key: value.tolist() for key, value in placed.items() if value.any()}


def vertex_tangents(atlas: Atlas) -> NDArray[np.float64]:
    """Unit tangents along u and their handedness, (n, 4).

    The bitangent of glTF, ``cross(normal, tangent) * w``, then runs up the texture.
    """
    u_axis, _ = texture_axes(atlas)
    weighted = unit_or_zero(u_axis) * atlas.mesh.face_areas[:, None]
    total = np.zeros_like(atlas.positions)
    for corner in range(3):
        np.add.at(total, atlas.faces[:, corner], weighted)
    tangents = frames(unit_or_zero(atlas.normals), total)[:, 0]
    # By triangles, since a field's mesh is an atlas of one chart; vertices belong to one side.
    handedness = np.ones(len(tangents))
    handedness[atlas.faces[atlas.uv_areas < 0.0]] = -1.0
    return np.column_stack([tangents, handedness])


class _Buffer:
    """Binary chunk under construction, with its views and accessors."""

    def __init__(self) -> None:
        self.content = bytearray()
        self._views: list[dict[str, int]] = []
        self._accessors: list[dict[str, object]] = []

    def add(
        self,
        array: NDArray[np.generic],
        kind: str,
        *,
        target: int = _VERTICES,
        bounds: bool = False,
    ) -> int:
        """Append an array; returns the number of its accessor."""
        accessor: dict[str, object] = {
            "bufferView": self.add_bytes(array.tobytes(), target),
            "componentType": _UINT if array.dtype.kind == "u" else _FLOAT,
            "count": len(array),
            "type": kind,
        }
        if bounds:
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def add_bytes(self, content: bytes, target: int | None = None) -> int:
        """Append bytes, aligned to four; returns the number of their view."""
        view = {"buffer": 0, "byteOffset": len(self.content), "byteLength": len(content)}
        if target is not None:
            view["target"] = target
        self._views.append(view)
        self.content += content + b"\0" * (-len(content) % 4)
        return len(self._views) - 1

    def description(self) -> dict[str, object]:
        """Parts of the glTF document that describe the binary chunk."""
        return {
            "buffers": [{"byteLength": len(self.content)}],
            "bufferViews": self._views,
            "accessors": self._accessors,
        }


def _document(
    name: str,
    attributes: dict[str, int],
    indices: int,
    images: list[int],
    placed: dict[str, list[float]],
) -> dict[str, Any]:
    """Scene with one mesh, and textures for its material."""
    node: dict[str, object] = {"name": name, "mesh": 0, **placed}
    primitive = {"attributes": attributes, "indices": indices, "material": 0, "mode": 4}
    return {
        "asset": {"version": "2.0", "generator": "reflfield"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"name": name, "primitives": [primitive]}],
        "textures": [{"source": number, "sampler": 0} for number in range(len(images))],
        "samplers": [
            {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}
        ],  # linear, trilinear, clamped
        "images": [{"bufferView": image, "mimeType": "image/png"} for image in images],
    }


def _add_material(document: dict[str, Any], material: GltfMaterial) -> None:
    document["materials"] = [material.description]
    if extensions := sorted(material.description.get("extensions", {})):
        document["extensionsUsed"] = extensions
    if material.extras:
        document["asset"]["extras"] = material.extras


def _png(pixels: NDArray[np.uint8]) -> bytes:
    stream = BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, format="PNG")
    return stream.getvalue()


def _glb(document: dict[str, object], binary: bytes) -> bytes:
    """Container of the two chunks, JSON (padded with spaces) and BIN."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
