"""Masks that contradict the others are said on standard error and in the report."""

import json

import cv2
import numpy as np
import pytest

from reflfield.capture.image_files import read_image
from reflfield.capture.image_writing import write_exr


@pytest.fixture(scope="module")
def said_of_inverted():
    return "v004: its silhouette contradicts the 8 others"


@pytest.fixture
def inverted(capture_copy):
    """Capture whose fifth mask is inverted."""
    camera = json.loads((capture_copy / "capture.json").read_text())["cameras"][4]
    assert camera["id"] == "v004"
    path = str(capture_copy / camera["silhouette"])
    assert cv2.imwrite(path, 255 - cv2.imread(path, cv2.IMREAD_UNCHANGED))
    return capture_copy


def test_one_inverted_mask_is_named_everywhere(inverted, run_tiny, tmp_path, said_of_inverted):
    out = tmp_path / "out"
    quick = ("--set", "comparison.without_alignment=false",
             "--set", "comparison.rate_distortion=false")  # fmt: skip
    run = run_tiny(out, *quick, capture=inverted)
    assert run.status == 0
    assert said_of_inverted in run.err
    assert "it is inverted" in run.err
    page = (out / "report" / "index.html").read_text()
    assert said_of_inverted in page[: page.index("<section")]
    assert "v004 (excluded from the hull)" in page
    details = json.loads((out / "stages" / "hull" / "hull.json").read_text())
    assert details["left_out"] == ["v004"]
    assert details["contradictions"][0]["explanation"]["kind"] == "inverted"
    counts = json.loads((out / "stages" / "hull" / "stage.json").read_text())["counts"]
    assert counts["views that contradict the others"] == ["v004"]
    again = run_tiny(out, *quick, capture=inverted)
    assert said_of_inverted in again.err, "not said when the hull is reused"


def test_masks_that_are_all_inverted_stop_the_run(capture_copy, run_tiny, tmp_path):
    for path in map(str, (capture_copy / "silhouettes").iterdir()):
        image = cv2.imread(path, cv2.IMREAD_UNCHANGED)
        assert cv2.imwrite(path, np.uint8(255) - image)
    run = run_tiny(tmp_path / "out", "--until", "hull", capture=capture_copy)
    assert run.status == 2
    assert "all are inverted (white must mean object)" in run.err


@pytest.fixture
def shifted(capture_copy, described):
    """Capture without masks, whose fifth camera saw the ball elsewhere."""
    described(capture_copy, lambda d: [camera.pop("silhouette") for camera in d["cameras"]])
    for path in (capture_copy / "photographs").glob("v004_*.exr"):
        write_exr(path, np.roll(read_image(path), 8, axis=1))
    return capture_copy


def test_contradictions_of_silhouettes_that_were_made_ask_for_masks(
    shifted, run_tiny, tmp_path
):
    run = run_tiny(tmp_path / "out", "--until", "hull", capture=shifted)
    assert run.status == 0
    assert "v004: its silhouette contradicts the 8 others" in run.err
    assert "v004: no masks were given" in run.err


def test_a_hull_that_made_silhouettes_do_not_bound_asks_for_masks(shifted, run_tiny, tmp_path):
    for path in (shifted / "photographs").iterdir():
        away = 3 * (int(path.stem[1:4]) % 3)
        write_exr(path, np.roll(read_image(path), away, axis=1))
    run = run_tiny(tmp_path / "out", "--until", "hull", capture=shifted)
    assert run.status == 2
    assert "no masks were given" in run.err
