""".lp and *_par.txt as other computers and programs write them."""

import numpy as np
import pytest

from reflfield.capture.image_writing import write_png
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError

HALF = 0.5**0.5


def photograph(path, value=128):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.full((4, 8, 3), value, np.uint8))


def directions(capture):
    return [light.direction.round(6).tolist() for light in capture.lights]


class TestLp:
    def opened(self, folder, *lines, encoding="utf-8"):
        text = "\r\n".join([str(len(lines)), *lines, ""])
        folder.mkdir(exist_ok=True)
        (folder / "dome.lp").write_bytes(text.encode(encoding))
        return open_capture(folder)

    @pytest.mark.parametrize(
        "prefix",
        [
            "C:\\RTI\\stela 9\\jpeg-exports\\",
            "/Users/someone/stela 9/jpeg-exports/",
            "\\\\server\\share\\",
            "../jpeg-exports/",
            "jpeg-exports\\",
        ],
    )
    def test_paths_from_other_computers_fall_back_to_the_base_name(self, tmp_path, prefix):
        photograph(tmp_path / "img 1.png")
        capture = self.opened(tmp_path, f"{prefix}img 1.png 0 0 1")
        assert capture.photographs[0].path == tmp_path / "img 1.png"

    def test_the_longest_end_of_a_path_that_exists_counts(self, tmp_path):
        for i, folder in enumerate((".", "left", "day/left", "right")):
            photograph(tmp_path / folder / "1.png", 50 * i)
        capture = self.opened(
            tmp_path,
            *(f"D:\\a\\{end} 0 0 1" for end in ("day\\left\\1.png", "x\\right\\1.png")),
        )
        assert [p.path for p in capture.photographs] == [
            tmp_path / "day/left/1.png",
            tmp_path / "right/1.png",
        ]

    @pytest.mark.parametrize(
        "lights",
        [
            ("0.6 0 -0.8", "0 0.6 -0.8", "0 0 -1"),  # z away from the camera
            ("120 45 0", "240 45 0", "0 90 0"),  # angles in degrees
            ("0.6 0.8 0", "0.6 -0.8 0", "0 1 0.1"),  # y towards the camera
        ],
    )
    def test_lights_behind_the_picture_are_of_another_convention(self, tmp_path, lights):
        photograph(tmp_path / "1.png")
        with pytest.raises(CaptureError, match=r"dome\.lp: .*z > 0, received [23] of 3"):
            self.opened(tmp_path, *(f"1.png {light}" for light in lights))

    def test_azimuth_and_elevation_are_no_direction(self, tmp_path):
        photograph(tmp_path / "1.png")
        photograph(tmp_path / "2.png")
        with pytest.raises(CaptureError, match=r"dome\.lp: .* 2 that are all within .*angles"):
            self.opened(tmp_path, "1.png 30 45 1", "2.png 60 45 1")

    @pytest.mark.parametrize("more", ["1.0", "1 .9 .8"])
    def test_intensities_behind_the_direction_are_said(self, tmp_path, more):
        photograph(tmp_path / "a 1.png")
        with pytest.raises(
            CaptureError, match=r"dome\.lp: .*more numbers in the line of 'a 1.png"
        ):
            self.opened(tmp_path, f"a 1.png 0 0 1 {more}")

    def test_few_lights_behind_the_picture_are_noted(self, tmp_path):
        for i in range(8):
            photograph(tmp_path / f"{i}.png")
        lines = [f"{i}.png 0.6 0 {-0.1 if i == 3 else 0.8}" for i in range(8)]
        note = self.opened(tmp_path, *lines).notes[0]
        assert "dome.lp: 1 of 8 lights are behind the image plane" in note

    @pytest.mark.parametrize(("factor", "n_notes"), [(1.05, 0), (2.0, 1)])
    def test_directions_of_different_lengths_are_noted(self, tmp_path, factor, n_notes):
        photograph(tmp_path / "0.png")
        photograph(tmp_path / "1.png")
        notes = self.opened(tmp_path, "0.png 0 0 3", f"1.png 0 0 {3 * factor}").notes
        assert len(notes) == n_notes
        assert all("lengths of 3 to 6, which count for nothing" in note for note in notes)

    def test_nothing_of_the_name_here(self, tmp_path):
        photograph(tmp_path / "jpeg-exports/1.png")
        with pytest.raises(CaptureError, match=r"leaves the folder.*the description into a"):
            self.opened(tmp_path / "assembly", "../jpeg-exports/1.png 0 0 1")

    @pytest.mark.parametrize(
        "lines",
        [
            ("1.png 0,707106781 0 0,707106781", "2.png 0 ,6 0,8"),
            ("1.png 0.707106781 0 0,707106781", "2.png 0 +6,0E-1 .8"),
        ],
    )
    def test_decimal_commas_alone_and_mixed(self, tmp_path, lines):
        for name in ("1.png", "2.png"):
            photograph(tmp_path / name)
        capture = self.opened(tmp_path, *lines)
        assert directions(capture) == [[0.707107, 0, 0.707107], [0, 0.6, 0.8]]

    @pytest.mark.parametrize(
        "encoding", ["cp1252", "utf-16", "utf-16-le", "utf-16-be", "utf-8"]
    )
    def test_names_with_umlauts_in_the_encodings_of_windows(self, tmp_path, encoding):
        photograph(tmp_path / "Münze 1.png")
        capture = self.opened(tmp_path, "Münze 1.png 0 0 1", encoding=encoding)
        assert capture.photographs[0].path.is_file()
        assert capture.photographs[0].name == "Münze 1"

    def test_other_case(self, tmp_path):
        photograph(tmp_path / "img_l000.png")
        assert self.opened(tmp_path, "IMG_L000.PNG 0 0 1").photographs[0].name == "img_l000"

    @pytest.mark.parametrize("count", ["²", "9" * 5000, "1_0", "-1", "1.0", "١"])
    def test_counts_that_are_none(self, tmp_path, count):
        photograph(tmp_path / "1.png")
        (tmp_path / "dome.lp").write_text(f"{count}\n1.png 0 0 1\n")
        with pytest.raises(CaptureError, match="expected the number of photographs"):
            open_capture(tmp_path)

    def test_control_characters(self, tmp_path):
        with pytest.raises(CaptureError, match=r"expected a text file|not a usable path"):
            self.opened(tmp_path, "a\x1b[2Jb.png 0 0 1")
        with pytest.raises(CaptureError, match="not a usable path"):
            self.opened(tmp_path, "a\x85b.png 0 0 1".replace("\x85", "\x9b"))


class TestMiddlebury:
    LINE = "a.png 100 0 3.5 0 100 2.5 0 0 1 1 0 0 0 1 0 0 0 1 0 0 2"

    def opened(self, folder, text):
        photograph(folder / "a.png")
        (folder / "a_par.txt").write_text(text)
        return open_capture(folder)

    def test_comments(self, tmp_path):
        text = f"# name K R t\n\n1  # image\n# first\n{self.LINE} # the only one\n"
        camera = self.opened(tmp_path, text).cameras[0]
        assert (camera.fl_x, camera.cx, camera.cy) == (100, 4, 3)

    def test_comments_before_the_kind_is_told(self, tmp_path):
        self.opened(tmp_path, f"# x\n1\n{self.LINE}\n")
        (tmp_path / "a_par.txt").rename(tmp_path / "cameras.dat")
        assert open_capture(tmp_path / "cameras.dat").format == "middlebury"

    @pytest.mark.parametrize(
        ("old", "new", "reason"),
        [
            ("1 0 0 0 1 0 0 0 1", "2 0 0 0 2 0 0 0 2", "'a.png'.*scale or shear"),
            ("1 0 0 0 1 0 0 0 1", "1 0 0 0 1 0 0 0 -1", "'a.png'.*mirrored"),
            ("100 0 3.5 0 100 2.5 0 0 1", "100 0 3.5 9 100 2.5 0 0 1", "zeros below"),
            ("100 0 3.5 0 100 2.5 0 0 1", "100 0 3.5 0 100 2.5 0 0 -1", "zeros below"),
            ("0 0 2", "0 0 1e308", "at most 1e.12"),
            ("0 0 2", "0 0 2_0", "21 finite numbers"),
        ],
    )
    def test_what_is_no_calibration(self, tmp_path, old, new, reason):
        head, _, tail = self.LINE.rpartition(old)
        with pytest.raises(CaptureError, match=rf"a_par\.txt: .*{reason}"):
            self.opened(tmp_path, f"1\n{head}{new}{tail}\n")
