"""Encodings that a description or an option states, and what depends on them."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from reflfield.capture.clipping import BLACK, MEASURED, SATURATED
from reflfield.capture.encoding import Encoding, decode_srgb, parse_encoding, read_pairs
from reflfield.capture.image_files import ImageReading, read_image, read_kinds
from reflfield.capture.image_writing import write_png
from reflfield.capture.readers import open_capture
from reflfield.cli import app
from reflfield.errors import CaptureError, InputError

FROZEN = Path(__file__).parents[1] / "data" / "capture_v1"
# Kintsugi3D's .vset of a real capture: linear luminance, code of 8 bits.
MUNSELL = [(0.031, 50), (0.09, 104), (0.198, 142), (0.362, 166), (0.591, 175), (0.9, 186)]


@pytest.fixture
def codes(tmp_path):
    """A PNG of all codes of 8 bits, grey; its path."""
    path = tmp_path / "codes.png"
    write_png(path, np.arange(256, dtype=np.uint8)[None])
    return path


@pytest.fixture
def encoded_capture(tmp_path):
    """The frozen capture with 16-bit PNGs of .5 instead of its photographs."""
    root = Path(shutil.copytree(FROZEN, tmp_path / "capture"))
    document = json.loads((root / "capture.json").read_text())
    listed = document["photographs"]
    assert isinstance(listed, dict)
    document["photographs"] = {"pattern": "photographs/{camera}_{light}.png"}
    half = np.full((6, 8, 3), 32768, np.uint16)
    for camera in document["cameras"]:
        for light in document["lights"]:
            write_png(root / f"photographs/{camera['id']}_{light['id']}.png", half)
    (root / "capture.json").write_text(json.dumps(document))
    return root


def rewritten(root, change):
    document = json.loads((root / "capture.json").read_text())
    change(document)
    (root / "capture.json").write_text(json.dumps(document))
    return open_capture(root)


class TestCurves:
    @pytest.mark.parametrize(
        ("text", "linear"),
        [
            ("linear", lambda c: c),
            ("srgb", decode_srgb),
            ("gamma=2.2", lambda c: c**2.2),
            ("gamma=1.8", lambda c: c**1.8),
        ],
    )
    def test_named(self, codes, text, linear):
        image = read_image(codes, ImageReading(encoding=parse_encoding(text)))
        expected = linear(np.arange(256) / 255)
        np.testing.assert_allclose(image[0, :, 1], expected, rtol=1e-5)  # float32 powers

    @pytest.mark.parametrize("form", ["vset", "csv", "heading", "shares"])
    def test_pairs_are_met_and_what_lies_above_is_not_measured(
        self, tmp_path, codes, form, rounding
    ):
        texts = {
            "vset": "# x\n" + "".join(f"e {linear}\t\t {code}\n" for linear, code in MUNSELL),
            "csv": "".join(f"{code},{linear}\n" for linear, code in MUNSELL),
            "heading": "linear, encoded\n" + "".join(f"{a},{c}\n" for a, c in MUNSELL),
            "shares": "".join(f"{code / 255!r},{linear}\n" for linear, code in MUNSELL),
        }
        path = tmp_path / ("pairs.vset" if form == "vset" else "pairs.csv")
        path.write_text(texts[form])
        reading = ImageReading(encoding=parse_encoding(str(path)))
        image, kinds = read_kinds(codes, reading)
        values = image[0, :, 0]
        for linear, code in MUNSELL:
            assert values[code] == pytest.approx(linear, rel=rounding(np.float32))
        assert values[0] == 0
        assert (np.diff(values) > 0).all()
        # Of the curve beyond the last pair only that it rises is known, whatever value it has.
        expected = [BLACK] + [MEASURED] * 186 + [SATURATED] * 69
        assert kinds[0, :, 0].tolist() == expected

    @pytest.mark.parametrize(
        "text", ["", "SRGB?", "gamma=", "gamma=nan", "gamma=0", "gamma=99", "pairs", "a.exe"]
    )
    def test_refused(self, text):
        with pytest.raises(InputError, match="encoding: expected"):
            parse_encoding(text)

    @pytest.mark.parametrize(
        "text",
        ["", "1,1\n", "a,b\n1,2\n",
         "1,1\n1,2\n", "1,2\n2,1\n", "1,1\n2,nan\n", "1,1,1\n2,2,2\n",
         "-1,-1\n2,2\n", "0,.5\n1,1\n", "\0\1\2",
         "a" * 200_000 + ",1\n"],
    )  # fmt: skip
    def test_pairs_refused(self, tmp_path, text):
        (tmp_path / "p.csv").write_text(text)
        with pytest.raises(InputError, match=r"p\.csv: expected"):
            read_pairs(tmp_path / "p.csv")


class TestStated:
    def test_of_all_and_of_one(self, encoded_capture, rounding):
        assert open_capture(encoded_capture).read_photograph(0)[0, 0, 0] == pytest.approx(
            decode_srgb(32768 / 65535), rel=rounding(np.float32)
        )

        def state(document):
            document["encoding"] = "linear"
            document["photographs"] = [
                {"camera": "v000", "light": "l000", "file": "photographs/v000_l000.png"},
                {
                    "camera": "v000",
                    "light": "l001",
                    "file": "photographs/v000_l001.png",
                    "encoding": "gamma=3",
                },
            ]

        capture = rewritten(encoded_capture, state)
        half = 32768 / 65535
        assert capture.read_photograph(0)[0, 0, 0] == pytest.approx(
            half, rel=rounding(np.float32)
        )
        assert capture.read_photograph(1)[0, 0, 0] == pytest.approx(
            half**3, rel=rounding(np.float32)
        )

    def test_table_in_the_capture_and_white_level(self, encoded_capture):
        (encoded_capture / "pairs.csv").write_text("0.5,0.1\n1,2\n")
        capture = rewritten(
            encoded_capture, lambda d: d.update(encoding="pairs.csv", white_level=32768)
        )
        image, kinds = capture.read_kinds(0)
        assert image[0, 0, 0] == pytest.approx(0.1, rel=1e-3)  # 32768 is a little above half
        assert (kinds == SATURATED).all()

    def test_transforms(self, encoded_capture, rounding):
        frame = {
            "file_path": "photographs/v000_l000.png",
            "transform_matrix": np.eye(4).tolist(),
            "pl_pos": [0, 0, 1],
        }
        document = {"fl_x": 9, "encoding": "linear", "frames": [frame]}
        path = encoded_capture / "transforms.json"
        path.write_text(json.dumps(document))
        value = open_capture(path).read_photograph(0)[0, 0, 0]
        assert value == pytest.approx(32768 / 65535, rel=rounding(np.float32))
        document["frames"][0]["encoding"] = "gamma=2"
        path.write_text(json.dumps(document))
        value = open_capture(path).read_photograph(0)[0, 0, 0]
        assert value == pytest.approx((32768 / 65535) ** 2, rel=rounding(np.float32))

    @pytest.mark.parametrize("value", ["sRGB", "../pairs.csv", "/etc/passwd.csv", 3, ""])
    def test_refused(self, encoded_capture, value):
        with pytest.raises(CaptureError, match=r"capture\.json.*"):
            rewritten(encoded_capture, lambda d: d.update(encoding=value))

    @pytest.mark.parametrize("key", ["encoding", "layer", "white_level"])
    def test_enters_the_digest(self, encoded_capture, key):
        before = open_capture(encoded_capture)
        value = {"encoding": Encoding("linear"), "layer": "x", "white_level": 9.0}[key]
        after = before.read_as(ImageReading(**{key: value}))
        for part in ("photographs", "silhouettes"):
            without = tuple(None for _ in before.cameras)
            plain, other = (replace(c, silhouettes=without) for c in (before, after))
            assert plain.digest([part]) != other.digest([part])
        assert before.digest(["lights"]) == after.digest(["lights"])

    def test_option_comes_before_the_description(self, encoded_capture):
        rewritten(encoded_capture, lambda d: d.update(encoding="gamma=3"))
        result = CliRunner().invoke(
            app, ["inspect", str(encoded_capture), "--encoding", "linear"]
        )
        assert result.exit_code == 0
        assert "values        0.5 .. 0.5," in result.stdout


def test_real_table(shared_data):
    """The flash photographs' own table: of a grey of its curve, the linear value."""
    encoding = read_pairs(shared_data("mia_guanyu_flash") / "guan-yu-replicability.vset")
    assert encoding.pairs == tuple((code / 255, linear) for linear, code in MUNSELL)
