"""A field as an OpenPBR material in MaterialX, with fitted maps, and its mesh as OBJ."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from reflfield.export.map_images import openpbr_images, write_images
from reflfield.export.material_maps import MaterialMaps, export_atlas, material_maps
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.geometry.uv_atlas import Atlas
from reflfield.util.files import filling

VERSION = "1.39"
# Map, its type, and the input of the surface that it goes to.
_INPUTS = (
    *(("base_colour", "color3", "base_color"), ("metallic", "float", "base_metalness")),
    *(("roughness", "float", "specular_roughness"),),
    *(("anisotropy", "float", "specular_roughness_anisotropy"),),
    *(("specular_colour", "color3", "specular_color"),),
    *(("specular_weight", "float", "specular_weight"),),
)


def write_materialx(path: Path, field: ReflectanceField) -> list[str]:
    """Write a folder with ``material.mtlx``, maps and mesh; returns what to know of it.

    Raises
    ------
    InputError
        If the field's light is unknown.
    """
    atlas = export_atlas(field)
    maps = material_maps(field, atlas)
    with filling(path) as partial:
        (partial / "material.mtlx").write_text(material_text(maps), encoding="utf-8")
        (partial / "object.obj").write_text(_obj(atlas), encoding="ascii")
        write_images(partial, openpbr_images(maps))
    return maps.lines()


def material_text(maps: MaterialMaps) -> str:
    """Text of the material."""
    root = ElementTree.Element("materialx", version=VERSION, colorspace="lin_rec709")
    surface = ElementTree.Element("open_pbr_surface", name="surface", type="surfaceshader")
    factors = {"base_colour": maps.base_factor, "specular_weight": maps.specular_factor}
    for name, kind, target in _INPUTS:
        output = _image(root, name, kind)
        if name in factors:
            output = _product(root, name, kind, factors[name])
        ElementTree.SubElement(surface, "input", name=target, type=kind, nodename=output)
    ElementTree.SubElement(
        surface, "input", name="geometry_normal", type="vector3", nodename=_normal(root)
    )
    ElementTree.SubElement(
        surface, "input", name="geometry_tangent", type="vector3", nodename=_tangent(root)
    )
    root.append(surface)
    material = ElementTree.SubElement(
        root, "surfacematerial", name="fitted_to_the_field", type="material"
    )
    ElementTree.SubElement(
        material, "input", name="surfaceshader", type="surfaceshader", nodename="surface"
    )
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _image(root: ElementTree.Element, name: str, kind: str, *, closest: bool = False) -> str:
    node = ElementTree.SubElement(root, "image", name=name, type=kind)
    file = {"name": "file", "type": "filename", "value": f"{name}.png"}
    if kind == "color3":
        file["colorspace"] = "srgb_texture"
    ElementTree.SubElement(node, "input", file)
    if closest:
        about = {"name": "filtertype", "type": "string", "value": "closest"}
        ElementTree.SubElement(node, "input", about)
    return name


def _product(root: ElementTree.Element, name: str, kind: str, factor: float) -> str:
    node = ElementTree.SubElement(root, "multiply", name=f"{name}_scaled", type=kind)
    ElementTree.SubElement(node, "input", name="in1", type=kind, nodename=name)
    ElementTree.SubElement(node, "input", name="in2", type="float", value=repr(factor))
    return f"{name}_scaled"


def _normal(root: ElementTree.Element) -> str:
    _image(root, "normal", "vector3")
    node = ElementTree.SubElement(root, "normalmap", name="turned_normal", type="vector3")
    ElementTree.SubElement(node, "input", name="in", type="vector3", nodename="normal")
    return "turned_normal"


def _tangent(root: ElementTree.Element) -> str:
    """The tangent, turned about the normal to where highlights stretch."""
    for kind in ("tangent", "normal"):
        node = ElementTree.SubElement(root, kind, name=f"world_{kind}", type="vector3")
        ElementTree.SubElement(node, "input", name="space", type="string", value="world")
    _image(root, "rotation", "float", closest=True)
    # MaterialX turns vectors clockwise: its v' = v M is their turn by -M.
    _product(root, "rotation", "float", -360.0)
    node = ElementTree.SubElement(root, "rotate3d", name="turned_tangent", type="vector3")
    for name, kind, source in (
        ("in", "vector3", "world_tangent"),
        ("amount", "float", "rotation_scaled"),
        ("axis", "vector3", "world_normal"),
    ):
        ElementTree.SubElement(node, "input", name=name, type=kind, nodename=source)
    return "turned_tangent"


def _obj(atlas: Atlas) -> str:
    """Mesh with texture coordinates and normals, in the capture's coordinates."""
    lines = [
        *("v {:.9g} {:.9g} {:.9g}".format(*point) for point in atlas.positions),
        *("vt {:.7g} {:.7g}".format(*uv) for uv in atlas.uv),
        *("vn {:.5g} {:.5g} {:.5g}".format(*normal) for normal in atlas.normals),
        *("f " + " ".join(f"{i}/{i}/{i}" for i in face + 1) for face in atlas.faces),
    ]
    return "\n".join(lines) + "\n"
