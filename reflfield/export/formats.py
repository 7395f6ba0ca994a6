"""Formats that a field can be exported to, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from reflfield.errors import InputError
from reflfield.export.gltf import write_glb
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.geometry.mesh import Mesh, welded
from reflfield.render.camera_rays import field_atlas
from reflfield.viewer.object_page import title_of, write_object_page
from reflfield.viewer.page_asset import texel_image


@dataclass(frozen=True)
class ExportFormat:
    """How a field becomes a file of another format.

    Parameters
    ----------
    suffix : str
        Of its files.
    what : str
        In a few words.
    write : callable
        From a path and a field; the file appears when it is whole.
    """

    suffix: str
    what: str
    write: Callable[[Path, ReflectanceField], None]


def _write_glb(path: Path, field: ReflectanceField) -> None:
    """Write the mesh with the colours of the field, seen and lit from straight above."""
    mesh, joined = welded(Mesh(field.positions, field.faces))
    atlas = field_atlas(field, mesh.vertex_normals[joined])
    write_glb(path, atlas, texel_image(field), title_of(field))


FORMATS: dict[str, ExportFormat] = {
    "html": ExportFormat(".html", "a web page that shows and relights it", write_object_page),
    "gltf": ExportFormat(".glb", "its mesh and colours, not to be relit", _write_glb),
}


def export_field(field: ReflectanceField, path: Path, to: str) -> None:
    """Write a field in another format.

    Parameters
    ----------
    field : ReflectanceField
    path : Path
        With the suffix of the format; its folder is created.
    to : str
        A name in `FORMATS`.

    Raises
    ------
    InputError
        If the format is unknown, or the file's name has another suffix.
    """
    known = "; ".join(f"{name}: {one.what}" for name, one in FORMATS.items())
    if to not in FORMATS:
        raise InputError(f"to: expected one of {known}; received {to!r}")
    suffix = FORMATS[to].suffix
    if path.suffix.lower() != suffix:
        raise InputError(f"out: expected a name that ends in {suffix}, received {path.name!r}")
    FORMATS[to].write(path, field)
