"""Rotations: conventions, inverses, degenerate frames."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.sphere.rotations import (
    frames_from_normals,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_angle,
)


def test_quaternions_round_trip_with_positive_scalar(rng, rounding):
    m = Rotation.random(200, random_state=rng).as_matrix().reshape(10, 20, 3, 3)
    q = quaternion_from_matrix(m)
    assert q.shape == (10, 20, 4)
    assert (q[..., 0] >= 0).all()
    assert np.allclose(matrix_from_quaternion(q), m, rtol=0, atol=rounding(float, 10))


@pytest.mark.stability
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, np.pi])
def test_angle_is_accurate_at_its_ends(angle, rounding):
    got = rotation_angle(Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix())
    assert abs(got - angle) < rounding(float, 4, scale=np.pi)


@pytest.mark.stability
def test_frames_survive_hints_along_the_normal(rng, rounding):
    n = rng.normal(size=(100, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    hints = np.concatenate([n[:50], np.zeros((25, 3)), rng.normal(size=(25, 3))])
    f = frames_from_normals(n, hints)
    tolerance = rounding(float, operations=3)
    assert np.abs(f @ f.transpose(0, 2, 1) - np.eye(3)).max() < tolerance
    assert np.abs(np.linalg.det(f) - 1).max() < tolerance
    assert np.abs(f[:, 2] - n).max() < tolerance
