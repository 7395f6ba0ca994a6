"""Maps of glTF's material, fitted to a field texel by texel, and how far they are from it.

All maps have the field's own texture and are 8-bit images as glTF stores them; between charts
they repeat the nearest texel, for viewers that shrink them. Their error is that of the maps as
they are stored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.encoding import decode_srgb, encode_srgb
from reflfield.errors import InputError
from reflfield.export.coherent_signs import coherent_signs
from reflfield.export.gltf import GltfMaterial, filled_texture, vertex_tangents
from reflfield.export.microfacet_fit import (
    MicrofacetFit,
    direction_pairs,
    fit_microfacets,
    texel_samples,
)
from reflfield.export.microfacets import DIELECTRIC_F0, MicrofacetMaterial
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.geometry.mesh import Mesh, unit_or_zero, welded
from reflfield.geometry.uv_atlas import Atlas
from reflfield.render.camera_rays import FieldSurface, field_atlas

Doubles = NDArray[np.float64]
Bytes = NDArray[np.uint8]

# Texels and pairs of directions that errors are measured with.
_MEASURED_TEXELS, _MEASURED_PAIRS, _MEASURED_SEED = 4096, 64, 1
# Share of the light that the brightest texels reflect; less only if all are darker.
_MOST_REFLECTED, _BRIGHT_PERCENTILE = 0.9, 99.5
_LEAST_NORMAL_Z = 0.02
_BRIGHTNESS = np.array([0.299, 0.587, 0.114])


@dataclass(frozen=True, eq=False)
class MaterialMaps:
    """Textures of a material, (height, width, 3 or 4) uint8 each, row 0 at v = 1.

    Parameters
    ----------
    base_colour : (height, width, 3) uint8
        sRGB-encoded share of `base_factor`.
    metallic_roughness : (height, width, 3) uint8
        Roughness in the second channel, metallic in the third.
    normal : (height, width, 3) uint8
        Of the mesh's tangent space, y up the texture.
    anisotropy : (height, width, 3) uint8
        Direction along which highlights stretch, and strength.
    specular : (height, width, 4) uint8
        sRGB-encoded share of `specular_factor`, and how much of a dielectric's reflection
        there is.
    mirrored : (height, width) bool
        Where the texture shows the surface mirrored: turning about the normal from the tangent
        then leads down the texture.
    base_factor, specular_factor : float
        Largest base colour and specular colour.
    exposure : float
        Factor from the field's samples to those of the material.
    errors : dict
        Plain JSON values; see `map_errors`.
    """

    base_colour: Bytes
    metallic_roughness: Bytes
    normal: Bytes
    anisotropy: Bytes
    specular: Bytes
    mirrored: NDArray[np.bool_]
    base_factor: float
    specular_factor: float
    exposure: float
    errors: dict[str, Any]

    def lines(self) -> list[str]:
        """What to say of the maps."""
        said = [
            f"maps: error {100 * self.errors['relative']:.1f} % of the field over all "
            f"directions (median of texels {100 * self.errors['median_of_texels']:.1f} %), "
            f"{100 * self.errors['relative_near_highlights']:.1f} % near highlights"
        ]
        if self.exposure < 1.0:
            said.append(
                f"maps: darker than the field by {self.exposure:.4g}: in the unit of the "
                "capture's lamps the object reflects more light than arrives"
            )
        return said


@dataclass(frozen=True, eq=False)
class TextureFrames:
    """Axes of the mesh's tangent space at each texel, as viewers interpolate them.

    Parameters
    ----------
    axes : (n, 3, 3) float64
        Columns tangent, bitangent and normal in the world: unit vectors, nearly orthogonal.
    outward : (n, 3) float64
        Normals of the triangles.
    """

    axes: Doubles
    outward: Doubles

    @property
    def mirrored(self) -> Bytes:
        """1 at texels of mirrored charts, (n,)."""
        return (np.linalg.det(self.axes) < 0.0).astype(np.uint8)

    def coordinates(self, world: Doubles) -> Doubles:
        """Coordinates of world vectors, (n, 3)."""
        return np.asarray(np.linalg.solve(self.axes, world[:, :, None])[:, :, 0], np.float64)

    def world(self, coordinates: Doubles) -> Doubles:
        """Unit vectors in the world of coordinates, (n, 3)."""
        return unit_or_zero(np.einsum("nij,nj->ni", self.axes, coordinates))


def export_atlas(field: ReflectanceField) -> Atlas:
    """Mesh of a field with its texture coordinates, smooth across the seams of charts."""
    mesh, joined = welded(Mesh(field.positions, field.faces))
    return field_atlas(field, mesh.vertex_normals[joined])


def texture_frames(field: ReflectanceField, atlas: Atlas) -> TextureFrames:
    """Tangent space of the mesh at the texels of a field."""
    texels = FieldSurface(field).texels
    corners, weights = atlas.faces[texels.face], texels.barycentric.astype(np.float64)
    tangents = vertex_tangents(atlas)
    normals = unit_or_zero(atlas.normals)
    bitangents = np.cross(normals, tangents[:, :3]) * tangents[:, 3:]
    axes = [
        unit_or_zero(np.einsum("nk,nkd->nd", weights, vectors[corners]))
        for vectors in (tangents[:, :3], bitangents, normals)
    ]
    return TextureFrames(np.stack(axes, axis=2), texels.face_normal.astype(np.float64))


def material_maps(field: ReflectanceField, atlas: Atlas) -> MaterialMaps:
    """Fit the maps to a field.

    Parameters
    ----------
    field : ReflectanceField
        Of a known light.
    atlas : Atlas
        Its mesh, as of `export_atlas`.

    Returns
    -------
    MaterialMaps

    Raises
    ------
    InputError
        If the field's light is unknown: nothing is known of its gloss.
    """
    if field.light_model == "unknown":
        raise InputError(
            "field: expected one of known lights, received one that was photographed in an "
            "unknown light: a material that can be lit anew cannot be fitted to it"
        )
    frames = texture_frames(field, atlas)
    exposure = _exposure(field, frames.outward)
    fit = fit_microfacets(field, frames.outward, exposure)
    texels, factors = _encoded(*_material_of(fit), frames, field.texel_of_pixel)
    errors = map_errors(field, _decoded(texels, factors, frames), frames.outward, exposure)
    images = {n: filled_texture(field.texel_of_pixel, v) for n, v in texels.items()}
    return MaterialMaps(
        base_colour=images["base_colour"],
        metallic_roughness=images["metallic_roughness"],
        normal=images["normal"],
        anisotropy=images["anisotropy"],
        specular=images["specular"],
        mirrored=filled_texture(field.texel_of_pixel, frames.mirrored[:, None])[..., 0] > 0,
        base_factor=factors["base_factor"],
        specular_factor=factors["specular_factor"],
        exposure=exposure,
        errors=errors,
    )


def gltf_material(maps: MaterialMaps) -> GltfMaterial:
    """Material of glTF with the maps as textures."""
    colour = [maps.base_factor] * 3
    surface = {
        "baseColorTexture": {"index": 0},
        "baseColorFactor": [*colour, 1.0],
        "metallicRoughnessTexture": {"index": 1},
    }
    extensions = {
        "KHR_materials_anisotropy": {
            "anisotropyStrength": 1.0,
            "anisotropyTexture": {"index": 3},
        },
        "KHR_materials_specular": {
            "specularTexture": {"index": 4},
            "specularColorTexture": {"index": 4},
            "specularColorFactor": [maps.specular_factor] * 3,
        },
    }
    description = {
        "name": "fitted to the reflectance field",
        "pbrMetallicRoughness": surface,
        "normalTexture": {"index": 2},
        "extensions": extensions,
    }
    textures = (
        *(maps.base_colour, maps.metallic_roughness, maps.normal, maps.anisotropy),
        maps.specular,
    )
    extras = {"reflfield": {"exposure": maps.exposure, "error": maps.errors}}
    return GltfMaterial(description, textures, extras)


def _exposure(field: ReflectanceField, outward: Doubles) -> float:
    """Factor below which no bright texel reflects more light than arrives."""
    views, lights = direction_pairs(_MEASURED_PAIRS, near_normal=False)
    texels = _some_texels(field)
    samples = texel_samples(field, texels, (views, lights), outward)[2]
    reflected = np.pi * (samples / lights[:, 2:]).mean(axis=1).max(axis=1)
    bright = float(np.percentile(reflected, _BRIGHT_PERCENTILE))
    return min(1.0, _MOST_REFLECTED / bright) if bright > 0 else 1.0


def _some_texels(field: ReflectanceField) -> NDArray[np.intp]:
    step = -(-field.n_texels // _MEASURED_TEXELS)
    return np.arange(0, field.n_texels, step)


def _material_of(fit: MicrofacetFit) -> tuple[Doubles, Doubles, Doubles, MicrofacetFit]:
    """Base colour, metallic and the dielectric's f0 that show a diffuse colour and an f0."""
    diffuse, f0 = np.minimum(fit.diffuse, 1.0), np.minimum(fit.f0, 1.0)
    metallic = _metallic(diffuse, f0)[:, None]
    of_diffuse = diffuse / np.maximum(1.0 - metallic, 1e-6)
    of_gloss = (f0 - DIELECTRIC_F0 * (1.0 - metallic)) / np.maximum(metallic, 1e-6)
    base = of_diffuse + metallic**2 * (of_gloss - of_diffuse)
    base = np.clip(base, 0.0, 1.0)
    dielectric = np.clip((f0 - metallic * base) / np.maximum(1.0 - metallic, 1e-3), 0.0, 1.0)
    return base, metallic[:, 0], dielectric, fit


def _metallic(diffuse: Doubles, f0: Doubles) -> Doubles:
    """Share of metal, by what a dielectric of the same brightness would reflect.

    Solves ``base = diffuse / (1 - m) = (f0 - 0.04 (1 - m)) / m`` for the brightness.
    """
    bright, gloss = (np.sqrt(part**2 @ _BRIGHTNESS) for part in (diffuse, f0))
    linear = bright + gloss - 2.0 * DIELECTRIC_F0
    root = np.sqrt(np.maximum(linear**2 - 4.0 * DIELECTRIC_F0 * (DIELECTRIC_F0 - gloss), 0.0))
    metallic = np.clip((root - linear) / (2.0 * DIELECTRIC_F0), 0.0, 1.0)
    return np.where(gloss <= DIELECTRIC_F0, 0.0, metallic)


def _encoded(
    base: Doubles,
    metallic: Doubles,
    dielectric: Doubles,
    fit: MicrofacetFit,
    frames: TextureFrames,
    texel_of_pixel: NDArray[np.integer],
) -> tuple[dict[str, Bytes], dict[str, float]]:
    """Bytes of each texel by map, and the factors of the maps."""
    level = np.minimum(dielectric.max(axis=1) / DIELECTRIC_F0, 1.0)
    tint = dielectric / (DIELECTRIC_F0 * np.maximum(level, 1e-6)[:, None])
    factors = {
        "base_factor": float(base.max(initial=1e-3)),
        "specular_factor": float(tint.max(initial=1.0)),
    }
    along, across = fit.alphas.T
    strength = np.sqrt((along - across) / np.maximum(1.0 - across, 1e-6))
    normal = frames.coordinates(fit.normals)
    normal[:, 2] = np.maximum(normal[:, 2], _LEAST_NORMAL_Z)
    stretch = frames.coordinates(fit.stretch)
    stretch = unit_or_zero(stretch * [1.0, 1.0, 0.0])[:, :2]
    stretch *= coherent_signs(stretch, texel_of_pixel)[:, None]
    roughness = np.sqrt(across)
    texels = {
        "base_colour": np.asarray(encode_srgb(base / factors["base_factor"])),
        "metallic_roughness": np.stack([np.ones_like(roughness), roughness, metallic], axis=1),
        "normal": 0.5 + 0.5 * unit_or_zero(normal),
        "anisotropy": np.column_stack([0.5 + 0.5 * stretch, strength]),
        "specular": np.column_stack([encode_srgb(tint / factors["specular_factor"]), level]),
    }
    return {name: _bytes(values) for name, values in texels.items()}, factors


def _bytes(values: Doubles) -> Bytes:
    return np.rint(255.0 * np.clip(values, 0.0, 1.0)).astype(np.uint8)


def _decoded(
    texels: dict[str, Bytes], factors: dict[str, float], frames: TextureFrames
) -> MicrofacetMaterial:
    """Material that a viewer reads from the bytes."""
    values = {name: stored / 255.0 for name, stored in texels.items()}
    level = values["specular"][:, 3]
    tint = np.asarray(decode_srgb(values["specular"][:, :3])) * factors["specular_factor"]
    direction = 2.0 * values["anisotropy"] - 1.0
    direction[:, 2] = 0.0
    return MicrofacetMaterial(
        base_colour=np.asarray(decode_srgb(values["base_colour"])) * factors["base_factor"],
        metallic=values["metallic_roughness"][:, 2],
        roughness=values["metallic_roughness"][:, 1],
        strength=values["anisotropy"][:, 2],
        dielectric_f0=np.minimum(DIELECTRIC_F0 * tint, 1.0) * level[:, None],
        dielectric_f90=level,
        normals=frames.world(2.0 * values["normal"] - 1.0),
        stretch=frames.world(direction),
    )


def map_errors(
    field: ReflectanceField, material: MicrofacetMaterial, outward: Doubles, exposure: float
) -> dict[str, Any]:
    """Difference of a material from a field, relative to the field.

    Returns
    -------
    dict
        ``relative``: root of the sum of squared differences over that of squared samples,
        views and lights spread by their cosines over the hemisphere of each texel;
        ``median_of_texels``: median of the same of each texel; ``relative_near_highlights``:
        where half vectors are close to the normal. Directions are others than those of the
        fit.
    """
    errors: dict[str, float] = {}
    for name, near in (("relative", False), ("relative_near_highlights", True)):
        pairs = direction_pairs(_MEASURED_PAIRS, near, _MEASURED_SEED)
        texels = _some_texels(field)
        views, lights, samples = texel_samples(field, texels, pairs, outward)
        points = np.repeat(texels, _MEASURED_PAIRS)
        shown = material.evaluate(points, views.reshape(-1, 3), lights.reshape(-1, 3))
        off = ((shown.reshape(samples.shape) / exposure - samples) ** 2).sum(axis=(1, 2))
        size = (samples**2).sum(axis=(1, 2))
        errors[name] = float(np.sqrt(off.sum() / max(size.sum(), 1e-300)))
        if not near:
            errors["median_of_texels"] = float(
                np.median(np.sqrt(off / np.maximum(size, 1e-300)))
            )
    return {name: round(value, 4) for name, value in errors.items()}
