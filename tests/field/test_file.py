"""The field file: identity, same bytes, laziness, and everything that is refused."""

import hashlib
import json
import pickle
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest

from reflfield.errors import FieldFileError, InputError
from reflfield.field import file as field_file
from reflfield.field.array_schemas import ARRAYS
from reflfield.field.build import Quantisation
from reflfield.field.description import describe
from reflfield.field.evaluation import evaluate
from reflfield.field.file import FORMAT_VERSION, open_field, write_field
from tests.synthetic_fields import baked_field, lambert, square_surface


@pytest.fixture
def field(make_field):
    return make_field(metadata={"options": {"clusters": 3}, "name": "vase"})


@pytest.fixture
def path(tmp_path, field):
    write_field(tmp_path / "field.rfld", field)
    return tmp_path / "field.rfld"


def rewrite(path, change):
    """Write the archive anew after `change` of its {name: bytes}."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def edit_header(path, change):
    def edit(members):
        header = json.loads(members["header.json"])
        change(header)
        members["header.json"] = json.dumps(header).encode()

    rewrite(path, edit)


def replace_array(path, name, content):
    """Put other bytes in place of a member, with the checksum to match."""

    def edit(members):
        members[f"{name}.bin"] = content
        header = json.loads(members["header.json"])
        header["arrays"][name]["sha256"] = hashlib.sha256(content).hexdigest()
        members["header.json"] = json.dumps(header).encode()

    rewrite(path, edit)


@pytest.mark.parametrize("n_components", [0, 4])
@pytest.mark.parametrize("step", [0.0, 0.1])
def test_save_and_load_is_identity(n_components, step, make_field, tmp_path):
    bits = Quantisation(step)
    field = make_field(n_components=n_components, quantisation=bits, metadata={"a": [1, "b"]})
    write_field(tmp_path / "f.rfld", field)
    opened = open_field(tmp_path / "f.rfld")
    for name in ARRAYS:
        assert opened.arrays[name].dtype == field.arrays[name].dtype
        assert np.array_equal(opened.arrays[name], field.arrays[name]), name
    for name in ("view_side", "light_side", "domain", "visibility", "light_model", "metadata"):
        assert getattr(opened, name) == getattr(field, name)
    up = np.tile([[0.0, 0.0, 1.0]], (60, 1))
    values = [evaluate(f, np.arange(60), up, up) for f in (field, opened)]
    assert np.array_equal(*values)


def test_equal_fields_give_equal_bytes(field, path, tmp_path):
    write_field(tmp_path / "again.rfld", open_field(path))
    assert (tmp_path / "again.rfld").read_bytes() == path.read_bytes()


def test_opening_reads_no_array_until_it_is_used(path, monkeypatch):
    read = []
    original = field_file._read_array
    monkeypatch.setattr(
        field_file, "_read_array", lambda p, name, d: read.append(name) or original(p, name, d)
    )
    opened = open_field(path)
    assert read == []
    _ = (opened.n_clusters, opened.n_clusters)
    assert read == ["coefficient_scale"]


def test_writing_leaves_nothing_behind_when_it_fails(tmp_path, path, field):
    before = path.read_bytes()
    bad = baked_field(square_surface(1), lambert(0.5), metadata={"when": object()})
    with pytest.raises(InputError, match="metadata: expected plain JSON"):
        write_field(path, bad)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["field.rfld"]


def test_missing_file_and_other_files_are_refused(tmp_path, path):
    with pytest.raises(FieldFileError, match=r"none.rfld: no such file"):
        open_field(tmp_path / "none.rfld")
    text = tmp_path / "text.rfld"
    text.write_text("no field")
    with pytest.raises(FieldFileError, match=r"text.rfld: expected a reflectance field"):
        open_field(text)
    with zipfile.ZipFile(tmp_path / "other.rfld", "w") as archive:
        archive.writestr("a.txt", "b")
    with pytest.raises(FieldFileError, match=r"a ZIP archive without header.json"):
        open_field(tmp_path / "other.rfld")
    with pytest.raises(FieldFileError, match=r"expected a file, received a folder"):
        open_field(tmp_path)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_truncated_files_are_refused(path, share):
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(FieldFileError, match=r"field.rfld: "):
        open_field(path)


def test_any_flipped_byte_is_noticed_or_harmless(path, field, rng):
    content = path.read_bytes()
    for position in rng.integers(0, len(content), 60):
        damaged = bytearray(content)
        damaged[position] ^= 0x5A
        path.write_bytes(bytes(damaged))
        try:
            opened = open_field(path)
            arrays = {name: opened.arrays[name] for name in ARRAYS}
        except FieldFileError:
            continue
        # Padding of the archive's own records may change without an effect.
        assert all(np.array_equal(arrays[name], field.arrays[name]) for name in ARRAYS)


def test_versions_of_the_past_are_refused(path):
    edit_header(path, lambda header: header.update(version=2))
    with pytest.raises(FieldFileError, match=r"version 2 of the format.*make the field again"):
        open_field(path)


def test_newer_versions_are_refused(path):
    edit_header(path, lambda header: header.update(version=FORMAT_VERSION + 1))
    wanted = rf"version {FORMAT_VERSION + 1} of the format.*install a newer"
    with pytest.raises(FieldFileError, match=wanted):
        open_field(path)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda h: h.update(format="other"), "expected format 'reflfield-field'"),
        (lambda h: h.update(version="1"), "version: expected a number"),
        (lambda h: h.update(domain="log"), "domain: expected one of"),
        (lambda h: h.pop("domain"), "damaged reflectance field"),
        (lambda h: h["arrays"].pop("uv"), "arrays: expected"),
        (lambda h: h["arrays"]["uv"].update(dtype="object"), "uv: expected dtype uint16"),
        (lambda h: h["arrays"]["uv"].update(shape=[5, 3]), "uv: expected shape"),
        (lambda h: h["arrays"]["faces"].update(shape=[-7, 3]), "shape: expected numbers >= 0"),
        (
            lambda h: h["arrays"]["faces"].update(shape=[10**15, 3]),
            "expected arrays of at most",
        ),
        (lambda h: h["arrays"]["faces"].update(shape=[8, 3]), "faces: expected 96 bytes"),
        (lambda h: h["arrays"]["faces"].update(shape=[6, 3]), "faces: expected 72 bytes"),
        (lambda h: h["arrays"]["faces"].update(filter="x"), "unknown filter"),
        (lambda h: h["arrays"]["faces"].update(context_bits=7), "faces: expected a known"),
        (lambda h: h["arrays"]["core"].update(shape=[1, 1, 1, 3]), "core: expected shape"),
        (lambda h: h["arrays"]["faces"].update(sha256="0"), "faces: the checksum differs"),
        (lambda h: h.update(arrays=[1]), "damaged reflectance field"),
    ],
)
def test_bad_headers_are_refused(path, change, text):
    edit_header(path, change)
    with pytest.raises(FieldFileError, match=text):
        _ = open_field(path).faces


def test_members_that_are_there_twice_are_named(path):
    with zipfile.ZipFile(path, "a") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the writer's own
        archive.writestr("uv.bin", b"x")
    with pytest.raises(FieldFileError, match=r"there more than once: \['uv\.bin'\]"):
        open_field(path)


def test_missing_and_surplus_members_are_refused(path):
    rewrite(path, lambda members: members.update({"../../evil.py": b"x"}))
    with pytest.raises(FieldFileError, match=r"not known: \['../../evil.py'\]"):
        open_field(path)
    rewrite(path, lambda members: (members.pop("../../evil.py"), members.pop("uv.bin")))
    with pytest.raises(FieldFileError, match=r"missing: \['uv.bin'\]"):
        open_field(path)


def test_pickles_and_foreign_bytes_are_refused(path):
    replace_array(path, "faces", pickle.dumps({"a": 1}))
    with pytest.raises(FieldFileError, match=r"faces"):
        _ = open_field(path).faces


def test_packed_members_are_refused(path):
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    with pytest.raises(FieldFileError, match="expected stored members"):
        open_field(path)


def test_false_sizes_allocate_nothing(path):
    edit_header(path, lambda h: h["arrays"]["faces"].update(shape=[10**8, 3]))
    tracemalloc.start()
    with pytest.raises(FieldFileError, match=r"faces: expected 1200000000 bytes"):
        _ = open_field(path, max_bytes=1 << 40).faces
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 25  # the dictionary


def test_bombs_are_refused_before_they_are_unpacked(tmp_path):
    # 5 MB of zeros in some kB: allowed only as far as the caller says.
    field = baked_field(square_surface(1), lambert(0.0), view_side=31, light_side=21)
    write_field(tmp_path / "bomb.rfld", field)
    with pytest.raises(FieldFileError, match="expected arrays of at most 1000000 bytes"):
        open_field(tmp_path / "bomb.rfld", max_bytes=1_000_000)


def test_indices_out_of_range_are_refused(path, field):
    def edit(members):
        packed = field_file.packed_array("cluster", np.full(60, 200, np.uint8))
        members["cluster.bin"] = packed.content
        header = json.loads(members["header.json"])
        digest = hashlib.sha256(packed.content).hexdigest()
        more = {"filter": packed.filter, "context_bits": packed.context_bits}
        header["arrays"]["cluster"].update(sha256=digest, **more)
        members["header.json"] = json.dumps(header).encode()

    rewrite(path, edit)
    with pytest.raises(InputError, match="cluster: expected indices from 0 to 2"):
        _ = open_field(path).cluster


def test_index_arrays_pack_well(tmp_path):
    field = baked_field(square_surface(256), lambert(0.5))
    write_field(tmp_path / "f.rfld", field)
    stored = open_field(tmp_path / "f.rfld").arrays.stored_bytes
    # 262 kB of running numbers; differences of 1 pack to next to nothing.
    assert stored["texel_of_pixel"] < 500


def test_description_names_counts_sizes_and_options(path, field):
    described = describe(open_field(path))
    assert described.counts["texels"] == 60
    assert described.counts["components"] == 4
    assert described.options["domain"] == "cube_root"
    assert described.memory_bytes["core"] == field.arrays["core"].nbytes
    assert sum(described.stored_bytes.values()) < path.stat().st_size
    assert described.ranges["mean"] == (field.mean.min(), field.mean.max())
    text = "\n".join(described.lines())
    for part in ("texels: 60", "domain: cube_root", "core:", "in the file", "metadata.name"):
        assert part in text
    assert describe(field).stored_bytes == {}
