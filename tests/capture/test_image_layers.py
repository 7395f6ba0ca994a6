"""Which layer, part or page of a file is read."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from reflfield.capture.image_files import ImageReading, image_size, read_image
from reflfield.capture.readers import open_capture
from reflfield.cli import app
from reflfield.errors import CaptureError
from tests.capture.exr_files import write_layers, write_parts
from tests.capture.tiff_files import strips_of, tags_of, write_tiff

FROZEN = Path(__file__).parents[1] / "data" / "capture_v1"
HEIGHT, WIDTH = 6, 8


def channels_of(*layers):
    """Channels of some layers, each of one value: the layer's number in tenths."""
    return {
        f"{layer}.{letter}" if layer else letter: np.full((HEIGHT, WIDTH), 0.1 * number)
        for number, (layer, letters) in enumerate(layers)
        for letter in letters
    }


class TestLayers:
    @pytest.mark.parametrize(
        ("layers", "number"),
        [
            # Blender; renamed view layers come before it in the alphabet
            ([("Main.AOV", "RGB"), ("Main.Combined", "RGBA"), ("Main.Depth", "Z")], 1),
            ([("ViewLayer.AO", "RGB"), ("ViewLayer.Combined", "RGBA")], 1),
            ([("ViewLayer.DiffCol", "RGB"), ("ViewLayer.Combined", "RGB"),
              ("ViewLayer.Normal", "XYZ")], 1),
            # plain channels, whatever lies beside them
            ([("albedo", "RGB"), ("", "RGBA"), ("beauty", "RGB")], 1),
            ([("", "RGB"), ("N", "RGB"), ("Z", "Z")], 0),
            ([("N", "RGB"), ("beauty", "RGB")], 1),
            ([("N", "RGB"), ("RGBA", "rgba")], 1),
            ([("diffuse", "RGB"), ("Ci", "rgb")], 1),
            # capital letters before small ones of one layer
            ([("", "RGB"), ("", "rgb")], 0),
            # the only layer there is
            ([("anything", "RGB")], 0),
            ([("", "Y")], 0),
            ([("grey", "Y")], 0),
            ([("normal", "XYZ"), ("combined", "Y")], 1),
        ],
    )  # fmt: skip
    def test_the_picture_is_taken(self, tmp_path, layers, number):
        write_layers(tmp_path / "a.exr", channels_of(*layers))
        alpha_hides = np.float32(0.1 * number)  # alpha has the value of its layer
        image = read_image(tmp_path / "a.exr")
        np.testing.assert_array_equal(image, np.full_like(image, alpha_hides))

    @pytest.mark.parametrize(
        ("layers", "listed"),
        [
            ([("ViewLayer.AO", "RGB"), ("ViewLayer.Depth", "Z")], "ViewLayer.AO"),
            ([("left.Combined", "RGB"), ("right.Combined", "RGB")],
             "left.Combined, right.Combined"),
            ([("N", "RGB"), ("albedo", "RGB")], "N, albedo"),
            ([("Normal", "XYZ")], "Normal.X, Normal.Y, Normal.Z"),
            ([("", "Z")], "Z"),
            ([("", "UV")], "U, V"),
        ],
    )  # fmt: skip
    def test_doubt_is_an_error_that_lists_what_is_there(self, tmp_path, layers, listed):
        write_layers(tmp_path / "a.exr", channels_of(*layers))
        with pytest.raises(CaptureError, match=rf"a\.exr: expected.*received.*{listed}"):
            read_image(tmp_path / "a.exr")

    @pytest.mark.parametrize(
        ("wanted", "number"), [("left.Combined", 0), ("RIGHT.combined", 1), ("albedo", 2)]
    )
    def test_by_name(self, tmp_path, wanted, number):
        layers = [("left.Combined", "RGB"), ("right.Combined", "RGB"), ("x.albedo", "RGB")]
        write_layers(tmp_path / "a.exr", channels_of(*layers))
        image = read_image(tmp_path / "a.exr", ImageReading(layer=wanted))
        np.testing.assert_array_equal(image, np.full_like(image, np.float32(0.1 * number)))

    @pytest.mark.parametrize("wanted", ["Combined", "beauty", "x"])
    def test_no_or_several_of_that_name(self, tmp_path, wanted):
        layers = [("left.Combined", "RGB"), ("right.Combined", "RGB")]
        write_layers(tmp_path / "a.exr", channels_of(*layers))
        with pytest.raises(CaptureError, match=rf"layer '{wanted}'.*left\.Combined, right"):
            read_image(tmp_path / "a.exr", ImageReading(layer=wanted))


class TestParts:
    @pytest.mark.parametrize(
        ("parts", "number"),
        [
            ([("N", "RGB"), ("albedo", "RGB"), ("C", "RGB")], 2),  # Houdini
            ([("depth", "Z"), ("rgba", "RGBA")], 1),
            ([("Beauty", "RGB"), ("normals", "XYZ")], 0),
            ([("depth", "Z"), ("ViewLayer.Combined", "RGB")], 1),
        ],
    )
    def test_the_picture_is_taken(self, tmp_path, parts, number):
        contents = {
            name: {letter: np.full((HEIGHT, WIDTH), 0.1 * (i + 1)) for letter in letters}
            for i, (name, letters) in enumerate(parts)
        }
        write_parts(tmp_path / "p.exr", contents)
        image = read_image(tmp_path / "p.exr")
        np.testing.assert_array_equal(
            image, np.full_like(image, np.float32(0.1 * (number + 1)))
        )
        by_number = read_image(tmp_path / "p.exr", ImageReading(layer=str(number)))
        np.testing.assert_array_equal(by_number, image)

    def test_doubt(self, tmp_path):
        plane = np.ones((HEIGHT, WIDTH))
        contents = {name: dict.fromkeys("RGB", plane) for name in ("N", "albedo", "specular")}
        write_parts(tmp_path / "p.exr", contents)
        with pytest.raises(CaptureError, match=r"p\.exr.*parts N, albedo, specular.*`layer="):
            read_image(tmp_path / "p.exr")


class TestPages:
    def page(self, value, height, *, reduced=0):
        pixels = np.full((height, WIDTH, 3), value, np.uint8)
        tags = tags_of(
            pixels, photometric=2, t254=(4, [reduced]), t285=(2, b"page%d\0" % height)
        )
        return tags, strips_of(pixels)

    def test_smaller_copies_are_passed_over(self, tmp_path):
        pages = [self.page(9, 2, reduced=1), self.page(255, 6), self.page(9, 2, reduced=1)]
        write_tiff(tmp_path / "t.tif", pages)
        np.testing.assert_array_equal(read_image(tmp_path / "t.tif"), np.ones((6, WIDTH, 3)))
        assert image_size(tmp_path / "t.tif") == (WIDTH, 6)

    def test_doubt_and_choice(self, tmp_path):
        write_tiff(tmp_path / "t.tif", [self.page(0, 6), self.page(255, 7)])
        with pytest.raises(CaptureError, match=r"t\.tif.*pages page6, page7.*`layer="):
            read_image(tmp_path / "t.tif")
        for name in ("page7", "1"):
            reading = ImageReading(layer=name)
            image = read_image(tmp_path / "t.tif", reading)
            np.testing.assert_array_equal(image, np.ones((7, WIDTH, 3)))
            assert image_size(tmp_path / "t.tif", reading) == (WIDTH, 7)


def test_layer_of_a_capture(tmp_path):
    """By option before the description; without either the command says what there is."""
    root = Path(shutil.copytree(FROZEN, tmp_path / "capture"))
    for path in (root / "photographs").iterdir():
        write_layers(path, channels_of(("x", "RGB"), ("left", "RGB"), ("right", "RGB")))
    result = CliRunner().invoke(app, ["inspect", str(root)])
    assert "left, right, x" in str(result.exception)
    document = json.loads((root / "capture.json").read_text())
    (root / "capture.json").write_text(json.dumps(document | {"layer": "left"}))
    assert open_capture(root).read_photograph(0)[0, 0, 0] == np.float32(0.1)
    result = CliRunner().invoke(app, ["inspect", str(root), "--layer", "right"])
    assert result.exit_code == 0
    assert "values        0.2 .. 0.2" in result.stdout
