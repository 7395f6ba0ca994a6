"""Poses written in another convention than the format's are noticed from the file alone."""

import numpy as np
import pytest

from reflfield.capture.cameras import Camera, looking_at
from reflfield.capture.pose_convention import check_poses
from reflfield.errors import CaptureError

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def dome(rng, n=12, target=(0.1, -0.2, 0.05)):
    """`camera_from_world` of cameras on a hemisphere that look near a target."""
    directions = rng.normal(size=(n, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    aims = target + 0.02 * rng.normal(size=(n, 3))
    pairs = zip(aims, directions, strict=True)
    return np.array([looking_at(aim + 2 * d, aim, (0, 0, 1)) for aim, d in pairs])


def cameras(poses, kind="opencv"):
    return [Camera(f"v{i}", kind, 8, 8, 8.0, 8.0, 4.0, 4.0, m) for i, m in enumerate(poses)]


def inverted(poses):
    return np.linalg.solve(poses, np.broadcast_to(np.eye(4), poses.shape))


def test_a_dome_passes(rng):
    check_poses(cameras(dome(rng)), "capture.json")


def test_a_dome_far_from_the_origin_passes(rng):
    check_poses(cameras(dome(rng, target=(4e5, 5e6, 100.0))), "capture.json")


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (inverted, "exchanged in OpenCV axes"),
        (lambda m: OPENGL @ m, "the camera axes are the other ones"),
        (lambda m: inverted(OPENGL @ m), "exchanged in OpenGL axes"),
        # what a reader of OpenGL camera-to-world makes of OpenCV and OpenGL world-to-camera
        (lambda m: OPENGL @ inverted(m), "exchanged in OpenCV axes"),
        (lambda m: OPENGL @ inverted(OPENGL @ m), "exchanged in OpenGL axes"),
    ],
)
def test_another_convention_is_named(rng, mistake, words):
    # 12 cameras at 2 m that aim within 4 cm of a point .23 m off the origin
    poses = dome(rng)
    with pytest.raises(CaptureError, match=rf"capture\.json: .*12 cameras.*{words}"):
        check_poses(cameras(mistake(poses)), "capture.json")


@pytest.mark.parametrize("n", [1, 3])
def test_few_cameras_are_left_alone(rng, n):
    check_poses(cameras(inverted(dome(rng, n))), "capture.json")


def test_parallel_and_orthographic_cameras_are_left_alone(rng):
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = np.arange(6)
    check_poses(cameras(poses), "capture.json")
    check_poses(cameras(inverted(dome(rng)), "orthographic"), "capture.json")


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (inverted, "exchanged in OpenCV axes"),
        (lambda m: OPENGL @ m, "the camera axes are the other ones"),
        (lambda m: OPENGL @ inverted(m), "exchanged in OpenCV axes"),
    ],
)
def test_another_convention_of_cameras_on_rings_is_named(mistake, words):
    # Inverted, the cameras of a ring stand in one point each, and three points look at each
    # other: with that counted, the first passed and the second was called an exchange.
    poses = [
        looking_at((2 * np.cos(a) * np.cos(e), 2 * np.sin(a) * np.cos(e), 2 * np.sin(e)),
                   (0.0, 0.0, 0.3), (0, 0, 1))
        for e in np.radians([0.0, 25.0, 50.0])
        for a in np.arange(6)
    ]  # fmt: skip
    check_poses(cameras(poses), "capture.json")
    with pytest.raises(CaptureError, match=rf"18 cameras.*{words}"):
        check_poses(cameras(mistake(np.array(poses))), "capture.json")
