"""Image files: what goes in comes out, and damage is named."""

import sys
import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from reflfield.capture import image_headers
from reflfield.capture.clipping import BLACK, MEASURED, SATURATED
from reflfield.capture.encoding import decode_srgb, encode_srgb
from reflfield.capture.exposures import merge_exposures
from reflfield.capture.image_files import image_size, read_coverage, read_exposure, read_image
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.errors import CaptureError, InputError, ShapeError


@pytest.fixture
def photograph(rng):
    """5 rows, 7 columns, linear, beyond 1."""
    return rng.uniform(0, 4, size=(5, 7, 3)).astype(np.float32)


class TestSrgb:
    def test_known_values(self):
        # IEC 61966-2-1: encoded .5 is linear .21404, the linear foot ends at .04045
        assert decode_srgb(0.5) == pytest.approx(0.2140411, rel=1e-6)
        assert decode_srgb(0.04) == 0.04 / 12.92

    def test_round_trip_of_all_bytes(self):
        codes = np.arange(256)
        back = encode_srgb(decode_srgb(codes / 255)) * 255
        np.testing.assert_allclose(back, codes, atol=1e-4)  # the standard's curve has a seam

    def test_dtype_is_kept_and_encoding_clips(self):
        assert decode_srgb(np.float32([0.5])).dtype == np.float32
        assert encode_srgb(np.array([-1.0, 9.0])).tolist() == [0.0, pytest.approx(1.0)]


class TestExr:
    @pytest.mark.parametrize("dtype", [np.float16, np.float32])
    def test_round_trip_is_exact(self, tmp_path, photograph, dtype):
        stored = photograph.astype(dtype)
        write_exr(tmp_path / "a.exr", stored)
        back = read_image(tmp_path / "a.exr")
        assert back.dtype == np.float32
        np.testing.assert_array_equal(back, stored.astype(np.float32))
        assert image_size(tmp_path / "a.exr") == (7, 5)

    def test_large_images_are_not_copied(self, tmp_path):
        image = np.zeros((500, 500, 3), np.float32)
        tracemalloc.start()
        write_exr(tmp_path / "a.exr", image)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 0.5 * image.nbytes

    def test_same_bytes_twice(self, tmp_path, photograph):
        for name in ("a.exr", "b.exr"):
            write_exr(tmp_path / name, photograph)
        assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()
        with OpenEXR.File(str(tmp_path / "a.exr"), header_only=True) as file:
            assert "capDate" not in file.header()  # the time of writing

    def test_luminance_is_grey(self, tmp_path, photograph):
        write_exr(tmp_path / "y.exr", photograph[..., 0])
        back = read_image(tmp_path / "y.exr")
        np.testing.assert_array_equal(back, np.repeat(photograph[..., :1], 3, axis=2))

    def test_layer_is_found_by_suffix(self, tmp_path, photograph):
        names = ["diffuse.R", "diffuse.G", "diffuse.B"]
        write_exr(tmp_path / "layer.exr", photograph, names)
        np.testing.assert_array_equal(read_image(tmp_path / "layer.exr"), photograph)

    def test_plain_channels_win_over_layers(self, tmp_path, photograph):
        stack = np.concatenate([photograph * 2, photograph], axis=2)
        names = ["a.R", "a.G", "a.B", "R", "G", "B"]
        write_exr(tmp_path / "both.exr", stack, names)
        np.testing.assert_array_equal(read_image(tmp_path / "both.exr"), photograph)

    def test_a_data_window_outside_of_the_display_window_is_refused(self, tmp_path):
        """It shows nothing of the picture; black would count as measured."""
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "displayWindow": (np.array([0, 0], np.int32), np.array([3, 2], np.int32)),
            "dataWindow": (np.array([10, 1], np.int32), np.array([11, 1], np.int32)),
        }
        channels = {name: np.array([[1, 2]], np.float32) for name in "RGB"}
        OpenEXR.File(header, channels).write(str(tmp_path / "w.exr"))
        with pytest.raises(CaptureError, match=r"w\.exr: .*\(0, 0, 3, 2\).*\(10, 1, 11, 1\)"):
            read_image(tmp_path / "w.exr")

    def test_data_window_is_placed_in_the_display_window(self, tmp_path):
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "displayWindow": (np.array([0, 0], np.int32), np.array([3, 2], np.int32)),
            "dataWindow": (np.array([1, 1], np.int32), np.array([2, 1], np.int32)),
        }
        channels = {name: np.array([[1, 2]], np.float32) for name in "RGB"}
        OpenEXR.File(header, channels).write(str(tmp_path / "w.exr"))
        expected = [[0, 0, 0, 0], [0, 1, 2, 0], [0, 0, 0, 0]]
        assert read_image(tmp_path / "w.exr")[..., 0].tolist() == expected
        assert image_size(tmp_path / "w.exr") == (4, 3)

    def test_dwab_environment(self, shared_data):
        path = shared_data("env") / "studio.exr"
        image = read_image(path)
        assert (image.shape[1], image.shape[0]) == image_size(path)
        assert image.max() > 1

    def test_names_must_match(self, tmp_path, photograph):
        with pytest.raises(ShapeError, match="channels"):
            write_exr(tmp_path / "a.exr", photograph, ["X", "Y"])
        with pytest.raises(ShapeError, match="names"):
            write_exr(tmp_path / "a.exr", np.zeros((2, 2, 5), np.float32))
        assert not list(tmp_path.iterdir())


class TestEncodedFiles:
    def test_eight_bit_png(self, tmp_path):
        encoded = np.arange(256, dtype=np.uint8).reshape(16, 16)[..., None].repeat(3, 2)
        encoded[..., 2] = 255 - encoded[..., 2]
        write_png(tmp_path / "a.png", encoded)
        expected = decode_srgb(encoded.astype(np.float32) / 255)
        np.testing.assert_array_equal(read_image(tmp_path / "a.png"), expected)

    @pytest.mark.parametrize("suffix", [".png", ".tif"])
    def test_sixteen_bits_are_kept(self, tmp_path, suffix):
        encoded = np.linspace(0, 65535, 4 * 5 * 3).reshape(4, 5, 3).astype(np.uint16)
        path = tmp_path / f"a{suffix}"
        assert cv2.imwrite(str(path), encoded[..., ::-1])
        expected = decode_srgb(encoded.astype(np.float32) / 65535)
        np.testing.assert_allclose(read_image(path), expected, rtol=1e-6)  # float32
        assert image_size(path) == (5, 4)

    def test_sixteen_bit_grey(self, tmp_path, rounding):
        encoded = np.array([[0, 1000, 65535]], np.uint16)
        write_png(tmp_path / "g.png", encoded)
        image = read_image(tmp_path / "g.png")
        expected = decode_srgb(encoded[0].astype(np.float32) / 65535)
        np.testing.assert_allclose(image[0, :, 1], expected, rounding(np.float32))

    def test_jpeg_is_close(self, tmp_path):
        Image.new("RGB", (16, 8), (200, 100, 50)).save(tmp_path / "a.jpg", quality=98)
        image = read_image(tmp_path / "a.jpg")
        assert image.shape == (8, 16, 3)
        expected = decode_srgb(np.array([200, 100, 50]) / 255)
        np.testing.assert_allclose(image[4, 8], expected, atol=0.02)  # a JPEG's two levels

    @pytest.mark.parametrize("mode", ["1", "P", "LA", "RGBA", "L"])
    def test_other_png_modes(self, tmp_path, mode):
        Image.new("RGB", (3, 2), (255, 255, 255)).convert(mode).save(tmp_path / "m.png")
        np.testing.assert_array_equal(read_image(tmp_path / "m.png"), np.ones((2, 3, 3)))

    def test_content_decides_not_the_suffix(self, tmp_path, photograph):
        write_exr(tmp_path / "a.exr", photograph)
        (tmp_path / "a.exr").rename(tmp_path / "a.png")
        np.testing.assert_array_equal(read_image(tmp_path / "a.png"), photograph)

    def test_sixteen_bit_round_trip(self, tmp_path, rng):
        encoded = rng.integers(0, 65536, size=(3, 4, 3)).astype(np.uint16)
        write_png(tmp_path / "a.png", encoded)
        back = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
        np.testing.assert_array_equal(back, encoded)

    def test_writer_wants_encoded_values(self, tmp_path, photograph):
        with pytest.raises(ShapeError, match=r"uint8.*encode_srgb"):
            write_png(tmp_path / "a.png", photograph)


class TestCoverage:
    def test_grey_is_not_srgb_decoded(self, tmp_path, rounding):
        write_png(tmp_path / "s.png", np.array([[0, 51, 255]], np.uint8))
        np.testing.assert_allclose(
            read_coverage(tmp_path / "s.png"), [[0, 0.2, 1]], rounding(np.float32)
        )

    def test_alpha_is_taken_where_it_says_something(self, tmp_path):
        rgba = np.full((1, 2, 4), 255, np.uint8)
        rgba[0, 0, 3] = 0
        write_png(tmp_path / "a.png", rgba)
        assert read_coverage(tmp_path / "a.png").tolist() == [[0, 1]]
        rgba[..., 3] = 255
        rgba[0, 0, :3] = 0
        write_png(tmp_path / "b.png", rgba)
        assert read_coverage(tmp_path / "b.png").tolist() == [[0, 1]]

    def test_exr(self, tmp_path):
        write_exr(tmp_path / "c.exr", np.array([[0, 0.5, 2]], np.float32))
        assert read_coverage(tmp_path / "c.exr").tolist() == [[0, 0.5, 1]]


class TestExposures:
    def test_bracket_recovers_radiance(self, rng):
        radiance = rng.uniform(0.01, 8, size=(20, 20, 3))
        seconds = [0.03, 0.12, 0.5, 2.0]
        shots = [encode_srgb(np.clip(radiance * t, 0, 1)) for t in seconds]
        eight_bit = [np.float32(np.round(s * 255) / 255) for s in shots]
        merged = merge_exposures(eight_bit, seconds)
        # half a code value of the best exposure is about 1.5 % of its radiance
        np.testing.assert_allclose(merged, radiance, rtol=0.03)

    def test_order_does_not_matter(self, rng):
        shots = [np.float32(rng.uniform(0, 1, size=(2, 2, 3))) for _ in range(3)]
        merged = merge_exposures(shots, [1.0, 2.0, 4.0])
        np.testing.assert_array_equal(merged, merge_exposures(shots[::-1], [4.0, 2.0, 1.0]))

    def test_grey_and_exr_exposures(self, tmp_path, rounding):
        write_png(tmp_path / "g.png", np.array([[0, 51, 255]], np.uint8))
        grey, kinds, _ = read_exposure(tmp_path / "g.png")
        assert kinds[0, :, 2].tolist() == [BLACK, MEASURED, SATURATED]
        np.testing.assert_allclose(grey[0, :, 2], [0, 0.2, 1], rounding(np.float32))
        write_exr(tmp_path / "e.exr", np.array([[[0.0, 0.214041, 5.0]]], np.float32))
        linear, kinds, _ = read_exposure(tmp_path / "e.exr")
        # half of the last digit of 0.214041, by the slope of 1.08
        np.testing.assert_allclose(linear, [[[0, 0.5, 1]]], rtol=0, atol=5.4e-7)
        assert kinds[0, 0].tolist() == [BLACK, MEASURED, SATURATED]

    def test_saturated_and_black_everywhere(self):
        white, black = np.ones((1, 1, 3), np.float32), np.zeros((1, 1, 3), np.float32)
        assert merge_exposures([white, white], [0.5, 4.0])[0, 0, 0] == 2.0
        assert merge_exposures([black, black], [0.5, 4.0])[0, 0, 0] == 0.0

    @pytest.mark.parametrize(
        ("shapes", "seconds", "reason"),
        [
            ([(2, 2, 3)], [1.0, 2.0], "one time per image"),
            ([], [], "at least one"),
            ([(2, 2, 3)], [0.0], "seconds > 0"),
            ([(2, 2, 3), (2, 3, 3)], [1.0, 2.0], "one size"),
        ],
    )
    def test_refused(self, shapes, seconds, reason):
        with pytest.raises(InputError, match=f"exposures.*{reason}"):
            merge_exposures([np.zeros(s, np.float32) for s in shapes], seconds)


class TestDamaged:
    @pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
    @pytest.mark.parametrize("suffix", [".exr", ".png", "16.png", ".jpg", ".tif"])
    def test_truncated(self, tmp_path, rng, suffix, share):
        path = tmp_path / f"broken{suffix}"
        noise = rng.integers(0, 65536, size=(40, 50, 3)).astype(np.uint16)
        if suffix == ".exr":
            write_exr(path, noise.astype(np.float32))
        elif suffix == "16.png":
            write_png(path, noise)
        else:
            Image.fromarray((noise >> 8).astype(np.uint8)).save(path)
        content = path.read_bytes()
        path.write_bytes(content[: int(len(content) * share)])
        with pytest.raises(CaptureError, match=r"broken.*(truncated|starts with)"):
            read_image(path)

    @pytest.mark.parametrize("value", [np.nan, np.inf])
    def test_not_finite(self, tmp_path, photograph, value):
        photograph[3, 4, 1] = photograph[4, 6, 2] = value
        write_exr(tmp_path / "bad.exr", photograph)
        with pytest.raises(CaptureError, match=r"bad\.exr.*2 pixels.*row 3, column 4"):
            read_image(tmp_path / "bad.exr")

    def test_missing(self, tmp_path):
        for reader in (read_image, image_size, read_coverage):
            with pytest.raises(CaptureError, match=r"none\.exr.*cannot be read"):
                reader(tmp_path / "none.exr")

    @pytest.mark.parametrize("content", [b"", b"PK\x03\x04 zip", b"hello world, no image"])
    def test_something_else(self, tmp_path, content):
        (tmp_path / "x.png").write_bytes(content)
        with pytest.raises(CaptureError, match=r"x\.png.*EXR, PNG, JPEG, TIFF or Radiance"):
            read_image(tmp_path / "x.png")

    def test_absurd_size_is_refused_before_decoding(self, tmp_path, monkeypatch, photograph):
        write_exr(tmp_path / "big.exr", photograph)
        write_png(tmp_path / "big.png", np.zeros((5, 7, 3), np.uint8))
        monkeypatch.setattr(image_headers, "MAX_PIXELS", 30)
        for name in ("big.exr", "big.png"):
            with pytest.raises(CaptureError, match=rf"{name}.*30 pixels.*7 x 5"):
                read_image(tmp_path / name)

    def test_huge_png_header(self, tmp_path):
        write_png(tmp_path / "h.png", np.zeros((2, 2), np.uint8))
        content = bytearray((tmp_path / "h.png").read_bytes())
        content[16:24] = (60000).to_bytes(4, "big") * 2
        (tmp_path / "h.png").write_bytes(bytes(content))
        with pytest.raises(CaptureError, match=r"h\.png"):
            read_image(tmp_path / "h.png")

    def test_channels_that_are_no_colour(self, tmp_path):
        write_exr(tmp_path / "n.exr", np.zeros((2, 2, 2), np.float32), ["U", "V"])
        with pytest.raises(CaptureError, match=r"n\.exr.*channels.*U, V"):
            read_image(tmp_path / "n.exr")


def test_photographs_read_by_many_threads_leave_standard_output_alone(tmp_path):
    """Readers that overlap must not leave each other's silence behind."""
    write_exr(tmp_path / "a.exr", np.ones((64, 64, 3), np.float32))
    before = sys.stdout
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(read_image, [tmp_path / "a.exr"] * 400))
    assert sys.stdout is before
