"""The container of Bonn's BTFs, byte by byte, and read by its reader."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.capture.btf import read_btf
from reflfield.errors import ShapeError
from reflfield.export.btf_container import BtfContainer, angles_of, write_btf


def container(rng, dtype="f4", **changes):
    """Three by two texels, two views, four lights, two components."""
    turns = Rotation.random(6, random_state=3).as_matrix()
    values = {
        "width": 3, "height": 2,
        "views": rng.uniform(0, 1, (2, 2)).astype("f4"),
        "lights": rng.uniform(0, 1, (4, 2)).astype("f4"),
        "singular_values": np.array([2.0, 1.0], dtype),
        "u": rng.normal(size=(24, 2)).astype(dtype),
        "sv": rng.normal(size=(6, 2)).astype(dtype),
        "rotations": turns.astype("f4"),
        "setup": "dome", "xml": "<a/>", "pixels_per_mm": 2.0,
    }  # fmt: skip
    return BtfContainer(**(values | changes))


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8"])
@pytest.mark.parametrize("rotated", [True, False])
def test_what_is_written_is_read_to_the_bit(tmp_path, rng, dtype, rotated, rounding):
    written = container(rng, dtype)
    written = written if rotated else replace(written, rotations=None)
    write_btf(tmp_path / "a.btf", written)
    read = read_btf(tmp_path / "a.btf")
    assert (read.width, read.height, read.cosine_included) == (3, 2, True)
    ((u, v),) = read.factors
    np.testing.assert_array_equal(u, written.u)
    np.testing.assert_array_equal(v, written.sv)
    for name in ("views", "lights"):
        angles = angles_of(getattr(read, name))
        np.testing.assert_allclose(angles, getattr(written, name), 0, rounding(np.float32))
    if rotated:
        np.testing.assert_array_equal(read.rotations, written.rotations)
    else:
        assert read.rotations is None


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


def test_shapes_that_do_not_fit_are_refused(rng):
    with pytest.raises(ShapeError, match="sv"):
        container(rng, width=4)
