"""Mesh files as they are found: every form is read rightly, damage is named by its line."""

import json
import os
import re
import struct

import numpy as np
import pytest
import trimesh

from capture_sim.errors import SceneError
from capture_sim.inputs import memory_limit
from capture_sim.objects import make_object, read_mesh

CUBE = trimesh.creation.box()
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def soup(vertices, faces):
    """Triangles as a set of corners, whatever their order; to 1e-6."""
    corners = np.asarray(vertices)[np.asarray(faces)]
    return {tuple(sorted(map(tuple, np.round(t, 6).tolist()))) for t in corners}


def vertex_lines(number="{:.6f} {:.6f} {:.6f}"):
    return ["v " + number.format(*v) for v in CUBE.vertices]


def relative():
    lines = []
    for face in CUBE.faces:
        lines += ["v {} {} {}".format(*CUBE.vertices[corner]) for corner in face]
        lines.append("f -3 -2 -1")
    return lines


def mixed():
    """Absolute and relative indices, with vertices after the first faces."""
    first = [f"f {' '.join(str(c + 1) for c in face)}" for face in CUBE.faces[:6]]
    rest = [f"f {a + 1} {b - 8} {c + 1}" for a, b, c in CUBE.faces[6:]]
    return [*vertex_lines(), *first, *rest]


def corners(pattern):
    texture = ["vt 0 0", "vt 1 0", "vt 1 1"]
    normals = ["vn 0 0 1", "vn 0 1 0", "vn 1 0 0"]
    faces = [
        "f " + " ".join(pattern.format(c + 1, k + 1) for k, c in enumerate(face))
        for face in CUBE.faces
    ]
    return [*vertex_lines(), *texture, *normals, *faces]


def ragged():
    """Triangles and quads, corners with and without coordinates."""
    quads = [f"f {' '.join(str(c + 1) for c in quad)}" for quad in QUADS[:3]]
    triangles = [
        f"f {a + 1}/1 {b + 1}/2 {c + 1}/3"
        for q in QUADS[3:]
        for a, b, c in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))
    ]
    return [*vertex_lines(), "vt 0 0", "vt 1 0", "vt 1 1", *quads, *triangles]


FORMS = {
    "relative": "\n".join(relative()),
    "mixed": "\n".join(mixed()),
    "relative v/vt": "\n".join(corners("{0}/{1}")).replace("f 1/1", "f -8/-3"),
    "v/vt": "\n".join(corners("{0}/{1}")),
    "v//vn": "\n".join(corners("{0}//{1}")),
    "v/vt/vn": "\n".join(corners("{0}/{1}/{1}")),
    "CRLF": "\r\n".join(corners("{0}")),
    "CR": "\r".join(corners("{0}")),
    "comments": "# a\n" + "\n".join(f"{line} # b" for line in corners("{0}")) + "\n#f 1 1 1",
    "tabs": "\n".join(corners("{0}")).replace(" ", "\t"),
    "indented": "\n".join(f"  {line}  " for line in corners("{0}")),
    "continued": "\n".join(corners("{0}")).replace("f 1 ", "f 1 \\\n  "),
    "colours": "\n".join(
        [*(f"{line} 0.5 0.5 0.5" for line in vertex_lines()[:4]), *corners("{0}")[4:]]
    ),
    "groups": "o cube\ng side\ns off\nusemtl gold\n" + "\n".join(corners("{0}")),
    "latin-1": "# Höhe\n" + "\n".join(corners("{0}")),
}


def written(tmp_path, text, name="cube.obj"):
    path = tmp_path / name
    path.write_bytes(text.encode("latin-1") if isinstance(text, str) else text)
    return path


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_obj_gives_the_whole_cube(tmp_path, form):
    vertices, faces, _ = read_mesh(written(tmp_path, FORMS[form]))
    assert soup(vertices, faces) == soup(CUBE.vertices, CUBE.faces)


def test_quads_and_ragged_faces_are_split(tmp_path):
    vertices, faces, _ = read_mesh(written(tmp_path, "\n".join(ragged())))
    mesh = trimesh.Trimesh(vertices, faces)
    assert len(faces) == 12
    assert (mesh.area, mesh.is_watertight) == (pytest.approx(6.0), True)


def test_relative_coordinates_keep_their_corners(tmp_path):
    text = (
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf -3/-3 -2/-2 -1/-1\n"
        "v 1 1 0\nvt 1 1\nf -3/-3 -1/-1 -2/-2\n"
    )
    vertices, faces, uv = read_mesh(written(tmp_path, text))
    assert faces.shape == (2, 3)
    np.testing.assert_array_equal(uv, vertices[:, :2])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("v 0,5 0,5 0,5", r"line 2: expected 3 or more finite numbers with decimal points"),
        ("v 1 2", r"line 2: expected 3 or more finite numbers"),
        ("v nan 0 0", r"line 2: expected 3 or more finite numbers"),
        ("vt abc", r"line 2: expected 1 or more finite numbers with decimal points after 'vt'"),
        ("f 1 2", r"line 2: expected three or more corners after 'f', received 'f 1 2'"),
        ("f 0 1 2", r"line 2: expected whole numbers from 1 on"),
        ("f -9 1 2", r"line 2: expected whole .* or back from -1 to -1, for 'v'"),
        ("f 1/2/3/4 1 1", r"line 2: expected corners v, v/vt, v//vn or v/vt/vn"),
        ("f 1.5 1 1", r"line 2: expected whole numbers"),
        ("f 1 2 99", r"cube\.obj: expected faces among the 9 lines 'v', received index 99"),
    ],
)
def test_damaged_obj_is_named_by_its_line(tmp_path, line, message):
    text = "\n".join(["v 0 0 0", line, *vertex_lines(), "f 1 2 3"])
    with pytest.raises(SceneError, match=rf"cube\.obj.*{message}|{message}"):
        read_mesh(written(tmp_path, text))


def glb(tree, blob=b""):
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


WHOLE = {
    "obj": "\n".join(corners("{0}/{1}")).encode(),
    **{kind: CUBE.export(file_type=kind) for kind in ("ply", "stl", "glb")},
    "off": CUBE.export(file_type="off").encode(),
}


@pytest.mark.parametrize("kind", sorted(WHOLE))
def test_whole_files_of_every_kind_are_read(tmp_path, kind):
    vertices, faces, _ = read_mesh(written(tmp_path, WHOLE[kind], f"cube.{kind.upper()}"))
    assert soup(vertices, faces) == soup(CUBE.vertices, CUBE.faces)


@pytest.mark.parametrize("kind", sorted(set(WHOLE) - {"obj"}))
@pytest.mark.parametrize("share", [0.0, 0.2, 0.6, 0.97])
def test_truncated_files_are_one_message(tmp_path, kind, share):
    whole = WHOLE[kind]
    path = written(tmp_path, whole[: int(share * len(whole))], f"cube.{kind}")
    with pytest.raises(SceneError, match=rf"^\S*cube\.{kind}: expected [^\n]*$") as caught:
        read_mesh(path)
    assert not re.search(r"IndexError|KeyError: |unmatched", str(caught.value))


def test_ascii_ply_that_ends_early_is_not_taken_for_a_smaller_one(tmp_path):
    text = CUBE.export(file_type="ply", encoding="ascii").decode().splitlines()
    path = written(tmp_path, "\n".join(text[:-4]), "cube.ply")
    with pytest.raises(SceneError, match=r"expected 12 elements 'face', .*received 8"):
        read_mesh(path)


BOMBS = {
    "zeros.glb": glb(
        {
            "asset": {"version": "2.0"},
            "accessors": [{"count": 10**11, "type": "VEC3", "componentType": 5126}],
            "bufferViews": [],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "nodes": [],
        }
    ),
    "instances.glb": glb(
        {
            "asset": {"version": "2.0"},
            "accessors": [{"count": 30_000, "type": "VEC3", "componentType": 5126}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "nodes": [{"mesh": 0}] * 10_000,
        }
    ),
    "count.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\n"
    b"property float x\nproperty float y\nproperty float z\nelement face 99999999999\n"
    b"property list uchar int vertex_indices\nend_header\n" + bytes(64),
    "ascii.ply": b"ply\nformat ascii 1.0\nelement vertex 99999999999\nproperty float x\n"
    b"property float y\nproperty float z\nend_header\n0 0 0\n",
    "count.stl": bytes(80) + struct.pack("<I", 4_000_000_000) + bytes(50),
    "count.off": b"OFF\n999999999 999999999 0\n0 0 0\n",
    "deep.gltf": b"[" * 100_000,
    "outside.gltf": json.dumps(
        {
            "asset": {"version": "2.0"},
            "buffers": [{"uri": "../secret.bin", "byteLength": 12}],
            "bufferViews": [{"buffer": 0, "byteLength": 12}],
            "accessors": [{"bufferView": 0, "count": 1, "type": "VEC3", "componentType": 5126}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}],
        }
    ).encode(),
}


@pytest.mark.parametrize("name", sorted(BOMBS))
def test_files_that_ask_for_what_they_do_not_hold_are_refused(tmp_path, name):
    (tmp_path / "secret.bin").write_bytes(bytes(12))
    (tmp_path / "meshes").mkdir()
    path = written(tmp_path / "meshes", BOMBS[name], name)
    with pytest.raises(SceneError, match=rf"{name}: expected|outside|secret\.bin"):
        read_mesh(path)


@pytest.mark.parametrize("name", ["cube.zip", "cube.3mf", "cube.xyz", "cube", "cube.obj.gz"])
def test_other_kinds_of_files_are_refused_unread(tmp_path, name):
    with pytest.raises(SceneError, match=r"a mesh file \(OBJ, PLY, STL, OFF, GLB, GLTF\)"):
        read_mesh(written(tmp_path, b"PK\3\4", name))


def test_folders_and_pipes_are_refused_unopened(tmp_path):
    (tmp_path / "folder.obj").mkdir()
    os.mkfifo(tmp_path / "pipe.obj")
    for name, kind in (("folder", "a folder"), ("pipe", "a named pipe")):
        with pytest.raises(SceneError, match=rf"object\.file: .*received {kind}"):
            make_object({"type": "mesh", "file": f"{name}.obj"}, tmp_path)
    with pytest.raises(SceneError, match=r"object\.file: expected a path, received 3"):
        make_object({"type": "mesh", "file": 3}, tmp_path)


def test_meshes_beyond_the_ceiling_are_refused_with_what_would_suffice(tmp_path):
    path = written(tmp_path, bytes(1 << 20), "cube.stl")
    with (
        memory_limit(1 << 20),
        pytest.raises(SceneError, match=r"--max-memory: expected at least \d+ MB for \S*cube"),
    ):
        read_mesh(path)
