"""Blender's script and the MaterialX text, by the tools themselves where they are."""

import importlib
import importlib.util
import json
import re
import types
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from PIL import Image

from reflfield.export.formats import export_field
from reflfield.export.map_images import openpbr_images, principled_images, stretch_turns, widths
from reflfield.export.material_maps import MaterialMaps, export_atlas, material_maps
from tests.viewer.shown_fields import half_vector_field


def maps_of(roughness, strength, direction, *, mirrored=False):
    """One texel."""

    def texel(*values):
        return np.rint(255 * np.array([[values]])).astype(np.uint8)

    return MaterialMaps(
        texel(0.5, 0.5, 0.5), texel(1.0, roughness, 0.0), texel(0.5, 0.5, 1.0),
        texel(0.5 + 0.5 * direction[0], 0.5 + 0.5 * direction[1], strength),
        texel(1.0, 1.0, 1.0, 1.0), np.array([[mirrored]]), 1.0, 1.0, 1.0, {},
    )  # fmt: skip


@pytest.mark.reference
@pytest.mark.parametrize(("roughness", "strength"), [(0.5, 0.0), (0.4, 0.35), (0.6, 0.5)])
def test_widths_are_kept_by_the_formulas_of_both(roughness, strength):
    """Blender's manual: alpha / aspect, alpha aspect; OpenPBR's specification."""
    maps = maps_of(roughness, strength, (1.0, 0.0))
    along, across = (one[0, 0] for one in widths(maps))
    images = {name: image[0, 0] / 255 for name, image in principled_images(maps).items()}
    aspect = np.sqrt(1 - 0.9 * images["anisotropic"])
    alpha = images["roughness"] ** 2
    steps = 0.02  # of 255ths of both images, of a width of 0.15, the smallest here
    np.testing.assert_allclose([alpha / aspect, alpha * aspect], [along, across], steps)
    images = {name: image[0, 0] / 255 for name, image in openpbr_images(maps).items()}
    a, r2 = images["anisotropy"], images["roughness"] ** 2
    t = r2 * np.sqrt(2 / (1 + (1 - a) ** 2))
    np.testing.assert_allclose([t, (1 - a) * t], [along, across], steps)


def test_directions_are_turns_from_the_tangent():
    for angle in (0.0, 0.3, 1.2, 2.9):
        for sign in (1, -1):
            maps = maps_of(0.5, 0.3, (np.cos(angle), np.sin(angle)), mirrored=sign < 0)
            turns = stretch_turns(maps)[0, 0]
            off = np.mod(turns - sign * angle / (2 * np.pi) + 0.25, 0.5) - 0.25
            assert abs(off) < 0.002  # of 8-bit components


def load(path):
    spec = importlib.util.spec_from_file_location("build_object", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root, field = tmp_path_factory.mktemp("maps"), half_vector_field()
    for name in ("blender", "materialx"):
        export_field(field, root / name, name)
    return field, root


def test_the_script_links_every_map(folders, monkeypatch):
    """With a stand-in for Blender that takes every call and keeps the links."""
    field, root = folders
    bpy = mock.MagicMock()
    bsdf = types.SimpleNamespace(type="BSDF_PRINCIPLED", inputs=mock.MagicMock())
    tree = bpy.data.materials.new.return_value.node_tree
    tree.nodes.__iter__.return_value = iter([bsdf])
    monkeypatch.setitem(__import__("sys").modules, "bpy", bpy)
    load(root / "blender" / "build_object.py").build()
    read = {call.args[0].rsplit("/", 1)[-1] for call in bpy.data.images.load.call_args_list}
    assert read == {path.name for path in (root / "blender").glob("*.png")}
    vertices, _, faces = bpy.data.meshes.new.return_value.from_pydata.call_args.args
    assert (len(vertices), len(faces)) == (len(field.positions), len(field.faces))
    sockets = {call.args[0] for call in bsdf.inputs.__getitem__.call_args_list}
    assert {"Base Color", "Normal", "Tangent", "Anisotropic Rotation"} <= sockets


@pytest.mark.reference
def test_blender_builds_the_object(folders):
    bpy = pytest.importorskip("bpy", reason="needs Blender's module bpy")
    field, root = folders
    made = load(root / "blender" / "build_object.py").build()
    assert len(made.data.polygons) == len(field.faces)
    tree = made.data.materials[0].node_tree
    linked = {
        link.to_socket.name for link in tree.links if link.to_node.type == "BSDF_PRINCIPLED"
    }
    assert len(linked) == 9
    assert made.name in bpy.data.objects


@pytest.mark.reference
def test_materialx_validates_the_text(folders):
    mx = pytest.importorskip("MaterialX", reason="needs the package MaterialX")
    document, library = mx.createDocument(), mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    mx.readFromXmlFile(document, str(folders[1] / "materialx" / "material.mtlx"))
    document.setDataLibrary(library)
    valid, message = document.validate()
    assert valid, message
    (material,) = document.getMaterialNodes()
    assert mx.getShaderNodes(material)[0].getCategory() == "open_pbr_surface"
    assert mx.getShaderNodes(material)[0].getNodeDef() is not None


def clockwise_turn(mx):
    """Function of a vector, degrees and an axis, as MaterialX writes the node rotate3d."""
    search = mx.getDefaultDataSearchPath()
    source = search.find("libraries/stdlib/genosl/mx_rotate_vector3.osl")
    (formula,) = re.findall(r"result = (.*);", Path(source.asString()).read_text())

    def turned(vector, degrees, axis):
        s, c = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
        names = {"_in": vector, "axis": axis, "nAxis": axis, "s": s, "c": c, "oc": 1 - c}
        return eval(formula, {"cross": np.cross, "dot": np.dot}, names)

    return turned


@pytest.mark.reference
def test_materialx_turns_tangents_to_where_highlights_stretch(folders):
    """The sense of its node rotate3d, and the values that it reads from the image."""
    mx = pytest.importorskip("MaterialX", reason="needs the package MaterialX")
    render = pytest.importorskip("MaterialX.PyMaterialXRender")
    field, root = folders
    maps = material_maps(field, export_atlas(field))
    document = mx.createDocument()
    mx.readFromXmlFile(document, str(root / "materialx" / "material.mtlx"))
    factor = document.getNode("rotation_scaled").getInput("in2").getValue()
    images = render.ImageHandler.create(render.StbImageLoader.create())
    images.setSearchPath(mx.FileSearchPath(str(root / "materialx")))
    read, turned = images.acquireImage("rotation.png"), clockwise_turn(mx)
    for row, column in ((5, 30), (12, 70), (20, 10)):
        amount = factor * read.getTexelColor(column, row)[0]
        x, y, _ = turned(np.array([1.0, 0, 0]), amount, np.array([0, 0, 1.0]))
        wanted = maps.anisotropy[row, column, :2] / 127.5 - 1
        wanted[1] *= -1 if maps.mirrored[row, column] else 1
        off = np.degrees(
            np.arctan2(x * wanted[1] - y * wanted[0], x * wanted[0] + y * wanted[1])
        )
        # Steps of 8 bits: 1.4 degrees of the turn, half a degree of components.
        assert abs((off + 90) % 180 - 90) < 1.2


@pytest.mark.reference
@pytest.mark.parametrize("target", ["Glsl", "Essl", "Osl", "Mdl", "Msl", "Slang"])
def test_materialx_translates_the_material(folders, target):
    """By its generators of shaders."""
    mx = pytest.importorskip("MaterialX", reason="needs the package MaterialX")
    of = {"Essl": "Glsl"}.get(target, target)
    module = pytest.importorskip(f"MaterialX.PyMaterialXGen{of}")
    shaders = importlib.import_module("MaterialX.PyMaterialXGenShader")
    document, library = mx.createDocument(), mx.createDocument()
    search = mx.getDefaultDataSearchPath()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), search, library)
    mx.readFromXmlFile(document, str(folders[1] / "materialx" / "material.mtlx"))
    document.setDataLibrary(library)
    generator = getattr(module, f"{target}ShaderGenerator").create()
    colours = shaders.DefaultColorManagementSystem.create(generator.getTarget())
    colours.loadLibrary(library)
    generator.setColorManagementSystem(colours)
    context = shaders.GenContext(generator)
    context.registerSourceCodeSearchPath(search)
    shader = generator.generate("fitted", document.getMaterialNodes()[0], context)
    assert "rotate" in shader.getSourceCode("pixel")


def test_images_have_the_size_of_the_texture(folders):
    field, root = folders
    for path in root.rglob("*.png"):
        with Image.open(path) as image:
            assert image.size == field.texel_of_pixel.shape[::-1]
    about = json.loads((root / "blender" / "material.json").read_text())
    assert 0 < about["error"]["relative"] < 0.3
