"""The container of Bonn's BTFs, byte by byte."""

import struct
from dataclasses import replace

import numpy as np
import pytest

from reflfield.capture.btf_container import (
    BtfContainer,
    angles_of,
    directions_of,
    read_btf,
    write_btf,
)
from reflfield.errors import CaptureError, ShapeError


def container(rng, dtype="f4", **changes):
    """Three by two texels, two views, four lights, two components."""
    values = {
        "width": 3, "height": 2,
        "views": rng.uniform(0, 1, (2, 2)).astype("f4"),
        "lights": rng.uniform(0, 1, (4, 2)).astype("f4"),
        "singular_values": np.array([2.0, 1.0], dtype),
        "u": rng.normal(size=(24, 2)).astype(dtype),
        "sv": rng.normal(size=(6, 2)).astype(dtype),
        "rotations": rng.normal(size=(6, 3, 3)).astype("f4"),
        "setup": "dome", "xml": "<a/>", "pixels_per_mm": 2.0,
    }  # fmt: skip
    return BtfContainer(**(values | changes))


def assert_equal(one, other):
    for name in vars(one):
        wanted, read = getattr(one, name), getattr(other, name)
        if isinstance(wanted, np.ndarray):
            assert read.dtype == wanted.dtype
            np.testing.assert_array_equal(read, wanted)
        else:
            assert read == wanted


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8"])
@pytest.mark.parametrize("rotated", [True, False])
def test_what_is_written_is_read_to_the_bit(tmp_path, rng, dtype, rotated):
    written = container(rng, dtype)
    written = written if rotated else replace(written, rotations=None)
    write_btf(tmp_path / "a.btf", written)
    read = read_btf(tmp_path / "a.btf")
    assert_equal(written, read)
    write_btf(tmp_path / "b.btf", read)
    assert (tmp_path / "a.btf").read_bytes() == (tmp_path / "b.btf").read_bytes()


@pytest.mark.reference
def test_bytes_are_where_the_format_says(tmp_path, rng):
    """Offsets counted by hand from the description of the format."""
    written = container(rng)
    write_btf(tmp_path / "a.btf", written)
    content = (tmp_path / "a.btf").read_bytes()
    assert content[:9] == b"!FMF06FCR"
    size, version = struct.unpack_from("<II", content, 9)
    # Itself, version, 3 x 80, 4 floats, flag, XML of 4, three names of one letter.
    assert size == 4 + 4 + 240 + 16 + 4 + (4 + 4) + 4 + 3 * (4 + 1)
    assert version == 4
    at = 9 + size
    n_views, theta, phi, n_lights = struct.unpack_from("<IffI", content, at)
    assert (n_views, n_lights) == (2, 4)
    assert [theta, phi] == written.views[0].tolist()
    at += 4 + 2 * (8 + 4 + 4 * 8)
    assert struct.unpack_from("<III", content, at) == (3, 2, 6)
    first = np.frombuffer(content, "<f4", 9, at + 12).reshape(3, 3)
    np.testing.assert_array_equal(first, written.rotations[0])
    at += 12 + 6 * 36
    assert struct.unpack_from("<IBIII", content, at) == (2, 4, 2, 24, 6)
    assert len(content) == at + 17 + 4 * (2 + 48 + 12)


def test_entries_run_by_channel_then_light_then_view(rng):
    u = np.arange(24.0).reshape(24, 1)
    one = container(rng, u=u, sv=np.ones((6, 1)), singular_values=np.ones(1))
    entries = one.entries(np.array([4]))
    assert entries.shape == (1, 2, 4, 3)
    assert entries[0, 1, 2, 1] == 1 + 3 * (2 + 4 * 1)


def test_angles_and_directions_belong_together(rng):
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # Angles are rounded to singles.
    np.testing.assert_allclose(directions_of(angles_of(directions)), directions, atol=1e-6)


@pytest.mark.stability
def test_damaged_files_are_refused(tmp_path, rng):
    path = tmp_path / "a.btf"
    write_btf(path, container(rng))
    content = path.read_bytes()
    for end in range(0, len(content), 7):
        path.write_bytes(content[:end])
        with pytest.raises(CaptureError, match=r"a\.btf"):
            read_btf(path)
    path.write_bytes(content + b"\0")
    with pytest.raises(CaptureError, match="no more bytes"):
        read_btf(path)
    # A count of lights that no memory could hold.
    size = struct.unpack_from("<I", content, 9)[0]
    wrong = bytearray(content)
    struct.pack_into("<I", wrong, 9 + size + 12, 0xFFFFFFFF)
    path.write_bytes(wrong)
    with pytest.raises(CaptureError, match="cut off"):
        read_btf(path)
    path.write_bytes(b"!DFMF08FCR" + content)
    with pytest.raises(CaptureError, match="DFMF08FCR"):
        read_btf(path)


def test_shapes_that_do_not_fit_are_refused(rng):
    with pytest.raises(ShapeError, match="sv"):
        container(rng, width=4)
