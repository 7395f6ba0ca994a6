"""Lens, lamps with an area and the light of the room."""

import numpy as np
import pytest

from capture_sim.brightness import measured
from capture_sim.contributions import arriving
from capture_sim.effects import (
    Photograph,
    defocus,
    environment,
    light_extent,
    vignetting,
)
from capture_sim.effects.near_lights import apply as illuminate
from capture_sim.rays import RayTracer, camera_rays
from capture_sim.scene import parse_scene


def scene(thing=None, kind="point", cameras=None, **effects):
    return parse_scene(
        {
            "object": thing or {"preset": "sphere", "radius": 0.05},
            "material": {"type": "lambert", "albedo": 0.6},
            "cameras": {"preset": "rti", "width": 48, "height": 48, **(cameras or {})},
            "lights": {"preset": "rti", "n": 2, "kind": kind},
            "effects": {"simulate": ["near_lights", *effects], **effects},
        }
    )


def test_natural_vignetting_is_the_fourth_power_of_the_cosine(rounding):
    camera = scene(cameras={"field_of_view_deg": 70.0}).cameras[0]
    column, row = np.meshgrid(np.arange(48) + 0.5, np.arange(48) + 0.5)
    _, rays = camera_rays(camera, np.stack([column.ravel(), row.ravel()], axis=1))
    axis = np.array(camera["camera_from_world"])[2, :3]
    gain = vignetting.gain(camera, vignetting.Options(coefficients=(0.0,)))
    np.testing.assert_allclose(gain.ravel(), (rays @ axis) ** 4, rounding(np.float64, 4))


def test_vignetting_of_an_orthographic_camera_is_the_polynomial():
    camera = scene(cameras={"model": "orthographic"}).cameras[0]
    gain = vignetting.gain(camera, vignetting.Options(coefficients=(-0.1, 0.2, -0.3)))
    rho2 = 2 * 23.5**2 / (0.25 * 2 * 48**2)
    assert gain[0, 0] == pytest.approx(1 - 0.1 * rho2 + 0.2 * rho2**2 - 0.3 * rho2**3)


def test_disc_diameter_by_tracing_two_rays_through_the_lens():
    """Independent: images of the rims of the aperture by the thin-lens equation."""
    thing = scene(defocus={"f_number": 2.0, "sensor_width": 0.02, "focus": 0.9})
    camera, options = thing.cameras[0], thing.effects.get(defocus.Options)
    pitch = 0.02 / 48
    focal = camera["fl_x"] * pitch
    sensor = 1.0 / (1.0 / focal - 1.0 / 0.9)  # where the plane of focus is sharp
    for depth in (0.7, 0.9, 1.3):
        image = 1.0 / (1.0 / focal - 1.0 / depth)
        aperture = focal / 2.0
        blur = aperture * abs(image - sensor) / image
        diameter = defocus.disc_diameter(camera, np.array([depth]), options, thing)[0]
        # The camera's focal length in pixels is taken for that of the lens.
        assert diameter == pytest.approx(blur / pitch, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("diameter", [0.5, 1.0, 3.0, 7.5])
def test_disc_kernels_have_the_moments_of_a_disc(diameter, rounding):
    kernel = defocus.disc_kernel(diameter).astype(float)
    half = len(kernel) // 2
    ticks = np.arange(-half, half + 1)
    assert kernel.sum() == pytest.approx(1.0, abs=rounding(np.float32))
    assert abs(kernel.sum(axis=0) @ ticks) < 2e-3  # centred, as far as 2048 points are
    if diameter >= 1.0:
        # Variance r^2 / 4 of the disc, plus at most 1/4 of linear interpolation.
        variance = kernel.sum(axis=0) @ ticks**2
        assert 0 <= variance - diameter**2 / 16 <= 0.25


def test_defocus_keeps_the_light_and_the_plane_of_focus():
    thing = scene(defocus={"f_number": 1.4, "focus": 0.8})
    image = np.zeros((48, 48, 3), np.float32)
    image[24, 20] = 1.0
    for depth, sharp in ((0.8, True), (1.0, False)):
        at = np.full((48, 48), depth, np.float32)
        blurred = defocus.apply(image, thing, Photograph(thing.cameras[0], 0, 0, depth=at))
        # Sums of float32 over some hundred pixels.
        np.testing.assert_allclose(blurred.sum(axis=(0, 1)), 1.0, rtol=1e-5)
        assert bool(blurred[24, 20, 0] > 0.99) is sharp


def test_defocus_needs_depth():
    thing = scene(defocus={})
    with pytest.raises(ValueError, match=r"photograph\.depth"):
        defocus.apply(
            np.zeros((4, 4, 3), np.float32), thing, Photograph(thing.cameras[0], 0, 0)
        )


def test_orthographic_cameras_are_always_sharp():
    assert defocus.needed(scene(cameras={"model": "orthographic"}, defocus={})).bound == 0.0


@pytest.mark.parametrize("kind", ["point", "directional"])
def test_a_lamp_shines_as_much_as_its_patches(kind):
    thing = scene(kind=kind, light_extent={"radius": 0.01, "angle_deg": 1.0, "samples": 25})
    lamp = thing.lights[1]
    patches = light_extent.apply(thing, lamp)
    point = np.array([[0.0, 0.0, 0.05]])
    whole, parts = illuminate((lamp,), point), illuminate(patches, point)
    total = parts.irradiance.sum(axis=1)
    # Patches to the side are farther away by the square of their angle, 1e-4, or less.
    np.testing.assert_allclose(total, whole.irradiance[:, 0], rtol=3e-4)
    cosine = parts.directions[0] @ whole.directions[0, 0]
    size = np.radians(1.0)
    if kind == "point":
        size = 0.01 / np.linalg.norm(lamp["position"] - point[0])
    outermost = np.sqrt(24.5 / 25) * size  # of 25
    # The disc faces the object's centre, off the point: observed 1e-3.
    assert np.arccos(cosine.min()) == pytest.approx(outermost, rel=2e-3)


def test_light_of_half_a_lamp_on_the_horizon():
    """A disc that is half below the horizon: 2 a / (3 pi) of its light arrives."""
    thing = scene(kind="directional", light_extent={"angle_deg": 2.0, "samples": 1024})
    lamp = {**thing.lights[0], "direction": [1.0, 0.0, 0.0], "irradiance": [1.0, 1.0, 1.0]}
    patches = illuminate(light_extent.apply(thing, lamp), np.zeros((1, 3)))
    arrives = (np.maximum(patches.directions[0, :, 2], 0) * patches.irradiance[0, :, 0]).sum()
    # Patches: observed 1.7e-3 of 1,024.
    assert arrives == pytest.approx(2 * np.radians(2.0) / (3 * np.pi), rel=5e-3)


def test_uniform_room_is_a_white_furnace():
    """A convex diffuse object in uniform radiance L shows albedo times L everywhere."""
    room = {"radiance": 0.5, "directionality": 0.0, "tint": [1, 1, 1], "samples": 2000}
    thing = measured(scene(environment=room), RayTracer(scene().mesh))
    dark = measured(scene(), RayTracer(thing.mesh))
    tracer = RayTracer(thing.mesh)
    pair = [(0, 1)]
    added = arriving(thing, tracer, pair)[0][0, 1] - arriving(dark, tracer, pair)[0][0, 1]
    inside = added[22:26, 22:26]
    # Midpoint rule with 2000 directions: the horizon cuts one row of about 1/sqrt(2000).
    np.testing.assert_allclose(inside, 0.6 * 0.5, rtol=5e-3)


def test_room_light_is_brighter_on_one_side(rounding):
    lights = environment.apply(
        scene(environment={"direction": [0, 0, 2], "directionality": 1.0})
    )
    up = np.array([light["direction"][2] for light in lights])
    shine = np.array([light["irradiance"][0] for light in lights])
    tolerance = rounding(np.float64, scale=2)
    np.testing.assert_allclose(shine / shine.mean(), 1.0 + up, rtol=0, atol=tolerance)
