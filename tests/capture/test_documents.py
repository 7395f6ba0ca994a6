"""Description files: bounded reading, encodings, numbers, names and counts."""

import json
import os
import tracemalloc

import numpy as np
import pytest

from reflfield.capture import documents
from reflfield.capture.documents import check_counts, number_array, read_json, read_text
from reflfield.capture.names import unique_names
from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError


@pytest.fixture
def file(tmp_path):
    """Function that writes bytes and returns the file."""

    def write(content):
        path = tmp_path / "capture.json"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


class TestText:
    @pytest.mark.parametrize(
        "encoding",
        ["utf-8", "utf-8-sig", "cp1252", "utf-16", "utf-16-le", "utf-16-be", "utf-32"],
    )
    def test_encodings_of_editors(self, file, encoding):
        text = "9\r\nMünze 1.png 0 0 1\r\n"
        assert read_text(file(text.encode(encoding))) == text

    @pytest.mark.parametrize("content", [b"\x00\x01\x02\x03", b"abc\x1b[31m", b"\x81\x8d\xff"])
    def test_what_is_no_text(self, file, content):
        with pytest.raises(
            CaptureError, match=r"capture\.json: expected a text file \(UTF-8\)"
        ):
            read_text(file(content))

    def test_pipes_devices_and_folders_are_refused_unread(self, tmp_path):
        os.mkfifo(tmp_path / "capture.json")
        with pytest.raises(CaptureError, match="expected a file, received a named pipe"):
            open_capture(tmp_path)
        with pytest.raises(CaptureError, match="received a named pipe"):
            open_capture(tmp_path / "capture.json")
        with pytest.raises(CaptureError, match="/dev/zero: expected a file, received a device"):
            open_capture("/dev/zero")

    def test_a_folder_of_the_name_of_a_description(self, tmp_path):
        (tmp_path / "transforms.json").mkdir()
        with pytest.raises(CaptureError, match=r"transforms\.json: .*received a folder"):
            open_capture(tmp_path)

    def test_link_that_leads_nowhere(self, tmp_path):
        (tmp_path / "capture.json").symlink_to("gone")
        with pytest.raises(CaptureError, match=r"capture\.json: cannot be read"):
            open_capture(tmp_path)


class TestJson:
    @pytest.mark.parametrize(
        "number", ["9" * 5000, "-" + "9" * 400, "1e999", "-1e999", "NaN", "Infinity"]
    )
    def test_numbers_that_are_no_doubles(self, file, number):
        with pytest.raises(CaptureError, match=r"expected JSON, received (the|a) number"):
            read_json(file(f'{{"a": {number}}}'))

    @pytest.mark.parametrize(
        "content",
        ['{"a": [' + "[],[]," * 2_100_000 + "0]}", '{"a": [' + '{"b":0},' * 500_000 + "0]}"],
    )
    def test_memory_is_bounded_before_parsing(self, file, content):
        # 12.6 MB of brackets or 4 MB of objects would take 600 and 120 MB
        path = file(content)
        tracemalloc.start()
        with pytest.raises(CaptureError, match=r"at most 4,000,000 values in 500,000 objects"):
            read_json(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 3.5 * len(content)  # the bytes, the text, and a copy while decoding

    def test_a_dome_of_151_by_151_fits(self, file):
        matrix = np.random.default_rng(0).normal(size=(4, 4)).tolist()
        frame = {
            "file_path": "photographs/view_000/light_000.exr",
            "mask_path": "silhouettes/view_000/light_000.png",
            "transform_matrix": matrix,
            "pl_pos": matrix[0][:3],
            "pl_intensity": matrix[1][:3],
            "camera_intrinsics": matrix[2],
            "w": 4000,
            "h": 3000,
        }
        frames = ",\n".join([json.dumps(frame, indent=4)] * 151 * 151)
        path = file(f'{{"frames": [{frames}]}}')
        assert path.stat().st_size < documents.MAX_DOCUMENT_BYTES
        assert len(read_json(path)["frames"]) == 151 * 151

    def test_a_key_with_two_values_is_refused_and_a_repetition_is_not(self, file):
        with pytest.raises(CaptureError, match="two values of the key 'fl_x' in one object"):
            read_json(file('{"cameras": [{"fl_x": 100, "w": 9, "fl_x": 120}]}'))
        assert read_json(file('{"w": 9, "w": 9}')) == {"w": 9}

    def test_deep_nesting(self, file):
        with pytest.raises(CaptureError, match="expected JSON"):
            read_json(file('{"a":' * 100_000))


class TestNumbers:
    @pytest.mark.parametrize(
        ("value", "reason"),
        [
            ([1, 2], "expected 3 numbers"),
            ([1, 2, "3"], r"expected 3 numbers, received \[1, 2, '3'\]"),
            ([1, 2, "nan"], "expected 3 numbers"),
            ([1, 2, True], "expected 3 numbers"),
            ([1, 2, None], "expected 3 numbers"),
            ([[1], [2], [3]], "expected 3 numbers"),
            ([[1, 2, [3]]], "expected 3 numbers"),
            ([[1, 2], [3]], "expected 3 numbers"),
            ({"x": 1}, "expected 3 numbers"),
            ("123", "expected 3 numbers"),
            (None, "expected 3 numbers"),
            ([1, 2, 1e13], "numbers of at most 1e.12"),
            ([0] * 10_000, r"received \[0, 0, .*\.\.\."),
        ],
    )
    def test_refused(self, value, reason):
        with pytest.raises(CaptureError, match=f"up: .*{reason}") as caught:
            number_array(value, [(3,)], "up")
        assert len(str(caught.value)) < 500

    @pytest.mark.parametrize(
        ("counts", "reason"),
        [
            ((1, 1, 100_001), "at most 100,000 photographs, received 100,001"),
            ((20_001, 1, 1), "at most 20,000 cameras"),
            ((10_000, 10_000, 1), r"at most 50,000,000 pairs.*10,000 x 10,000"),
        ],
    )
    def test_counts(self, counts, reason):
        with pytest.raises(CaptureError, match=rf"capture\.json: expected {reason}"):
            check_counts("capture.json", *counts)
        check_counts("capture.json", 151, 151, 151 * 151)


class TestNames:
    @pytest.mark.parametrize(
        ("files", "names"),
        [
            (["a.png", "a.exr", "a_1.exr"], ["a", "a_2", "a_1"]),
            (["a_1.exr", "a.png", "a.exr"], ["a_1", "a", "a_2"]),
            (["a.png", "A.png"], ["a", "A_1"]),
            (["b/a.png", "c/a.png", "b_a.png"], ["b_a", "c_a", "b_a_1"]),
            (["straße.png", "STRASSE.png"], ["straße", "STRASSE_1"]),
        ],
    )
    def test_distinct_where_suffixes_meet_and_case_is_one(self, tmp_path, files, names):
        assert unique_names([tmp_path / file for file in files], tmp_path) == names

    def test_many_alike(self, tmp_path):
        names = unique_names([tmp_path / "a.png"] * 5000, tmp_path)
        assert names[:3] == ["a", "a_1", "a_2"]
        assert len(set(names)) == 5000

    def test_long_names_fit_a_file_system(self, tmp_path):
        deep = tmp_path / ("ü" * 120) / ("ü" * 120)
        names = unique_names([deep / "a.png", tmp_path / "a.png", deep / "b/a.png"], tmp_path)
        assert len(set(names)) == 3
        assert max(len(f"{name}.relit.exr".encode()) for name in names) < 255
