"""Camera raw files: developed where rawpy is installed, else refused; never their thumbnail."""

import numpy as np
import pytest

from reflfield.capture import decoding
from reflfield.capture.clipping import MEASURED, SATURATED
from reflfield.capture.image_files import image_size, read_image, read_kinds
from reflfield.errors import CaptureError
from tests.capture.tiff_files import strips_of, tags_of, write_tiff

MOSAIC, RGB = 32803, 2
WHITE_LEVEL = 60_000
# Linear sRGB from XYZ of white D65 (IEC 61966-2-1): with it the camera's primaries are sRGB's.
SRGB_FROM_XYZ = [3.2404542, -1.5371385, -0.4985314, -0.9692660, 1.8760108, 0.0415560,
                 0.0556434, -0.2040259, 1.0572252]  # fmt: skip
LEFT, RIGHT = (0.2, 0.4, 0.1), (0.5, 0.25, 1.2)


def rationals(values):
    return [number for value in values for number in (round(value * 1e6), 1_000_000)]


def mosaic_of(height=64, width=96):
    """Two halves of one colour each, through a filter RGGB; blue is saturated on the right."""
    colour = np.where(np.arange(width)[None, :, None] < width // 2, LEFT, RIGHT)
    colour = np.broadcast_to(colour, (height, width, 3))
    mosaic = np.zeros((height, width, 1))
    for y, x, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        mosaic[y::2, x::2, 0] = colour[y::2, x::2, channel]
    return np.rint(np.minimum(mosaic, 1) * WHITE_LEVEL).astype(np.uint16)


def thumbnail(**more):
    pixels = np.full((16, 16, 3), 200, np.uint8)
    return tags_of(pixels, photometric=RGB, t254=(4, [1]), **more), strips_of(pixels)


def sensor(**more):
    mosaic = mosaic_of()
    pattern = {"t33421": (3, [2, 2]), "t33422": (1, [0, 1, 1, 2]), "t254": (4, [0])}
    return tags_of(mosaic, photometric=MOSAIC, **pattern, **more), strips_of(mosaic)


def write_dng(path, *, neutral=(1, 1, 1)):
    """A DNG whose first page is the sensor's data."""
    text = {271: b"Maker\0", 272: b"Camera\0", 50708: b"Camera\0"}
    tags, strips = sensor(
        t50706=(1, [1, 4, 0, 0]),
        t50707=(1, [1, 1, 0, 0]),
        t50714=(4, [0]),
        t50717=(4, [WHITE_LEVEL]),
        t50721=(10, rationals(SRGB_FROM_XYZ)),
        t50728=(5, rationals(neutral)),
        t50778=(3, [21]),
    )
    tags |= {tag: (2, list(value)) for tag, value in text.items()}
    write_tiff(path, [(tags, strips)])


def write_nef(path):
    """A TIFF whose first page is a thumbnail; the sensor's data hang below it."""
    tags, strips = thumbnail()
    write_tiff(path, [(tags | {330: [sensor()]}, strips)])


@pytest.fixture
def without_rawpy(monkeypatch):
    monkeypatch.setattr(decoding, "raw_library", lambda: None)


@pytest.mark.parametrize("name", ["a.dng", "a.DNG", "photograph.tif"])
def test_developed_linear(tmp_path, name):
    pytest.importorskip("rawpy")
    write_dng(tmp_path / name)
    assert image_size(tmp_path / name) == (96, 64)
    image, kinds = read_kinds(tmp_path / name)
    np.testing.assert_allclose(image[32, 20], LEFT, atol=1e-4)  # two steps of 16 bits
    np.testing.assert_allclose(image[32, 76], (0.5, 0.25, 1), atol=1e-4)
    assert (kinds[32, 20] == MEASURED).all()
    assert (kinds[32, 76] == SATURATED).all()  # the matrix mixes channels


def test_white_balance_of_the_camera(tmp_path):
    """Camera neutral (.5, 1, .8): what it records there is white."""
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "a.dng", neutral=(0.5, 1, 0.8))
    image = read_image(tmp_path / "a.dng")
    red, green, blue = image[32, 20] / image[32, 20, 1]
    steps = 2 / 65535 / 0.4  # of 16 bits, by green
    assert (red, green, blue) == pytest.approx((0.5 / 0.5, 1, 0.25 / 0.8), abs=steps)


def test_camera_that_is_not_known_is_refused(tmp_path):
    pytest.importorskip("rawpy")
    write_nef(tmp_path / "a.nef")
    with pytest.raises(CaptureError, match=r"a\.nef: .*camera raw.*convert"):
        read_image(tmp_path / "a.nef")


@pytest.mark.parametrize("name", ["a.nef", "a.NEF", "a.tif", "a"])
def test_never_the_thumbnail(tmp_path, name, without_rawpy):
    write_nef(tmp_path / name)
    for reader in (read_image, image_size):
        with pytest.raises(CaptureError, match=r"camera raw file.*reflfield\[raw\]"):
            reader(tmp_path / name)


@pytest.mark.parametrize(
    "start",
    [
        b"FUJIFILMCCD-RAW 0201", b"\0\0\0\x18ftypcrx \0\0\0\1crx isom",
        b"II*\0\x10\0\0\0CR\2\0",
        b"IIRO\x08\0\0\0", b"IIU\0\x18\0\0\0", b"FOVb", b"\0MRM",
    ],
)  # fmt: skip
def test_other_makers_by_content(tmp_path, start, without_rawpy):
    (tmp_path / "photograph.jpg").write_bytes(start + bytes(500))
    with pytest.raises(CaptureError, match=r"photograph\.jpg.*camera raw.*reflfield\[raw\]"):
        read_image(tmp_path / "photograph.jpg")


@pytest.mark.parametrize("suffix", ["nef", "cr2", "CR3", "arw", "raf", "rw2"])
def test_by_suffix_whatever_it_holds(tmp_path, suffix, without_rawpy):
    tags, strips = thumbnail()
    write_tiff(tmp_path / f"a.{suffix}", [(tags, strips)])
    with pytest.raises(CaptureError, match=r"camera raw.*reflfield\[raw\]"):
        read_image(tmp_path / f"a.{suffix}")


def test_damaged(tmp_path):
    pytest.importorskip("rawpy")
    (tmp_path / "a.cr2").write_bytes(b"II*\0\x10\0\0\0CR\2\0" + bytes(3000))
    with pytest.raises(CaptureError, match=r"a\.cr2: .*LibRaw cannot"):
        read_image(tmp_path / "a.cr2")
