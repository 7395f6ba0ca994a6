"""Reflectance of simulated objects: analytic, measured and spatially varying.

`make_material` builds any of them from a TOML table. A material answers three
questions about points with texture coordinates ``uv``: its BRDF (`evaluate`, in
the shading frame), how that frame lies in the surface's (`frame_change`), and
which of several materials is there (`label`).
"""

from capture_sim.materials.analytic import GGX, AshikhminShirley, Lambert
from capture_sim.materials.base import Material
from capture_sim.materials.material_registry import make_material, material_presets
from capture_sim.materials.rgl import MeasuredRGL, read_rgl
from capture_sim.materials.spatial import Mixed, SpatiallyVarying, frames_from
from capture_sim.materials.textures import Texture, make_texture, read_image

__all__ = [
    "GGX",
    "AshikhminShirley",
    "Lambert",
    "Material",
    "MeasuredRGL",
    "Mixed",
    "SpatiallyVarying",
    "Texture",
    "frames_from",
    "make_material",
    "make_texture",
    "material_presets",
    "read_image",
    "read_rgl",
]
