"""Captures in another unit or range than they would be read in are refused or noted."""

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from reflfield.capture.encoding import parse_encoding
from reflfield.capture.image_files import ImageReading, read_image
from reflfield.capture.readers import open_capture
from reflfield.checking.capture_check import check_capture
from reflfield.errors import CaptureError

FROZEN = Path(__file__).parents[1] / "data" / "capture_v1"
LINEAR = ImageReading(encoding=parse_encoding("linear"))


@pytest.fixture
def frozen(tmp_path):
    """A copy of the frozen capture of 2 cameras and 3 lights."""
    return Path(shutil.copytree(FROZEN, tmp_path / "frozen"))


def described(folder, edit):
    path = folder / "capture.json"
    document = json.loads(path.read_text())
    edit(document)
    path.write_text(json.dumps(document))


def in_png(folder, codes_of, dtype=np.uint16):
    """Replace all photographs by PNG files of their values (1 is the brightest) as codes."""

    for path in sorted((folder / "photographs").glob("*.exr")):
        image = read_image(path)
        codes = codes_of(image / image.max()).round().astype(dtype)
        cv2.imwrite(str(path.with_suffix(".png")), codes[..., ::-1])
    pattern = "photographs/{camera}_{light}.png"
    described(folder, lambda document: document.update(photographs={"pattern": pattern}))


class TestCodes:
    def test_linear_codes_of_12_bits_are_no_dark_srgb(self, frozen):
        in_png(frozen, lambda image: 4095 * image)
        with pytest.raises(
            CaptureError, match=r"\.png: .*codes up to 4095 .*12 bits.*`encoding='linear'`"
        ):
            open_capture(frozen)
        capture = open_capture(frozen, reading=LINEAR)
        assert capture.read_photograph(0).max() == np.float32(4095 / 65535)

    def test_stated_as_srgb_they_are_read_so(self, frozen, rounding):
        in_png(frozen, lambda image: 4095 * image)
        described(frozen, lambda document: document.update(encoding="srgb"))
        largest = open_capture(frozen).read_photograph(0).max()
        encoded = 4095 / 65535
        expected = ((encoded + 0.055) / 1.055) ** 2.4
        assert largest == pytest.approx(expected, rel=rounding(np.float32))

    @pytest.mark.parametrize(
        ("codes_of", "dtype"),
        [
            (lambda image: 16 * (4095 * image).round(), np.uint16),  # 12 bits at the top
            (lambda image: 17_000 * image, np.uint16),
            (lambda image: 255 * image, np.uint8),
        ],
    )
    def test_other_codes_pass(self, frozen, codes_of, dtype):
        in_png(frozen, codes_of, dtype)
        assert not open_capture(frozen).notes

    def test_codes_of_14_bits_are_noted(self, frozen):
        in_png(frozen, lambda image: 16_383 * image)
        (note,) = open_capture(frozen).notes
        assert "16383 in all" in note
        assert "14 bits; say `encoding='linear'`" in note
        assert not open_capture(frozen, reading=LINEAR).notes


def same_file_twice(document):
    document["photographs"] = [
        {"camera": "v000", "light": light, "file": "photographs/v000_l000.exr"}
        for light in ("l000", "l001")
    ]


class TestOneFileForTwoPhotographs:
    def test_is_refused(self, frozen):
        described(frozen, same_file_twice)
        with pytest.raises(
            CaptureError, match=r"v000_l000\.exr: .*same file for camera 'v000' under light"
        ):
            open_capture(frozen)

    def test_frames_may_share_one(self, frozen):
        described(frozen, same_file_twice)
        assert open_capture(frozen, require_photographs=False).photographs


class TestUnits:
    @pytest.mark.parametrize(("factor", "n_notes"), [(1.0, 0), (1000.0, 1)])
    def test_lights_in_millimetres_among_cameras_in_metres_are_noted(
        self, frozen, factor, n_notes
    ):
        def move(document):
            for light in document["lights"]:
                if "position" in light:
                    light["position"] = (factor * np.array(light["position"])).tolist()

        described(frozen, move)
        notes = [note for note in open_capture(frozen).notes if "one unit" in note]
        assert len(notes) == n_notes
        assert all("times as far" in note for note in notes)


@pytest.mark.parametrize(("factor", "n_notes"), [(1.01, 0), (2.0, 1)])
def test_oblong_pixels_are_noted(frozen, factor, n_notes):
    def stretch(document):
        camera = document["cameras"][0]
        camera["fl_y"] = factor * camera["fl_x"]

    described(frozen, stretch)
    notes = [note for note in open_capture(frozen).notes if "oblong in v000" in note]
    assert len(notes) == n_notes


@pytest.mark.parametrize(
    ("share", "n_notes"), [(0.1, 0), (0.9, 0), (0.0, 1), (0.01, 1), (0.99, 1), (90, 1), (-1, 1)]
)
def test_principal_points_at_the_border_or_outside_are_noted(frozen, share, n_notes):
    """As cx and cy that are shares of the image's sides."""
    described(frozen, lambda doc: doc["cameras"][1].update(cx=share * doc["cameras"][1]["w"]))
    notes = [note for note in open_capture(frozen).notes if "principal point" in note]
    assert len(notes) == n_notes
    assert all("border in v001 (" in note for note in notes)


@pytest.mark.parametrize(
    ("share", "model", "n_notes"),
    [(0.3, "opencv", 0), (0.2, "opencv", 1), (0.2, "opencv_fisheye", 0)],
)
def test_lenses_wider_than_there_are_are_noted(frozen, share, model, n_notes):
    def widen(document):
        camera = document["cameras"][0]
        length = share * max(camera["w"], camera["h"])
        camera.update(model=model, fl_x=length, fl_y=length)

    described(frozen, widen)
    notes = [note for note in open_capture(frozen).notes if "in millimetres, or" in note]
    assert len(notes) == n_notes
    assert all("straight in v000 (" in note for note in notes)


def in_files(folder, suffix, settings_of):
    """Replace all photographs by files of a kind with Exif data (seconds, stop, ISO) each."""
    for number, path in enumerate(sorted((folder / "photographs").glob("*.exr"))):
        image = read_image(path)
        picture = Image.fromarray(np.uint8(255 * np.clip(image, 0, 1)))
        exif = picture.getexif()
        stated = zip((33434, 33437, 34855), settings_of(number), strict=True)
        exif[34665] = {tag: value for tag, value in stated if value}
        picture.save(path.with_suffix(suffix), exif=exif.tobytes())
    pattern = "photographs/{camera}_{light}" + suffix
    described(folder, lambda document: document.update(photographs={"pattern": pattern}))


class TestExposures:
    @pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
    @pytest.mark.parametrize(
        "other", [(1 / 15, 8.0, 100), (1 / 60, 4.0, 100), (1 / 60, 8.0, 400)]
    )
    def test_photographs_exposed_differently_by_their_exif_data(self, frozen, suffix, other):
        usual = (1 / 60, 8.0, 100)
        in_files(frozen, suffix, lambda number: other if number == 2 else usual)
        (note,) = open_capture(frozen).notes
        assert re.search(rf"v000_l002\{suffix}: exposed 4 times as much as v00", note)
        assert "0.01667 s, f/8, ISO 100; 1 of 6 files differ" in note
        checked = check_capture(open_capture(frozen, require_photographs=False))
        (finding,) = [found for found in checked.all if found.kind == "exposures"]
        assert finding.severity == "note"

    @pytest.mark.parametrize("values", [(1 / 60, 8.0, 100), (0, 0, 0), (1 / 60, 0, 0)])
    def test_one_exposure_is_not_spoken_of(self, frozen, values):
        in_files(frozen, ".jpg", lambda number: values)
        assert open_capture(frozen).notes == ()

    def test_stated_exposure_times_are_taken_off(self, frozen):
        in_files(frozen, ".jpg", lambda number: (0.01 * 2**number, 8.0, 100))

        def state(document):
            names = sorted(path.name for path in (frozen / "photographs").glob("*.jpg"))
            document["photographs"] = [
                {"camera": name[:4], "light": name[5:9], "exposures":
                 [{"file": f"photographs/{name}", "seconds": 0.01 * 2**number}]}
                for number, name in enumerate(names)
            ]  # fmt: skip

        described(frozen, state)
        assert open_capture(frozen).notes == ()

    def test_a_dark_frame_of_another_exposure(self, frozen):
        in_files(frozen, ".jpg", lambda number: (1 / 60, 8.0, 400 if number == 5 else 100))

        def name_dark_frame(document):
            *names, dark = sorted(path.name for path in (frozen / "photographs").glob("*.jpg"))
            document["photographs"] = [
                {"camera": name[:4], "light": name[5:9], "file": f"photographs/{name}",
                 "dark": f"photographs/{dark}"}
                for name in names
            ]  # fmt: skip

        described(frozen, name_dark_frame)
        assert any("exposed 4 times as much" in note for note in open_capture(frozen).notes)

    def test_exif_data_that_are_no_cameras(self, frozen):
        in_files(frozen, ".jpg", lambda number: (2**32 - 1, 0, 0) if number else (1, 0, 0))
        assert open_capture(frozen).notes == ()
