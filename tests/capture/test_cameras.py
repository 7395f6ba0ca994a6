"""Cameras: projection, rays and lens distortion."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from reflfield.capture.cameras import Camera, looking_at
from reflfield.capture.lenses import distort, largest_radius, undistort
from reflfield.errors import CaptureError, ShapeError

FISHEYE = (0.05, -0.01, 0.0, 0.0, 0.003, 0.001)
BARREL = (-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02)


def make_camera(kind="opencv", distortion=(0.0,) * 6, pose=None, **changes):
    numbers = {"width": 64, "height": 48, "fl_x": 70.0, "fl_y": 72.0, "cx": 31.0, "cy": 25.0}
    pose = np.eye(4) if pose is None else pose
    return Camera(
        "cam", kind, **(numbers | changes), camera_from_world=pose, distortion=distortion
    )


def random_pose(rng):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    pose[:3, 3] = rng.normal(size=3)
    return pose


def points_in_front(camera, rng, n=50):
    """World points at depths 1 .. 3 that project into the image."""
    pixels = rng.uniform((1, 1), (camera.width - 1, camera.height - 1), size=(n, 2))
    origins, directions = camera.rays(pixels)
    return origins + rng.uniform(1, 3, size=(n, 1)) * directions, pixels


class TestExact:
    def test_axis_point_lands_on_the_principal_point(self):
        pixels, depth = make_camera().project([[0.0, 0.0, 2.0]])
        assert pixels.tolist() == [[31.0, 25.0]]
        assert depth.tolist() == [2.0]

    def test_x_right_y_down(self):
        # (0.5, 0.25, 1): u = 70 * .5 + 31 = 66, v = 72 * .25 + 25 = 43
        pixels, _ = make_camera().project([[0.5, 0.25, 1.0]])
        assert pixels.tolist() == [[66.0, 43.0]]

    def test_centre_of_top_left_pixel_is_half_half(self, rounding):
        camera = make_camera(width=2, height=2, fl_x=1.0, fl_y=1.0, cx=1.0, cy=1.0)
        _, directions = camera.rays([[0.5, 0.5]])
        expected = np.array([-0.5, -0.5, 1.0]) / np.sqrt(1.5)
        np.testing.assert_allclose(directions[0], expected, rtol=rounding(np.float64))

    def test_orthographic_scale_is_pixels_per_metre(self, rounding):
        camera = make_camera("orthographic", fl_x=100.0, fl_y=100.0)
        pixels, depth = camera.project([[0.1, -0.05, -4.0]])
        np.testing.assert_allclose(pixels, [[41.0, 20.0]], rtol=rounding(np.float64))
        assert depth.tolist() == [-4.0]
        assert camera.view_directions([[5.0, 5.0, 5.0]]).tolist() == [[0.0, 0.0, -1.0]]

    def test_barrel_by_hand(self, rounding):
        # r^2 = 1/4, g = 1 - .2/4 = .95
        camera = make_camera(distortion=(-0.2, 0, 0, 0, 0, 0))
        pixels, _ = camera.project([[0.5, 0.0, 1.0]])
        tolerance = rounding(np.float64, scale=64)
        assert pixels[0, 0] == pytest.approx(31 + 70 * 0.5 * 0.95, abs=tolerance)

    def test_view_direction_points_to_the_camera(self):
        camera = make_camera(pose=looking_at([0, 0, 3], [0, 0, 0], [0, 1, 0]))
        assert camera.centre.tolist() == [0, 0, 3]
        assert camera.view_directions([[0, 0, 1]]).tolist() == [[0, 0, 1]]
        assert camera.up.tolist() == [0, 1, 0]
        assert camera.forward.tolist() == [0, 0, -1]

    def test_looking_straight_along_up_has_an_answer(self):
        pose = looking_at([0, 0, 3], [0, 0, 0], [0, 0, 1])
        np.testing.assert_array_equal(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
        assert pose[2, :3].tolist() == [0, 0, -1]

    def test_contains_what_has_a_pixel(self):
        corners = [[0, 0], [63.9, 47.9], [64, 0], [0, 48], [-0.1, 0], [np.nan, 1]]
        inside = make_camera().contains(corners)
        assert inside.tolist() == [True, True, False, False, False, False]


class TestFisheye:
    def test_equidistant_by_hand(self, rounding):
        # 45 degrees off the axis in x: f pi/4 from the middle
        pixels, depth = make_camera("opencv_fisheye").project([[1.0, 0.0, 1.0]])
        np.testing.assert_allclose(pixels, [[31 + 70 * np.pi / 4, 25]], rounding(np.float64))
        assert depth.tolist() == [1]

    def test_rays_by_hand(self, rounding):
        # 70 pi/3 pixels beside the middle: 60 degrees off the axis
        _, directions = make_camera("opencv_fisheye").rays([[31 + 70 * np.pi / 3, 25]])
        tolerance = rounding(np.float64)
        np.testing.assert_allclose(directions, [[3**0.5 / 2, 0, 0.5]], 0, tolerance)

    def test_steep_rays_and_those_beyond_90_degrees(self, rounding):
        camera = make_camera("opencv_fisheye")
        radii = 70 * np.radians([0.0, 89.9, 90.1, 170.0])
        pixels = np.stack([31 + radii, np.full(4, 25.0)], axis=1)
        _, directions = camera.rays(pixels)
        angles = np.degrees(np.arccos(directions[:2, 2]))
        half_of_the_digits = np.degrees(np.sqrt(rounding(np.float64)))  # arccos at 1
        np.testing.assert_allclose(angles, [0, 89.9], rtol=0, atol=half_of_the_digits)
        assert np.isnan(directions[2:]).all()
        assert np.isnan(camera.project([[1.0, 0, 0], [1, 0, -1]])[0]).all()

    def test_behind_the_fold_there_is_no_image(self, rounding):
        # theta - theta^3/3 folds at theta = 1
        camera = make_camera("opencv_fisheye", (-1 / 3, 0, 0, 0, 0, 0))
        pixels, _ = camera.project([[np.tan(0.99), 0, 1], [np.tan(1.01), 0, 1]])
        tolerance = rounding(np.float64, scale=78)
        assert pixels[0, 0] == pytest.approx(31 + 70 * (0.99 - 0.99**3 / 3), abs=tolerance)
        assert np.isnan(pixels[1]).all()
        _, directions = camera.rays([pixels[0], [31 + 70 * 0.67, 25]])
        tolerance = rounding(np.float64, condition=1 / (1 - 0.99**2))  # of theta
        assert directions[0, 2] == pytest.approx(np.cos(0.99), abs=tolerance)
        assert np.isnan(directions[1]).all()

    def test_lines_bend(self):
        assert not make_camera("opencv_fisheye").keeps_lines_straight
        assert make_camera().keeps_lines_straight
        assert not make_camera(distortion=BARREL).keeps_lines_straight

    def test_no_points(self):
        camera = make_camera("opencv_fisheye")
        assert camera.project(np.zeros((0, 3)))[0].shape == (0, 2)
        assert camera.rays(np.zeros((0, 2)))[1].shape == (0, 3)


class TestLaws:
    @pytest.mark.parametrize("kind", ["opencv", "opencv_fisheye", "orthographic"])
    @pytest.mark.parametrize("distortion", [(0.0,) * 6, BARREL])
    def test_points_on_rays_project_back(self, rng, rounding, kind, distortion):
        if kind == "opencv_fisheye" and any(distortion):
            distortion = FISHEYE
        camera = make_camera(kind, distortion, random_pose(rng))
        points, pixels = points_in_front(camera, rng)
        back, depth = camera.project(points)
        # pixels are ~64, the inverse lens stops at Newton's tolerance of 1e-9 focal lengths
        tolerance = rounding(np.float64, operations=50, scale=64) + 70 * 1e-9 * any(distortion)
        np.testing.assert_allclose(back, pixels, rtol=0, atol=tolerance)
        if kind != "orthographic":
            assert (depth > 0).all()

    def test_view_directions_oppose_rays(self, rng, rounding):
        camera = make_camera(distortion=BARREL, pose=random_pose(rng))
        points, pixels = points_in_front(camera, rng)
        _, directions = camera.rays(pixels)
        np.testing.assert_allclose(
            camera.view_directions(points), -directions, atol=rounding(np.float64, 20)
        )

    def test_world_frame_does_not_matter(self, rng, rounding):
        camera = make_camera(distortion=BARREL, pose=random_pose(rng))
        points, _ = points_in_front(camera, rng)
        new_from_old = random_pose(rng)
        moved = points @ new_from_old[:3, :3].T + new_from_old[:3, 3]
        pose = camera.camera_from_world @ np.linalg.solve(new_from_old, np.eye(4))
        same, _ = make_camera(distortion=BARREL, pose=pose).project(moved)
        expected, _ = camera.project(points)
        np.testing.assert_allclose(same, expected, atol=rounding(np.float64, 50, scale=300))

    @given(
        k1=st.floats(-0.4, 0.4),
        k2=st.floats(-0.1, 0.1),
        k4=st.floats(-0.05, 0.3),
        radius=st.floats(0, 0.95),
        angle=st.floats(0, 6.3),
    )
    @settings(max_examples=60, deadline=None)
    def test_undistort_inverts_distort(self, k1, k2, k4, radius, angle):
        distortion = (k1, k2, 0.0, 0.0, 0.0, k4)
        r = radius * min(largest_radius(distortion), 2.0)
        ideal = np.array([[r * np.cos(angle), r * np.sin(angle)]])
        back = undistort(distort(ideal, distortion), distortion)
        # near the fold the inverse's condition grows without bound; .95 of it costs ~1e2
        np.testing.assert_allclose(back, ideal, atol=1e-6)


@pytest.mark.reference
class TestOpenCV:
    @pytest.mark.parametrize(
        "distortion",
        [
            (0.0,) * 6,
            BARREL,
            (0.3, -0.1, 0, 0.01, 0.02, 0),
            (0.1, -0.05, 0.01, -0.02, 0.01, 0.2, -0.01, 0.005),
        ],
    )
    def test_projection(self, rng, rounding, distortion):
        camera = make_camera(distortion=distortion, pose=random_pose(rng))
        points, _ = points_in_front(camera, rng)
        pose = camera.camera_from_world
        turned, _ = cv2.Rodrigues(pose[:3, :3])
        expected, _ = cv2.projectPoints(
            points, turned, pose[:3, 3], camera.matrix, np.array(camera.distortion)
        )
        pixels, _ = camera.project(points)
        # Rodrigues' round trip costs a few hundred roundings
        tolerance = rounding(np.float64, operations=1000, scale=64)
        np.testing.assert_allclose(pixels, expected[:, 0], rtol=0, atol=tolerance)

    def test_undistortion(self, rng):
        camera = make_camera(distortion=BARREL)
        pixels = rng.uniform((0, 0), (64, 48), size=(40, 2))
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-14)
        expected = cv2.undistortPoints(
            pixels[:, None], camera.matrix, np.array([*BARREL, 0, 0]), criteria=criteria
        )[:, 0]
        _, directions = camera.rays(pixels)
        # OpenCV's fixed-point iteration stops at about 1e-9
        np.testing.assert_allclose(directions[:, :2] / directions[:, 2:], expected, atol=1e-8)


@pytest.mark.stability
class TestExtremes:
    def test_points_at_and_behind_the_camera_have_no_pixel(self):
        camera = make_camera(distortion=BARREL)
        pixels, depth = camera.project([[0.1, 0, 0], [0.1, 0, -1], [0, 0, 0], [0, 0, 1]])
        assert depth.tolist() == [0, -1, 0, 1]
        assert np.isnan(pixels[:3]).all()
        assert np.isfinite(pixels[3]).all()
        assert camera.contains(pixels).tolist() == [False, False, False, True]

    def test_folded_lens_does_not_bring_outside_points_into_the_image(self):
        # r - r^3 folds at r = .577; at r = 1 it is 0 again: the principal point.
        camera = make_camera(distortion=(-1.0, 0, 0, 0, 0, 0))
        pixels, _ = camera.project([[1.0, 0.0, 1.0], [0.5, 0.0, 1.0]])
        assert np.isnan(pixels[0]).all()
        assert pixels[1, 0] == pytest.approx(31 + 70 * 0.375)

    def test_pixels_beyond_the_fold_have_no_ray(self):
        camera = make_camera(distortion=(-1.0, 0, 0, 0, 0, 0))
        _, directions = camera.rays([[31.0 + 70 * 0.5, 25.0], [31.0 + 70 * 0.3, 25.0]])
        assert np.isnan(directions[0]).all()
        assert np.linalg.norm(directions[1]) == pytest.approx(1)

    def test_pole_of_the_rational_model_is_a_limit(self):
        assert largest_radius((0, 0, 0, 0, 0, -0.25)) == pytest.approx(2.0)
        assert largest_radius((0.1, 0.1, 0, 0, 0, 0)) == np.inf

    @pytest.mark.parametrize("scale", [1e-6, 1e6, 1e12])
    def test_relative_error_does_not_grow_with_scale(self, rng, rounding, scale):
        camera = make_camera(distortion=BARREL)
        points, pixels = points_in_front(camera, rng)
        scaled, _ = camera.project(points * scale)
        tolerance = rounding(np.float64, 50, scale=64) + 70 * 1e-9
        np.testing.assert_allclose(scaled, pixels, rtol=0, atol=tolerance)

    def test_grazing_point_overflows_quietly(self):
        pixels, _ = make_camera().project([[1e300, 0, 1e-300]])
        assert not make_camera().contains(pixels).any()

    def test_no_points(self):
        pixels, depth = make_camera(distortion=BARREL).project(np.zeros((0, 3)))
        assert pixels.shape == (0, 2)
        assert depth.shape == (0,)
        assert make_camera(distortion=BARREL).rays(np.zeros((0, 2)))[1].shape == (0, 3)


def sheared():
    pose = np.eye(4)
    pose[0, 1] = 0.5
    return pose


class TestRefused:
    @pytest.mark.parametrize(
        ("pose", "reason"),
        [
            (np.diag([1.0, 1.0, 0.0, 1.0]), "singular matrix"),
            (np.diag([2.0, 2.0, 2.0, 1.0]), "scale or shear"),
            (sheared(), "scale or shear"),
            (np.diag([1.0, 1.0, -1.0, 1.0]), "mirrored"),
            (np.full((4, 4), np.nan), "not finite"),
            (np.ones((4, 4)), "last row"),
            (np.eye(3), r"shape \(4, 4\)"),
        ],
    )
    def test_pose(self, pose, reason):
        with pytest.raises(CaptureError, match=f"camera 'cam'.*camera_from_world.*{reason}"):
            make_camera(pose=pose)

    @pytest.mark.parametrize(
        ("changes", "reason"),
        [
            ({"fl_x": 0.0}, "singular.*fl_x"),
            ({"fl_y": -5.0}, "fl_y > 0"),
            ({"fl_x": 1e-3}, "in pixels, of at least .* are they millimetres"),
            ({"width": 0}, "1 x 1 pixels"),
            ({"cx": float("inf")}, "finite intrinsics"),
            ({"distortion": (0.0,) * 9}, "8 distortion"),
            ({"kind": "fisheye"}, "'fisheye'"),
        ],
    )
    def test_intrinsics(self, changes, reason):
        with pytest.raises(CaptureError, match=f"camera 'cam'.*{reason}"):
            make_camera(**changes)

    def test_shapes(self):
        with pytest.raises(ShapeError, match="points"):
            make_camera().project([1.0, 2.0, 3.0])
        with pytest.raises(ShapeError, match="pixels"):
            make_camera().rays([[1.0, 2.0, 3.0]])

    def test_looking_at_itself(self):
        with pytest.raises(CaptureError, match="coincide"):
            looking_at([1, 1, 1], [1, 1, 1], [0, 0, 1])

    def test_pose_is_read_only(self):
        with pytest.raises(ValueError, match="read-only"):
            make_camera().camera_from_world[0, 0] = 2
