"""Small rotations of the kernels against SciPy's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment.rotation_steps import copy_nearest, cosine_between, rotate_right

HALF_TURN = np.diag([-1.0, -1.0, 1.0])


@pytest.mark.parametrize("length", [0.0, 1e-9, 1e-4, 0.5, 3.0])
def test_a_step_from_the_right_is_a_product_with_its_exponential(length, rounding):
    start = Rotation.random(random_state=1).as_matrix()
    step, out = length * np.array([0.48, -0.6, 0.64]), np.zeros((3, 3))
    rotate_right(start, step, out)
    expected = start @ Rotation.from_rotvec(step).as_matrix()
    np.testing.assert_allclose(out, expected, atol=rounding(np.float64, operations=8))


def test_angles_between_rotations_count_half_turns_only_where_they_are_equal(rounding):
    one = Rotation.random(random_state=2).as_matrix()
    other = one @ Rotation.from_rotvec([0.3, -0.2, 2.5]).as_matrix()
    plain, turned = (
        np.cos(Rotation.from_matrix(one.T @ b).magnitude()) for b in (other, other @ HALF_TURN)
    )
    tolerance = rounding(np.float64, operations=9)
    assert plain + 0.1 < turned
    assert cosine_between(one, other, False) == pytest.approx(plain, abs=tolerance)
    assert cosine_between(one, other, True) == pytest.approx(max(plain, turned), abs=tolerance)
    half = other @ HALF_TURN
    assert cosine_between(one, half, False) == pytest.approx(turned, abs=tolerance)
    assert cosine_between(one, half, True) == pytest.approx(max(plain, turned), abs=tolerance)


@pytest.mark.parametrize("half_turn", [False, True])
def test_the_nearer_of_a_rotation_and_its_half_turn_is_copied(half_turn):
    near = Rotation.random(random_state=3).as_matrix()
    source = near @ Rotation.from_rotvec([0.01, 0.02, 0.1]).as_matrix()
    for rotation in (source, source @ HALF_TURN):
        out = near.copy()
        copy_nearest(rotation, half_turn, out)
        np.testing.assert_array_equal(out, source if half_turn else rotation)
