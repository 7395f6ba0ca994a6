"""Relit photographs and turntables: files, names, exposure, same bytes."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from reflfield.capture.capture import Capture
from reflfield.capture.image_files import read_coverage, read_image
from reflfield.capture.lights import Light
from reflfield.capture.photographs import Exposure, Photograph
from reflfield.errors import InputError
from reflfield.render.exposure import ExposureMeter
from reflfield.render.relit_photographs import relight_photographs
from reflfield.render.renderer import RenderOptions, render
from reflfield.render.turntable import OrbitOptions, orbit_cameras, render_orbit
from reflfield.util.progress import listening
from tests.synthetic_fields import baked_field, lambert, sphere_surface

FAST = RenderOptions(workers=1, samples_per_pixel=4)


@pytest.fixture(scope="module")
def field():
    return baked_field(sphere_surface(12), lambert([0.8, 0.5, 0.2]), light_side=9)


def capture_of(field, names=("a", "b.1", "c")):
    cameras = tuple(orbit_cameras(field.positions, OrbitOptions(n_images=2, size=24)))
    lights = tuple(
        Light(f"l{i}", "point", position=p, intensity=[9, 9, 9])
        for i, p in enumerate([(5, 5, 5), (5, -5, 2)])
    )
    photographs = tuple(
        Photograph(name, i % 2, (i + 1) % 2, (Exposure(Path("absent.exr")),))
        for i, name in enumerate(names)
    )
    return Capture("three", Path(), cameras, lights, photographs)


def test_each_image_has_its_own_camera_and_light(field, tmp_path):
    capture = capture_of(field)
    relit = list(relight_photographs(field, capture, tmp_path / "out", FAST))
    assert [image.name for image in relit] == ["a", "b.1", "c"]
    for image, photograph in zip(relit, capture.photographs, strict=True):
        camera, light = capture.cameras[photograph.camera], capture.lights[photograph.light]
        expected = render(field, camera, light, FAST)
        assert np.array_equal(image.rendering.image, expected.image)
        assert np.array_equal(read_image(image.exr), expected.image)
        assert np.array_equal(read_coverage(image.exr), expected.coverage)
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["a.exr", "a.png", "b.1.exr", "b.1.png", "c.exr", "c.png"]


def test_pictures_share_one_exposure(field, tmp_path):
    relit = list(relight_photographs(field, capture_of(field), tmp_path, FAST))
    meter = ExposureMeter()
    for image in relit:
        meter.add(image.rendering.image, image.rendering.coverage)
    exposure = meter.exposure
    for image in relit:
        decoded = read_image(image.png)
        wanted = np.clip(image.rendering.image * exposure, 0, 1)
        # Half a step of 8 bits times the steepest slope of the sRGB decoding, 2.28.
        assert np.abs(decoded - wanted).max() < 0.5 / 255 * 2.3
    brightest = read_image(relit[0].png).max()
    list(relight_photographs(field, capture_of(field), tmp_path, FAST, exposure=exposure / 4))
    assert read_image(relit[0].png).max() < 0.5 * brightest


def test_same_photographs_give_the_same_bytes(field, tmp_path):
    for folder, workers in (("one", 1), ("two", 2)):
        options = RenderOptions(workers=workers, samples_per_pixel=4)
        list(relight_photographs(field, capture_of(field), tmp_path / folder, options))
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


def test_names_that_collide_or_leave_the_folder_are_refused(field, tmp_path):
    with pytest.raises(InputError, match="received 'a' twice"):
        next(relight_photographs(field, capture_of(field, ("a", "a")), tmp_path / "x"))
    with pytest.raises(InputError, match="without folders"):
        next(relight_photographs(field, capture_of(field, ("../a",)), tmp_path / "x"))
    assert not (tmp_path / "x").exists()


def test_turntable_keeps_the_object_in_view_and_turns_about_up():
    points = np.random.default_rng(3).normal(size=(200, 3)) * [1, 2, 0.5] + [5, 0, -2]
    options = OrbitOptions(n_images=7, up=(0, 2, 0), elevation_deg=-35, size=101)
    cameras = orbit_cameras(points, options)
    middle = 0.5 * (points.min(0) + points.max(0))
    for camera in cameras:
        pixels, depth = camera.project(points)
        assert camera.contains(pixels).all()
        assert (depth > 0).all()
        towards = camera.centre - middle
        assert np.arcsin(towards[1] / np.linalg.norm(towards)) == pytest.approx(np.deg2rad(-35))
    steps = np.diff([camera.centre for camera in cameras], axis=0)
    assert np.allclose(np.linalg.norm(steps, axis=1), np.linalg.norm(steps[0]))


def test_turntable_writes_images_animation_and_sheet(field, tmp_path):
    seen = []
    light = Light("l", "directional", direction=[1, 1, 1], intensity=[2, 2, 2])
    options = OrbitOptions(n_images=5, size=20, frames_per_second=10)
    with listening(lambda text, done, total: seen.append((done, total))):
        orbit = render_orbit(field, light, tmp_path / "orbit", options, FAST)
    assert seen == [(i, 5) for i in range(6)]
    assert [path.name for path in orbit.images] == [f"orbit_{i:03d}.png" for i in range(5)]
    with Image.open(orbit.animation) as animation:
        assert (animation.n_frames, animation.size) == (5, (20, 20))
        animation.seek(1)
        animation.load()
        assert animation.info["duration"] == 100
    with Image.open(orbit.contact_sheet) as sheet:
        assert sheet.size == (60, 40)
        with Image.open(orbit.images[4]) as last:
            tile = np.asarray(sheet)[20:40, 20:40]
            assert np.array_equal(tile, np.asarray(last))
    again = render_orbit(field, light, tmp_path / "again", options, FAST)
    assert again.animation.read_bytes() == orbit.animation.read_bytes()
    assert again.exposure == orbit.exposure


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"n_images": 0}, "n_images"),
        ({"up": (0, 0, 0)}, "up: expected"),
        ({"elevation_deg": 90}, "elevation_deg"),
        ({"field_of_view_deg": 0}, "field_of_view_deg"),
        ({"frames_per_second": 0}, "frames_per_second"),
    ],
)
def test_bad_turntables_are_refused(change, text):
    with pytest.raises(InputError, match=text):
        OrbitOptions(**change)


def test_exposure_of_nothing_is_one():
    meter = ExposureMeter()
    assert meter.exposure_or_one == 1.0
    meter.add(np.zeros((9, 9, 3)), np.ones((9, 9)))
    assert meter.exposure_or_one == 1.0
