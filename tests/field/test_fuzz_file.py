"""Field files that are damaged or made to harm: one error that names the file, or the field."""

import hashlib
import json
import os
import shutil
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from reflfield.errors import FieldFileError, InputError
from reflfield.field import file as field_file
from reflfield.field.array_schemas import ARRAYS
from reflfield.field.description import describe
from reflfield.field.evaluation import evaluate
from reflfield.field.file import open_field, write_field

N_TEXELS = 60


@pytest.fixture
def field(make_field):
    return make_field(metadata={"up": [0.0, 1.0, 0.0], "options": {"clusters": 3}})


@pytest.fixture
def path(tmp_path, field):
    write_field(tmp_path / "field.rfld", field)
    return tmp_path / "field.rfld"


def parts(path):
    """Header and members of a field file."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    return json.loads(members.pop("header.json")), members


def assemble(path, header, members):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("header.json", json.dumps(header))
        for name, content in members.items():
            archive.writestr(name, content)


def with_array(path, name, array):
    """The file with another array in it, packed and with its checksum as if it were meant."""
    header, members = parts(path)
    packed = field_file.packed_array(name, array)
    members[f"{name}.bin"] = packed.content
    header["arrays"][name] = {
        "dtype": array.dtype.name,
        "shape": list(array.shape),
        "filter": packed.filter,
        "context_bits": packed.context_bits,
        "sha256": hashlib.sha256(packed.content).hexdigest(),
    }
    assemble(path, header, members)


def use_everything(path):
    """All that a field gives; arrays and options to compare."""
    opened = open_field(path, max_bytes=1 << 28)
    description = describe(opened)
    up = np.tile([[0.0, 0.0, 1.0]], (opened.n_texels, 1))
    values = evaluate(opened, np.arange(opened.n_texels), up, up)
    assert np.isfinite(values).all()
    arrays = {name: opened.arrays[name] for name in ARRAYS}
    frames, options = opened.local_from_world, description.options
    return arrays, values, frames, opened.up, options, opened.metadata


def tried(path):
    """All that a field gives, or None and what is said of it."""
    try:
        return use_everything(path), ""
    except FieldFileError as error:
        return None, str(error)


def assert_same(one, other):
    assert all(np.array_equal(one[0][name], other[0][name]) for name in ARRAYS)
    assert all(np.array_equal(a, b) for a, b in zip(one[1:4], other[1:4], strict=True))
    assert one[4:] == other[4:]


def damaged(content, rng):
    """Some way to damage a file: bits, bytes, runs, cuts, repetitions."""
    data = bytearray(content)
    at = int(rng.integers(len(data)))
    kind = rng.integers(6)
    if kind == 0:
        data[at] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        data[at] = int(rng.integers(256))
    elif kind == 2:
        run = data[at : at + int(rng.integers(1, 64))]
        data[at : at + len(run)] = rng.bytes(len(run))
    elif kind == 3:
        del data[at:]
    elif kind == 4:
        del data[at : at + int(rng.integers(1, 64))]
    else:
        data[at:at] = data[at : at + int(rng.integers(1, 64))]
    return bytes(data)


def damage_is_noticed_or_harmless(path, rng, times):
    content, whole = path.read_bytes(), use_everything(path)
    noticed = 0
    for _ in range(times):
        path.write_bytes(damaged(content, rng))
        read, message = tried(path)
        if read is None:
            assert message.startswith(str(path))
            assert "\n" not in message
            noticed += 1
        else:
            assert_same(whole, read)
    return noticed


def test_damaged_bytes_are_noticed_or_harmless(path, rng):
    """Padding of the archive's own records may change; nothing that is used does."""
    assert damage_is_noticed_or_harmless(path, rng, 150) > 120


@pytest.mark.slow
def test_much_damage_is_noticed_or_harmless(path, rng):
    assert damage_is_noticed_or_harmless(path, rng, 5000) > 4000


ZERO, NEGATIVE, NAN, INFINITE, HUGE = 0.0, -1.0, np.nan, np.inf, 1e38
STEPS = (
    "turn_step", "function_scale", "function_gain", "view_scale", "light_scale", "core_scale",
    "indirect_scale", "position_box", "uv_box",
)  # fmt: skip


@pytest.mark.parametrize("value", [ZERO, NEGATIVE, NAN, INFINITE, HUGE])
@pytest.mark.parametrize("name", STEPS)
def test_steps_that_are_none_are_refused(path, field, name, value):
    array = field.arrays[name].copy()
    array[..., -1] = value
    with_array(path, name, array)
    with pytest.raises(FieldFileError, match=rf"field\.rfld: {name}: expected .*received"):
        use_everything(path)


@pytest.mark.parametrize("value", [NEGATIVE, NAN, INFINITE, HUGE])
@pytest.mark.parametrize(
    "name", ["coefficient_scale", "colour_factor", "indirect_functions", "position_box"]
)
def test_numbers_that_are_none_are_refused(path, field, name, value):
    array = field.arrays[name].copy()
    array[(0,) * array.ndim] = value
    if value == NEGATIVE and name != "coefficient_scale":
        pytest.skip("may be negative")
    with_array(path, name, array)
    with pytest.raises(FieldFileError, match=rf"field\.rfld: {name}: expected .*received"):
        use_everything(path)


def test_products_that_overflow_are_refused(path, field):
    for name in ("core_scale", "function_gain"):
        with_array(path, name, np.full_like(field.arrays[name], 1e24))
    with pytest.raises(InputError, match=r"functions: expected finite numbers"):
        use_everything(path)


@pytest.mark.parametrize("name", ["faces", "texel_of_pixel", "cluster"])
def test_indices_beyond_the_ends_name_the_file(path, field, name):
    array = field.arrays[name].copy()
    array.flat[0] = 99
    with_array(path, name, array)
    with pytest.raises(FieldFileError, match=rf"field\.rfld: {name}: expected indices from"):
        use_everything(path)


@pytest.mark.parametrize(
    ("axis", "name"),
    [
        ("n_vertices", "positions"),
        ("n_faces", "faces"),
        ("height", "texel_of_pixel"),
        ("width", "texel_of_pixel"),
        ("n_texels", "cluster"),
        ("n_clusters", "coefficient_scale"),
        ("function_rank", "function_scale"),
        ("view_rank", "view_scale"),
        ("light_rank", "light_scale"),
    ],
)
def test_fields_of_nothing_are_refused(path, axis, name):
    header, members = parts(path)
    for other, (_, axes) in ARRAYS.items():
        shape = header["arrays"][other]["shape"]
        header["arrays"][other]["shape"] = [
            0 if a == axis else n for a, n in zip(axes, shape, strict=True)
        ]
    assemble(path, header, members)
    with pytest.raises(FieldFileError, match=rf"{name}.*expected {axis} of at least 1"):
        open_field(path)


@pytest.mark.parametrize(
    "metadata",
    [
        {"up": [0, 0]},
        {"up": [0, 0, 0]},
        {"up": "z"},
        {"up": [0, 0, 1e400]},
        {"up": {"x": 1}},
        {"observed_lights": [[0, 0, 5]]},
        {"observed_lights": "all"},
        {"observed_lights": [[1, 0, 0], [1, 0]]},
        [1, 2],
        [["up", [0, 0, 1]]],
        "text",
        None,
        {"psnr": float("nan")},
    ],
)
def test_metadata_that_are_none_are_refused_when_the_file_is_opened(path, metadata):
    header, members = parts(path)
    header["metadata"] = metadata
    assemble(path, header, members)
    with pytest.raises(FieldFileError, match=r"field\.rfld: damaged reflectance field \("):
        open_field(path)


def grown(header, **lengths):
    """Header with other lengths of some axes."""
    for name, (_, axes) in ARRAYS.items():
        shape = header["arrays"][name]["shape"]
        header["arrays"][name]["shape"] = [
            lengths.get(axis, n) for axis, n in zip(axes, shape, strict=True)
        ]
    return header


@pytest.mark.parametrize(
    "lengths",
    [
        {"n_clusters": 65_000, "n_view_nodes": 441, "n_light_nodes": 441},
        {"n_texels": 100_000_000},
        {"height": 60_000, "width": 60_000},
        {"function_rank": 3000, "view_rank": 400, "light_rank": 400},
        {"n_vertices": 10**18},
    ],
)
def test_sizes_are_compared_before_anything_is_unpacked(path, lengths, monkeypatch):
    header, members = parts(path)
    assemble(path, grown(header, **lengths), members)
    monkeypatch.setattr(field_file, "unpack", None)
    with pytest.raises(FieldFileError, match=r"expected arrays of at most \d+ bytes"):
        open_field(path)


def test_files_that_are_none_are_refused_unopened(tmp_path):
    os.mkfifo(tmp_path / "pipe.rfld")
    (tmp_path / "loop.rfld").symlink_to("loop.rfld")
    (tmp_path / "nowhere.rfld").symlink_to("nothing")
    (tmp_path / "empty.rfld").touch()
    for name, message in {
        "pipe.rfld": "expected a file, received a named pipe",
        "loop.rfld": "cannot be read",
        "nowhere.rfld": "cannot be read",
        "empty.rfld": "expected a reflectance field",
    }.items():
        with pytest.raises(FieldFileError, match=rf"{name}: {message}"):
            open_field(tmp_path / name)


JUNK = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**30), 10**30),
    st.sampled_from([0, 1, -1, 2**31, 2**63, 10**400, 3.0, 1e308]),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(max_size=8),
    st.lists(st.integers(-2, 2**40), max_size=4),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
)


def places(tree, before=()):
    """Paths to all entries of a JSON value."""
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        yield (*before, key)
        if isinstance(value, dict | list):
            yield from places(value, (*before, key))


def fuzzed_headers(path, examples):
    """Put junk at any place of the header; what is opened all the same is of finite numbers."""
    header, members = parts(path)
    text, everywhere = json.dumps(header), list(places(header))
    whole = use_everything(path)

    @settings(
        max_examples=examples,
        deadline=10_000,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.lists(st.tuples(st.sampled_from(everywhere), JUNK), min_size=1, max_size=2))
    def fuzz(changes):
        changed = json.loads(text)
        for place, junk in changes:
            at = changed
            for key in place[:-1]:
                at = at[key] if isinstance(at, dict | list) and _has(at, key) else {}
            if isinstance(at, dict | list) and _has(at, place[-1]):
                at[place[-1]] = junk
        assemble(path, changed, members)
        read, message = tried(path)
        if read is None:
            assert message.startswith(str(path))
            assert len(message) < 2000
        else:
            assert all(np.array_equal(whole[0][n], read[0][n]) for n in ARRAYS)

    fuzz()


def _has(tree, key):
    return key in tree if isinstance(tree, dict) else isinstance(key, int) and key < len(tree)


def test_headers_with_junk_are_one_error_or_a_field(path):
    fuzzed_headers(path, 80)


@pytest.mark.slow
def test_many_headers_with_junk(path):
    fuzzed_headers(path, 3000)


def test_members_of_other_fields_do_not_fit(path, make_field, tmp_path):
    write_field(tmp_path / "other.rfld", make_field(n_texels=61))
    header, members = parts(path)
    members["cluster.bin"] = parts(tmp_path / "other.rfld")[1]["cluster.bin"]
    assemble(path, header, members)
    with pytest.raises(FieldFileError, match=r"cluster: the checksum differs"):
        use_everything(path)


def test_deep_headers_are_refused(path, tmp_path):
    _, members = parts(path)
    shutil.copy(path, tmp_path / "deep.rfld")
    with zipfile.ZipFile(tmp_path / "deep.rfld", "w") as archive:
        archive.writestr("header.json", b'{"metadata": ' + b"[" * 100_000)
        for name, content in members.items():
            archive.writestr(name, content)
    with pytest.raises(FieldFileError, match=r"deep\.rfld: damaged reflectance field"):
        open_field(tmp_path / "deep.rfld")


@pytest.mark.parametrize(
    ("name", "value", "what"),
    [
        ("function_gain", 1e20, "functions"),
        ("coefficient_scale", 1e24, "functions"),
        ("core_scale", 1e24, "functions"),
        ("indirect_scale", 1e24, "indirect_functions"),
        ("indirect_functions", 1e24, "indirect_functions"),
    ],
)
def test_finite_values_whose_samples_overflow(path, name, value, what):
    opened = open_field(path)
    with_array(path, name, np.full_like(opened.arrays[name], value))
    spoilt = open_field(path)
    with pytest.raises(FieldFileError, match=rf"field\.rfld: {what}: expected finite numbers"):
        _ = spoilt.node_table, spoilt.indirect
