"""Baselines: against what is known of them, measured as the field is."""

import numpy as np
import pytest

from reflfield.capture.cameras import Camera
from reflfield.capture.lights import DirectionalLight
from reflfield.metrics.baselines import (
    BLACK,
    MEAN,
    NEAREST,
    Baselines,
    BaselineScores,
    albedo_of_field,
    albedo_of_means,
)
from reflfield.metrics.image_metrics import ImagePair, compare_images, measure_image
from reflfield.render.camera_rays import FieldSurface
from reflfield.render.renderer import RenderOptions, render
from tests.synthetic_fields import baked_field, blinn_phong, lambert, sphere_surface

ALBEDO = np.array([0.8, 0.5, 0.2])
CAMERA = Camera.look_at([4, 0, 0], width=40, height=40, fov_deg=36)
LIGHT = DirectionalLight([1, 1, 0.5], np.pi)
OPTIONS = RenderOptions(workers=1, samples_per_pixel=4)


@pytest.fixture(scope="module")
def matt():
    return baked_field(sphere_surface(24), lambert(ALBEDO), visibility="factored")


@pytest.fixture(scope="module")
def surface(matt):
    return FieldSurface(matt, 1)


def test_the_mean_of_a_matt_field_is_its_albedo(matt, surface):
    expected = np.tile(ALBEDO / np.pi, (matt.n_texels, 1))
    # The codes' step and the smooth normals of a faceted sphere: observed .008.
    assert albedo_of_field(matt, surface) == pytest.approx(expected, rel=0.01)


def test_the_mean_of_a_shiny_field_lies_between_matt_part_and_peak():
    shiny = baked_field(sphere_surface(12), blinn_phong(0.3, 1.0, 40.0))
    albedo = albedo_of_field(shiny, FieldSurface(shiny, 1))
    assert (albedo > 0.3 / np.pi).all()
    assert (albedo < 0.3 / np.pi + 0.5).all()


def test_a_matt_field_is_its_own_mean_texture(matt, surface):
    """Under the same light, with the same shadows: nothing is left but the normals' error."""
    baselines = Baselines(matt, surface, albedo_of_field(matt, surface), "none", OPTIONS)
    images = dict(baselines.images(CAMERA, LIGHT, None))
    truth = render(matt, CAMERA, LIGHT, OPTIONS)
    pair = ImagePair("a", truth.image, images[MEAN], truth.coverage)
    assert compare_images([pair]).mean["psnr_ldr"] > 40
    assert set(images) == {BLACK, MEAN}
    assert not images[BLACK].any()


def test_a_baseline_is_measured_as_the_field_is(matt):
    truth = render(matt, CAMERA, LIGHT, OPTIONS)
    pair = ImagePair("a", truth.image, truth.image, truth.coverage)
    scores = BaselineScores(exposure=2.0)
    black = np.zeros_like(truth.image)
    scores.add(pair, BLACK, black)
    document = scores.to_dict({NEAREST: "no photographs", MEAN: "none"})
    expected = measure_image(ImagePair("a", truth.image, black, truth.coverage), 2.0)
    assert document[BLACK]["images"] == [expected.to_dict()]
    assert document[BLACK]["mean"]["psnr_ldr"] == expected.psnr_ldr
    assert document["missing"] == {NEAREST: "no photographs", MEAN: "none"}
    assert NEAREST not in document


def test_the_albedo_of_means_is_bounded_where_lights_graze():
    means = np.array([[0.1, 0.1, 0.1]])
    assert albedo_of_means(means, np.array([[0.5, 0.0, 1.0]])) == pytest.approx(
        np.array([[0.2, 2.0, 0.1]])
    )


def test_without_photographs_it_is_said_why(matt, surface):
    albedo = np.ones((matt.n_texels, 3))
    baselines = Baselines(matt, surface, albedo, "not at hand", OPTIONS)
    assert baselines.nearest_to(CAMERA, LIGHT, "a") is None
    assert baselines.missing == {NEAREST: "not at hand"}
