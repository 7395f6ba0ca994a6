"""Fields of one colour per texel: against the formula, and against the general model."""

import numpy as np
import pytest

from reflfield.errors import ShapeError
from reflfield.field.evaluation import evaluate, sum_lights
from reflfield.field.texture_field import (
    apparent_texture,
    lambertian_texture,
)
from reflfield.sphere.hemisphere import softened_cosine
from tests.synthetic_fields import baked_field, lambert, sphere_surface


@pytest.fixture(scope="module")
def sphere():
    return baked_field(sphere_surface(8), lambert(0.5))


def directions(rng, n):
    vectors = rng.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_a_matt_texture_is_the_albedo_times_the_rounded_cosine(sphere, rng, rounding):
    albedo = rng.uniform(0, 1, (sphere.n_texels, 3))
    normals = sphere.local_from_world[:, 2]
    field = lambertian_texture(sphere, albedo, normals)
    texels = rng.integers(0, sphere.n_texels, 40)
    views, lights = directions(rng, 40), directions(rng, 40)
    expected = albedo[texels] * softened_cosine((normals[texels] * lights).sum(axis=1))[:, None]
    got = evaluate(field, texels, views, lights)
    assert got == pytest.approx(expected, abs=rounding(np.float32, operations=10))
    assert (expected == 0).any()  # some lights are below the horizon
    assert (expected > 0.1).any()
    assert (evaluate(field, [-1], views[:1], lights[:1]) == 0).all()


def test_a_sum_over_lights_is_the_sum_of_single_ones(sphere, rng, rounding):
    field = lambertian_texture(sphere, np.full((sphere.n_texels, 3), 0.2),
                               sphere.local_from_world[:, 2])  # fmt: skip
    texels, views, lights = np.arange(5), directions(rng, 5), directions(rng, 7)
    powers, lit = rng.uniform(size=(7, 3)), rng.uniform(size=(5, 7)) < 0.7
    expected = sum(
        evaluate(field, texels, views, np.tile(light, (5, 1))) * power * reached[:, None]
        for light, power, reached in zip(lights, powers, lit.T, strict=True)
    )
    got = sum_lights(field, texels, views, lights, powers, lit)
    assert got == pytest.approx(expected, abs=rounding(np.float32, operations=30))


def test_apparent_samples_depend_on_no_direction(sphere, rng):
    samples = rng.uniform(-0.1, 1, (sphere.n_texels, 3))
    field = apparent_texture(sphere, samples)
    texels = np.arange(20)
    got = evaluate(field, texels, directions(rng, 20), directions(rng, 20))
    assert np.array_equal(got, np.maximum(samples[:20], 0).astype(np.float32))
    assert field.visibility == "kept"


def test_one_colour_for_each_texel_is_demanded(sphere):
    with pytest.raises(ShapeError, match="samples"):
        apparent_texture(sphere, np.ones((3, 3)))
