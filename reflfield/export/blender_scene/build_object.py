"""Build an exported object in Blender 4.0 or newer.

    blender --python build_object.py
    blender --background --python build_object.py -- object.blend

In Blender's own Python, ``build()`` returns the object. All files lie beside this one.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np

HERE = Path(__file__).resolve().parent
# Map, socket of the Principled BSDF, whether it holds colours.
SINGLE_MAPS = (
    ("metallic", "Metallic"),
    ("roughness", "Roughness"),
    ("anisotropic", "Anisotropic"),
    ("rotation", "Anisotropic Rotation"),
)


def build() -> Any:
    """Make the object with its material and put it into the scene."""
    about = json.loads((HERE / "material.json").read_text())
    mesh = make_mesh(about["name"])
    mesh.materials.append(make_material(about))
    made = bpy.data.objects.new(about["name"], mesh)
    made.location = about["origin"]
    bpy.context.scene.collection.objects.link(made)
    return made


def make_mesh(name: str) -> Any:
    """Mesh with its texture coordinates, smooth."""
    with np.load(HERE / "object.npz", allow_pickle=False) as arrays:
        positions, faces, uv = (arrays[key] for key in ("positions", "faces", "uv"))
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(positions.tolist(), [], faces.tolist())
    layer = mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", uv[faces.ravel()].ravel().tolist())
    mesh.polygons.foreach_set("use_smooth", [True] * len(faces))
    mesh.update()
    return mesh


def make_material(about: dict[str, Any]) -> Any:
    """Principled BSDF with the fitted maps."""
    material = bpy.data.materials.new(about["name"])
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    bsdf = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    colour = scaled(nodes, links, "base_colour", about["base_factor"])
    links.new(colour, bsdf.inputs["Base Color"])
    tint = scaled(nodes, links, "specular_tint", about["specular_factor"])
    links.new(tint, bsdf.inputs["Specular Tint"])
    half = math_node(nodes, links, image(nodes, "specular_level"), 0.5)
    links.new(half, bsdf.inputs["Specular IOR Level"])
    for name, socket in SINGLE_MAPS:
        links.new(image(nodes, name), bsdf.inputs[socket])
    bsdf.inputs["IOR"].default_value = 1.5
    bsdf.distribution = "GGX"  # as the maps were fitted: without light from facet to facet
    normal = nodes.new("ShaderNodeNormalMap")
    links.new(image(nodes, "normal"), normal.inputs["Color"])
    links.new(normal.outputs["Normal"], bsdf.inputs["Normal"])
    tangent = nodes.new("ShaderNodeTangent")
    tangent.direction_type = "UV_MAP"
    tangent.uv_map = "UVMap"
    links.new(tangent.outputs["Tangent"], bsdf.inputs["Tangent"])
    return material


def image(nodes: Any, name: str, *, colours: bool = False) -> Any:
    """Output of a node that reads a map."""
    node = nodes.new("ShaderNodeTexImage")
    node.image = bpy.data.images.load(str(HERE / f"{name}.png"))
    node.image.colorspace_settings.name = "sRGB" if colours else "Non-Color"
    if name == "rotation":  # half a turn and none are the same, what lies between is not
        node.interpolation = "Closest"
    return node.outputs["Color"]


def scaled(nodes: Any, links: Any, name: str, factor: float) -> Any:
    """Output of a map of colours times a factor."""
    node = nodes.new("ShaderNodeVectorMath")
    node.operation = "SCALE"
    links.new(image(nodes, name, colours=True), node.inputs[0])
    node.inputs["Scale"].default_value = factor
    return node.outputs["Vector"]


def math_node(nodes: Any, links: Any, value: Any, factor: float) -> Any:
    """Output of a number times a factor."""
    node = nodes.new("ShaderNodeMath")
    node.operation = "MULTIPLY"
    links.new(value, node.inputs[0])
    node.inputs[1].default_value = factor
    return node.outputs["Value"]


if __name__ == "__main__":
    build()
    if "--" in sys.argv:
        target = Path(sys.argv[sys.argv.index("--") + 1]).resolve()
        bpy.ops.wm.save_as_mainfile(filepath=str(target))
