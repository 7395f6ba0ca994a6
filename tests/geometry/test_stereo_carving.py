"""Stereo by patches: a bowl with texture under one light, and bodies that say nothing.

Photographs are rendered by rays; what is textured is an even solid texture in three dimensions.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.ndimage import map_coordinates

from reflfield.capture.cameras import Camera
from reflfield.geometry.carving import Grid
from reflfield.geometry.cones import measured_views
from reflfield.geometry.depth_fusion import BAND, carved_by_depths
from reflfield.geometry.light_stack import reduced_view
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.patch_costs import (
    LARGE_STEP,
    NOISE,
    OUTSIDE,
    REACH,
    SMALL_STEP,
    OwnImage,
    PackedImages,
    Sweep,
    aggregated,
    least_offsets,
    patch_costs,
)
from reflfield.geometry.patch_stereo import PatchStereo, PatchView, SeenSurface
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.stereo_carving import carved_by_stereo
from reflfield.geometry.visual_hull import HullOptions, visual_hull

OPTIONS = HullOptions(resolution=64, n_triangles=0)
SIZE, OUTER, INNER = 80, 1.0, 0.8
SIDES = 3
MIDDLE = np.array([0.0, 0.0, -0.5])
RADII = np.array([0.0, 0.2, 0.4, 0.55])
INSIDE = -np.sqrt(INNER**2 - RADII**2)


def ring(elevation, count, offset=0.0):
    """Unit vectors at an elevation, degrees."""
    azimuth = np.radians(offset + np.arange(count) * 360.0 / count)
    up = np.radians(elevation)
    flat = np.cos(up) * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    return np.column_stack([flat, np.full(count, np.sin(up))])


def turned(profile):
    """Closed body of revolution about z."""
    made = trimesh.creation.revolve(np.array(profile), sections=64)
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces))


def bowl():
    """Half a hollow ball, open at the top."""
    angles = np.radians(np.linspace(-85, 0, 18))
    outside = [[OUTER * np.cos(a), OUTER * np.sin(a)] for a in angles]
    inside = [[INNER * np.cos(a), INNER * np.sin(a)] for a in angles[::-1]]
    return turned([[0.0, -OUTER], *outside, *inside, [0.0, -INNER]])


def ball():
    made = trimesh.creation.icosphere(4)
    return Mesh(0.6 * np.asarray(made.vertices) + MIDDLE, np.asarray(made.faces))


def cameras(kind="opencv"):
    """Views from the level of the rim and from above."""
    views = []
    for i, towards in enumerate(np.concatenate([ring(5, 12), ring(40, 10, 9), ring(70, 6)])):
        eye = MIDDLE + 6.0 * towards
        view = Camera.look_at(
            eye, MIDDLE, [0.0, 0.0, 1.0], width=SIZE, height=SIZE, fov_deg=24, id=f"v{i}"
        )
        if kind == "orthographic":
            view = replace(view, kind=kind, fl_x=view.fl_x / 6.0, fl_y=view.fl_y / 6.0)
        views.append(view)
    return views


def texture(points):
    """Albedo (n, 3): sums of waves of a few pixels' length."""
    rng = np.random.default_rng(3)
    waves = rng.normal(size=(24, 3)) * 14.0
    phase = rng.uniform(0, 2 * np.pi, 24)
    value = np.cos(points @ waves.T + phase).sum(axis=1) / np.sqrt(24)
    return np.clip(0.5 + 0.2 * value, 0.05, 1.0)[:, None] * [1.0, 0.8, 0.6]


def plain(points):
    return np.full((len(points), 3), 0.5)


def shown(mesh, camera, albedo):
    """Coverage (h, w) and one photograph, under one light from above."""
    scene = RayScene(mesh)
    at = (np.arange(SIZE * SIDES) + 0.5) / SIDES
    origins, rays = camera.rays(np.stack(np.meshgrid(at, at), axis=2).reshape(-1, 2))
    origins = origins - 5.0 * rays if camera.kind == "orthographic" else origins
    distance, face, _ = scene.first_hit(origins, rays)
    hit = face >= 0
    points = origins[hit] + distance[hit, None] * rays[hit]
    normals = mesh.face_normals[face[hit]]
    light = np.array([0.3, 0.2, 0.93])
    values = np.zeros((len(rays), 3))
    values[hit] = albedo(points) * (0.3 + 0.7 * np.maximum(normals @ light, 0))[:, None]
    return averaged(hit[:, None].astype(float))[..., 0], averaged(values)


def averaged(values):
    """Means (h, w, c) of the rays of each pixel."""
    parts = values.reshape(SIZE, SIDES, SIZE, SIDES, -1)
    return parts.mean(axis=(1, 3)).astype(np.float32)


def photographed(mesh, albedo=texture, kind="opencv"):
    """Cameras, silhouettes and photographs of a body."""
    views = cameras(kind)
    seen = [shown(mesh, view, albedo) for view in views]
    return views, [coverage for coverage, _ in seen], [image for _, image in seen]


def patch_views(views, coverages, photographs, factor=1):
    parts = zip(views, coverages, photographs, strict=True)
    return [PatchView.of(reduced_view(v, seen, [image], factor)) for v, seen, image in parts]


@pytest.fixture(scope="module")
def textured():
    return photographed(bowl())


@pytest.fixture(scope="module")
def hull(textured):
    return visual_hull(*textured[:2], OPTIONS)[0]


def heights(mesh):
    """Height of the surface under points above it, mean over eight directions."""
    azimuth = np.radians(np.arange(8) * 45.0 + 10.0)
    at = [[r * np.cos(a), r * np.sin(a), 3.0] for r in RADII for a in azimuth]
    distance = RayScene(mesh).first_hit(at, np.tile([0.0, 0.0, -1.0], (len(at), 1)))[0]
    return (3.0 - distance).reshape(len(RADII), -1).mean(axis=1)


def carved(views, coverages, photographs, body, threads=2):
    outlines = measured_views(views, coverages)
    seen = patch_views(views, coverages, photographs)
    return carved_by_stereo(body, outlines, seen, OPTIONS, 0, threads)


@pytest.fixture(scope="module")
def carved_bowl(textured, hull):
    return carved(*textured, hull)


def test_inside_of_a_textured_bowl_is_carved(hull, carved_bowl):
    assert np.abs(heights(hull)).max() < 0.15  # filled nearly to the rim
    assert carved_bowl.mesh.watertight
    # Pixels and voxels of 0.03 units.
    assert np.abs(heights(carved_bowl.mesh) - INSIDE).max() < 0.03
    # Those from above; from the level of the rim the outside stays where it is.
    assert set(carved_bowl.views) == {f"v{i}" for i in range(12, 28)}


def test_rim_and_outside_are_not_eaten_away(textured, carved_bowl):
    views, coverages, _ = textured
    scene = RayScene(carved_bowl.mesh)
    for view, coverage in zip(views[:12], coverages[:12], strict=True):
        lost = (coverage > 0.99) & (scene.silhouette(view) < 0.5)
        # The wall is six pixels thick at the rim; a band of half a pixel around the outline.
        assert lost.sum() < 0.02 * (coverage > 0.99).sum()


def test_same_surface_from_any_number_of_threads(textured, hull, carved_bowl):
    one = carved(*textured, hull, 1)
    np.testing.assert_array_equal(one.mesh.vertices, carved_bowl.mesh.vertices)


def test_parallel_rays():
    views, coverages, photographs = photographed(bowl(), kind="orthographic")
    body = visual_hull(views, coverages, OPTIONS)[0]
    body = carved(views, coverages, photographs, body)
    assert np.abs(heights(body.mesh) - INSIDE).max() < 0.03


def true_depth(mesh, camera):
    pixels = np.stack(np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5), axis=2)
    origins, rays = camera.rays(pixels.reshape(-1, 2))
    distance = RayScene(mesh).first_hit(origins, rays)[0]
    return (distance * (rays @ camera.forward)).reshape(SIZE, SIZE)


def test_depths_around_the_true_surface_lean_to_neither_side(textured, hull):
    """Curved surfaces, and the hull before them, must not move depths in or out."""
    views = patch_views(*textured)
    mesh = bowl()
    stereo = PatchStereo(views, RayScene(hull), [13, 23], 2)
    off = []
    for seen, number in zip(stereo.depths(RayScene(mesh), "test"), [13, 23], strict=True):
        # Windows around the object begin somewhere in the photograph.
        x = round(textured[0][number].cx - seen.camera.cx)
        y = round(textured[0][number].cy - seen.camera.cy)
        height, width = seen.depth.shape
        truth = true_depth(mesh, textured[0][number])[y : y + height, x : x + width]
        off.append((seen.depth - truth)[seen.confirmed & np.isfinite(truth)])
    off = np.concatenate(off)
    # Pixels of 0.03 units: a twentieth, and for single ones a third.
    assert abs(np.median(off)) < 0.0015
    assert np.median(np.abs(off)) < 0.01


def test_noise_goes_both_ways_where_the_hull_is_the_surface():
    """Planes behind the hull alone would let depths err inwards only."""
    views, coverages, photographs = photographed(ball())
    mesh = visual_hull(views, coverages, OPTIONS)[0]
    seen_views = patch_views(views, coverages, photographs)
    (seen,) = PatchStereo(seen_views, RayScene(mesh), [14]).depths(None, "test")
    x = round(views[14].cx - seen.camera.cx)
    y = round(views[14].cy - seen.camera.cy)
    height, width = seen.depth.shape
    off = seen.depth - true_depth(mesh, views[14])[y : y + height, x : x + width]
    off = off[np.isfinite(off)] / seen.spacing
    assert np.mean(off < -0.2) > 0.1
    # Planes that curve away from the ball: half of their spacing, not more.
    assert abs(np.median(off)) < 0.6


def brute_force_cost(own, covered, other, at, places):
    """Cost of one patch against one view, from its definition, by SciPy's interpolation."""
    y, x = at
    a, b = [], []
    for i in range(y - REACH, y + REACH + 1):
        for k in range(x - REACH, x + REACH + 1):
            inside = 0 <= i < covered.shape[0] and 0 <= k < covered.shape[1]
            if not inside or not covered[i, k]:
                continue
            u, v = places[i, k]
            if not (0 <= u < other.shape[1] - 1 and 0 <= v < other.shape[0] - 1):
                continue
            a.append(own[i, k])
            b.append(map_coordinates(other, [[v], [u]], order=1)[0])
    if len(a) < 0.5 * (2 * REACH + 1) ** 2:
        return 1.0
    a, b = np.array(a, float), np.array(b, float)
    covariance = np.mean((a - a.mean()) * (b - b.mean()))
    return min(1 - covariance / np.sqrt((a.var() + NOISE**2) * (b.var() + NOISE**2)), 1.0)


def test_costs_are_those_of_a_sum_by_brute_force(rng):
    """Rays along z through pixels; two views that show them shifted and stretched."""
    height, width = 14, 17
    own = rng.normal(size=(height, width)).astype(np.float32)
    covered = rng.random((height, width)) > 0.2
    pictures = [rng.normal(size=(12, 15)).astype(np.float32) for _ in range(3)]
    matrices = np.zeros((3, 3, 4))
    for j, matrix in enumerate(matrices):
        matrix[0] = [0.8, 0.1, 0.3 + 0.2 * j, 0.2]
        matrix[1] = [-0.1, 0.9, 0.2 * j, 0.4]
        matrix[2] = [0.01, 0.0, 0.05, 1.0]
    sizes = np.array([picture.shape for picture in pictures])
    first = np.concatenate([[0], np.cumsum([p.size for p in pictures])[:-1]]).astype(np.int64)
    images = PackedImages(
        np.concatenate([p.ravel() for p in pictures]), first, sizes.astype(np.int64), matrices
    )
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    origins = np.stack([x, y, np.zeros_like(x)], axis=2)
    rays = np.broadcast_to([0.0, 0.0, 1.0], origins.shape).copy()
    front = rng.uniform(0, 2, (height, width))
    offsets = np.array([0.0, 0.7])
    low, high = np.zeros((height, width), np.int64), np.where(covered, 1, -1)
    sweep = Sweep(origins, rays, front, offsets, low, high)
    costs = patch_costs(images, sweep, OwnImage(own, covered), np.arange(3))
    assert (costs[~covered] == OUTSIDE).all()
    for k, offset in enumerate(offsets):
        points = np.stack([x, y, front + offset, np.ones_like(x)], axis=2)
        # Middle and borders: sums over patches begin and end there.
        for at in ((7, 8), (3, 4), (13, 16), (0, 9), (1, 6), (1, 9), (2, 8), (12, 7), (7, 1)):
            if not covered[at]:
                continue
            each = []
            for matrix, picture in zip(matrices, pictures, strict=True):
                u, v, w = np.moveaxis(points @ matrix.T, 2, 0)
                places = np.stack([u / w - 0.5, v / w - 0.5], axis=2)
                each.append(brute_force_cost(own, covered, picture, at, places))
            expected = np.mean(sorted(each)[:2])
            # Sums of 49 products in single precision.
            assert costs[at][k] == pytest.approx(expected, abs=2e-5)


def aggregated_by_definition(costs, low, high):
    """The recursion, written out."""
    height, width, n = costs.shape
    total = np.zeros_like(costs)

    def path(y, x, dy, dx):
        here = np.full(n, OUTSIDE)
        some = slice(low[y, x], high[y, x] + 1)
        fy, fx = y - dy, x - dx
        if not (0 <= fy < height and 0 <= fx < width) or high[fy, fx] < 0:
            here[some] = costs[y, x, some]
            return here
        last = path(fy, fx, dy, dx)
        for k in range(low[y, x], high[y, x] + 1):
            steps = [last[k], last.min() + LARGE_STEP]
            steps += [last[i] + SMALL_STEP for i in (k - 1, k + 1) if 0 <= i < n]
            here[k] = costs[y, x, k] + min(steps) - last.min()
        return here

    for y, x in np.argwhere(high >= 0):
        some = slice(low[y, x], high[y, x] + 1)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                if (dy, dx) != (0, 0):
                    total[y, x, some] += path(y, x, dy, dx)[some]
    return total


def test_sums_along_paths_are_those_of_the_recursion(rng):
    costs = rng.random((6, 7, 5)).astype(np.float32)
    low = rng.integers(0, 3, (6, 7))
    high = np.minimum(low + rng.integers(0, 4, (6, 7)), 4)
    high[rng.random((6, 7)) < 0.15] = -1
    sums = aggregated(costs, low, high)
    # Eight paths of seven pixels in single precision.
    np.testing.assert_allclose(sums, aggregated_by_definition(costs, low, high), atol=2e-5)


def test_least_sum_lies_between_surfaces():
    offsets = 0.3 * np.arange(-4, 5)
    total = ((offsets - 0.11) ** 2)[None, None].astype(np.float32)
    ends = np.zeros((1, 1), np.int64), np.full((1, 1), 8)
    # A parabola in single precision.
    assert least_offsets(total, offsets, *ends)[0, 0] == pytest.approx(0.11, abs=1e-5)
    # At an end of the range there is no parabola; off the object nothing.
    assert least_offsets(total, offsets, ends[0] + 6, ends[1])[0, 0] == offsets[6]
    assert np.isnan(least_offsets(total, offsets, ends[0], ends[1] - 9)[0, 0])


def seen_planes(depths, noise=0.0, rng=None):
    """Orthographic views along -z that see planes at some heights, all confirmed."""
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    down[2, 3] = 2.0
    camera = Camera("v", "orthographic", 20, 20, 20.0, 20.0, 10.0, 10.0, down)
    maps = []
    for height in depths:
        depth = np.full((20, 20), 2.0 - height)
        if rng is not None:
            depth += rng.normal(0, noise, depth.shape)
        maps.append(SeenSurface(camera, depth, np.ones((20, 20), np.bool_), 0.01))
    return maps


GRID = Grid(np.array([-0.4, -0.4, -0.4]), 0.02, (41, 41, 41), 1)
FULL = np.full((41, 41, 41), 50.0, np.float32)


def level(volume):
    """Height at which a volume's signed distance passes 0, in the middle."""
    column = volume[20, 20]
    top = np.flatnonzero(column > 0).max()
    share = column[top] / (column[top] - column[top + 1])
    return GRID.origin[2] + GRID.spacing * (top + share)


def test_depths_are_averaged_where_views_see_a_surface(rng):
    volume = carved_by_depths(FULL, GRID, seen_planes([0.10, 0.12, 0.11]))
    # A hundredth of a voxel: numbers in single precision, blurred along a straight line.
    assert level(volume) == pytest.approx(0.11, abs=2e-4)
    noisy = carved_by_depths(FULL, GRID, seen_planes([0.1] * 9, 0.02, rng))
    # Nine views, and pixels within the blur, of a voxel of noise each.
    assert level(noisy) == pytest.approx(0.1, abs=0.01)


def test_one_wrong_view_does_not_eat_a_surface_away():
    """A mean over all would move it by a third of the band."""
    right = seen_planes([0.1, 0.1, 0.1])
    wrong = seen_planes([-0.3])
    # As above; and the blur of a voxel of .02.
    assert level(carved_by_depths(FULL, GRID, right + wrong)) == pytest.approx(0.1, abs=2e-4)
    most = carved_by_depths(FULL, GRID, right[:1] + wrong * 2)
    assert level(most) == pytest.approx(-0.3, abs=0.01)  # the blur, again


def test_threads_carve_the_same(rng):
    seen = seen_planes([0.1] * 5, 0.02, rng)
    one, three = (carved_by_depths(FULL, GRID, seen, workers) for workers in (1, 3))
    np.testing.assert_array_equal(one, three)


def test_what_no_view_sees_stays_and_nothing_grows():
    unseen = seen_planes([0.1])
    unseen[0] = replace(unseen[0], depth=np.full((20, 20), np.nan))
    same = np.full_like(FULL, BAND)
    np.testing.assert_array_equal(carved_by_depths(FULL, GRID, unseen), same)
    volume = carved_by_depths(FULL, GRID, seen_planes([0.1]))
    assert (volume <= FULL).all()
    assert volume.min() >= -BAND


@pytest.mark.parametrize("albedo", [texture, plain])
def test_body_without_hollows_stays(albedo):
    views, coverages, photographs = photographed(ball(), albedo)
    body = visual_hull(views, coverages, OPTIONS)[0]
    assert carved(views, coverages, photographs, body) is None


@pytest.mark.stability
class TestHardCases:
    @pytest.mark.parametrize(
        "change",
        [
            lambda i, image: np.zeros_like(image),
            lambda i, image: np.full_like(image, 0.3),
            lambda i, image: np.full_like(image, np.nan),
            lambda i, image: np.random.default_rng(i).random(image.shape, np.float32),
        ],
        ids=["black", "equal", "not a number", "of nothing common"],
    )
    def test_nothing_is_carved_of_photographs_that_say_nothing(self, change, textured, hull):
        views, coverages, photographs = textured
        changed = [change(i, image) for i, image in enumerate(photographs)]
        assert carved(views, coverages, changed, hull) is None

    @pytest.mark.parametrize("scale", [1e-12, 1e12])
    def test_unit_of_radiance_and_exposures_do_not_matter(self, scale, textured, hull):
        views, coverages, photographs = textured
        changed = [
            np.float32(scale * (1 + i % 3)) * image for i, image in enumerate(photographs)
        ]
        body = carved(views, coverages, changed, hull)
        assert np.abs(heights(body.mesh) - INSIDE).max() < 0.03

    def test_views_that_are_all_alone_find_nothing(self, textured, hull):
        views = patch_views(*textured)
        alone = PatchStereo(views[:1] + views[6:7], RayScene(hull), [0, 1])
        for seen in alone.depths(None, "test"):
            assert np.isnan(seen.depth).all()
            assert not seen.confirmed.any()
