"""Textures of images and patterns; what is no image is refused before it is decoded."""

import os
import struct
import zlib

import cv2
import numpy as np
import pytest

from capture_sim.errors import SceneError
from capture_sim.inputs import memory_limit
from capture_sim.materials import make_texture

UV = np.zeros((1, 2))


def test_image_texture_decodes_and_has_v_up(tmp_path):
    cv2.imwrite(str(tmp_path / "t.png"), np.array([[[0] * 3], [[255, 188, 0]]], np.uint8))
    texture = make_texture(
        {"type": "image", "file": "t.png"}, "albedo", low=0, high=1, folder=tmp_path
    )
    bottom, top = texture.evaluate(np.array([[0.5, 0.25], [0.5, 0.75]]))
    np.testing.assert_array_equal(top, 0.0)
    np.testing.assert_allclose(bottom, [0.0, 0.503, 1.0], atol=1e-3)  # sRGB 188 is 0.503


@pytest.mark.parametrize("kind", ["checker", "stripes", "noise", "dots", "meander", "bands"])
def test_patterns_are_periodic_and_within_their_values(kind, rng):
    texture = make_texture({"type": kind, "values": [0.2, 0.7]}, "x", low=0, high=1)
    # Exact in binary, so that uv + 1 is too, and never on an edge of a pattern.
    uv = (np.floor(rng.random((200, 2)) * 1024) + 0.25) / 1024
    values = texture.evaluate(uv)
    assert values.min() >= 0.2 - 1e-12
    assert values.max() <= 0.7 + 1e-12
    assert np.ptp(values) > 0.1
    np.testing.assert_array_equal(texture.evaluate(uv + 1.0), values)


def test_texture_that_is_no_image(tmp_path):
    (tmp_path / "t.png").write_bytes(b"not an image")
    with pytest.raises(SceneError, match="PNG, JPEG or TIFF"):
        make_texture(
            {"type": "image", "file": "t.png"}, "albedo", low=0, high=1, folder=tmp_path
        )


def png_that_claims(width, height):
    """A PNG file of some bytes whose header claims a size."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = b""
    for kind, data in ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(64))), (b"IEND", b"")):
        chunks += struct.pack(">I", len(data)) + kind + data
        chunks += struct.pack(">I", zlib.crc32(kind + data))
    return b"\x89PNG\r\n\x1a\n" + chunks


@pytest.mark.parametrize("size", [(8193, 8192), (10**6, 100), (16_000, 16_000), (10**9, 10**9)])
def test_textures_that_claim_many_pixels_are_refused_before_they_are_decoded(
    tmp_path, size, monkeypatch
):
    (tmp_path / "t.png").write_bytes(png_that_claims(*size))
    monkeypatch.setattr(cv2, "imread", None)
    with pytest.raises(SceneError, match=r"t\.png: expected at most 67,108,864 pixels"):
        make_texture(
            {"type": "image", "file": "t.png"}, "albedo", low=0, high=1, folder=tmp_path
        )


def test_textures_beyond_the_ceiling_are_refused_with_what_would_suffice(tmp_path):
    (tmp_path / "t.png").write_bytes(png_that_claims(8000, 8000))
    table = {"type": "image", "file": "t.png"}
    with (
        memory_limit(500 << 20),
        pytest.raises(SceneError, match=r"--max-memory: .*at least \d+ MB for \S*t\.png"),
    ):
        make_texture(table, "albedo", low=0, high=1, folder=tmp_path)


@pytest.mark.parametrize("kind", ["a folder", "a named pipe"])
def test_textures_that_are_no_files_are_refused_unopened(tmp_path, kind):
    make = {"a folder": os.mkdir, "a named pipe": os.mkfifo}
    make[kind](tmp_path / "t.png")
    table = {"type": "image", "file": "t.png"}
    with pytest.raises(SceneError, match=rf"albedo\.file: expected a file, received {kind}"):
        make_texture(table, "albedo", low=0, high=1, folder=tmp_path)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("limits", [(0.1, 0.9), (0.9, 0.1)])
def test_images_are_decoded_where_they_are_read(tmp_path, rng, dtype, limits, rounding):
    """By a table: what a texel holds is the sRGB formula of its stored number."""
    stored = rng.integers(0, np.iinfo(dtype).max + 1, (5, 7, 3), dtype=dtype)
    cv2.imwrite(str(tmp_path / "t.png"), stored[:, :, ::-1])
    table = {"type": "image", "file": "t.png", "range": list(limits)}
    texture = make_texture(table, "albedo", low=0, high=1, folder=tmp_path)
    row, column = (axis.ravel() for axis in np.mgrid[:5, :7])
    uv = np.stack([(column + 0.5) / 7, 1 - (row + 0.5) / 5], axis=1)
    encoded = stored / np.iinfo(dtype).max
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    expected = limits[0] + (limits[1] - limits[0]) * linear
    # Coordinates in the middle of a texel are off by a few roundings, times slopes of 7.
    np.testing.assert_allclose(texture.evaluate(uv), expected.reshape(-1, 3), atol=1e-13)
    assert texture.bounds == pytest.approx(
        (expected.min(), expected.max()), abs=rounding(np.float64)
    )
    assert texture.pixels.nbytes == stored.nbytes
