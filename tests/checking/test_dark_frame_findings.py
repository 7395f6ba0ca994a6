"""What a check says of light of the room, and of dark frames that hold it."""

import numpy as np
import pytest

from reflfield.capture.image_files import read_image
from reflfield.capture.image_writing import write_exr
from reflfield.checking.findings import ERROR, NOTE
from tests.checking import faults as f


@pytest.fixture
def lit_room(clean_dome, tmp_path):
    """The dome in a lit room, with a dark frame of each view that nothing names."""
    planted = f.Planted.copy(clean_dome, tmp_path / "capture")
    (planted.folder / "dark").mkdir()
    n_lights = len(planted.document["lights"])
    brightest = max(read_image(planted.photograph(4, i)).max() for i in range(n_lights))
    for view in range(len(planted.document["cameras"])):
        seen = [read_image(planted.photograph(view, i)) for i in range(n_lights)]
        coverage = np.mean(seen, axis=0) > 0
        room = (0.1 * brightest * coverage).astype(np.float32)
        write_exr(planted.folder / f"dark/{view}.exr", room)
        for light in range(n_lights):
            planted.change_photograph(view, light, lambda image, room=room: image + room)
    return planted


def name_dark_frames(planted, file="dark/{}.exr"):
    def change(document):
        for number, camera in enumerate(document["cameras"]):
            camera["dark"] = file.format(number)

    planted.describe(change)


def kinds(findings, severity=None):
    return [one.kind for one in findings.all if severity in (None, one.severity)]


def test_light_of_the_room_is_found_and_gone_with_dark_frames(lit_room, check_folder):
    before = check_folder(lit_room.folder)
    (ambient,) = [one for one in before.all if one.kind == "ambient light"]
    assert "'dark' in capture.json" in ambient.remedy
    name_dark_frames(lit_room)
    after = check_folder(lit_room.folder)
    assert [one.line() for one in after.all if one.severity != NOTE] == []
    (note,) = [one for one in after.all if one.kind == "dark frame"]
    assert note.words.startswith("20 of them are subtracted from 260 of 260 photographs")


def test_half_of_the_light_is_still_found(lit_room, check_folder):
    for view in range(20):
        path = lit_room.folder / f"dark/{view}.exr"
        write_exr(path, 0.4 * read_image(path))
    name_dark_frames(lit_room)
    (ambient,) = [
        one for one in check_folder(lit_room.folder).all if one.kind == "ambient light"
    ]
    assert "take them again" in ambient.remedy


def test_a_photograph_with_a_lamp_is_no_dark_frame(lit_room, check_folder):
    bright = lit_room.folder / "dark/7.exr"
    write_exr(bright, 2 * read_image(lit_room.photograph(7, 10)))
    name_dark_frames(lit_room)
    (finding,) = [o for o in check_folder(lit_room.folder).all if o.kind == "bright dark frame"]
    assert finding.subjects == lit_room.names("cameras", 7)


def test_dark_frames_that_cannot_be_used_are_told_once_each(lit_room, check_folder):
    (lit_room.folder / "dark/3.exr").unlink()
    write_exr(lit_room.folder / "dark/5.exr", np.zeros((4, 4, 3), np.float32))
    name_dark_frames(lit_room)
    findings = check_folder(lit_room.folder)
    refused = [one for one in findings.all if (one.kind, one.severity) == ("dark frame", ERROR)]
    assert [one.subjects for one in refused] == [lit_room.names("cameras", i) for i in (3, 5)]
    assert "damaged photograph" not in kinds(findings)
    assert "18 of them" in next(o.words for o in findings.all if o.severity == NOTE
                                and o.kind == "dark frame")  # fmt: skip
