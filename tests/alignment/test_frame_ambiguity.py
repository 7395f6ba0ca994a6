"""Symmetries told from a target's energy by order, and rotations nearest to the identity."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment.frame_ambiguity import (
    Symmetry,
    mean_rotation,
    reduce_to_fundamental_zone,
    symmetry_about_normal,
    twist,
)
from reflfield.sphere.coupling import couple

LIMIT = 5
ORDERS = np.arange(LIMIT**2) - np.floor(np.sqrt(np.arange(LIMIT**2))) ** 2
ORDERS = np.abs(ORDERS - np.floor(np.sqrt(np.arange(LIMIT**2)))).astype(int)


def target_of_orders(rng, kept):
    """A function of two directions whose sums of orders pass `kept`."""
    values = rng.standard_normal((1, LIMIT**2, LIMIT**2))
    pairs = [kept(a, b) for a in ORDERS for b in ORDERS]
    return couple(values * np.reshape(pairs, values.shape[1:]))


@pytest.mark.parametrize(
    ("kept", "kind"),
    [
        (lambda a, b: a == b == 0, "all"),
        (lambda a, b: (a + b) % 2 == 0, "half"),
        (lambda a, b: True, "none"),
        (lambda a, b: (a + b) % 2 == 1, "none"),
    ],
)
def test_symmetry_is_that_of_the_orders_that_hold_energy(kept, kind, rng):
    assert symmetry_about_normal(target_of_orders(rng, kept)).kind == kind


def test_a_little_of_what_breaks_a_symmetry_is_noise_and_more_is_not(rng):
    round_one = target_of_orders(rng, lambda a, b: a == b == 0)
    rest = target_of_orders(rng, lambda a, b: (a + b) % 2 == 0)
    for share, kind in ((1e-4, "all"), (1.0, "half")):
        parts = zip(round_one.blocks, rest.blocks, strict=True)
        mixed = type(rest)(rest.band_limits, tuple(a + share * b for a, b in parts))
        assert symmetry_about_normal(mixed).kind == kind


@pytest.mark.parametrize("angle", [-3.0, -1.0, 0.0, 0.7, 2.5])
def test_twists_and_the_rotations_without_them(angle, rounding):
    tilt = Rotation.from_rotvec([0.3, -0.2, 0.0])
    rotation = (tilt * Rotation.from_rotvec([0, 0, angle])).as_matrix()[None]
    tolerance = rounding(np.float64, operations=16)
    assert twist(rotation)[0] == pytest.approx(angle, abs=tolerance)
    none, half, whole = (
        reduce_to_fundamental_zone(rotation, Symmetry(kind)) for kind in ("none", "half", "all")
    )
    np.testing.assert_array_equal(none, rotation)
    np.testing.assert_allclose(whole[0], tilt.as_matrix(), atol=tolerance)
    nearest = (angle + np.pi / 2) % np.pi - np.pi / 2
    assert twist(half)[0] == pytest.approx(nearest, abs=tolerance)
    np.testing.assert_allclose(half[0, :, 2], rotation[0, :, 2], atol=tolerance)


def test_the_mean_of_rotations_is_a_rotation_near_all_of_them(rng):
    centre = Rotation.random(random_state=4)
    near = centre * Rotation.from_rotvec(0.1 * rng.standard_normal((200, 3)))
    mean = mean_rotation(near.as_matrix(), np.ones(200))
    assert np.linalg.det(mean) == pytest.approx(1.0)
    # The spread over the root of the count, three times.
    assert (centre.inv() * Rotation.from_matrix(mean)).magnitude() < 0.1 * np.sqrt(3 / 200) * 3
