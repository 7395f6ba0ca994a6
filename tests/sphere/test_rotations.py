"""Rotations: conventions, inverses, degenerate frames."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.sphere.rotations import (
    frames_from_normals,
    matrix_from_euler,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_angle,
)


@pytest.mark.reference
def test_euler_is_the_product_of_axis_rotations(rng, rounding):
    a, b, c = rng.uniform(-3, 3, (3, 50))
    about_z, about_y = np.array([0, 0, 1.0]), np.array([0, 1.0, 0])

    def turn(angles, axis):
        return Rotation.from_rotvec(angles[:, None] * axis)

    expected = (turn(a, about_z) * turn(b, about_y) * turn(c, about_z)).as_matrix()
    assert np.allclose(matrix_from_euler(a, b, c), expected, rtol=0, atol=rounding(float, 10))


def test_quaternions_round_trip_with_positive_scalar(rng, rounding):
    m = Rotation.random(200, random_state=rng).as_matrix().reshape(10, 20, 3, 3)
    q = quaternion_from_matrix(m)
    assert q.shape == (10, 20, 4)
    assert (q[..., 0] >= 0).all()
    assert np.allclose(matrix_from_quaternion(q), m, rtol=0, atol=rounding(float, 10))


@pytest.mark.stability
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, np.pi])
def test_angle_is_accurate_at_its_ends(angle, rounding):
    got = rotation_angle(matrix_from_euler(0.0, angle, 0.0))
    assert abs(got - angle) < rounding(float, 4, scale=np.pi)


@pytest.mark.stability
def test_frames_survive_hints_along_the_normal(rng, rounding):
    n = rng.normal(size=(100, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    hints = np.concatenate([n[:50], np.zeros((25, 3)), rng.normal(size=(25, 3))])
    f = frames_from_normals(n, hints)
    assert np.allclose(f @ f.transpose(0, 2, 1), np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(f), 1)
    assert np.allclose(f[:, 2], n)
