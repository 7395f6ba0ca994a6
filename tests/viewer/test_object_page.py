"""The page as text: nothing is fetched, names are escaped, sizes are bounded; its commands."""

import base64
import hashlib
import json
import re
import struct
import subprocess
import sys
import threading
import urllib.error
import urllib.request
import zlib
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import trimesh

import reflfield as rf
from reflfield.errors import InputError
from reflfield.export.formats import FORMATS, export_field
from reflfield.field.observed_sphere import table_directions
from reflfield.field.quantisation import QuantisedBox
from reflfield.viewer.object_page import (
    PAGE_FILES,
    SCRIPTS,
    Bookmark,
    can_be_shown,
    object_page,
    too_large_page,
    write_object_page,
)
from reflfield.viewer.page_asset import TABLE_STEPS, packed_block, page_asset
from reflfield.viewer.page_server import PageServer
from tests.viewer.shown_fields import half_vector_field

HOSTILE = "</script><script>alert(1)</script>\u202e & \"'<!--"


class Elements(HTMLParser):
    """Attributes of all elements, and the text of scripts and styles."""

    def __init__(self, html):
        super().__init__()
        self.tags, self.texts, self.inside = [], {}, None
        self.feed(html)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self.inside = (tag, dict(attributes).get("id"), dict(attributes).get("type"))

    def handle_data(self, data):
        self.texts.setdefault(self.inside, []).append(data)


@pytest.fixture(scope="module")
def field():
    return half_vector_field(name=HOSTILE)


@pytest.fixture(scope="module")
def page(field):
    return object_page(field)


def decoded(block):
    """Arrays of a packed block, as the script restores them."""
    content = zlib.decompress(block.content)
    assert len(content) == block.size
    arrays = {}
    for entry in block.entries:
        dtype, shape = np.dtype(entry["dtype"]), tuple(entry["shape"])
        n_bytes = int(np.prod(shape)) * dtype.itemsize
        raw = np.frombuffer(content[entry["start"] : entry["start"] + n_bytes], np.uint8)
        if entry["planes"]:
            raw = np.ascontiguousarray(raw.reshape(dtype.itemsize, -1).T)
        array = raw.reshape(-1).view(dtype).reshape(shape)
        for axis in entry["delta"]:
            array = np.cumsum(array, axis=axis, dtype=dtype)
        arrays[entry["name"]] = array
    return arrays


def stored_vectors(path, attribute):
    """An attribute of the only mesh of a glTF file, as stored: trimesh computes normals."""
    content = path.read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    document, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    number = document["meshes"][0]["primitives"][0]["attributes"][attribute]
    accessor = document["accessors"][number]
    start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    return np.frombuffer(binary, np.float32, 3 * accessor["count"], start).reshape(-1, 3)


class TestPacking:
    @pytest.mark.parametrize("dtype", ["int8", "uint8", "int16", "uint16", "int32", "float32"])
    @pytest.mark.parametrize("kind", ["noise", "ramp", "empty"])
    def test_arrays_come_back(self, rng, dtype, kind):
        values = rng.integers(-128, 127, (7, 5, 3)) if kind == "noise" else np.arange(105)
        packed = values.reshape(-1, 5, 3).astype(dtype)[: 0 if kind == "empty" else None]
        back = decoded(packed_block({"first": packed, "second": packed}))
        for name in ("first", "second"):
            np.testing.assert_array_equal(back[name], packed)
            assert back[name].dtype == packed.dtype

    def test_smooth_numbers_become_small(self):
        ramp = np.add.outer(np.arange(200), np.arange(300)).astype(np.int16)
        assert len(packed_block({"ramp": ramp}).content) < ramp.nbytes / 100

    def test_an_asset_holds_the_arrays_of_the_field(self, field):
        asset = page_asset(field)
        first, rest = map(decoded, asset.blocks)
        for name, array in (first | rest).items():
            if name in field.arrays:
                np.testing.assert_array_equal(array, field.arrays[name])
        box = QuantisedBox(first["positions"], first["position_box"])
        np.testing.assert_array_equal(box.decode(), field.positions)
        assert asset.header["traced"]

    def test_indirect_light_is_that_of_the_field_to_half_a_step(self, field):
        _, rest = map(decoded, page_asset(field).blocks)
        shown = rest["indirect_table"] * rest["indirect_table_scale"][:, None, None]
        nodes = table_directions()
        wanted = field.indirect.at(nodes.reshape(-1, 3)).reshape(*nodes.shape[:2], -1)
        wanted = np.moveaxis(wanted, 2, 0)
        step = np.abs(wanted).max(axis=(1, 2), keepdims=True) / TABLE_STEPS
        assert (np.abs(shown - wanted) <= 0.501 * step).all()

    def test_kept_shadows_need_no_indirect_light(self):
        asset = page_asset(half_vector_field("kept"))
        names = {entry["name"] for block in asset.blocks for entry in block.entries}
        assert not any(name.startswith("indirect") for name in names)
        assert not asset.header["indirect"]


class TestText:
    def test_scripts_and_styles_are_allowed_by_their_digests_and_nothing_else_is(self, page):
        elements = Elements(page)
        (policy,) = [
            attributes["content"]
            for _, attributes in elements.tags
            if attributes.get("http-equiv") == "Content-Security-Policy"
        ]
        rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
        assert rules["default-src"] == "'none'"
        assert rules["img-src"] == "data:"
        assert "unsafe" not in policy
        assert "http" not in policy
        for tag, rule in (("script", "script-src"), ("style", "style-src")):
            texts = [t for key, some in elements.texts.items() if key == (tag, None, None)
                     for t in some if t.strip()]  # fmt: skip
            assert texts
            for text in texts:
                digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
                assert f"'sha256-{digest}'" in rules[rule]

    def test_nothing_is_fetched(self, page):
        for tag, attributes in Elements(page).tags:
            assert tag not in ("link", "iframe", "object", "embed", "base")
            assert not {"src", "href", "srcset", "action", "style"} & set(attributes)
            assert not any(name.startswith("on") for name in attributes)
        assert not re.search(r"\bfetch\(|XMLHttpRequest|WebSocket|importScripts|import\(", page)
        assert not re.search(r"\b(eval|Function)\(|innerHTML|document\.write", page)

    def test_names_are_escaped(self, page):
        tags = [tag for tag, _ in Elements(page).tags]
        assert tags.count("script") == len(re.findall("<script", page)) == 7
        assert "alert(1)</script>" not in page
        assert "&lt;script&gt;alert(1)" in page
        assert "\u202e" not in page

    def test_notes_of_bookmarks_are_no_markup(self, field):
        camera = rf.Camera.look_at([0, -3, 0], width=8, height=8)
        light = rf.PointLight([0, -3, 1])
        bookmark = Bookmark(HOSTILE, HOSTILE, camera, (light,), 1.0, b"</script>")
        text = object_page(field, bookmarks=[bookmark])
        assert len(re.findall("<script", text)) == 7
        header = json.loads(re.search(r'id="header">(.*?)</script>', text).group(1))
        assert header["bookmarks"][0]["name"].startswith("</script>")

    def test_all_files_of_the_package_are_in_it(self, page):
        folder = Path(rf.__file__).parent / "viewer"
        beside = {
            path.name for path in folder.iterdir() if path.suffix in (".js", ".css", ".html")
        }
        assert beside == set(PAGE_FILES)
        assert all((folder / name).read_text() in page for name in SCRIPTS)

    def test_same_field_same_text(self, field, page):
        assert object_page(field) == page

    def test_too_large_a_page_is_refused(self, field):
        with pytest.raises(InputError, match=r"page: expected at most 1,000 bytes.*`size`"):
            object_page(field, most_bytes=1000)
        assert "&lt;/script&gt;" in too_large_page(HOSTILE)

    def test_the_first_picture_comes_within_a_megabyte(self, page):
        assert page.index('id="block-1"') < 1e6

    def test_lenses_that_bend_lines_and_maps_cannot_be_shown(self):
        camera = rf.Camera.look_at([0, 0, 2])
        assert can_be_shown(camera, rf.PointLight([0, 0, 2]))
        assert not can_be_shown(camera, rf.Light("even", "point", falls_off=False))
        spot = rf.Light("s", "spot", position=[0, 0, 2], direction=[0, 0, -1])
        assert not can_be_shown(camera, spot)
        bent = rf.Camera("b", "opencv", 9, 9, 9, 9, 4, 4, np.eye(4), (0.1,))
        assert not can_be_shown(bent, rf.PointLight([0, 0, 2]))


class TestFormats:
    def test_html_and_gltf_are_written(self, field, tmp_path):
        export_field(field, tmp_path / "deep" / "object.html", "html")
        assert (tmp_path / "deep" / "object.html").read_text() == object_page(field)
        export_field(field, tmp_path / "object.glb", "gltf")
        loaded = trimesh.load(tmp_path / "object.glb", force="mesh")
        assert len(loaded.faces) == len(field.faces)
        # Both sides of a seam have one normal.
        places, normals = (
            stored_vectors(tmp_path / "object.glb", name) for name in ("POSITION", "NORMAL")
        )
        same = (places[:, None] == places[None]).all(axis=2)
        assert same.sum() > len(places) + 24
        assert (normals @ normals.T)[same].min() > 1 - 1e-6

    def test_unknown_ones_are_refused_with_the_list(self, field, tmp_path):
        with pytest.raises(InputError, match=r"to: expected one of html.*gltf.*received 'obj'"):
            export_field(field, tmp_path / "object.obj", "obj")
        with pytest.raises(InputError, match=r"out: expected a name that ends in \.html"):
            export_field(field, tmp_path / "object.htm", "html")
        assert list(tmp_path.iterdir()) == []
        assert set(FORMATS) >= {"html", "gltf"}


class TestServer:
    @pytest.fixture
    def server(self):
        with PageServer("<p>Münze".encode()) as running:
            thread = threading.Thread(target=running.serve_forever)
            thread.start()
            yield running
            running.shutdown()
            thread.join()

    def test_serves_the_page_to_this_machine(self, server):
        assert server.server_address[0] == "127.0.0.1"
        with urllib.request.urlopen(server.url) as answer:
            assert answer.read().decode() == "<p>Münze"
            assert answer.headers["Content-Type"] == "text/html; charset=utf-8"

    @pytest.mark.parametrize("path", ["etc/passwd", "../", "index.html"])
    def test_serves_nothing_else(self, server, path):
        with pytest.raises(urllib.error.HTTPError, match="404") as refused:
            urllib.request.urlopen(server.url + path)
        refused.value.close()

    def test_other_names_that_lead_here_get_nothing(self, server):
        asked = urllib.request.Request(server.url, headers={"Host": "evil.example:80"})
        with pytest.raises(urllib.error.HTTPError, match="404") as refused:
            urllib.request.urlopen(asked)
        refused.value.close()

    def test_ports_that_cannot_be_used_are_refused(self, server):
        with pytest.raises(InputError, match=f"port: {server.server_port} cannot be used"):
            PageServer(b"", server.server_port)
        with pytest.raises(InputError, match="port: expected 0 to 65535, received -1"):
            PageServer(b"", -1)


def test_writing_a_page_imports_nothing_slow(field, tmp_path):
    slow = ("dask", "distributed", "matplotlib", "open3d", "trimesh", "zarr", "skimage")
    rf.Field(field).save(tmp_path / "field.rfld")
    script = (
        "import sys; from reflfield.field.file import open_field\n"
        "from reflfield.viewer.object_page import write_object_page\n"
        "write_object_page(sys.argv[2], open_field(sys.argv[1]))\n"
        f"print(*(set({slow}) & set(sys.modules)))"
    )
    paths = [str(tmp_path / name) for name in ("field.rfld", "object.html")]
    done = subprocess.run(
        [sys.executable, "-c", script, *paths], capture_output=True, check=True, text=True
    )
    assert done.stdout.split() == []
    write_object_page(tmp_path / "again.html", field)
    assert (tmp_path / "again.html").read_text() == (tmp_path / "object.html").read_text()
