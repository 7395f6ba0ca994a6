"""A field as a script that builds its object in Blender, with fitted maps."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import numpy as np

from reflfield.export.gltf import far_origin
from reflfield.export.map_images import principled_images, write_images
from reflfield.export.material_maps import export_atlas, material_maps
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.util.files import filling
from reflfield.viewer.object_page import title_of

SCRIPT = "build_object.py"


def write_blender(path: Path, field: ReflectanceField) -> list[str]:
    """Write a folder with script, mesh and maps; returns what to know of it.

    Raises
    ------
    InputError
        If the field's light is unknown.
    """
    atlas = export_atlas(field)
    maps = material_maps(field, atlas)
    origin = far_origin(atlas.positions)
    about = {
        "name": title_of(field),
        "origin": origin.tolist(),
        "base_factor": maps.base_factor,
        "specular_factor": maps.specular_factor,
        "exposure": maps.exposure,
        "error": maps.errors,
    }
    mesh = {
        "positions": (atlas.positions - origin).astype("<f4"),
        "faces": atlas.faces.astype("<i4"),
        "uv": atlas.uv.astype("<f4"),
    }
    script = resources.files(__package__) / "blender_scene" / SCRIPT
    with filling(path) as partial:
        (partial / SCRIPT).write_text(script.read_text(encoding="utf-8"), encoding="utf-8")
        (partial / "material.json").write_text(json.dumps(about, indent=1), encoding="utf-8")
        np.savez_compressed(partial / "object.npz", allow_pickle=False, **mesh)
        write_images(partial, principled_images(maps))
    return [*maps.lines(), f"open it: blender --python {path / SCRIPT}"]
