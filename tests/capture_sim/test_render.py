"""Rendered photographs against hand-checkable values and plain sums over pairs."""

from dataclasses import replace

import numpy as np
import pytest

from capture_sim import render, view_samples
from capture_sim.effects import near_lights
from capture_sim.materials import make_material
from capture_sim.model import Blocks
from capture_sim.rays import RayTracer, camera_rays, towards_camera
from capture_sim.render import shade
from capture_sim.scene import EffectOptions, ImageOptions, parse_scene
from capture_sim.surface import surface_points
from capture_sim.truth import area_uniform_points, lights_visible
from capture_sim.view_samples import sample_view
from capture_sim.visibility import Nodes, TracedLights, trace_lights

ONE_RAY = ImageOptions(samples_per_side=1, edge_samples_per_side=1)


def scene_of(thing, material, *, cameras=None, lights=None, **tables):
    one_camera = {"preset": "list", "directions": [[1, -2, 1.5]]}
    one_light = {"preset": "list", "directions": [[2, -1, 1.0]]}
    rig = {
        "cameras": {**one_camera, "width": 32, "height": 32, **(cameras or {})},
        "lights": {**(lights if "preset" in (lights or {}) else one_light), **(lights or {})},
    }
    rig["lights"].setdefault("distance", 1.5)
    tables.setdefault("effects", {"interreflection": "off"})
    return parse_scene({"object": thing, "material": material, **rig, **tables})


def photographs(scene, camera=0):
    tracer = RayTracer(scene.mesh)
    return shade(scene, tracer, sample_view(scene, tracer, scene.cameras[camera]), scene.lights)


def test_lambert_plane_follows_cosine_and_inverse_square(rounding):
    scene = scene_of(
        {"preset": "flat_sample", "size": [2.0, 2.0]},
        {"type": "lambert", "albedo": [0.2, 0.5, 0.8]},
        lights={
            "preset": "list",
            "directions": [[0.6, 0.0, 0.8]],
            "intensity": [3.0, 2.0, 1.0],
        },
        cameras={"directions": [[0, 0, 1]], "extent": 0.5},
    )
    image = photographs(replace(scene, image=ONE_RAY))[0]
    # Pixel pitch 0.5 m / 32 at the plane; image x is world x, image y is world -y.
    ticks = (np.arange(32) - 15.5) * 0.5 / 32
    x, y = np.meshgrid(ticks, -ticks)
    light = 1.5 * np.array([0.6, 0.0, 0.8])
    distance2 = (light[0] - x) ** 2 + (light[1] - y) ** 2 + light[2] ** 2
    cosine = light[2] / np.sqrt(distance2)
    facing = np.array([3.0, 2.0, 1.0]) / distance2[..., None]
    expected = np.array([0.2, 0.5, 0.8]) / np.pi * cosine[..., None] * facing
    # Hits come from float32 rays; their error moves the point by about eps * distance.
    np.testing.assert_allclose(image, expected, rtol=rounding(np.float32, operations=4))


def test_coverage_of_a_disc_is_its_area():
    scene = scene_of(
        {"preset": "sphere", "radius": 0.1, "around": 512},
        {"preset": "grey_card"},
        cameras={"directions": [[0, 0, 1]], "model": "orthographic", "extent": 0.25},
        image={"edge_samples_per_side": 8},
    )
    coverage = sample_view(scene, RayTracer(scene.mesh), scene.cameras[0]).coverage
    pixels_per_metre = 32 / 0.25
    ticks = (np.arange(32) + 0.5 - 16) / pixels_per_metre
    distance = np.hypot(*np.meshgrid(ticks, ticks))
    assert (coverage[distance < 0.1 - 1 / pixels_per_metre] == 1.0).all()
    assert (coverage[distance > 0.1 + 1 / pixels_per_metre] == 0.0).all()
    # A pixel that the outline crosses is wrong by about a tenth of a row of rays, 1/80;
    # there are 8 r of them with independent errors: 4 sigma.
    tolerance = 4 * np.sqrt(8 * 0.1 * pixels_per_metre) / 80
    assert coverage.sum() == pytest.approx(np.pi * (0.1 * pixels_per_metre) ** 2, abs=tolerance)


def test_pixels_at_the_outline_hold_their_share_of_the_light():
    scene = scene_of(
        {"preset": "flat_sample", "size": [0.1, 0.1]},
        {"type": "lambert", "albedo": 1.0},
        cameras={"directions": [[0, 0, 1]], "model": "orthographic", "extent": 0.3},
        lights={"preset": "list", "kind": "directional", "directions": [[0, 0, 1]]},
    )
    view = sample_view(scene, RayTracer(scene.mesh), scene.cameras[0])
    image = photographs(scene)[0, ..., 0]
    assert ((view.coverage > 0) & (view.coverage < 1)).any()
    # Irradiance pi on a white plane gives radiance 1, so the image equals the coverage.
    np.testing.assert_allclose(image, view.coverage, rtol=1e-6)  # float32 sums of 16 parts


def brute_force_blocked(mesh, origins, targets):
    """Moeller-Trumbore on every face, float64."""
    corner, along, up = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    along, up = along - corner, up - corner
    blocked = np.zeros(len(origins), bool)
    for i, (origin, target) in enumerate(zip(origins, targets, strict=True)):
        direction = target - origin
        p = np.cross(direction, up)
        determinant = np.einsum("fc,fc->f", along, p)
        safe = np.where(np.abs(determinant) > 1e-18, determinant, np.inf)
        offset = origin - corner
        u = np.einsum("fc,fc->f", offset, p) / safe
        q = np.cross(offset, along)
        v = q @ direction / safe
        t = np.einsum("fc,fc->f", up, q) / safe
        blocked[i] = ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1)).any()
    return blocked


def test_shadows_agree_with_brute_force():
    scene = scene_of(
        {"preset": "amphora", "around": 24, "along": 24},
        {"preset": "grey_card"},
        lights={"preset": "fibonacci", "n": 8},
        truth={"points": 250},
    )
    tracer = RayTracer(scene.mesh)
    points = area_uniform_points(scene, np.random.default_rng(3))
    visible = lights_visible(scene, tracer, points)
    positions = np.array([light["position"] for light in scene.lights])
    starts = points.start + tracer.start_offset * points.face_normal
    directions = near_lights.apply(scene.lights, points.position).directions
    above = np.einsum("nlj,nj->nl", directions, points.shading_from_world[:, 2]) > 0
    reached = np.stack(
        [
            ~brute_force_blocked(scene.mesh, starts, np.broadcast_to(p, starts.shape))
            for p in positions
        ],
        axis=1,
    )
    assert 0.05 < (above & ~reached).mean() < 0.9  # the object does shadow itself
    # Rays through an edge may fall to either side in float32: at most 2 in 1000.
    assert (visible != (above & reached)).mean() <= 2e-3


def test_tracing_a_convex_object_changes_nothing():
    scene = scene_of(
        {"preset": "sphere", "around": 48},
        {"preset": "grey_card"},
        image={"samples_per_side": 1},
    )
    untraced = photographs(scene)
    traced = photographs(
        replace(
            scene, effects=EffectOptions(forced={"shadows": True, "interreflection": False})
        )
    )
    # Rays start on the smooth surface, so the facets draw no line along the terminator.
    np.testing.assert_allclose(traced, untraced, atol=2e-3 * untraced.max())


def test_blocks_do_not_change_the_picture():
    scene = scene_of(
        {"preset": "vase"}, {"preset": "painted_vase"}, lights={"preset": "rti", "n": 5}
    )
    whole = photographs(scene)
    small = replace(scene, blocks=Blocks(block=1 << 17))
    np.testing.assert_array_equal(photographs(small), whole)


@pytest.mark.parametrize("kind", ["point", "directional"])
@pytest.mark.parametrize("material", ["painted_vase", "satin"])
def test_photographs_are_the_sum_over_pairs(kind, material):
    scene = scene_of(
        {"preset": "amphora", "around": 48, "along": 48},
        {"preset": material},
        lights={"preset": "fibonacci", "n": 7, "kind": kind},
    )
    tracer = RayTracer(scene.mesh)
    view = sample_view(scene, tracer, scene.cameras[0])
    points = view.points
    views = towards_camera(view.camera, points.position)
    arriving = render.arriving_light(scene, scene.lights, points.position)
    lit, cosine = render.lit_pairs(scene, tracer, points, arriving)
    reflectance = render.reflectance_of_pairs(
        scene.material, points, views, arriving.directions, lit, cosine
    )
    expected = np.zeros((view.coverage.size, 7, 3))
    weighted = view.weight[:, None, None] * reflectance * arriving.irradiance
    np.add.at(expected, view.pixel, weighted)
    image = shade(scene, tracer, view, scene.lights)
    expected = np.moveaxis(expected, 1, 0).reshape(image.shape)
    assert (expected > 0).any(axis=(1, 2, 3)).all()
    # The compiled BRDFs keep five digits; see `Material.precision`.
    assert np.linalg.norm(image - expected) < 1e-5 * np.linalg.norm(expected)


def test_visibility_known_beforehand_changes_next_to_nothing():
    scene = scene_of(
        {"preset": "amphora", "around": 64, "along": 64},
        {"preset": "grey_card"},
        cameras={"width": 64, "height": 64, "target": [0, 0, 0.1]},
        lights={"preset": "fibonacci", "n": 70, "target": [0, 0, 0.1]},
    )
    tracer = RayTracer(scene.mesh, n_threads=0)
    view = sample_view(scene, tracer, scene.cameras[0])
    nodes = Nodes.of(scene.mesh, 0.006)
    traced = trace_lights(scene, tracer, nodes)
    exact, shared = (shade(scene, tracer, view, scene.lights, t) for t in (None, traced))
    assert (exact > 0).any()
    changed = (exact != shared).any(axis=-1)
    # 1.5e-5 of the pixels were measured at 256 px.
    assert changed.mean() < 1e-4
    assert np.linalg.norm(exact - shared) < 2e-3 * np.linalg.norm(exact)


def test_some_lights_of_those_traced():
    scene = scene_of(
        {"preset": "amphora", "around": 24, "along": 24},
        {"preset": "grey_card"},
        lights={"preset": "bonn151", "target": [0, 0, 0.1]},
    )
    tracer = RayTracer(scene.mesh)
    view = sample_view(scene, tracer, scene.cameras[0])
    nodes = Nodes.of(scene.mesh, 0.01)
    whole = trace_lights(scene, tracer, nodes)
    together = shade(scene, tracer, view, scene.lights, whole)
    chosen = np.array([140, 3, 70])
    lights = tuple(scene.lights[k] for k in chosen)
    alone = shade(scene, tracer, view, lights, whole.some(chosen))
    assert (alone == together[chosen]).all()
    assert (alone > 0).any(axis=(1, 2, 3)).all()


@pytest.mark.stability
def test_nodes_about_points_on_edges_and_corners():
    mesh = scene_of({"preset": "sphere", "around": 24}, {"preset": "grey_card"}).mesh
    nodes = Nodes.of(mesh, 0.004)
    face, barycentric = nodes.places()
    assert len(np.unique(nodes.per_side)) > 1
    # One bit for each node, its index in the triangle: a node's own bit is among the three.
    index = np.arange(len(nodes)) - nodes.first[face]
    bits = (np.uint64(1) << (index % 64).astype(np.uint64))[:, None]
    rng = np.random.default_rng(1)
    shaken = barycentric + 1e-9 * rng.normal(size=barycentric.shape)
    points = surface_points(mesh, make_material({"preset": "grey_card"}), face, shaken)
    _, union = TracedLights(nodes, bits, np.arange(64)).agreed(points)
    assert ((union & bits) == bits).all()


@pytest.mark.parametrize("thing", ["amphora", "relief", "sphere"])
def test_outlines_are_found_as_by_searching_everywhere(thing, monkeypatch):
    scene = scene_of(
        {"preset": thing},
        {"preset": "grey_card"},
        cameras={"width": 96, "height": 96, "target": [0, 0, 0.05]},
    )
    tracer = RayTracer(scene.mesh)
    samples = sample_view(scene, tracer, scene.cameras[0])
    monkeypatch.setattr(
        view_samples, "_near_outline", lambda searched, *_: searched.coverage >= 0.0
    )
    everywhere = sample_view(scene, tracer, scene.cameras[0])
    assert ((samples.coverage > 0) & (samples.coverage < 1)).sum() > 50
    assert (samples.coverage == everywhere.coverage).all()
    assert (samples.pixel == everywhere.pixel).all()


def test_radiance_is_linear_in_the_light(rounding):
    scene = scene_of({"preset": "vase"}, {"preset": "glazed_ceramic"})
    brighter = tuple(
        {**light, "intensity": [4 * i for i in light["intensity"]]} for light in scene.lights
    )
    ratio_4 = photographs(replace(scene, lights=brighter))
    np.testing.assert_allclose(ratio_4, 4 * photographs(scene), rtol=rounding(np.float32))


def test_lens_distortion_bends_rays_as_opencv_projects(rng):
    import cv2

    terms = {"k1": -0.2, "k2": 0.05, "p1": 0.002, "p2": -0.001, "k3": 0.01, "k4": 0.1}
    camera = {
        "id": "v0",
        "model": "opencv",
        "w": 100,
        "h": 80,
        "fl_x": 90.0,
        "fl_y": 95.0,
        "cx": 51.0,
        "cy": 39.0,
        "camera_from_world": np.eye(4).tolist(),
        **terms,
    }
    pixels = rng.uniform([0, 0], [100, 80], (50, 2))
    origins, directions = camera_rays(camera, pixels)
    matrix = np.array([[90.0, 0, 51], [0, 95.0, 39], [0, 0, 1]])
    lens = np.array([-0.2, 0.05, 0.002, -0.001, 0.01, 0.1, 0.0, 0.0])
    again, _ = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), matrix, lens)
    assert not origins.any()
    np.testing.assert_allclose(
        again[:, 0], pixels, atol=1e-6
    )  # 1e-12 of undistortion, times focal


def test_view_directions_meet_the_camera(rng, rounding):
    scene = scene_of({"preset": "sphere"}, {"preset": "grey_card"})
    camera = scene.cameras[0]
    faces = rng.integers(len(scene.mesh.faces), size=20)
    points = surface_points(scene.mesh, scene.material, faces, np.full((20, 3), 1 / 3))
    towards = towards_camera(camera, points.position)
    centre = np.array([1, -2, 1.5]) / np.linalg.norm([1, -2, 1.5])
    np.testing.assert_allclose(
        np.cross(towards, centre - points.position), 0.0, atol=rounding(np.float64)
    )
