"""Held-out photographs are measured on the whole object, whatever they show of it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from reflfield.capture.image_files import read_image
from reflfield.capture.image_writing import write_exr
from reflfield.capture.lights import UNKNOWN, Light
from reflfield.capture.readers import open_capture
from reflfield.geometry.mesh import read_ply
from reflfield.geometry.ray_scene import RayScene
from reflfield.metrics.comparison_silhouettes import (
    projected_coverage,
    write_comparison_silhouettes,
)
from reflfield.options import HoldOut
from reflfield.pipeline.hold_out import split_of
from reflfield.render.exposure import object_pixels

BARE = (
    "--set", "comparison.without_alignment=false",
    "--set", "comparison.rate_distortion=false",
)  # fmt: skip


@pytest.fixture(scope="module")
def true_capture(tiny_capture):
    """The capture with its true silhouettes."""
    return open_capture(tiny_capture)


@pytest.fixture(scope="module")
def hull(finished):
    return read_ply(finished.folder / "hull.ply")


def unmasked(capture):
    """The capture as if no silhouette had been given."""
    return replace(capture, silhouettes=())


def rim(silhouette):
    """Number of pixels on the outline of the pixels that count."""
    counted = object_pixels(silhouette)
    inner = counted & np.roll(counted, 1, 0) & np.roll(counted, -1, 0)
    inner &= np.roll(counted, 1, 1) & np.roll(counted, -1, 1)
    return int((counted & ~inner).sum())


def compared_of(capture, hold_out):
    return split_of(capture, hold_out).compared_capture(capture)


def made(capture, compared, hull, folder):
    return write_comparison_silhouettes(compared, capture, hull, folder, threads=1)


class TestWhereTheyComeFrom:
    def test_given_ones_are_taken(self, true_capture, hull, tmp_path):
        compared = compared_of(true_capture, HoldOut(views=2, lights=2))
        silhouettes = made(true_capture, compared, hull, tmp_path)
        assert silhouettes.origins == ("given", "given")
        for view in range(2):
            given = compared.read_silhouette(view)
            np.testing.assert_array_equal(silhouettes.read(view), given)

    def test_all_photographs_of_the_camera_make_them(self, true_capture, hull, tmp_path):
        """One held-out photograph shows the lit side alone; all six of its camera the whole."""
        capture = unmasked(true_capture)
        compared = compared_of(capture, HoldOut(views=1, lights=1))
        silhouettes = made(capture, compared, hull, tmp_path)
        assert silhouettes.origins == ("photographs",)
        truth = true_capture.read_silhouette(5)
        n = int(object_pixels(silhouettes.read(0)).sum())
        assert abs(n - object_pixels(truth).sum()) <= rim(truth)
        alone = int(object_pixels(compared.read_silhouette(0)).sum())
        assert object_pixels(truth).sum() - alone > rim(truth)

    def test_of_a_camera_with_one_photograph_the_hull_is(self, true_capture, hull, tmp_path):
        """Each view has a light of its own: a flash, a hand-held lamp."""
        kept = tuple(p for p in true_capture.photographs if p.light == p.camera % 6)
        capture = replace(unmasked(true_capture), photographs=kept)
        compared = compared_of(capture, HoldOut(photographs=3))
        silhouettes = made(capture, compared, hull, tmp_path)
        assert silhouettes.origins == ("hull",) * 3
        ids = [camera.id for camera in capture.cameras]
        for view, camera in enumerate(compared.cameras):
            truth = object_pixels(true_capture.read_silhouette(ids.index(camera.id)))
            measured = object_pixels(silhouettes.read(view))
            # The hull of all other views has the outline of the object to the pixel.
            outline = rim(true_capture.read_silhouette(ids.index(camera.id)))
            assert (truth ^ measured).sum() <= outline

    def test_in_one_unknown_light_the_photograph_is(self, true_capture, hull, tmp_path):
        one = unmasked(true_capture).subset(lights=[0])
        capture = replace(one, lights=(Light("room", UNKNOWN),))
        compared = compared_of(capture, HoldOut(views=2))
        silhouettes = made(capture, compared, hull, tmp_path)
        assert silhouettes.origins == ("photographs", "photographs")
        view = [camera.id for camera in capture.cameras].index(compared.cameras[0].id)
        expected = capture.read_silhouette(view)
        # Half a step of 8 bits, and rounding of singles.
        np.testing.assert_allclose(silhouettes.read(0), expected, atol=0.5001 / 255)

    def test_where_all_photographs_are_dark_the_hull_is(
        self, tiny_capture, true_capture, hull, tmp_path, monkeypatch
    ):
        dark = np.zeros((32, 32, 3), np.float32)
        monkeypatch.setattr(type(true_capture), "read_photograph", lambda *_: dark)
        capture = unmasked(true_capture)
        compared = compared_of(capture, HoldOut(views=1, lights=1))
        silhouettes = made(capture, compared, hull, tmp_path)
        assert silhouettes.origins == ("hull",)
        scene = RayScene(hull, 1)
        expected = projected_coverage(scene, compared.cameras[0])
        np.testing.assert_array_equal(silhouettes.read(0), expected)


def test_a_dark_held_out_frame_does_not_end_the_run(
    run_tiny, capture_copy, described, tmp_path
):
    """Nor are saturated pixels of another one measured."""

    def without_silhouettes(document):
        for camera in document["cameras"]:
            del camera["silhouette"]

    described(capture_copy, without_silhouettes)
    write_exr(capture_copy / "photographs" / "v005_l004.exr", np.zeros((32, 32, 3), np.float32))
    bright = capture_copy / "photographs" / "v005_l001.exr"
    image = read_image(bright)
    # A plateau of 25 pixels at 1, a usual limit, amid the object.
    limit = image.max()
    image /= np.float32(limit)
    image[14:19, 14:19] = 1.0
    write_exr(bright, image)
    out = tmp_path / "out"
    words = ("--hold-out", "views=1,lights=2")
    outcome = run_tiny(out, *BARE, *words, capture=capture_copy)
    assert outcome.status == 0, outcome.err
    metrics = json.loads((out / "metrics.json").read_text())
    lit, dark = metrics["images"]
    assert (lit["name"], dark["name"]) == ("v005_l001", "v005_l004")
    # As of a view that is not held out: from all its photographs.
    expected = object_pixels(open_capture(capture_copy).read_silhouette(5)).sum()
    for image in (dark, lit):
        assert image["n_pixels"] + image["n_excluded"] == expected
        assert image["silhouette_from"] == "photographs"
    assert (dark["n_excluded"], lit["n_excluded"]) == (0, 25)
    assert metrics["measured"]["saturated_pixels_left_out"] == 25
    assert metrics["measured"]["silhouettes"] == {"photographs": 2}
    page = (out / "report" / "index.html").read_text()
    assert "2 made from all photographs of their cameras" in page
    assert "25 pixels of the object are saturated in the photographs and excluded" in page
    records = json.loads((out / "timings.json").read_text())["stages"]
    assert [r["counts"] for r in records if r["name"] == "held_out_silhouettes"] == [
        {"views": 1, "photographs": 1}
    ]
