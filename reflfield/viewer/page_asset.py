"""A field as the page's script reads it: a JSON header and blocks of packed arrays.

The arrays are those of the field file, still quantised: what a browser unpacks by itself is
deflate, so each array is made small for that (differences along axes, bytes of one significance
together) and decoded by the script as `field` does. Two blocks: the surface with a preview of
its colours, which gives the first picture, and all the rest.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.encoding import encode_srgb
from reflfield.field.array_schemas import INDIRECT_ARRAYS, SCHEMAS
from reflfield.field.build import indirect_arrays
from reflfield.field.evaluation import evaluate
from reflfield.field.observed_sphere import covered, table_directions
from reflfield.field.reflectance_field import ClusteredField, ReflectanceField
from reflfield.geometry.mesh import Mesh
from reflfield.options import available_cores
from reflfield.viewer.baked_shadows import baked_indirect

FORMAT, VERSION = "reflfield-object", 1
FIRST_ARRAYS = ("positions", "position_box", "faces", "uv", "uv_box")
# Largest side of the preview, pixels.
PREVIEW_SIDE = 256
# Steps of the table of indirect light from 0 to the largest value of a function.
TABLE_STEPS = 511
PREVIEW_PERCENTILE = 99.0
# Level 9 takes seven times as long for a page that is 4 % smaller (a plate of 800 x 800).
PACKING_LEVEL = 6
# Of the distances between hull and surface, that full colour stands for, and codes up to it.
MOVED_PERCENTILE, MOVED_STEPS = 95.0, 127


@dataclass(frozen=True)
class PackedBlock:
    """Arrays in one stream.

    Parameters
    ----------
    content : bytes
        The arrays one after another, zlib-compressed.
    entries : tuple of dict
        Name, dtype, shape, start (in the uncompressed bytes), axes of differences, and whether
        bytes are sorted by significance, of each array.
    size : int
        Uncompressed bytes.
    """

    content: bytes
    entries: tuple[dict[str, Any], ...]
    size: int


@dataclass(frozen=True)
class PageAsset:
    """What the page holds of a field: the header and two blocks."""

    header: dict[str, Any]
    blocks: tuple[PackedBlock, ...]


def page_asset(field: ReflectanceField, moved: NDArray[np.floating] | None = None) -> PageAsset:
    """Header and packed arrays of a field.

    Parameters
    ----------
    field : ReflectanceField
    moved : (n_vertices,) float, optional
        How far the surface lies outside of the hull that it was made from.

    Returns
    -------
    PageAsset
    """
    first: dict[str, NDArray[Any]] = {name: field.arrays[name] for name in FIRST_ARRAYS}
    first["preview"] = texel_image(field, -(-max(field.texel_of_pixel.shape) // PREVIEW_SIDE))
    mesh = Mesh(field.positions, field.faces)
    shown = {}
    if moved is not None:
        first["moved"], shown["moved"] = _moved_codes(moved, mesh.diagonal)
    rest = {n: field.arrays[n] for n in SCHEMAS[field.model] if n not in FIRST_ARRAYS}
    rest = {name: array for name, array in rest.items() if name not in INDIRECT_ARRAYS}
    has_indirect = field.visibility == "factored" and not field.indirect.is_black
    if has_indirect:
        rest |= _indirect_arrays(field)
    if field.observed_lights is not None and len(field.observed_lights):
        rest["light_covered"] = _light_covered(field.observed_lights)
    blocks = packed_block(first), packed_block(rest)
    header = (
        _header(field, mesh, has_indirect)
        | shown
        | {"blocks": [{"bytes": block.size, "arrays": list(block.entries)} for block in blocks]}
    )
    return PageAsset(header, blocks)


def texel_colours(field: ReflectanceField) -> NDArray[np.uint8]:
    """Colour of every texel seen and lit from straight above, sRGB-encoded, (n_texels, 3)."""
    normals = np.ascontiguousarray(field.local_from_world[:, 2])
    texels = np.arange(field.n_texels, dtype=np.int32)
    samples = evaluate(field, texels, normals, normals)
    white = float(np.percentile(samples.max(axis=1, initial=0.0), PREVIEW_PERCENTILE))
    exposed = np.clip(samples / (white or 1.0), 0.0, 1.0)
    return np.rint(np.asarray(encode_srgb(exposed)) * 255).astype(np.uint8)


def texel_image(field: ReflectanceField, step: int = 1) -> NDArray[np.uint8]:
    """Texture of `texel_colours`, every n-th pixel of it, (height, width, 3); 0 where none."""
    texels = field.texel_of_pixel[::step, ::step]
    image = texel_colours(field)[np.maximum(texels, 0)]
    return np.where(texels[..., None] >= 0, image, np.uint8(0))


def packed_block(arrays: Mapping[str, NDArray[Any]]) -> PackedBlock:
    """Arrays in one stream, each in the way that packs it best.

    Examples
    --------
    >>> block = packed_block({"ramp": np.arange(1000, dtype=np.int32)})
    >>> block.entries[0]["delta"], block.size, len(block.content) < 100
    ([0], 4000, True)
    """
    entries, parts, start = [], [], 0
    for name, values in arrays.items():
        array = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"))
        content, way = min(_packings(array), key=lambda one: len(zlib.compress(one[0], 1)))
        entry = {"name": name, "dtype": array.dtype.name, "shape": list(array.shape)}
        entries.append({**entry, **way, "start": start})
        parts.append(content)
        start += len(content)
    return PackedBlock(zlib.compress(b"".join(parts), PACKING_LEVEL), tuple(entries), start)


def _packings(array: NDArray[Any]) -> Iterator[tuple[bytes, dict[str, Any]]]:
    """Bytes of an array in each of the ways that the script can undo."""
    axes: list[list[int]] = [[]]
    if array.dtype.kind in "iu" and array.size:
        axes += [[0]] + ([[0, 1]] if array.ndim > 1 else []) + ([[1]] if array.ndim > 1 else [])
    for delta, planes in product(axes, (False, True)):
        differences = array
        for axis in delta:
            # Wraps around, as the sums of the script do.
            differences = np.diff(differences, axis=axis, prepend=array.dtype.type(0))
        contiguous = np.ascontiguousarray(differences)
        whole = contiguous.reshape(-1).view(np.uint8).reshape(-1, array.itemsize)
        yield (whole.T if planes else whole).tobytes(), {"delta": delta, "planes": planes}


def _moved_codes(
    moved: NDArray[np.floating], size: float
) -> tuple[NDArray[np.int8], dict[str, float]]:
    """Distances over that of full colour, and the share of the size that this one is."""
    full = float(np.percentile(np.abs(moved), MOVED_PERCENTILE)) or float(np.abs(moved).max())
    shares = np.clip(moved / (full or 1.0), -1.0, 1.0)
    return np.rint(shares * MOVED_STEPS).astype(np.int8), {"share_of_size": full / size}


def _header(field: ReflectanceField, mesh: Mesh, has_indirect: bool) -> dict[str, Any]:
    sides = [field.view_side, field.light_side] if isinstance(field, ClusteredField) else [0, 0]
    return {
        "format": FORMAT,
        "version": VERSION,
        "model": field.model,
        "power": field.inverse_power,
        "traced": field.visibility == "factored",
        "known_light": field.light_model == "known",
        "indirect": has_indirect,
        "sides": sides,
        "up": field.up.tolist(),
        "texel_width": float(np.sqrt(mesh.area / field.n_texels)),
    }


def _indirect_arrays(field: ReflectanceField) -> dict[str, NDArray[Any]]:
    """Functions of indirect light at the nodes of a table over the sphere, and coefficients."""
    nodes = table_directions()
    light = baked_indirect(field, available_cores())
    stored = indirect_arrays(light, field.n_texels, float(field.arrays["indirect_scale"][0]))
    values = light.at(nodes.reshape(-1, 3))
    table = np.moveaxis(values.reshape(*nodes.shape[:2], -1), 2, 0)
    scale = np.abs(table).max(axis=(1, 2), initial=0.0) / TABLE_STEPS
    steps = np.where(scale > 0, scale, 1.0)[:, None, None]
    return {
        "indirect_table": np.rint(table / steps).astype(np.int16),
        "indirect_table_scale": scale.astype(np.float32),
        "indirect_coefficients": stored["indirect_coefficients"],
        "indirect_scale": stored["indirect_scale"],
    }


def _light_covered(observed: NDArray[np.float64]) -> NDArray[np.uint8]:
    """1 at the nodes of the sphere's table that lie between observed lights."""
    nodes = table_directions()
    return covered(nodes.reshape(-1, 3), observed).reshape(nodes.shape[:2]).astype(np.uint8)
