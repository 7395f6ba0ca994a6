"""Light from one part of a surface to another, beside form factors and sums by brute force."""

import numpy as np
import pytest

from reflfield.capture.lights import Light
from reflfield.field.indirect_light import IndirectLight
from reflfield.render.bounced_light import RAYS_ALONG, BouncedLight, cosine_directions
from reflfield.render.camera_rays import FieldSurface
from reflfield.render.environment_map import EnvironmentMap
from reflfield.render.renderer import Renderer, RenderOptions
from reflfield.viewer.baked_shadows import baked_indirect
from tests.render.test_renderer import constant, overhead, sun
from tests.synthetic_fields import FramedSurface, baked_field, sphere_surface, square_surface

SIDE, ALBEDO = 12, 0.6
# Nearly along the floor, from below it: only the wall is lit, head on.
LOW = sun(np.array([1.0, 0.0, -1e-4]))


def corner_surface(side=SIDE):
    """A floor, 0 to 1 along x and y, and a wall of the same size over its edge x = 0."""
    floor = square_surface(side)
    on_floor = np.add(floor.positions, [0.5, 0.5, 0.0])
    # x to z, z to x and y to -y: a rotation.
    on_wall = np.stack([on_floor[:, 2], 1 - on_floor[:, 1], on_floor[:, 0]], axis=1)
    texture = np.arange(side**2).reshape(side, side)
    frames = np.tile(np.eye(3), (side**2, 1, 1))
    turned = np.tile([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]], (side**2, 1, 1))
    return FramedSurface(
        positions=np.concatenate([on_floor, on_wall]),
        faces=np.concatenate([floor.faces, floor.faces + 4]),
        uv=np.concatenate([floor.uv * [0.5, 1], floor.uv * [0.5, 1] + [0.5, 0]]),
        texel_of_pixel=np.concatenate([texture, texture + side**2], axis=1),
        base_from_world=np.concatenate([frames, turned]),
    )


def field_of(surface, albedo=ALBEDO, gain=(1.0, 1.0, 1.0), functions=None):
    """Matt field whose shadows show bounced light, and harmonics."""
    n = len(surface.base_from_world)
    harmonics = np.zeros((1, 1, 3), np.float32) if functions is None else functions
    indirect = IndirectLight(
        harmonics, np.zeros((n, 0), np.float32), gain=np.array(gain, np.float32)
    )
    samples = constant(albedo / np.pi)
    return baked_field(
        surface, samples, domain="linear", indirect=indirect, visibility="factored"
    )


def bounced_light(field, workers=1):
    field.decode()
    return BouncedLight(FieldSurface(field), workers)


def factor_to_wall(x, y, n=400):
    """Share of the light that leaves the floor at (x, y) for the wall, by a sum over it."""
    middle = (np.arange(n) + 0.5) / n
    across, up = np.meshgrid(middle, middle)
    square = x**2 + (across - y) ** 2 + up**2
    return float((x * up / (np.pi * square**2)).sum() / n**2)


@pytest.fixture(scope="module")
def corner():
    return bounced_light(field_of(corner_surface()))


def test_shares_of_two_squares_are_their_form_factor(corner):
    n = SIDE**2
    to_wall = corner.shares[:n, n:].sum() / n
    back = corner.shares[n:, :n].sum() / n
    # J. Howell's catalogue, C-14, for unit squares at a right angle; a draw of all rays.
    chance = 3 * np.sqrt(0.2 * 0.8 / (n * RAYS_ALONG**2))
    assert to_wall == pytest.approx(0.20004, abs=chance)
    assert back == pytest.approx(0.20004, abs=chance)
    # Nothing goes from a plane to itself.
    assert corner.shares[:n, :n].nnz == corner.shares[n:, n:].nnz == 0


def test_what_comes_back_from_a_floor_beside_a_lit_wall(corner):
    bounced = corner.under(LOW)
    assert not corner.lit(LOW)[: SIDE**2].any()
    middle = (np.arange(SIDE) + 0.5) / SIDE
    # Texture rows run downwards.
    expected = np.array([[factor_to_wall(x, y) for x in middle] for y in middle[::-1]])
    expected *= ALBEDO**2 / np.pi
    floor = bounced[: SIDE**2].reshape(SIDE, SIDE, 3)
    # 64 rays a texel know a share of a half to 6 %, all a mean to less than 1; the cosine's
    # foot adds 1 % to albedos.
    np.testing.assert_allclose(floor[..., 0].mean(), expected.mean(), rtol=0.03)
    np.testing.assert_allclose(floor[..., 0], expected, atol=4 * 0.06 * ALBEDO**2 / np.pi)
    np.testing.assert_array_equal(floor[..., 0], floor[..., 2])


def test_samples_do_not_depend_on_how_strong_a_light_is(corner, rounding):
    strong = sun(LOW.direction, irradiance=(30.0, 2.0, 0.5))
    # A product and a quotient of singles.
    np.testing.assert_allclose(
        corner.under(strong), corner.under(LOW), rtol=rounding(np.float32, operations=64)
    )
    # A spot that reaches nothing brings nothing.
    away = Light(
        "spot",
        "spot",
        position=(0.5, 0.5, 3.0),
        direction=(0.0, 0.0, 1.0),
        intensity=(1.0, 1.0, 1.0),
        cone_angle=0.3,
        falloff_angle=0.2,
    )
    assert not corner.under(away).any()


def test_near_lamps_light_each_texel_from_its_own_side(corner):
    """A lamp below the floor's plane, before the wall: its light falls off over the wall."""
    lamp = Light("lamp", "point", position=(2.0, 0.5, -0.02), intensity=(1.0, 1.0, 1.0))
    n = SIDE**2
    positions = corner.surface.texel_points[0]
    towards = np.array(lamp.position) - positions
    distance = np.linalg.norm(towards, axis=1)
    # Radiance of the wall by hand: albedo over pi, the cosine, and the square of the distance.
    wall = ALBEDO / np.pi * towards[n:, 0] / distance[n:] ** 3
    wall *= corner.lit(lamp)[n:]
    sent = np.concatenate([np.zeros(n), wall])
    expected = ALBEDO * (corner.shares @ sent)[:n] * distance[:n] ** 2
    # The foot of the cosine adds to the albedo, and interpolation on nodes to the cosine.
    np.testing.assert_allclose(corner.under(lamp)[:n, 0], expected, rtol=0.03)


def test_pictures_show_it_in_shadows_alone():
    field = field_of(corner_surface(), gain=(1.0, 0.5, 0.0))
    camera = overhead(size=10, pixels_per_metre=8.0, cx=1.0, cy=9.0)
    image = Renderer(field, RenderOptions(workers=1)).render(camera, LOW).image
    red, green, blue = image[1:8, 2:9].reshape(-1, 3).mean(axis=0)
    assert red > 0.015  # two thirds of the albedo squared, the form factor and 1 / pi
    # In the linear domain; singles summed over 49 pixels.
    assert green == pytest.approx(0.5 * red, rel=1e-5)
    assert blue == 0
    # From above the floor is lit, and the wall's foot does not count twice.
    lit = Renderer(field, RenderOptions(workers=1)).render(camera, sun([0, 0, 1])).image
    # At its far side taps of the texture reach a little into the wall's texels.
    np.testing.assert_allclose(lit[1:8, 2:9], ALBEDO / np.pi, rtol=1e-3)


def test_without_a_gain_nothing_is_traced():
    plain = Renderer(field_of(corner_surface(2), gain=(0, 0, 0)), RenderOptions(workers=1))
    camera = overhead(size=6, pixels_per_metre=8.0, cx=1.0, cy=5.0)
    assert not plain.render(camera, LOW).image.any()
    assert plain.field.indirect.is_black


def test_environments_are_the_sum_of_their_lights(rng, rounding):
    field = field_of(corner_surface(4))
    renderer = Renderer(field, RenderOptions(environment_directions=40, workers=2))
    pixels = rng.uniform(0, 1, (8, 16, 3)).astype(np.float32)
    environment = renderer._source(EnvironmentMap(pixels))
    traced = bounced_light(field)
    expected = np.zeros((field.n_texels, 3))
    for direction, power in zip(
        environment._lights.directions, environment._lights.irradiances, strict=True
    ):
        light = Light("part", "directional", direction=direction, intensity=(1.0, 1.0, 1.0))
        dark = ~traced.lit(light)
        expected += np.where(dark[:, None], traced.under(light) * power, 0)
    # Sums of forty lights, and of the rays of a texel.
    np.testing.assert_allclose(
        environment._in_shadows, expected, rtol=rounding(np.float32, operations=40 + 64)
    )
    camera = overhead(size=10, pixels_per_metre=8.0, cx=1.0, cy=9.0)
    image = renderer.render(camera, EnvironmentMap(pixels)).image
    without = Renderer(field_of(corner_surface(4), gain=(0, 0, 0)), renderer.options)
    assert (image > without.render(camera, EnvironmentMap(pixels)).image)[1:8, 2:9].all()


@pytest.mark.stability
def test_closed_and_convex_surfaces():
    """All that leaves the inside of a ball arrives there; nothing returns to its outside."""
    inside = sphere_surface(16)
    inside = FramedSurface(
        inside.positions,
        inside.faces[:, ::-1].copy(),
        inside.uv,
        inside.texel_of_pixel,
        inside.base_from_world * np.array([1.0, -1.0, -1.0])[:, None],
    )
    hollow, ball = (bounced_light(field_of(s)) for s in (inside, sphere_surface(16)))
    # But for rays that leave through cracks of the texture's seams.
    assert np.quantile(hollow.shares.sum(axis=1), 0.05) == pytest.approx(1, abs=0.05)
    # Sums of 64 singles.
    assert hollow.shares.sum(axis=1).max() <= 1 + 1e-5
    everything = np.ones((hollow.field.n_texels, 1), np.bool_)
    direct = np.ones((hollow.field.n_texels, 1, 3), np.float32)
    # What comes back of light that is 1 everywhere: the albedo, by 64 lights.
    np.testing.assert_allclose(np.median(hollow.between(direct, everything)), ALBEDO, rtol=0.03)
    assert not hollow.between(direct, ~everything).any()
    # A chord of a coarse ball dips below its neighbours by little.
    assert ball.shares.sum() < 1e-3 * ball.field.n_texels


@pytest.mark.parametrize("workers", [2, 5])
def test_results_do_not_depend_on_the_number_of_threads(corner, workers):
    again = bounced_light(field_of(corner_surface()), workers)
    assert (again.shares != corner.shares).nnz == 0
    np.testing.assert_array_equal(again.under(LOW), corner.under(LOW))


def test_directions_are_distributed_as_the_cosine(rng):
    directions = cosine_directions(rng.random((500, 64, 2)))
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1)
    z = directions[..., 2]
    # Of the cosine's density the mean of z is 2/3, to chance of 32,000 draws in strata.
    assert z.mean() == pytest.approx(2 / 3, abs=2e-3)
    # And that of z^2 1/2.
    assert np.square(z).mean() == pytest.approx(0.5, abs=2e-3)
    # One in each cell: each texel has its rays on all sides.
    assert np.abs(directions.mean(axis=1)[:, :2]).max() < 0.1


def test_pages_have_harmonics_of_all_that_shadows_show(corner):
    functions = np.zeros((1, 1, 3), np.float32)
    functions[0, 0] = 0.02
    field = field_of(corner_surface(), functions=functions)
    assert baked_indirect(field_of(corner_surface(), gain=(0, 0, 0))).coefficients.size == 0
    baked = baked_indirect(field, 2)
    assert not baked.is_traced
    floor = np.arange(SIDE**2)
    towards = np.tile(np.float64(LOW.direction), (len(floor), 1))
    exact = field.indirect.towards(floor, towards, 1, corner.under(LOW)[floor])
    # Smooth functions of the light's direction, and only those of degree three.
    error = baked.towards(floor, towards, 1) - exact
    assert np.sqrt(np.mean(error**2)) < 0.35 * np.sqrt(np.mean(exact**2))
