"""A flat field as the material of another mesh.

Each texel of the mesh gets the model of the texel of the flat field that lies there on the
texture, and its frame, turned from the axes of the texture (u, v, off the plane) to the mesh's
tangent, binormal and normal. Shadows of the mesh are traced.

References
----------
G. Müller, R. Sarlette, R. Klein, "Data-driven Local Coordinate Systems for Image-Based
Rendering", Eurographics 2006, figure 8.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from reflfield.errors import InputError
from reflfield.field.array_schemas import INDIRECT_ARRAYS, SCHEMAS
from reflfield.field.build import BaseSurface, indirect_arrays, surface_arrays
from reflfield.field.quantisation import codes_from_rotations
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.texels import TexelTable, frames, texel_table, texture_axes
from reflfield.geometry.textured_mesh import TexturedMesh
from reflfield.geometry.uv_atlas import Atlas, AtlasOptions, built_atlas
from reflfield.render.camera_rays import FieldSurface

Doubles = NDArray[np.float64]

# Length of the mean normal of a surface that counts as flat.
_FLAT = 0.999
# Side of the mesh's texture, texels; half of them are used.
_LEAST_SIDE, MOST_SIDE = 64, 2048


def draped_field(
    field: ReflectanceField, target: TexturedMesh, tiles: float = 1.0
) -> ReflectanceField:
    """Return a field in memory with the surface of a mesh and the material of a flat field.

    Parameters
    ----------
    field : ReflectanceField
        Flat, of a known light.
    target : TexturedMesh
    tiles : float
        How often the flat field is repeated along each axis of the texture.

    Returns
    -------
    ReflectanceField
        Of the model of `field`. Nothing is known of light that the mesh sends to itself: in
        shadow it is black.

    Raises
    ------
    InputError
        If the field is not flat, its light is unknown, or `tiles` is not positive.
    """
    _check(field, tiles)
    surface = FieldSurface(field)
    side = _texture_side(field, target, tiles)
    atlas = built_atlas(target.mesh, AtlasOptions(resolution=side)).atlas
    table = texel_table(atlas)
    weights = table.barycentric.astype(np.float64)
    uv = np.einsum("nk,nkd->nd", weights, target.corner_uv[table.face])
    source = _texels_at(field, tiles * uv)
    turned = surface.local_from_texture[source] @ _texture_frames(target, table)
    arrays = dict(field.arrays)
    for name, (_, axes) in SCHEMAS[field.model].items():
        if axes[0] == "n_texels" and name not in INDIRECT_ARRAYS:
            arrays[name] = np.ascontiguousarray(field.arrays[name][source])
    arrays |= surface_arrays(
        BaseSurface(atlas.positions, atlas.faces, atlas.uv, table.texel_of_pixel)
    )
    arrays["turns"] = codes_from_rotations(turned, float(field.arrays["turn_step"][0]))
    arrays |= indirect_arrays(None, len(table), 1.0)
    kept = {n: field.metadata[n] for n in ("capture",) if n in field.metadata}
    return replace(field, arrays=arrays, visibility="factored", metadata=kept)


def _check(field: ReflectanceField, tiles: float) -> None:
    if not 0 < tiles <= 1e4:
        raise InputError(f"tiles: expected more than 0, at most 10000, received {tiles}")
    if field.light_model == "unknown":
        raise InputError(
            "field: expected one of known lights, received one that was photographed in an "
            "unknown light: it cannot be lit anew"
        )
    mesh = Mesh(field.positions, field.faces)
    if np.linalg.norm(mesh.face_areas @ mesh.face_normals) < _FLAT * mesh.area:
        raise InputError(
            "field: expected a flat one, of a capture whose base geometry is a plane, to be "
            "the material of another mesh, received one of a solid object"
        )


def _texture_side(field: ReflectanceField, target: TexturedMesh, tiles: float) -> int:
    """Side of a texture whose texels are about as dense as those of the flat field."""
    first, second, third = np.moveaxis(target.corner_uv, 1, 0)
    (a1, b1), (a2, b2) = (second - first).T, (third - first).T
    tiled = tiles**2 * 0.5 * float(np.abs(a1 * b2 - a2 * b1).sum())
    if not tiled > 0:
        raise InputError("mesh: expected texture coordinates that cover an area, received none")
    wanted = np.sqrt(2.0 * tiled * field.n_texels)
    return int(np.clip(np.ceil(wanted), _LEAST_SIDE, MOST_SIDE))


def _texels_at(field: ReflectanceField, uv: Doubles) -> NDArray[np.int32]:
    """Nearest texels of the repeated flat field, (n,)."""
    texels = field.texel_of_pixel
    nearest = ndimage.distance_transform_edt(
        texels < 0, return_distances=False, return_indices=True
    )
    height, width = texels.shape
    repeated = uv - np.floor(uv)
    column = np.minimum((repeated[:, 0] * width).astype(int), width - 1)
    row = np.minimum(((1.0 - repeated[:, 1]) * height).astype(int), height - 1)
    return texels[tuple(nearest)][row, column]


def _texture_frames(target: TexturedMesh, table: TexelTable) -> Doubles:
    """Rows tangent along u, binormal and smooth normal of texels, (n, 3, 3).

    Right-handed also where the texture is mirrored; the material then is not.
    """
    n_corners = 3 * len(target.corner_uv)
    low, high = target.corner_uv.min(axis=(0, 1)), target.corner_uv.max(axis=(0, 1))
    apart = Atlas(  # only for its derivatives, which keep their directions
        positions=target.mesh.corners.reshape(-1, 3),
        faces=np.arange(n_corners).reshape(-1, 3).astype(np.int32),
        uv=((target.corner_uv - low) / (high - low).max()).reshape(-1, 2).clip(0.0, 1.0),
        chart=np.zeros(len(target.corner_uv), np.int32),
        normals=np.zeros((n_corners, 3)),
        height=1,
        width=1,
    )
    along, _ = texture_axes(apart)
    return frames(table.normal.astype(np.float64), along[table.face])
