"""Alpha of photographs: the silhouette where none is given, and nothing below it is seen."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.capture.clipping import MEASURED, TRANSPARENT
from reflfield.capture.encoding import decode_srgb, encode_srgb
from reflfield.capture.image_files import read_alpha, read_image, read_kinds
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.capture.inspect import describe
from reflfield.capture.lights import Light
from reflfield.capture.photographs import Exposure, Photograph
from reflfield.errors import CaptureError
from tests.capture.tiff_files import strips_of, tags_of, write_tiff

SIZE = 32
CODE = 0.5 / 65535 + 1e-7  # half a step of 16 bits, read into float32
COLOUR = 2.28 * CODE  # the slope of sRGB at 1 is 2.275


@pytest.fixture
def alpha():
    """A disk, anti-aliased."""
    y, x = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    return np.clip(10.5 - np.hypot(x, y), 0, 1).astype(np.float32)


@pytest.fixture
def radiance(rng):
    """The object's own, everywhere."""
    return rng.uniform(0.2, 0.9, size=(SIZE, SIZE, 3)).astype(np.float32)


def save(path, radiance, alpha, clutter=0.7):
    """A photograph with clutter below alpha 0, as each format has it by convention."""
    shown = (alpha > 0)[..., None]
    straight = np.where(shown, radiance, clutter)
    if path.suffix == ".exr":
        multiplied = np.where(shown, radiance * alpha[..., None], clutter)
        write_exr(path, np.dstack([multiplied, alpha]).astype(np.float32))
        return
    kind = {"straight": 2, "multiplied": 1}.get(path.stem, 2)
    encoded = encode_srgb(straight)
    if kind == 1:
        encoded = np.where(shown, encoded * alpha[..., None], clutter)
    codes = np.rint(np.dstack([encoded, alpha]) * 65535).astype(np.uint16)
    if path.suffix == ".png":
        write_png(path, codes)
    else:
        tags = tags_of(codes, photometric=2, t338=(3, [kind]))
        write_tiff(path, [(tags, strips_of(codes))])


def capture_of(folder, names, base_geometry="hull"):
    camera = Camera("v", "opencv", SIZE, SIZE, 50.0, 50.0, SIZE / 2, SIZE / 2, np.eye(4))
    photographs = tuple(
        Photograph(name, 0, i, (Exposure(folder / name),)) for i, name in enumerate(names)
    )
    lights = tuple(Light(f"l{i}", "unknown") for i in range(len(names)))
    return Capture("c", folder, (camera,), lights, photographs, base_geometry)


class TestReading:
    @pytest.mark.parametrize("name", ["a.exr", "a.png", "straight.tif", "multiplied.tif"])
    def test_the_object_before_black(self, tmp_path, radiance, alpha, name):
        """Colour times alpha in all formats, and black where alpha is 0."""
        save(tmp_path / name, radiance, alpha)
        image, kinds = read_kinds(tmp_path / name)
        expected = radiance * alpha[..., None]
        # half a step of 16 bits, by the slope of sRGB of at most 2.3, more where alpha divides
        np.testing.assert_allclose(image, expected, atol=1e-4)
        assert not image[alpha == 0].any()
        assert (kinds[alpha == 0] == TRANSPARENT).all()
        assert (kinds[alpha == 1] == MEASURED).all()
        np.testing.assert_allclose(read_alpha(tmp_path / name), alpha, rtol=0, atol=CODE)

    @pytest.mark.parametrize("name", ["a.exr", "a.png", "straight.tif"])
    def test_opaque_alpha_is_none(self, tmp_path, radiance, name):
        save(tmp_path / name, radiance, np.ones((SIZE, SIZE), np.float32))
        assert read_alpha(tmp_path / name) is None
        np.testing.assert_allclose(read_image(tmp_path / name), radiance, rtol=0, atol=COLOUR)

    def test_a_fourth_channel_that_is_no_alpha(self, tmp_path, radiance, rounding):
        codes = np.rint(encode_srgb(radiance) * 255).astype(np.uint8)
        four = np.dstack([codes, np.zeros_like(codes[..., 0])])
        tags = tags_of(four, photometric=2, t338=(3, [0]))
        write_tiff(tmp_path / "x.tif", [(tags, strips_of(four))])
        np.testing.assert_allclose(
            read_image(tmp_path / "x.tif"), decode_srgb(codes / 255), rtol=rounding(np.float32)
        )
        assert read_alpha(tmp_path / "x.tif") is None

    def test_alpha_that_hides_everything_is_refused(self, tmp_path, radiance):
        save(tmp_path / "a.exr", radiance, np.zeros((SIZE, SIZE), np.float32))
        with pytest.raises(CaptureError, match=r"a\.exr.*alpha.*0 everywhere"):
            read_image(tmp_path / "a.exr")


class TestSilhouettes:
    @pytest.mark.parametrize("base_geometry", ["hull", "plane"])
    @pytest.mark.parametrize("name", ["a.exr", "a.png", "straight.tif"])
    def test_alpha_is_the_silhouette(self, tmp_path, radiance, alpha, name, base_geometry):
        save(tmp_path / name, radiance, alpha)
        capture = capture_of(tmp_path, [name], base_geometry)
        np.testing.assert_allclose(capture.read_silhouette(0), alpha, rtol=0, atol=CODE)

    def test_one_bad_matte_does_no_harm(self, tmp_path, radiance, alpha):
        half = np.where(np.arange(SIZE) < 15, alpha, 0)
        mattes = [alpha, alpha, half, alpha, np.ones_like(alpha)]
        names = [f"{i}.png" for i in range(len(mattes))]
        for name, matte in zip(names, mattes, strict=True):
            save(tmp_path / name, radiance, matte)
        cv2.imwrite(str(tmp_path / "plain.jpg"), np.full((SIZE, SIZE, 3), 99, np.uint8))
        capture = capture_of(tmp_path, [*names, "plain.jpg"])
        np.testing.assert_allclose(capture.read_silhouette(0), alpha, rtol=0, atol=CODE)

    def test_a_file_comes_before_alpha(self, tmp_path, radiance, alpha, rounding):
        save(tmp_path / "a.png", radiance, alpha)
        mask = np.rint(np.roll(alpha, 5, axis=1) * 255).astype(np.uint8)
        write_png(tmp_path / "mask.png", mask)
        capture = replace(capture_of(tmp_path, ["a.png"]), silhouettes=(tmp_path / "mask.png",))
        np.testing.assert_allclose(
            capture.read_silhouette(0), mask / 255, rtol=rounding(np.float32)
        )
        assert not capture.read_photograph(0)[alpha == 0].any()  # still no clutter

    def test_opaque_alpha_leaves_the_silhouette_to_be_made(self, tmp_path, alpha):
        object_on_black = np.where(alpha[..., None] > 0.5, 0.6, 0.0) * np.ones(3)
        save(tmp_path / "a.png", object_on_black, np.ones_like(alpha))
        made = capture_of(tmp_path, ["a.png"]).read_silhouette(0)
        assert 0.9 < made.sum() / alpha.sum() < 1.1

    def test_summary_says_where_silhouettes_come_from(self, tmp_path, radiance, alpha):
        save(tmp_path / "a.png", radiance, alpha)
        lines = describe(capture_of(tmp_path, ["a.png"])).lines()
        assert any("0 of 1 given, others are the photographs' alpha" in line for line in lines)

    @pytest.mark.parametrize("largest", [1, 100])
    def test_a_faint_silhouette_says_its_largest_value(
        self, tmp_path, radiance, alpha, largest
    ):
        save(tmp_path / "a.exr", radiance, np.ones_like(alpha))
        write_png(tmp_path / "m.png", ((alpha > 0.5) * largest).astype(np.uint8))
        capture = replace(capture_of(tmp_path, ["a.exr"]), silhouettes=(tmp_path / "m.png",))
        with pytest.raises(CaptureError, match=rf"m\.png.*largest value is {largest} of 255"):
            capture.read_silhouette(0)
