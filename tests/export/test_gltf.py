import json
import struct
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
import trimesh
from PIL import Image

from reflfield.errors import InputError, ShapeError
from reflfield.export.gltf import (
    colour_material,
    filled_texture,
    vertex_tangents,
    write_glb,
)
from reflfield.geometry.uv_atlas import Atlas

# Asymmetric: red top left, green top right, blue bottom left, white bottom right.
TEXTURE = (
    np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], dtype=np.uint8)
    .repeat(4, axis=0)
    .repeat(4, axis=1)
)


def quad(mirrored=False):
    u = np.array([0.0, 1.0, 1.0, 0.0])
    return Atlas(
        positions=[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
        faces=[[0, 1, 2], [0, 2, 3]],
        uv=np.stack([1.0 - u if mirrored else u, [0.0, 0.0, 1.0, 1.0]], axis=1),
        chart=[0, 0], normals=[[0, 0, 1]] * 4, height=8, width=8,
    )  # fmt: skip


def chunks(path):
    """JSON and binary chunk, by the container's definition."""
    content = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size, kind = struct.unpack_from("<I4s", content, 12)
    assert kind == b"JSON"
    document = json.loads(content[20 : 20 + size])
    binary_size, kind = struct.unpack_from("<I4s", content, 20 + size)
    assert kind == b"BIN\0"
    return document, content[28 + size : 28 + size + binary_size]


def accessor(path, name):
    document, binary = chunks(path)
    number = document["meshes"][0]["primitives"][0]["attributes"][name]
    entry = document["accessors"][number]
    view = document["bufferViews"][entry["bufferView"]]
    width = int(entry["type"][-1])
    array = np.frombuffer(binary, "<f4", entry["count"] * width, view["byteOffset"])
    return array.reshape(-1, width)


@pytest.mark.stability
def test_mesh_far_from_the_origin_keeps_its_shape(tmp_path):
    """Coordinates of a survey: single precision there has steps of half a metre."""
    path, far = tmp_path / "atlas.glb", np.array([441547.5, 5121946.5, 2345.0])
    near = quad()
    moved = replace(near, positions=near.positions * 0.1 + far)
    write_glb(path, moved, colour_material(TEXTURE))
    document, _ = chunks(path)
    relative = accessor(path, "POSITION")
    # To the rounding of a float of the size of the quad.
    assert np.abs(np.ptp(relative, axis=0) - [0.1, 0.1, 0.0]).max() < 1e-8
    world = relative + np.array(document["nodes"][0]["translation"])
    # To the rounding of doubles of five million.
    assert np.abs(world - (near.positions * 0.1 + far)).max() < 1e-8


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 0, -2], [0, -1, 0], [1, 2, 3]])
def test_an_object_stands_upright(tmp_path, up, rounding):
    """As trimesh places it: glTF's up is +Y; of a survey's coordinates, too."""
    tall = replace(quad(), positions=[[0, 0, 0], [1, 0, 2], [1, 1, 4], [0, 3, -5]])
    for origin in (0.0, 1e6):
        placed = replace(tall, positions=tall.positions + origin)
        write_glb(tmp_path / "a.glb", placed, colour_material(TEXTURE), up=up)
        loaded = trimesh.load_scene(tmp_path / "a.glb").to_geometry()
        heights = placed.positions @ np.array(up) / np.linalg.norm(up)
        # Of the coordinates; single precision holds the quarters around the middle exactly.
        tolerance = rounding(np.float64, scale=np.abs(placed.positions).max())
        np.testing.assert_allclose(loaded.vertices[:, 1], heights, rtol=0, atol=tolerance)
        apart = (
            np.linalg.norm(np.diff(v, axis=0), axis=1)
            for v in (loaded.vertices, placed.positions)
        )
        np.testing.assert_allclose(*apart, rtol=0, atol=tolerance)


def test_a_flat_object_faces_the_viewer(tmp_path, rounding):
    write_glb(tmp_path / "a.glb", quad(), colour_material(TEXTURE), up=[0, 0, 1])
    assert chunks(tmp_path / "a.glb")[0]["nodes"] == [{"name": "reflfield", "mesh": 0}]
    turned = replace(quad(), positions=quad().positions[:, [2, 0, 1]], normals=[[1, 0, 0]] * 4)
    write_glb(tmp_path / "a.glb", turned, colour_material(TEXTURE), up=[1, 0, 0])
    loaded = trimesh.load_scene(tmp_path / "a.glb").to_geometry()
    np.testing.assert_allclose(loaded.face_normals, [[0, 0, 1]] * 2, atol=rounding(np.float64))


def test_a_texture_is_filled_from_the_nearest_texel():
    texels = np.array([[0, -1, -1, -1, 1]])
    values = np.array([[10, 20, 30], [40, 50, 60]], np.uint8)
    filled = filled_texture(texels, values)
    assert filled[0, [0, 1, 3, 4], 0].tolist() == [10, 10, 40, 40]


def test_trimesh_reads_geometry_and_the_texture_the_right_way_up(tmp_path):
    path = tmp_path / "deep" / "atlas.glb"
    write_glb(path, quad(), colour_material(TEXTURE))
    (loaded,) = trimesh.load_scene(path).geometry.values()
    np.testing.assert_array_equal(loaded.vertices, quad().positions)
    np.testing.assert_array_equal(loaded.faces, quad().faces)
    # trimesh counts v upwards, as the atlas does.
    np.testing.assert_allclose(loaded.visual.uv, quad().uv, atol=1e-7)
    colours = loaded.visual.to_color().vertex_colors[:, :3]
    np.testing.assert_array_equal(
        colours, [[0, 0, 255], [255, 255, 255], [0, 255, 0], [255, 0, 0]]
    )
    assert [file.name for file in path.parent.iterdir()] == ["atlas.glb"]


def test_the_file_holds_what_the_specification_asks_for(tmp_path):
    write_glb(tmp_path / "a.glb", quad(), colour_material(TEXTURE))
    document, binary = chunks(tmp_path / "a.glb")
    assert document["buffers"][0]["byteLength"] == len(binary)
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])
    position = document["accessors"][0]
    assert (position["min"], position["max"]) == ([0, 0, 0], [1, 1, 0])
    # v downwards: the first vertex shows the bottom of the texture.
    np.testing.assert_array_equal(accessor(tmp_path / "a.glb", "TEXCOORD_0")[0], [0.0, 1.0])
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    png = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    np.testing.assert_array_equal(np.asarray(Image.open(BytesIO(png))), TEXTURE)


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_bitangent_runs_up_the_texture(tmp_path, mirrored):
    write_glb(tmp_path / "a.glb", quad(mirrored), colour_material(TEXTURE))
    tangent = accessor(tmp_path / "a.glb", "TANGENT")
    np.testing.assert_array_equal(tangent, vertex_tangents(quad(mirrored)).astype("f4"))
    way = -1.0 if mirrored else 1.0
    np.testing.assert_array_equal(tangent, [[way, 0, 0, way]] * 4)
    bitangent = np.cross([0, 0, 1], tangent[:, :3]) * tangent[:, 3:]
    np.testing.assert_array_equal(bitangent, [[0, 1, 0]] * 4)


def test_textures_that_are_not_encoded_are_refused():
    with pytest.raises(InputError, match="uint8"):
        colour_material(TEXTURE.astype(np.float32))
    with pytest.raises(ShapeError, match="base_colour"):
        colour_material(TEXTURE[..., 0])
