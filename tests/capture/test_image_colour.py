"""What files state about their colour is honoured with the right value, or refused."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image, ImageCms

from reflfield.capture.color_spaces import ADOBE_RGB, P3_D65, REC709, rec709_from_primaries
from reflfield.capture.encoding import Encoding, decode_srgb
from reflfield.capture.image_files import ImageReading, read_coverage, read_image
from reflfield.errors import CaptureError
from tests.capture.exr_files import attribute, write_exr_by_hand
from tests.capture.tiff_files import strips_of, tags_of, write_tiff

STORED = np.array([[[0, 51, 255], [128, 128, 128], [30, 200, 90]]], np.uint8)
SHARES = STORED / 255


def png_with(path, *chunks):
    """A PNG of `STORED` with further chunks before the image."""
    Image.fromarray(STORED).save(path)
    content = path.read_bytes()
    added = b""
    for name, data in chunks:
        body = name + data
        added += struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))
    path.write_bytes(content[:33] + added + content[33:])


def fixed(value):
    return struct.pack(">i", round(value * 65536))


def xyz_d50(primaries):
    """Columns of a profile for some primaries of white D65, adapted to D50 (Bradford)."""
    x, y = np.reshape(primaries, (4, 2)).T
    xyz = np.stack([x, y, 1 - x - y])
    white = xyz[:, 3] / xyz[1, 3]
    columns = xyz[:, :3] * np.linalg.solve(xyz[:, :3], white)
    cone = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367],
                     [0.0389, -0.0685, 1.0296]])  # fmt: skip
    scale = np.diag(cone @ [0.9642, 1, 0.8249] / (cone @ white))
    return np.linalg.solve(cone, scale @ cone) @ columns


def profile_of(primaries, curve, *, space=b"RGB ", more=()):
    """An ICC profile of version 2: a matrix and one curve for all channels."""
    tags = {b"desc": b"desc\0\0\0\0" + struct.pack(">I", 5) + b"Test\0" + bytes(80)}
    for name, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), xyz_d50(primaries).T, strict=True):
        tags[name] = b"XYZ \0\0\0\0" + b"".join(fixed(value) for value in column)
    curves = (b"rTRC", b"gTRC", b"bTRC") if space == b"RGB " else (b"kTRC",)
    tags |= dict.fromkeys(curves, curve) | dict(more)
    table, body = struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        padded = content + bytes(-len(content) % 4)
        place = 132 + 12 * len(tags) + len(body)
        table += name + struct.pack(">II", place, len(content))
        body += padded
    header = bytes(8) + b"\2\x20\0\0mntr" + space + b"XYZ " + bytes(12) + b"acsp" + bytes(88)
    return struct.pack(">I", 132 + len(table) + len(body)) + header[4:128] + table + body


def gamma_curve(exponent):
    return b"curv\0\0\0\0" + struct.pack(">IH", 1, round(exponent * 256))


def power(exponent, factor=1.0):
    """The parametric curve (factor x) ** exponent."""
    return b"para\0\0\0\0\0\1\0\0" + b"".join(map(fixed, (exponent, factor, 0.0)))


LINEAR_CURVE = b"curv\0\0\0\0" + struct.pack(">I", 0)


class TestPng:
    @pytest.mark.parametrize(
        ("chunks", "linear"),
        [
            ([(b"gAMA", struct.pack(">I", 100_000))], lambda c: c),
            ([(b"gAMA", struct.pack(">I", 45_455))], lambda c: c ** (1 / 0.45455)),
            ([(b"gAMA", struct.pack(">I", 50_000))], lambda c: c**2),
            ([(b"sRGB", b"\0")], decode_srgb),
            # sRGB comes before the gAMA that accompanies it for old readers
            ([(b"gAMA", struct.pack(">I", 45_455)), (b"sRGB", b"\0")], decode_srgb),
            ([(b"cICP", bytes([1, 8, 0, 1]))], lambda c: c),
            ([(b"cICP", bytes([1, 13, 0, 1]))], decode_srgb),
            # and cICP before all others
            ([(b"gAMA", struct.pack(">I", 50_000)), (b"cICP", bytes([1, 8, 0, 1]))],
             lambda c: c),
        ],
    )  # fmt: skip
    def test_curves(self, tmp_path, chunks, linear, rounding):
        png_with(tmp_path / "a.png", *chunks)
        np.testing.assert_allclose(
            read_image(tmp_path / "a.png"), linear(SHARES), rounding(np.float32)
        )

    def test_primaries(self, tmp_path, rounding):
        """Display P3 green lies outside of Rec.709: its red and blue come out negative."""
        png_with(tmp_path / "cicp.png", (b"cICP", bytes([12, 8, 0, 1])))
        white_first = [*P3_D65[6:], *P3_D65[:6]]
        numbers = struct.pack(">8I", *(round(v * 100_000) for v in white_first))
        png_with(
            tmp_path / "chrm.png", (b"gAMA", struct.pack(">I", 100_000)), (b"cHRM", numbers)
        )
        # Display P3 (SMPTE EG 432-1) to Rec.709, linear, as published for CSS Color 4
        matrix = [[1.2249401763, -0.2249401763, 0.0], [-0.0420569547, 1.0420569547, 0.0],
                  [-0.0196375546, -0.0786360456, 1.0982736001]]  # fmt: skip
        expected = SHARES @ np.transpose(matrix)
        for name in ("cicp.png", "chrm.png"):
            np.testing.assert_allclose(
                read_image(tmp_path / name), expected, rtol=0, atol=rounding(np.float32)
            )

    @pytest.mark.parametrize(
        ("chunk", "reason"),
        [
            ((b"cICP", bytes([9, 16, 0, 1])), "transfer 16"),
            ((b"cICP", bytes([9, 18, 0, 1])), "transfer 18"),
            ((b"cICP", bytes([1, 13, 0, 0])), "narrow range"),
            ((b"gAMA", struct.pack(">I", 1)), "gamma of 100000"),
            ((b"cHRM", bytes(32)), "chromaticities"),
            ((b"iCCP", b"x\0\0" + zlib.compress(b"no profile")), "profile"),
            ((b"cICP", bytes([1, 13])), "cICP that is not 4 bytes"),
            ((b"gAMA", b"\0"), "gAMA that is not 4 bytes"),
            ((b"cHRM", bytes(31)), "cHRM that is not 32 bytes"),
        ],
    )
    def test_refused_with_the_remedy(self, tmp_path, chunk, reason, rounding):
        png_with(tmp_path / "a.png", chunk)
        with pytest.raises(CaptureError, match=rf"a\.png: .*{reason}.*`encoding`"):
            read_image(tmp_path / "a.png")
        said = ImageReading(encoding=Encoding("linear"))
        np.testing.assert_allclose(
            read_image(tmp_path / "a.png", said), SHARES, rounding(np.float32)
        )


def test_an_animation_is_refused_and_one_of_a_single_picture_read(tmp_path):
    png_with(tmp_path / "many.png", (b"acTL", struct.pack(">II", 3, 0)))
    with pytest.raises(CaptureError, match=r"many\.png: expected one picture.* animation of 3"):
        read_image(tmp_path / "many.png")
    png_with(tmp_path / "one.png", (b"acTL", struct.pack(">II", 1, 0)))
    Image.fromarray(STORED).save(tmp_path / "plain.png")
    plain = read_image(tmp_path / "plain.png")
    np.testing.assert_array_equal(read_image(tmp_path / "one.png"), plain)


class TestProfiles:
    def save(self, path, profile):
        picture = Image.fromarray(np.repeat(STORED, 8, 0).repeat(8, 1))
        options = {"quality": 100, "subsampling": 0} if path.suffix == ".jpg" else {}
        picture.save(path, icc_profile=profile, **options)

    @pytest.mark.parametrize("suffix", ["png", "jpg", "tif"])
    @pytest.mark.parametrize(
        ("primaries", "curve", "linear"),
        [
            (REC709, LINEAR_CURVE, lambda c: c),
            (REC709, gamma_curve(1.0), lambda c: c),
            (REC709, gamma_curve(1.8), lambda c: c ** (461 / 256)),
            (ADOBE_RGB, gamma_curve(563 / 256), lambda c: c ** (563 / 256)),
        ],
    )
    def test_matrix_and_curve(self, tmp_path, suffix, primaries, curve, linear):
        path = tmp_path / f"a.{suffix}"
        self.save(path, profile_of(primaries, curve))
        matrix = rec709_from_primaries(primaries)
        expected = linear(SHARES) if matrix is None else linear(SHARES) @ matrix.T
        # a JPEG's codes are off by up to two
        tolerance = 0.02 if suffix == "jpg" else 2e-4
        np.testing.assert_allclose(read_image(path)[4, 4::8], expected[0], atol=tolerance)

    def test_adobe_rgb_of_a_camera_that_writes_no_profile(self, tmp_path):
        picture = Image.fromarray(np.repeat(STORED, 8, 0).repeat(8, 1))
        exif = picture.getexif()
        settings = exif.get_ifd(0x8769)
        settings[0xA001], settings[0xA005] = 65535, {1: "R03"}
        path = tmp_path / "a.jpg"
        picture.save(path, exif=exif, quality=100, subsampling=0)
        expected = SHARES ** (563 / 256) @ rec709_from_primaries(ADOBE_RGB).T
        # a JPEG's codes are off by up to two
        np.testing.assert_allclose(read_image(path)[4, 4::8], expected[0], atol=0.02)

    @pytest.mark.parametrize("suffix", ["png", "tif"])
    def test_srgb_profiles_are_srgb_exactly(self, tmp_path, suffix):
        made = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
        self.save(tmp_path / f"a.{suffix}", made)
        self.save(tmp_path / f"b.{suffix}", None)
        np.testing.assert_array_equal(
            read_image(tmp_path / f"a.{suffix}"), read_image(tmp_path / f"b.{suffix}")
        )

    def test_grey(self, tmp_path, rounding):
        grey = np.array([[0, 128, 255]], np.uint8)
        profile = profile_of(REC709, gamma_curve(2.0), space=b"GRAY")
        Image.fromarray(grey).save(tmp_path / "g.png", icc_profile=profile)
        expected = (grey / 255) ** 2
        np.testing.assert_allclose(
            read_image(tmp_path / "g.png")[..., 2], expected, rounding(np.float32)
        )

    @pytest.mark.parametrize(
        ("profile", "reason"),
        [
            (profile_of(REC709, LINEAR_CURVE, more=[(b"A2B0", bytes(40))]), "'Test'.*matrix"),
            (profile_of(REC709, LINEAR_CURVE, more=[(b"gTRC", gamma_curve(2))]),
             "'Test'.*different curves"),
            (profile_of(REC709, b"mft2\0\0\0\0"), "'Test'"),
            (profile_of(REC709, power(-1.0)), "not finite"),
            (profile_of(REC709, power(30_000.0, 2.0)), "not finite"),
            (b"\0" * 200, "damaged"),
        ],
    )  # fmt: skip
    def test_refused_by_name(self, tmp_path, profile, reason):
        self.save(tmp_path / "a.tif", profile)
        with pytest.raises(CaptureError, match=rf"a\.tif: .*profile.*{reason}.*`encoding`"):
            read_image(tmp_path / "a.tif")

    def test_of_a_silhouette_is_none_of_our_business(self, tmp_path, rounding):
        mask = Image.fromarray(np.array([[0, 51, 255]], np.uint8))
        mask.save(tmp_path / "m.tif", icc_profile=bytes(200))
        np.testing.assert_allclose(
            read_coverage(tmp_path / "m.tif"), [[0, 0.2, 1]], rounding(np.float32)
        )


class TestFloats:
    def test_exr_chromaticities(self, tmp_path, rng, rounding):
        values = rng.uniform(0, 3, size=(4, 5, 3)).astype(np.float32)
        stated = attribute("chromaticities", "chromaticities", struct.pack("<8f", *P3_D65))
        channels = {name: (values[..., i], 1) for i, name in enumerate("RGB")}
        write_exr_by_hand(tmp_path / "p3.exr", channels, stated)
        expected = values @ rec709_from_primaries(P3_D65).T
        tolerance = rounding(np.float32, scale=3)
        np.testing.assert_allclose(read_image(tmp_path / "p3.exr"), expected, 0, tolerance)

    def test_aces_white_stays_white(self, tmp_path, rounding):
        ap0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
        stated = attribute("chromaticities", "chromaticities", struct.pack("<8f", *ap0))
        write_exr_by_hand(
            tmp_path / "a.exr", dict.fromkeys("RGB", (np.ones((2, 2)), 1)), stated
        )
        np.testing.assert_allclose(read_image(tmp_path / "a.exr"), 1.0, rounding(np.float32))

    def test_exr_chromaticities_of_no_colours(self, tmp_path):
        stated = attribute("chromaticities", "chromaticities", struct.pack("<8f", *[0.3] * 8))
        write_exr_by_hand(
            tmp_path / "a.exr", dict.fromkeys("RGB", (np.ones((2, 2)), 1)), stated
        )
        with pytest.raises(CaptureError, match=r"a\.exr: .*chromaticities"):
            read_image(tmp_path / "a.exr")

    def test_tiff_transfer_function_is_refused(self, tmp_path):
        pixels = STORED
        tags = tags_of(pixels, photometric=2, t301=(3, list(range(0, 65536, 256)) * 3))
        write_tiff(tmp_path / "t.tif", [(tags, strips_of(pixels))])
        with pytest.raises(CaptureError, match=r"t\.tif: .*transfer function"):
            read_image(tmp_path / "t.tif")

    @pytest.mark.parametrize("name", ["OCIO", "OPENIMAGEIO_OPTIONS"])
    def test_the_environment_changes_nothing(self, tmp_path, name, run_python):
        """Neither a colour configuration nor options of the library's own."""
        png_with(tmp_path / "a.png", (b"gAMA", struct.pack(">I", 50_000)))
        value = "ocio://default" if name == "OCIO" else "threads=3,png:linear_premult=1"
        code = (
            "from reflfield.capture.image_files import read_image; "
            f"print(read_image({str(tmp_path / 'a.png')!r}).tolist())"
        )
        assert run_python(code, {name: value}) == f"{read_image(tmp_path / 'a.png').tolist()}\n"
