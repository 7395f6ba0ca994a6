"""Truth against analytic surfaces and against the calibration it belongs to."""

from dataclasses import replace

import numpy as np
import pytest

from capture_sim.heldout import heldout_pairs, transforms_frame
from capture_sim.model import Blocks
from capture_sim.rays import RayTracer, world_from_camera
from capture_sim.scene import parse_scene
from capture_sim.truth import apparent_brdfs, area_uniform_points, lights_visible, view_truth


def scene(thing=None, **changed):
    tables = {
        "object": thing or {"preset": "sphere", "radius": 0.1},
        "material": {"type": "lambert", "albedo": 0.6},
        "cameras": {
            "preset": "rings",
            "elevations_deg": [-20, 30],
            "counts": [3, 5],
            "width": 40,
            "height": 32,
        },
        "lights": {"preset": "fibonacci", "n": 11, "distance": 0.7},
        "truth": {"points": 400},
        "heldout": {"photographs": 6},
        **changed,
    }
    return parse_scene(tables)


def test_view_truth_of_a_sphere(rounding):
    ball = scene()
    truth = view_truth(ball, RayTracer(ball.mesh), ball.cameras[4])
    hit = truth["label"] >= 0
    assert 0.2 < hit.mean() < 0.9
    assert np.array_equal(hit, np.isfinite(truth["depth"]))
    position, normal, tangent = (truth[k][hit] for k in ("position", "normal", "tangent"))
    # Facets of 192 lie 1 - cos(pi / 192) of the radius inside the sphere each way.
    inside = (np.pi / 192) ** 2 + rounding(np.float32)
    np.testing.assert_allclose(np.linalg.norm(position, axis=1), 0.1, inside)
    np.testing.assert_allclose(normal, position / 0.1, rtol=0, atol=inside)
    cosine = np.einsum("nc,nc->n", normal, tangent)
    np.testing.assert_allclose(cosine, 0.0, atol=rounding(np.float32))
    assert (truth["normal"][~hit] == 0).all()


def test_positions_project_to_the_centres_of_their_pixels(rounding):
    vase = scene({"preset": "vase"}, material={"preset": "painted_vase"})
    camera = vase.cameras[2]
    truth = view_truth(vase, RayTracer(vase.mesh), camera)
    row, column = np.nonzero(truth["label"] >= 0)
    pose = np.array(camera["camera_from_world"])
    position = truth["position"][row, column] @ pose[:3, :3].T + pose[:3, 3]
    x = camera["fl_x"] * position[:, 0] / position[:, 2] + camera["cx"]
    y = camera["fl_y"] * position[:, 1] / position[:, 2] + camera["cy"]
    # Float32 rays and positions, a metre away.
    tolerance = rounding(np.float32, scale=camera["fl_x"])
    np.testing.assert_allclose(x, column + 0.5, rtol=0, atol=tolerance)
    np.testing.assert_allclose(y, row + 0.5, rtol=0, atol=tolerance)
    depth = np.linalg.norm(position, axis=1)
    np.testing.assert_allclose(truth["depth"][row, column], depth, rounding(np.float32, 4))
    assert set(np.unique(truth["label"])) == {-1, 0, 1}


def test_packed_visibility_unpacks_to_the_lights():
    vase = scene({"preset": "vase"})
    tracer = RayTracer(vase.mesh)
    truth = view_truth(vase, tracer, vase.cameras[0])
    assert truth["light_visible"].shape == (32, 40, 2)
    assert truth["n_lights"] == 11
    bits = np.unpackbits(truth["light_visible"], axis=2, count=11, bitorder="little")
    hit = truth["label"] >= 0
    assert not bits[~hit].any()
    # The light above a point's horizon on the upper side must be seen there.
    lights = np.array([light["position"] for light in vase.lights])
    towards = lights - truth["position"][hit][:, None]
    above = np.einsum("nlc,nc->nl", towards, truth["normal"][hit]) > 0
    assert not (bits[hit].astype(bool) & ~above).any()
    assert bits[hit].mean() > 0.2


def test_apparent_brdf_of_a_lambert_sphere(rounding):
    ball = scene()
    truth = apparent_brdfs(ball, RayTracer(ball.mesh))
    normal = truth["frame"][:, 2]
    cos_light = np.einsum("nlc,nc->nl", truth["lights"], normal)
    cos_view = np.einsum("nvc,nc->nv", truth["views"], normal)
    expected = 0.6 / np.pi * np.maximum(cos_light, 0)[:, None] * (cos_view > 0)[:, :, None]
    tolerance = rounding(np.float32)
    for channel in range(3):
        np.testing.assert_allclose(truth["samples"][..., channel], expected, atol=tolerance)
    assert np.array_equal(truth["light_visible"], cos_light > 0)
    assert truth["observed"].shape == truth["samples"].shape[:3]


def test_cameras_see_the_near_side_of_a_sphere():
    ball = scene()
    truth = apparent_brdfs(ball, RayTracer(ball.mesh))
    cos_view = np.einsum("nvc,nc->nv", truth["views"], truth["frame"][:, 2])
    clear = np.abs(cos_view) > 0.05  # facets hide points at the very horizon
    assert np.array_equal(truth["view_visible"][clear], (cos_view > 0)[clear])


def test_frames_are_rotations_and_follow_the_material(rounding):
    turned = scene(
        material={"type": "textured", "base": {"preset": "brushed_metal"}, "tangent_angle": 0.5}
    )
    truth = apparent_brdfs(turned, RayTracer(turned.mesh))
    change = truth["frame"] @ np.swapaxes(truth["surface_frame"], 1, 2)
    c, s = np.cos(0.5), np.sin(0.5)
    expected = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(
        change, np.broadcast_to(expected, change.shape), atol=rounding(np.float32)
    )


def test_points_are_spread_evenly_over_the_area():
    ball = scene(truth={"points": 4000})
    height = area_uniform_points(ball, np.random.default_rng(5)).position[:, 2] / 0.1
    # On a sphere z is uniform in [-1, 1] (Archimedes): mean 0, variance 1/3; 4 sigma.
    assert abs(height.mean()) < 4 * np.sqrt(1 / 3 / 4000)
    assert height.var() == pytest.approx(1 / 3, abs=4 * np.sqrt(4 / 45 / 4000))


def test_points_are_spread_evenly_within_a_triangle():
    plate = scene({"type": "plane", "size": [0.2, 0.2]}, truth={"points": 4000})
    assert len(plate.mesh.faces) == 2
    place = area_uniform_points(plate, np.random.default_rng(5)).position[:, :2] / 0.1
    # Uniform in [-1, 1]^2: mean 0, variance 1/3; 4 sigma.
    np.testing.assert_allclose(place.mean(axis=0), 0.0, atol=4 * np.sqrt(1 / 3 / 4000))
    np.testing.assert_allclose(place.var(axis=0), 1 / 3, atol=4 * np.sqrt(4 / 45 / 4000))


def test_lights_visible_by_blocks():
    vase = scene({"preset": "vase"})
    tracer = RayTracer(vase.mesh)
    points = area_uniform_points(vase, np.random.default_rng(1))
    whole = lights_visible(vase, tracer, points)
    small = replace(vase, blocks=Blocks(block=1 << 16))
    assert np.array_equal(lights_visible(small, tracer, points), whole)


def test_heldout_axes_round_trip(rounding):
    exact = rounding(np.float64)
    for camera, light in heldout_pairs(scene()):
        frame = transforms_frame(camera, light, "a.exr", "a.png")
        world_from_opengl = np.array(frame["transform_matrix"])
        # OpenGL: x right, y up, z back; the object lies ahead, along -z.
        towards = -world_from_opengl[:3, 3]  # the sphere's centre is the origin
        towards /= np.linalg.norm(towards)
        np.testing.assert_allclose(world_from_opengl[:3, 2], -towards, rtol=0, atol=exact)
        assert world_from_opengl[2, 1] > 0  # up in the image is up in the world
        again = np.linalg.solve(world_from_opengl @ np.diag([1, -1, -1, 1]), np.eye(4))
        np.testing.assert_allclose(again, camera["camera_from_world"], rtol=0, atol=exact)
        assert frame["pl_pos"] == light["position"]


def test_heldout_views_and_lights_are_new_but_within_the_rig():
    ball = scene()
    cameras = np.array([world_from_camera(c)[:3, 3] for c in ball.cameras])
    lights = np.array([light["position"] for light in ball.lights])
    pairs = heldout_pairs(ball)
    assert [camera["id"] for camera, _ in pairs] == [f"h{i:03d}" for i in range(6)]
    for camera, light in pairs:
        position = world_from_camera(camera)[:3, 3]
        assert np.linalg.norm(position) == pytest.approx(1.0)
        assert np.linalg.norm(cameras - position, axis=1).min() > 0.02
        assert cameras[:, 2].min() <= position[2] <= 1.0
        assert np.linalg.norm(light["position"]) == pytest.approx(0.7)
        assert np.linalg.norm(lights - light["position"], axis=1).min() > 0.01


def test_heldout_lights_stand_on_the_side_of_the_viewer():
    towards = [
        (world_from_camera(camera)[:3, 3], np.array(light["position"]))
        for camera, light in heldout_pairs(scene(heldout={"photographs": 20}))
    ]
    cosines = [v @ l / np.linalg.norm(v) / np.linalg.norm(l) for v, l in towards]  # noqa: E741
    # The nearest light of the mixture does; its neighbours may lie a little behind.
    assert min(cosines) > -0.3
    assert np.median(cosines) > 0.3


def test_distant_lights_are_held_out_far_away(rounding):
    sunny = scene(lights={"preset": "fibonacci", "n": 5, "kind": "directional"})
    (_, light), *_ = heldout_pairs(sunny)
    distance = np.linalg.norm(np.array(light["position"]) - sunny.mesh.centre)
    irradiance = np.array(light["intensity"]) / distance**2
    np.testing.assert_allclose(irradiance, np.pi, rounding(np.float64))


def test_a_single_camera_is_kept():
    plate = scene({"preset": "relief"}, cameras={"preset": "rti"})
    assert all(
        camera["camera_from_world"] == plate.cameras[0]["camera_from_world"]
        for camera, _ in heldout_pairs(plate)
    )
