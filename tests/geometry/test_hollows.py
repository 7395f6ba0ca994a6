"""Hollows that no silhouette shows: a bowl and bodies that have none, of simulated photographs.

A clay bowl's inside is seen by cameras from above only. Matt surfaces are rendered by rays,
shadows included, without light between parts of the object.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from reflfield.capture.cameras import Camera
from reflfield.geometry.cones import measured_views
from reflfield.geometry.depth_search import TRUNCATION, search_depths
from reflfield.geometry.hollow_carving import carved_hollows, contradict
from reflfield.geometry.light_stack import MISSING, projection_matrix, reduced_view
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.visual_hull import HullOptions, visual_hull

OPTIONS = HullOptions(resolution=64, n_triangles=0)
SIZE, OUTER, INNER = 56, 1.0, 0.85
SIDES = 4


def ring(elevation, count, offset=0.0):
    """Unit vectors at an elevation, degrees."""
    azimuth = np.radians(offset + np.arange(count) * 360.0 / count)
    up = np.radians(elevation)
    return np.stack(
        [
            np.cos(up) * np.cos(azimuth),
            np.cos(up) * np.sin(azimuth),
            np.full(count, np.sin(up)),
        ],
        axis=1,
    )


def bowl():
    """Half a hollow ball, open at the top."""
    profile = [[0.0, -OUTER]]
    for angle in np.radians(np.linspace(-85, 0, 18)):
        profile.append([OUTER * np.cos(angle), OUTER * np.sin(angle)])
    for angle in np.radians(np.linspace(0, -85, 18)):
        profile.append([INNER * np.cos(angle), INNER * np.sin(angle)])
    profile.append([0.0, -INNER])
    made = trimesh.creation.revolve(np.array(profile), sections=64)
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces))


def ball():
    """A ball where the bowl is."""
    made = trimesh.creation.icosphere(4)
    return Mesh(0.8 * np.asarray(made.vertices) + [0.0, 0.0, -0.4], np.asarray(made.faces))


def cameras(kind="opencv"):
    """Views from the level of the rim, from above it, and from the top."""
    towards = np.concatenate([ring(0, 5), ring(35, 6, 20), ring(60, 6), ring(90, 1)])
    views = []
    for i, direction in enumerate(towards):
        up = [0.0, 1.0, 0.0] if abs(direction[2]) > 0.9 else [0.0, 0.0, 1.0]
        middle = np.array([0.0, 0.0, -0.4])
        view = Camera.look_at(
            middle + 6.0 * direction,
            middle,
            up,
            width=SIZE,
            height=SIZE,
            fov_deg=24,
            id=f"v{i}",
        )
        if kind == "orthographic":
            view = replace(view, kind=kind, fl_x=view.fl_x / 6.0, fl_y=view.fl_y / 6.0)
        views.append(view)
    return views


LIGHTS = 5.0 * np.concatenate([ring(15, 5), ring(45, 5, 30), ring(75, 3)])


def shown(mesh, camera, albedo=0.5, shine=0.0):
    """Coverage (h, w) and photographs under all lights, of rays within each pixel."""
    scene = RayScene(mesh)
    at = (np.arange(SIZE * SIDES) + 0.5) / SIDES
    pixels = np.stack(np.meshgrid(at, at), axis=2).reshape(-1, 2)
    origins, rays = camera.rays(pixels)
    origins = origins - 5.0 * rays if camera.kind == "orthographic" else origins
    distance, face, _ = scene.first_hit(origins, rays)
    hit = face >= 0
    points = origins[hit] + distance[hit, None] * rays[hit]
    corners = mesh.vertices[mesh.faces[face[hit]]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= -np.sign(np.einsum("nd,nd->n", normals, rays[hit]))[:, None]
    colour = albedo * np.array([1.0, 0.6, 0.4])
    images = []
    for light in LIGHTS:
        away = light - points
        towards = away / np.linalg.norm(away, axis=1, keepdims=True)
        blocked = scene.occluded(points + 1e-4 * normals, towards)
        cosine = np.maximum(np.einsum("nd,nd->n", normals, towards), 0) * ~blocked
        half = towards - rays[hit]
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        peak = shine * np.maximum(np.einsum("nd,nd->n", half, normals), 0) ** 20 * ~blocked
        values = np.zeros((len(pixels), 3))
        values[hit] = cosine[:, None] * colour + peak[:, None]
        images.append(averaged(values))
    return averaged(hit[:, None].astype(float))[..., 0], images


def averaged(values):
    """Means (h, w, c) of the rays of each pixel."""
    parts = values.reshape(SIZE, SIDES, SIZE, SIDES, -1)
    return parts.mean(axis=(1, 3)).astype(np.float32)


def taken(mesh, kind="opencv", **look):
    """Cameras, silhouettes and photographs of a body."""
    views = cameras(kind)
    coverages, photographs = zip(*(shown(mesh, view, **look) for view in views), strict=True)
    return views, list(coverages), list(photographs)


def reduced(views, coverages, photographs, factor=1):
    parts = zip(views, coverages, photographs, strict=True)
    return [reduced_view(view, seen, images, factor) for view, seen, images in parts]


@pytest.fixture(scope="module")
def clay_bowl():
    return taken(bowl())


@pytest.fixture(scope="module")
def hull_of_bowl(clay_bowl):
    views, coverages, _ = clay_bowl
    return visual_hull(views, coverages, OPTIONS)[0]


def heights(mesh, radii):
    """Height of the surface under points above it, mean over eight directions."""
    azimuth = np.radians(np.arange(8) * 45.0 + 10.0)
    at = [[r * np.cos(a), r * np.sin(a), 3.0] for r in radii for a in azimuth]
    distance = RayScene(mesh).first_hit(at, np.tile([0.0, 0.0, -1.0], (len(at), 1)))[0]
    return (3.0 - distance).reshape(len(radii), -1).mean(axis=1)


RADII = np.array([0.0, 0.2, 0.4, 0.6])
INSIDE = -np.sqrt(INNER**2 - RADII**2)


def carved(views, coverages, photographs, hull, threads=1):
    outlines = measured_views(views, coverages)
    stack = reduced(views, coverages, photographs)
    return carved_hollows(hull, outlines, stack, OPTIONS, 0, threads)


def test_inside_of_a_clay_bowl_is_carved(clay_bowl, hull_of_bowl):
    assert np.abs(heights(hull_of_bowl, RADII)).max() < 0.1  # filled to the rim
    body = carved(*clay_bowl, hull_of_bowl)
    assert body.mesh.watertight
    # Pixels of 0.045 units, voxels of 0.035.
    assert np.abs(heights(body.mesh, RADII) - INSIDE).max() < 0.045
    # The inner half ball over what the hull fills.
    assert body.share == pytest.approx(INNER**3 / OUTER**3, abs=0.1)
    assert set(body.views) == {f"v{i}" for i in range(5, 18)}


def test_outside_stays_as_the_silhouettes_have_it(clay_bowl, hull_of_bowl):
    body = carved(*clay_bowl, hull_of_bowl)
    below = body.mesh.vertices[np.linalg.norm(body.mesh.vertices, axis=1) > 0.95]
    below = below[below[:, 2] < -0.2]
    distance, _ = cKDTree(hull_of_bowl.vertices).query(below)
    # A tenth of a voxel.
    assert np.percentile(distance, 95) < 0.0035


def test_same_surface_from_any_number_of_threads(clay_bowl, hull_of_bowl):
    one, two = (carved(*clay_bowl, hull_of_bowl, threads) for threads in (1, 2))
    np.testing.assert_array_equal(one.mesh.vertices, two.mesh.vertices)


def test_depths_are_those_of_the_inside(clay_bowl, hull_of_bowl):
    stack = reduced(*clay_bowl)
    depths = search_depths(stack, RayScene(hull_of_bowl))
    top = depths[17]
    assert top.moved.mean() > 0.3
    row, column = np.nonzero(top.moved)
    x = (column + 0.5 - top.view.camera.cx) / top.view.camera.fl_x
    y = (row + 0.5 - top.view.camera.cy) / top.view.camera.fl_y
    depth = top.depth[row, column]
    radius = np.hypot(x, y) * depth
    truth = 6.0 - 0.4 + np.sqrt(np.maximum(INNER**2 - radius**2, 0))
    # A step is three quarters of a pixel of 0.045.
    assert np.median(np.abs(depth - truth)) < 0.034


def error_at(stack, number, pixel, distance, middle):
    """Error of a pixel of a view at a distance along its ray, by SciPy's interpolation."""
    camera, others = stack[number].camera, []
    origin, ray = (part[0] for part in camera.rays([pixel]))
    point = origin + distance * ray
    level = np.concatenate([view.values[view.covered].ravel() for view in stack])
    limit = TRUNCATION * np.sqrt(np.mean(level**2))
    row, column = int(pixel[1]), int(pixel[0])
    own = stack[number].values[row, column].ravel()
    for other in near(stack, number, middle):
        x, y = stack[other].camera.project(point[None])[0][0] - 0.5
        height, width = stack[other].covered.shape
        if not (0 <= x < width - 1 and 0 <= y < height - 1):
            continue
        flat = stack[other].values.reshape(height, width, -1)
        theirs = np.array(
            [map_coordinates(flat[..., q], [[y], [x]], order=1)[0] for q in range(len(own))]
        )
        large = np.maximum(own, theirs).sum()
        if large > 0.4 / 0.3 * limit * len(own):
            others.append(np.minimum(np.abs(own - theirs), limit).sum() / large)
    return np.mean(sorted(others)[:2]) if len(others) > 1 else np.inf


def near(stack, number, middle):
    """The six views nearest to one, up to 75 degrees."""
    towards = np.array([view.camera.view_directions(middle[None])[0] for view in stack])
    angle = np.degrees(np.arccos(np.clip(towards @ towards[number], -1, 1)))
    order = [i for i in np.argsort(angle, kind="stable") if 3 < angle[i] < 75 and i != number]
    return order[:6]


def test_errors_are_those_of_a_sum_by_brute_force(clay_bowl, hull_of_bowl):
    stack, scene = reduced(*clay_bowl), RayScene(hull_of_bowl)
    middle = hull_of_bowl.bounds.mean(axis=0)
    for number in (6, 9):
        depths = search_depths(stack, scene)[number]
        known = np.argwhere(np.isfinite(depths.error_on_hull))
        for row, column in known[:: max(1, len(known) // 12)]:
            pixel = np.array([column + 0.5, row + 0.5])
            origins, rays = stack[number].camera.rays([pixel])
            enter = scene.first_hit(origins, rays)[0][0]
            step = 0.75 / stack[number].camera.fl_x * enter
            expected = min(
                error_at(stack, number, pixel, enter + k * step, middle) for k in (0, 1)
            )
            # Sums of some forty numbers in single precision.
            assert depths.error_on_hull[row, column] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("look", [{}, {"shine": 0.6}, {"albedo": 0.02, "shine": 3.0}])
def test_body_without_hollows_stays(look):
    views, coverages, photographs = taken(ball(), **look)
    hull, _ = visual_hull(views, coverages, OPTIONS)
    assert carved(views, coverages, photographs, hull) is None


def test_orthographic_views_and_reduced_photographs(clay_bowl):
    views, coverages, photographs = taken(bowl(), "orthographic")
    hull, _ = visual_hull(views, coverages, OPTIONS)
    body = carved(views, coverages, photographs, hull)
    assert np.abs(heights(body.mesh, RADII) - INSIDE).max() < 0.045


def test_lens_is_undone_in_a_reduced_view():
    straight = cameras()[7]
    bent = replace(straight, distortion=(5.0,))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    at, _ = bent.project(points)
    ramp = np.arange(SIZE) + 0.5
    # A picture of its own coordinates: what a straight ray meets is where the lens bends it.
    image = np.stack([*np.meshgrid(ramp, ramp), np.ones((SIZE, SIZE))], axis=2)
    view = reduced_view(bent, np.ones((SIZE, SIZE)), [image.astype(np.float32)], 1)
    seen, _ = view.camera.project(points)
    column, row = np.floor(seen).astype(int).T
    values = view.values[row, column, 0] ** 3
    # Nearest pixels: half of one off. The lens moves points by up to two pixels.
    assert np.abs(straight.project(points)[0] - at).max() > 2
    assert np.abs(values[:, :2] - at).max() < 0.75


def test_matrix_projects_as_the_camera_does(rng):
    points = rng.uniform(-0.5, 0.5, (20, 3))
    for kind in ("opencv", "orthographic"):
        view = cameras(kind)[8]
        x, y, w = projection_matrix(view) @ np.c_[points, np.ones(20)].T
        expected, _ = view.project(points)
        # Products of four numbers of about a hundred.
        np.testing.assert_allclose(np.stack([x / w, y / w], axis=1), expected, rtol=1e-12)


@pytest.mark.stability
class TestHardCases:
    def stack(self, clay_bowl, change):
        views, coverages, photographs = clay_bowl
        changed = [
            [change(i, image) for image in images] for i, images in enumerate(photographs)
        ]
        return reduced(views, coverages, changed)

    @pytest.mark.parametrize(
        "change",
        [
            lambda i, image: np.zeros_like(image),
            lambda i, image: np.full_like(image, 0.3),
            lambda i, image: np.full_like(image, np.nan),
            lambda i, image: None,
            lambda i, image: image * np.float32(10.0 ** (3 * (i % 7) - 9)),
        ],
        ids=["black", "equal", "not a number", "no photograph", "exposures that differ"],
    )
    def test_nothing_is_carved_of_photographs_that_say_nothing(
        self, change, clay_bowl, hull_of_bowl
    ):
        assert not contradict(hull_of_bowl, self.stack(clay_bowl, change))

    @pytest.mark.parametrize("scale", [1e-12, 1e12])
    def test_unit_of_radiance_does_not_matter(self, scale, clay_bowl, hull_of_bowl):
        depths = [
            search_depths(self.stack(clay_bowl, change), RayScene(hull_of_bowl), 3)
            for change in (lambda i, x: x, lambda i, x: np.float32(scale) * x)
        ]
        moved = [np.concatenate([d.moved.ravel() for d in each]) for each in depths]
        # Cube roots of single precision: a pixel at the limit may fall on either side.
        assert np.mean(moved[0] != moved[1]) < 1e-3
        assert moved[0].any()

    def test_photographs_that_are_missing_are_passed_over(self, clay_bowl, hull_of_bowl):
        views, coverages, photographs = clay_bowl
        some = [
            [None if (i + j) % 7 == 0 else image for j, image in enumerate(images)]
            for i, images in enumerate(photographs)
        ]
        stack = reduced(views, coverages, some)
        assert (stack[0].values[:, :, 0] == MISSING).all()
        assert contradict(hull_of_bowl, stack)

    def test_seven_lights_are_too_few(self, clay_bowl, hull_of_bowl):
        views, coverages, photographs = clay_bowl
        few = [images[:7] for images in photographs]
        assert not contradict(hull_of_bowl, reduced(views, coverages, few))
        some = [images[:8] for images in photographs]
        assert contradict(hull_of_bowl, reduced(views, coverages, some))

    def test_two_views_are_too_few(self, clay_bowl, hull_of_bowl):
        assert not contradict(hull_of_bowl, reduced(*(part[5:7] for part in clay_bowl)))
