from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import trimesh

from reflfield.capture.cameras import Camera
from reflfield.capture.lights import Light
from reflfield.errors import InputError
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.occlusion import (
    VisibilityOptions,
    cameras_inside,
    check_light_outside,
    depth_edges,
    light_visibility,
    view_visibility,
)
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.texels import texel_table
from reflfield.geometry.uv_atlas import Atlas, AtlasOptions, built_atlas

UNIT_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)


def two_balls():
    """A large ball at the origin and a small one above it."""
    large = trimesh.creation.icosphere(subdivisions=3)
    small = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    small.apply_translation([0, 0, 1.8])
    both = trimesh.util.concatenate([large, small])
    return Mesh(both.vertices, both.faces)


def floor_under_a_square(scale=1.0, origin=0.0):
    """Floor of side 4 at z = 0, an occluder of side 1 at z = 1 around the axis."""
    floor = np.column_stack([(UNIT_SQUARE - 0.5) * 4.0, np.zeros(4)])
    roof = np.column_stack([UNIT_SQUARE - 0.5, np.ones(4)])
    quads = [[0, 1, 2], [0, 2, 3]]
    mesh = Mesh(np.concatenate([floor, roof]) * scale + origin, [*quads, [4, 5, 6], [4, 6, 7]])
    atlas = Atlas(
        positions=floor * scale + origin, faces=quads, uv=UNIT_SQUARE, chart=[0, 0],
        normals=[[0, 0, 1]] * 4, height=40, width=40,
    )  # fmt: skip
    return RayScene(mesh), texel_table(atlas)


def top_camera(kind="opencv", size=80, height=10.0, scale=1.0, origin=0.0):
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = -pose[:3, :3] @ (np.array([0, 0, height]) * scale + origin)
    focal = size * height / 5.0 if kind == "opencv" else size / 5.0 / scale
    return Camera("top", kind, size, size, focal, focal, size / 2, size / 2, pose)


def shadow_of(light_height, texels):
    """Signed distance of floor points to the square's shadow of a lamp on the axis."""
    half = 0.5 * light_height / (light_height - 1.0)
    return half - np.abs(texels.position[:, :2]).max(axis=1)


@pytest.mark.reference
def test_occlusion_and_hits_agree_with_brute_force(rng):
    mesh = two_balls()
    origins = rng.normal(size=(150, 3)) * 1.5
    ways = rng.normal(size=(150, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    first, second, third = np.moveaxis(mesh.corners, 1, 0)
    e1, e2 = second - first, third - first
    # Moeller-Trumbore for all pairs.
    p = np.cross(ways[:, None], e2[None])
    determinant = (e1 * p).sum(axis=2)
    offset = origins[:, None] - first
    u = (offset * p).sum(axis=2) / determinant
    q = np.cross(offset, e1)
    v = (ways[:, None] * q).sum(axis=2) / determinant
    t = (e2 * q).sum(axis=2) / determinant
    crossing = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    truth = np.where(crossing, t, np.inf).min(axis=1)
    scene = RayScene(mesh)
    distance, face, barycentric = scene.first_hit(origins, ways)
    np.testing.assert_array_equal(np.isinf(distance), np.isinf(truth))
    hit = np.isfinite(truth)
    np.testing.assert_allclose(distance[hit], truth[hit], rtol=1e-5, atol=1e-5)  # float32
    points = np.einsum("nk,nkd->nd", barycentric[hit], mesh.corners[face[hit]])
    # The error of the distance, and as much of the barycentric coordinates.
    np.testing.assert_allclose(points, origins[hit] + truth[hit, None] * ways[hit], atol=2e-5)
    np.testing.assert_array_equal(scene.occluded(origins, ways), hit)
    limit = np.where(hit, truth * rng.choice([0.99, 1.01], size=len(truth)), 5.0)
    np.testing.assert_array_equal(scene.occluded(origins, ways, limit), truth < limit)


@pytest.mark.parametrize("height", [3.0, 50.0])
def test_near_lamps_throw_the_shadow_of_a_point(height):
    scene, texels = floor_under_a_square()
    lamp = Light("l", "point", position=[0, 0, height])
    lit = light_visibility(texels, scene, lamp)
    away = np.abs(shadow_of(height, texels)) > 0.01
    np.testing.assert_array_equal(lit[away], shadow_of(height, texels)[away] < 0.0)


def test_a_lamp_below_the_occluder_is_not_blocked_by_it():
    scene, texels = floor_under_a_square()
    assert light_visibility(texels, scene, Light("l", "point", position=[0, 0, 0.9])).all()


def test_far_and_unknown_lights():
    scene, texels = floor_under_a_square()
    lit = light_visibility(texels, scene, Light("l", "directional", direction=[0, 0, 1]))
    np.testing.assert_array_equal(lit, np.abs(texels.position[:, :2]).max(axis=1) > 0.5)
    below = Light("l", "directional", direction=[0, 0.1, -1])
    assert not light_visibility(texels, scene, below).any()
    assert light_visibility(texels, scene, Light("l", "unknown")).all()


@pytest.mark.parametrize("kind", ["opencv", "orthographic"])
def test_cameras_see_the_floor_beside_the_occluder(kind):
    scene, texels = floor_under_a_square()
    seen = view_visibility(texels, scene, top_camera(kind))
    half = 0.5 * 10.0 / 9.0 if kind == "opencv" else 0.5
    reach = np.abs(texels.position[:, :2]).max(axis=1)
    pixel = 5.0 / 80.0
    assert not seen[reach < half + pixel].any()  # hidden, or within the band of the edge
    assert seen[(reach > half + 3 * pixel) & (reach < 2.0 - 3 * pixel)].all()
    without_band = VisibilityOptions(edge_band=0.0)
    seen = view_visibility(texels, scene, top_camera(kind), without_band)
    away = np.abs(reach - half) > 0.01
    np.testing.assert_array_equal(seen[away], reach[away] > half)


def test_grazing_views_bad_pixels_and_texels_outside_the_frame_are_rejected():
    scene, texels = floor_under_a_square()
    camera = top_camera()
    strict = VisibilityOptions(grazing_cosine=0.999, edge_band=0.0)
    seen = view_visibility(texels, scene, camera, strict)
    away_from_axis = np.linalg.norm(texels.position[:, :2], axis=1)
    assert not seen[away_from_axis > 10.0 * np.tan(np.arccos(0.999))].any()
    cropped = Camera(
        "c", "opencv", 40, 80, camera.fl_x, camera.fl_y, 40, 40, camera.camera_from_world
    )
    seen = view_visibility(texels, scene, cropped)
    assert not seen[texels.position[:, 0] > 0.0].any()
    assert seen.any()
    nowhere = np.zeros((80, 80), np.float32)
    assert not view_visibility(texels, scene, camera, silhouette=nowhere).any()
    shared = depth_edges(scene, camera, VisibilityOptions())
    np.testing.assert_array_equal(
        view_visibility(texels, scene, camera, edges=shared),
        view_visibility(texels, scene, camera),
    )


def test_the_back_is_not_seen_and_blocks_do_not_matter():
    mesh = two_balls()
    texels = texel_table(built_atlas(mesh, AtlasOptions(resolution=64, method="boxes")).atlas)
    scene = RayScene(mesh)
    camera = top_camera()
    seen = view_visibility(texels, scene, camera)
    towards = camera.view_directions(texels.position)
    assert not seen[(towards * texels.normal).sum(axis=1) < 0.15].any()
    assert seen.mean() > 0.1
    halves = [texels.subset(slice(0, 500)), texels.subset(slice(500, None))]
    again = np.concatenate([view_visibility(half, scene, camera) for half in halves])
    np.testing.assert_array_equal(seen, again)


def test_a_surface_does_not_shadow_itself():
    ball = trimesh.creation.icosphere(subdivisions=4)
    mesh = Mesh(ball.vertices, ball.faces)
    texels = texel_table(built_atlas(mesh, AtlasOptions(resolution=64, method="boxes")).atlas)
    lamp = Light("l", "directional", direction=[1, 2, 3])
    lit = light_visibility(texels, RayScene(mesh), lamp)
    cosine = texels.normal @ lamp.direction
    assert lit[cosine > 0.1].all()
    assert not lit[cosine < 0.0].any()


@pytest.mark.stability
@pytest.mark.parametrize(("scale", "origin"), [(1e-3, 0.0), (1.0, 1e3)])
def test_shadows_do_not_depend_on_place_and_size(scale, origin):
    scene, texels = floor_under_a_square(scale, origin)
    lamp = Light("l", "point", position=np.array([0, 0, 3.0]) * scale + origin)
    lit = light_visibility(texels, scene, lamp)
    reference_scene, reference = floor_under_a_square()
    np.testing.assert_array_equal(
        lit,
        light_visibility(reference, reference_scene, Light("l", "point", position=[0, 0, 3])),
    )
    camera = top_camera(scale=scale, origin=origin)
    np.testing.assert_array_equal(
        view_visibility(texels, scene, camera),
        view_visibility(reference, reference_scene, top_camera()),
    )


def test_a_light_inside_the_object_is_refused_by_name():
    mesh = two_balls()
    positions = np.array([[0.5, 0, 0], [0, 0, 1.8], [0, 0, 1.25], [1e6, 0, 0]])
    assert RayScene(mesh).inside(positions).tolist() == [True, True, False, False]
    open_mesh = Mesh(mesh.vertices, mesh.faces[1:])
    assert not RayScene(open_mesh).inside(positions[:1]).any()
    with pytest.raises(InputError, match=r"light 'l042'.*inside its hull"):
        check_light_outside(RayScene(mesh), Light("l042", "point", position=[0.5, 0, 0]))
    check_light_outside(RayScene(mesh), Light("l", "directional"))


def test_cameras_inside_the_object_are_refused_or_named():
    scene = RayScene(two_balls())

    def camera(name, *centre):
        pose = np.eye(4)
        pose[:3, 3] = -np.array(centre)
        return replace(top_camera(), id=name, camera_from_world=pose)

    inside, outside = camera("v3", 0.5, 0, 0), camera("v4", 0, 0, 9)
    assert cameras_inside(scene, [inside, outside]) == ("v3",)
    assert cameras_inside(scene, [outside]) == ()
    with pytest.raises(InputError, match=r"cameras: .* 2 that are all inside its hull.*'v3'"):
        cameras_inside(scene, [inside, inside])


def test_options_are_checked():
    with pytest.raises(InputError, match="grazing_cosine"):
        VisibilityOptions(grazing_cosine=1.0)
    with pytest.raises(InputError, match="edge_band"):
        VisibilityOptions(edge_band=-1.0)


@pytest.mark.stability
def test_rays_that_start_far_away_keep_their_digits():
    scene = RayScene(two_balls())
    start, way = [[0.0, 0.0, 1e4]] * 2, [[0.0, 0.0, -1.0]] * 2
    top = 1e4 - 2.1  # the small ball's pole is a vertex of its icosphere
    assert scene.first_hit(start, way)[0] == pytest.approx(top, abs=1e-5)
    assert scene.occluded(start, way, [top - 1e-3, top + 1e-3]).tolist() == [False, True]


def test_edges_do_not_depend_on_the_strips_that_they_are_found_in(monkeypatch):
    """And large photographs are gone through strip by strip: five rows here."""
    sphere = trimesh.creation.icosphere(2)
    ball = Mesh(sphere.vertices, sphere.faces)
    pose = np.eye(4)
    pose[2, 3] = 4.0
    camera = Camera("v", "opencv", 40, 33, 50.0, 50.0, 20.0, 16.5, pose)
    scene, options = RayScene(ball), VisibilityOptions(edge_band=2.5)
    whole, covered = depth_edges(scene, camera, options), scene.silhouette(camera)
    rows = []
    traced = RayScene.row_depths

    def row_depths(self, camera, first, end):
        rows.append(end - first)
        return traced(self, camera, first, end)

    monkeypatch.setattr("reflfield.geometry.ray_scene.RAYS_AT_ONCE", 200)
    monkeypatch.setattr(RayScene, "row_depths", row_depths)
    assert np.array_equal(depth_edges(scene, camera, options), whole)
    assert np.array_equal(scene.silhouette(camera), covered)
    # Five rows, and as many on both sides as the band and one neighbour reach.
    assert max(rows) == 5 + 2 * 4
    assert 100 < whole.sum() < 40 * 33 / 2
    assert 500 < covered.sum() < 700


@pytest.mark.parametrize(
    ("kind", "distortion", "moved"),
    [
        ("opencv", (), [0.3, -0.2, 4.0]),
        ("opencv", (), [2.5, 0.0, 4.0]),  # the ball leaves the image
        ("opencv", (), [0.0, 0.0, 0.5]),  # the camera is inside of it
        ("opencv", (0.3, 0.1), [0.3, -0.2, 4.0]),
        ("orthographic", (), [0.3, -0.2, 4.0]),
    ],
)
def test_pixels_that_cannot_show_the_mesh_are_not_looked_at_and_miss_nothing(
    kind, distortion, moved
):
    sphere = trimesh.creation.icosphere(2)
    scene = RayScene(Mesh(sphere.vertices, sphere.faces))
    pose = np.eye(4)
    pose[:3, 3] = moved
    focal = 50.0 if kind == "opencv" else 12.0
    camera = Camera("v", kind, 40, 33, focal, focal, 20.0, 16.5, pose, distortion)
    y, x = np.mgrid[:33, :40] + 0.5
    everywhere = scene.pixel_depths(camera, np.stack([x.ravel(), y.ravel()], axis=1))
    everywhere = everywhere.reshape(33, 40)
    # Some are drawn, not traced; rays have single precision.
    assert_depths = partial(np.testing.assert_allclose, rtol=64 * np.finfo(np.float32).eps)
    assert_depths(scene.row_depths(camera, 0, 33), everywhere)
    assert_depths(scene.row_depths(camera, 7, 12), everywhere[7:12])


def test_threads_of_a_query_are_no_more_than_cores():
    square = Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 1, 2]])
    scene = RayScene(square, threads=100_000)
    distance, _, _ = scene.first_hit([[0.6, 0.2, 3.0]], [[0, 0, -1]])
    assert distance.tolist() == [3.0]


def test_facing_is_the_cosine_of_rays_and_normals():
    made = trimesh.creation.icosphere(5)
    scene = RayScene(Mesh(np.asarray(made.vertices), np.asarray(made.faces)))
    camera = Camera.look_at(
        [0.0, -4.0, 0.0], [0, 0, 0], [0, 0, 1], width=41, height=31, fov_deg=40
    )
    cosines = scene.facing(camera, 2)
    assert cosines.shape == (16, 21)
    rows, columns = np.mgrid[0:31:2, 0:41:2]
    origins, rays = camera.rays(np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5)
    # Distance of each ray from the middle of the unit sphere, and the sine that it is.
    along = -(origins * rays).sum(axis=1)
    sine = np.linalg.norm(origins + along[:, None] * rays, axis=1)
    expected = np.sqrt(np.maximum(1 - sine**2, 0)).reshape(cosines.shape)
    inside = (sine < 0.97).reshape(cosines.shape)
    # Triangles of .02 radians: a third of that, where the ray is steep.
    np.testing.assert_allclose(cosines[inside], expected[inside], atol=0.006)
    assert np.isnan(cosines[(sine > 1.01).reshape(cosines.shape)]).all()
    parallel = replace(camera, kind="orthographic", fl_x=20.0, fl_y=20.0)
    # A ray beside the middle by half a pixel of 1/20.
    assert scene.facing(parallel)[15, 20] == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize("band", [0.5, 1.0, 1.5, 2.0, 3.3])
def test_edges_reach_as_far_as_their_band(band):
    """Pixels whose centres are within the band of the line between two that differ."""
    square = Mesh([[1, 1, 4], [2, 1, 4], [2, 2, 4], [1, 2, 4]], [[0, 2, 1], [0, 3, 2]])
    camera = Camera("v", "opencv", 60, 48, 64.0, 64.0, 0.5, 0.5, np.eye(4))
    scene = RayScene(square)
    covered = scene.silhouette(camera)
    beside = np.zeros(covered.shape, bool)
    for axis in (0, 1):
        differs = np.diff(covered, axis=axis)
        ahead = [(0, 0), (0, 0)]
        for side in ((0, 1), (1, 0)):
            ahead[axis] = side
            beside |= np.pad(differs, ahead)
    y, x = np.nonzero(beside)
    rows, columns = np.mgrid[:48, :60]
    away = np.hypot(rows[..., None] - y, columns[..., None] - x).min(axis=2)
    edges = depth_edges(scene, camera, VisibilityOptions(edge_band=band))
    assert 0 < edges.sum() < edges.size / 2
    np.testing.assert_array_equal(edges, away + 0.5 <= band)
