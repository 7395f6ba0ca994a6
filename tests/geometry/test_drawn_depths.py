"""Depth images that are drawn triangle by triangle, against rays and against formulas."""

import numpy as np
import pytest
import trimesh

from reflfield.capture.cameras import Camera
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.ray_kernels import draw_nearest
from reflfield.geometry.ray_scene import RayScene

# Embree's single precision, on a mesh of unit diagonal a few diagonals away.
RAY_ERROR = 64 * np.finfo(np.float32).eps


def traced(scene, camera):
    """Depths (height, width) by a ray through the centre of each pixel."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    return scene.pixel_depths(camera, pixels).reshape(y.shape)


def rays_fail(*_):
    raise AssertionError("expected no ray")


@pytest.mark.parametrize("shape", ["ball", "torus", "box", "open half"])
@pytest.mark.parametrize("distance", [1.6, 5.0])
def test_drawn_depths_are_those_of_rays(shape, distance, monkeypatch):
    made = {
        "ball": trimesh.creation.icosphere(3),
        "torus": trimesh.creation.torus(0.8, 0.3),
        "box": trimesh.creation.box([1.0, 0.7, 1.2]),
        "open half": trimesh.creation.icosphere(3),
    }[shape]
    faces = np.asarray(made.faces)
    if shape == "open half":
        faces = faces[made.triangles_center[:, 2] > 0.1]
    scene = RayScene(Mesh(np.asarray(made.vertices), faces))
    rng = np.random.default_rng(3)
    for towards in rng.standard_normal((6, 3)):
        position = distance * towards / np.linalg.norm(towards)
        camera = Camera.look_at(position, 0.1 * towards[::-1], width=90, height=70, fov_deg=50)
        expected = traced(scene, camera)
        with monkeypatch.context() as patch:
            patch.setattr(RayScene, "pixel_depths", rays_fail)
            drawn = scene.row_depths(camera, 0, 70)
        # At the outline rounding may decide; pixel centres are at random places here.
        assert np.array_equal(np.isfinite(drawn), np.isfinite(expected))
        shown = np.isfinite(drawn)
        assert shown.sum() > 200
        np.testing.assert_allclose(drawn[shown], expected[shown], atol=RAY_ERROR * distance)


@pytest.mark.stability
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_depths_of_a_plane_follow_its_formula(scale):
    """A tilted square that fills the image, with corners far beyond the image."""
    corners = np.array([[-40.0, -40, -6], [40, -40, 14], [40, 40, 14], [-40, 40, -6]]) * scale
    square = Mesh(corners + np.array([0, 0, 20 * scale]), [[0, 1, 2], [0, 2, 3]])
    camera = Camera("v", "opencv", 64, 48, 60.0, 55.0, 30.0, 25.0, np.eye(4))
    drawn = RayScene(square).row_depths(camera, 0, 48)
    y, x = np.mgrid[:48, :64] + 0.5
    across, down = (x - 30.0) / 60.0, (y - 25.0) / 55.0
    # z = (24 + x / 4) of the scale on the square, and x = across * z.
    z = 24.0 * scale / (1.0 - across / 4.0)
    slant = np.sqrt(1.0 + across**2 + down**2)
    # A few roundings of numbers up to some thousand pixels, over a depth that varies fourfold.
    np.testing.assert_allclose(drawn, z * slant, rtol=1e5 * np.finfo(np.float64).eps)


@pytest.mark.stability
def test_edges_through_pixel_centres_leave_no_crack():
    n = 17
    y, x = np.mgrid[:n, :n] + 0.5
    vertices = np.stack([x.ravel(), y.ravel(), np.ones(n * n)], axis=1)
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([first, first + 1, first + n + 1], axis=1),
            np.stack([first, first + n + 1, first + n], axis=1),
        ]
    ).astype(np.int32)
    for turned in (faces, faces[:, ::-1].copy()):
        out = np.zeros((n + 2, n + 2))
        draw_nearest(vertices, turned, -1, -1, out)
        assert np.array_equal(out[1:-1, 1:-1], np.ones((n, n)))
        assert out.sum() == n * n


@pytest.mark.stability
def test_triangles_without_area_or_far_off_the_image_draw_nothing():
    vertices = np.array(
        [[1.0, 1, 1], [5, 5, 1], [9, 9, 1], [1e300, 1e300, 1], [np.inf, 0, 1], [2, 7, 1]]
    )
    faces = np.array([[0, 1, 2], [0, 0, 5], [4, 1, 5], [3, 3, 3]], np.int32)
    out = np.zeros((10, 10))
    draw_nearest(vertices, faces, 0, 0, out)
    assert not out.any()


def test_the_nearest_of_several_triangles_is_kept_in_any_order():
    corners = np.array([[-1.0, -1], [9, -1], [-1, 9]])
    near, far = (np.column_stack([corners, np.full(3, nearness)]) for nearness in (0.5, 0.25))
    vertices = np.concatenate([near, far])
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    for order in (faces, faces[::-1].copy()):
        out = np.zeros((3, 3))
        draw_nearest(vertices, order, 0, 0, out)
        assert np.array_equal(out, np.full((3, 3), 0.5))
