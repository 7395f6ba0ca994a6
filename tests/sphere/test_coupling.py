from math import factorial, sqrt

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.errors import InputError, ShapeError
from reflfield.sphere.coupling import (
    channels,
    clebsch_gordan,
    couple,
    real_coupling,
    rotate_coupled,
    uncouple,
)
from reflfield.sphere.wigner import block_offsets, rotation_blocks


def racah(l1, m1, l2, m2, j, m):
    """<l1 m1 l2 m2 | j m> by Racah's sum, integers as far as possible."""
    f = factorial
    front = (2 * j + 1) * f(l1 + l2 - j) * f(l1 - l2 + j) * f(-l1 + l2 + j) / f(l1 + l2 + j + 1)
    front *= f(j + m) * f(j - m) * f(l1 - m1) * f(l1 + m1) * f(l2 - m2) * f(l2 + m2)
    total = 0.0
    for k in range(l1 + l2 - j + 1):
        parts = [k, l1 + l2 - j - k, l1 - m1 - k, l2 + m2 - k, j - l2 + m1 + k, j - l1 - m2 + k]
        if min(parts) >= 0:
            product = 1
            for part in parts:
                product *= f(part)
            total += (-1) ** k / product
    return sqrt(front) * total


@pytest.mark.reference
@pytest.mark.parametrize(("l1", "l2"), [(0, 0), (1, 1), (2, 1), (1, 3), (4, 4)])
def test_coefficients_match_racah(l1, l2, rounding):
    table = clebsch_gordan(l1, l2)
    tolerance = rounding(float, operations=9 * 6)  # terms of Racah's sum, and factors of each
    for j in range(abs(l1 - l2), l1 + l2 + 1):
        for m in range(-j, j + 1):
            for m1 in range(-l1, l1 + 1):
                m2 = m - m1
                if abs(m2) <= l2:
                    got = table[j * j - (l1 - l2) ** 2 + j + m, m1 + l1, m2 + l2]
                    expected = racah(l1, m1, l2, m2, j, m)
                    assert got == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize(("l1", "l2"), [(0, 5), (3, 3), (7, 2), (15, 15)])
def test_real_coupling_is_orthogonal(l1, l2, rounding):
    matrix = real_coupling(l1, l2)
    error = np.abs(matrix @ matrix.T - np.eye(len(matrix))).max()
    assert error < rounding(np.float64, operations=2 * (l1 + l2) + 2)


@pytest.mark.parametrize("limits", [(4, 4), (6, 3), (1, 5), (5, 1), (1, 1)])
def test_coupled_blocks_turn_by_one_matrix_per_degree(limits, rng, rounding):
    a = rng.standard_normal((2, limits[0] ** 2, limits[1] ** 2))
    turn = Rotation.random(1, random_state=7).as_matrix()
    flat, offsets = rotation_blocks(turn, max(limits))[0], block_offsets(max(limits))
    sides = []
    for limit in limits:
        side = np.zeros((limit**2, limit**2))
        for j in range(limit):
            part = slice(j * j, (j + 1) ** 2)
            side[part, part] = flat[offsets[j] : offsets[j + 1]].reshape(2 * j + 1, -1)
        sides.append(side)
    direct = couple(sides[0] @ a @ sides[1].T)
    coupled = rotate_coupled(couple(a), rotation_blocks(turn, sum(limits) - 1))
    for x, y in zip(direct.blocks, coupled.blocks, strict=True):
        np.testing.assert_allclose(x, y, atol=rounding(np.float64, 100))


def test_coupling_keeps_norms_and_is_undone(rng, rounding):
    a = rng.standard_normal((3, 25, 16))
    coupled = couple(a)
    sums = rounding(np.float64, 50)
    np.testing.assert_allclose(coupled.norms(), np.linalg.norm(a, axis=(1, 2)), rtol=sums)
    np.testing.assert_allclose(uncouple(coupled), a, atol=sums)


def test_number_of_coefficients_is_kept():
    for limits in [(8, 8), (5, 2)]:
        n = sum((2 * j + 1) * len(pairs) for j, pairs in enumerate(channels(limits)))
        assert n == limits[0] ** 2 * limits[1] ** 2


def test_wrong_sizes_are_refused():
    with pytest.raises(ShapeError, match="coefficients"):
        couple(np.zeros((1, 5, 4)))
    with pytest.raises(InputError, match="L_view"):
        couple(np.zeros((1, 17**2, 4)))
