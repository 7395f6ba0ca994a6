"""Kinds of image files that people have: each reads as its maker meant it, or is refused."""

import cv2
import numpy as np
import pytest
from PIL import Image

from reflfield.capture.encoding import decode_srgb
from reflfield.capture.image_files import (
    image_orientation,
    image_size,
    read_coverage,
    read_image,
)
from reflfield.errors import CaptureError
from tests.capture.exr_files import write_exr_by_hand
from tests.capture.tiff_files import strips_of, tags_of, write_tiff

RGB, GREY_BLACK_0, GREY_WHITE_0 = 2, 1, 0
HALF = np.finfo(np.float16).eps  # Y is rounded to half, then RGB


@pytest.fixture
def linear(rng):
    """6 rows, 5 columns, also below 0 and above 1."""
    return rng.uniform(-0.5, 3, size=(6, 5, 3))


@pytest.fixture
def codes(rng):
    return rng.integers(0, 65536, size=(6, 5, 3)).astype(np.uint16)


def decoded(codes):
    return decode_srgb(codes / np.iinfo(codes.dtype).max)


class TestTiff:
    @pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
    @pytest.mark.parametrize("grey", [False, True])
    def test_floats_are_linear(self, tmp_path, linear, dtype, grey):
        stored = (linear[..., :1] if grey else linear).astype(dtype)
        tags = tags_of(stored, photometric=GREY_BLACK_0 if grey else RGB)
        write_tiff(tmp_path / "f.tif", [(tags, strips_of(stored))])
        expected = np.broadcast_to(stored.astype(np.float32), (6, 5, 3))
        np.testing.assert_array_equal(read_image(tmp_path / "f.tif"), expected)

    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32])
    def test_integers_are_srgb(self, tmp_path, codes, dtype, rounding):
        largest = np.iinfo(dtype).max
        stored = np.rint(codes / 65535 * largest).astype(dtype)
        tags = tags_of(stored, photometric=RGB)
        write_tiff(tmp_path / "i.tif", [(tags, strips_of(stored))])
        np.testing.assert_allclose(
            read_image(tmp_path / "i.tif"), decoded(stored), rounding(np.float32)
        )

    @pytest.mark.parametrize("order", ["<", ">"])
    @pytest.mark.parametrize("big", [False, True])
    @pytest.mark.parametrize("planar", [False, True])
    def test_planes_big_files_and_byte_orders(
        self, tmp_path, codes, order, big, planar, rounding
    ):
        tags = tags_of(codes, photometric=RGB, planar=planar)
        strips = strips_of(codes, order=order, planar=planar)
        write_tiff(tmp_path / "p.tif", [(tags, strips)], order=order, big=big)
        np.testing.assert_allclose(
            read_image(tmp_path / "p.tif"), decoded(codes), rounding(np.float32)
        )
        assert image_size(tmp_path / "p.tif") == (5, 6)

    @pytest.mark.parametrize("bits", [1, 4, 8, 16, 32])
    def test_white_is_zero(self, tmp_path, rng, bits):
        """A silhouette of which white is zero is not inside out."""
        top = 2**bits - 1
        covered = rng.integers(0, 2, size=(6, 8, 1))
        dtype = {16: np.uint16, 32: np.uint32}.get(bits, np.uint8)
        stored = ((1 - covered) * top).astype(dtype)
        tags = tags_of(stored, photometric=GREY_WHITE_0, bits=bits)
        strips = strips_of(stored)
        if bits == 1:
            strips = [np.packbits(stored[..., 0], axis=1).tobytes()]
        if bits == 4:
            strips = [(stored[:, ::2, 0] * 16 + stored[:, 1::2, 0]).astype(np.uint8).tobytes()]
        write_tiff(tmp_path / "w.tif", [(tags, strips)])
        np.testing.assert_array_equal(read_coverage(tmp_path / "w.tif"), covered[..., 0])
        np.testing.assert_array_equal(read_image(tmp_path / "w.tif")[..., 1], covered[..., 0])

    @pytest.mark.parametrize(
        ("dtype", "photometric", "reason"),
        [
            (np.int16, RGB, "int16"),
            (np.float32, GREY_WHITE_0, "white is zero"),
            (np.uint8, 8, "Lab"),
        ],
    )
    def test_what_is_no_photograph_is_refused(self, tmp_path, dtype, photometric, reason):
        n = 1 if photometric == GREY_WHITE_0 else 3
        stored = np.zeros((4, 4, n), dtype)
        write_tiff(
            tmp_path / "x.tif", [(tags_of(stored, photometric=photometric), strips_of(stored))]
        )
        with pytest.raises(CaptureError, match=rf"x\.tif: expected.*{reason}"):
            read_image(tmp_path / "x.tif")

    @pytest.mark.parametrize("suffix", ["tif", "jpg"])
    def test_four_inks_are_refused(self, tmp_path, suffix):
        Image.new("CMYK", (8, 8), (0, 99, 0, 0)).save(tmp_path / f"ink.{suffix}")
        with pytest.raises(CaptureError, match=r"ink.*(CMYK|4 channels)"):
            read_image(tmp_path / f"ink.{suffix}")


class TestOthers:
    def test_luminance_and_chroma(self, tmp_path, rng):
        """Y = wR R + wG G + wB B, RY = (R - Y) / Y; chroma at half the resolution."""
        luminance = rng.uniform(0.2, 2, size=(6, 8)).astype(np.float32)
        red, blue = (np.full((3, 4), value, np.float32) for value in (0.25, -0.5))
        channels = {"Y": (luminance, 1), "RY": (red, 2), "BY": (blue, 2)}
        write_exr_by_hand(tmp_path / "yc.exr", channels)
        image = read_image(tmp_path / "yc.exr")
        weights = np.array([0.2126, 0.7152, 0.0722])  # Rec.709
        np.testing.assert_allclose(image[..., 0], 1.25 * luminance, HALF)
        np.testing.assert_allclose(image[..., 2], 0.5 * luminance, HALF)
        np.testing.assert_allclose(image @ weights, luminance, HALF)
        plain = dict.fromkeys("RGB", (luminance, 1))
        write_exr_by_hand(tmp_path / "rgb.exr", plain)  # the other reader is back in use
        np.testing.assert_array_equal(read_image(tmp_path / "rgb.exr")[..., 1], luminance)

    def test_radiance_hdr(self, tmp_path, rng):
        radiance = rng.uniform(0, 300, size=(6, 40, 3)).astype(np.float32)
        assert cv2.imwrite(str(tmp_path / "sky.hdr"), radiance[..., ::-1])
        image = read_image(tmp_path / "sky.hdr")
        step = radiance.max(axis=2, keepdims=True) / 128  # of the common exponent
        assert (np.abs(image - radiance) <= step).all()
        assert image_size(tmp_path / "sky.hdr") == (40, 6)

    def test_radiance_hdr_exposure_is_undone(self, tmp_path):
        assert cv2.imwrite(str(tmp_path / "a.hdr"), np.full((6, 40, 3), 8, np.float32))
        content = (tmp_path / "a.hdr").read_bytes()
        lines = b"#?RADIANCE\nEXPOSURE=4\nEXPOSURE=0.5\n"
        (tmp_path / "a.hdr").write_bytes(content.replace(b"#?RADIANCE\n", lines, 1))
        np.testing.assert_array_equal(read_image(tmp_path / "a.hdr"), 4)

    def test_radiance_hdr_colour_correction_is_undone(self, tmp_path):
        assert cv2.imwrite(str(tmp_path / "a.hdr"), np.full((6, 40, 3), 8, np.float32))
        content = (tmp_path / "a.hdr").read_bytes()
        lines = b"#?RADIANCE\nCOLORCORR= 2 1 4\nEXPOSURE=2\nCOLORCORR=1 1 .5\n"
        (tmp_path / "a.hdr").write_bytes(content.replace(b"#?RADIANCE\n", lines, 1))
        expected = np.broadcast_to([2, 4, 2], (6, 40, 3))
        np.testing.assert_array_equal(read_image(tmp_path / "a.hdr"), expected)

    @pytest.mark.parametrize(
        ("old", "new", "reason"),
        [
            (b"-Y 6 +X 40", b"+Y 6 +X 40", "rows from the top left"),
            (b"32-bit_rle_rgbe", b"32-bit_rle_xyze", "xyze"),
            (b"#?RADIANCE\n", b"#?RADIANCE\nGAMMA=2.2\n", "GAMMA"),
            (b"#?RADIANCE\n", b"#?RADIANCE\nEXPOSURE=0\n", "finite"),
            (b"#?RADIANCE\n", b"#?RADIANCE\nCOLORCORR=2\n", "finite"),
        ],
    )
    def test_radiance_hdr_that_is_not_understood(self, tmp_path, old, new, reason):
        assert cv2.imwrite(str(tmp_path / "a.hdr"), np.ones((6, 40, 3), np.float32))
        content = (tmp_path / "a.hdr").read_bytes()
        assert old in content
        (tmp_path / "a.hdr").write_bytes(content.replace(old, new, 1))
        with pytest.raises(CaptureError, match=rf"a\.hdr: expected.*{reason}"):
            read_image(tmp_path / "a.hdr")

    def test_palette_and_one_bit(self, tmp_path, rounding):
        picture = Image.new("P", (4, 2))
        picture.putpalette([10, 20, 30, 200, 100, 50])
        picture.putdata([0, 1, 1, 0, 1, 0, 0, 1])
        picture.save(tmp_path / "p.png", bits=1)
        chosen = np.array([[0, 1, 1, 0], [1, 0, 0, 1]])
        expected = decode_srgb(np.array([[10, 20, 30], [200, 100, 50]])[chosen] / 255)
        np.testing.assert_allclose(
            read_image(tmp_path / "p.png"), expected, rounding(np.float32)
        )
        Image.fromarray(chosen.astype(bool)).save(tmp_path / "b.png")
        np.testing.assert_array_equal(read_coverage(tmp_path / "b.png"), chosen)

    @pytest.mark.parametrize(
        ("content", "kind"),
        [(b"GIF89a", "GIF"), (b"BM123456", "BMP"), (b"8BPS\0\1", "Photoshop"),
         (b"RIFF\0\0\0\0WEBP", "WebP"), (b"PF\n4 4\n", "PFM"), (b"SDPX", "DPX")],
    )  # fmt: skip
    def test_other_formats_are_named(self, tmp_path, content, kind):
        (tmp_path / "x.png").write_bytes(content + bytes(100))
        with pytest.raises(CaptureError, match=rf"x\.png: expected an EXR.*{kind}.*convert"):
            read_image(tmp_path / "x.png")

    @pytest.mark.parametrize("suffix", [".exr", ".term", ".tif", ".JPG", "", ".?a=b"])
    def test_a_wrong_suffix_does_no_harm(self, tmp_path, suffix):
        path = tmp_path / f"a{suffix}"
        path.write_bytes(cv2.imencode(".png", np.full((3, 4, 3), 255, np.uint8))[1].tobytes())
        np.testing.assert_array_equal(read_image(path), np.ones((3, 4, 3)))

    def test_a_suffix_that_means_something_to_the_library(self, tmp_path):
        path = tmp_path / "a.null"
        path.write_bytes(cv2.imencode(".png", np.full((3, 4, 3), 255, np.uint8))[1].tobytes())
        with pytest.raises(CaptureError, match=r"a\.null: .*png.*rename"):
            read_image(path)


class TestOrientation:
    @pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
    def test_pixels_stay_as_they_are_stored(self, tmp_path, suffix):
        picture = Image.fromarray(np.full((4, 6, 3), 255, np.uint8))
        picture.paste((0, 0, 0), (0, 0, 3, 4))
        exif = picture.getexif()
        exif[274] = 6
        path = tmp_path / f"turned.{suffix}"
        picture.save(path, exif=exif, quality=100)
        assert image_orientation(path) == 6
        assert image_size(path) == (6, 4)
        image = read_image(path)
        assert image.shape == (4, 6, 3)
        assert image[:, :2].max() < 0.1
        assert image[:, 4:].min() > 0.9

    @pytest.mark.parametrize(
        "exif", [b"II*\0", b"II*\0\x08\0\0\0\xff\xff", b"MM\0*" + b"\xff" * 90]
    )
    def test_garbled_exif_data_leave_the_pixels_sound(self, tmp_path, exif):
        Image.new("RGB", (8, 8), (255, 255, 255)).save(
            tmp_path / "a.jpg", exif=b"Exif\0\0" + exif
        )
        assert image_orientation(tmp_path / "a.jpg") == 1
        np.testing.assert_array_equal(read_image(tmp_path / "a.jpg"), np.ones((8, 8, 3)))

    def test_no_statement_is_upright(self, tmp_path):
        Image.new("RGB", (3, 2)).save(tmp_path / "a.jpg")
        assert image_orientation(tmp_path / "a.jpg") == 1
