"""Formats that a field can be exported to, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from numpy.typing import ArrayLike

from reflfield.errors import InputError
from reflfield.export.blender import write_blender
from reflfield.export.btf_samples import write_btf_field
from reflfield.export.gltf import colour_material, filled_texture, write_glb
from reflfield.export.material_maps import export_atlas, gltf_material, material_maps
from reflfield.export.materialx import write_materialx
from reflfield.export.mitsuba import write_mitsuba
from reflfield.export.rti import write_rti
from reflfield.export.texture_layers import write_texture_layers
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.viewer.object_page import title_of, write_object_page
from reflfield.viewer.page_asset import texel_colours

FOLDER = ""  # stands for the suffix of formats that are several files


@dataclass(frozen=True)
class ExportFormat:
    """How a field becomes files of another format.

    Parameters
    ----------
    suffix : str
        Of its file; `FOLDER` if it is a folder.
    what : str
        In a few words.
    write : callable
        From a path and a field to lines to say; the file or folder appears when it is whole.
    """

    suffix: str
    what: str
    write: Callable[[Path, ReflectanceField], list[str]]


def _write_page(path: Path, field: ReflectanceField) -> list[str]:
    write_object_page(path, field)
    return []


def _write_glb(path: Path, field: ReflectanceField) -> list[str]:
    """Write the mesh with fitted maps; of a field of unknown light, with its colours alone."""
    atlas = export_atlas(field)
    if field.light_model == "unknown":
        image = filled_texture(field.texel_of_pixel, texel_colours(field))
        colours = colour_material(image, "in the light of the capture", lit=False)
        write_glb(path, atlas, colours, title_of(field), field.up)
        return ["colours alone, without light: the capture's light is unknown"]
    maps = material_maps(field, atlas)
    write_glb(path, atlas, gltf_material(maps), title_of(field), field.up)
    return maps.lines()


FORMATS: dict[str, ExportFormat] = {
    "html": ExportFormat(".html", "a web page that shows and relights it", _write_page),
    "gltf": ExportFormat(".glb", "its mesh with fitted maps of glTF's material", _write_glb),
    "blender": ExportFormat(FOLDER, "a script that builds it in Blender", write_blender),
    "materialx": ExportFormat(FOLDER, "an OpenPBR material and a mesh", write_materialx),
    "mitsuba": ExportFormat(FOLDER, "a BSDF of Mitsuba 3 and a scene", write_mitsuba),
    "rti": ExportFormat(FOLDER, "one view for relight and OpenLIME", write_rti),
    "exr": ExportFormat(".exr", "frames and coefficients as layers", write_texture_layers),
    "btf": ExportFormat(".btf", "a container of the University of Bonn", write_btf_field),
}


def export_field(
    field: ReflectanceField, path: Path, to: str, view: ArrayLike | None = None
) -> list[str]:
    """Write a field in another format.

    Parameters
    ----------
    field : ReflectanceField
    path : Path
        With the suffix of the format, or none if that is a folder; what it lies in is created.
    to : str
        A name in `FORMATS`.
    view : (3,) array_like, optional
        World direction to the viewer, of the formats that show one view.

    Returns
    -------
    list of str
        What to know of the result, such as its error.

    Raises
    ------
    InputError
        If the format is unknown, the path has another suffix, or the field has not what the
        format needs.
    """
    known = "; ".join(f"{name}: {one.what}" for name, one in FORMATS.items())
    if to not in FORMATS:
        raise InputError(f"to: expected one of {known}; received {to!r}")
    suffix = FORMATS[to].suffix
    if path.suffix.lower() != suffix:
        wanted = f"that ends in {suffix}" if suffix else "of a folder, without a suffix"
        raise InputError(f"out: expected a name {wanted}, received {path.name!r}")
    if view is None:
        return FORMATS[to].write(path, field)
    if to != "rti":
        raise InputError(f"view: expected with the format rti, received with {to}")
    return write_rti(path, field, view)
