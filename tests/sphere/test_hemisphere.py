"""Hemisphere grids: equal area, inverse maps, partition of unity, poles and horizon."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reflfield.errors import InputError, ShapeError
from reflfield.sphere.hemisphere import (
    HORIZON_SOFTNESS,
    HemisphereGrid,
    direction_from_square,
    softened_cosine,
    softened_cosine_of,
    square_from_xyz,
)


def square_from_direction(directions):
    """(n, 2) square coordinates of directions (n, 3)."""
    return np.array([square_from_xyz(*d) for d in directions])


def upper(rng, n):
    d = rng.normal(size=(n, 3))
    d[:, 2] = np.abs(d[:, 2])
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_maps_are_inverse(rng, rounding):
    d = upper(rng, 10_000)
    back = direction_from_square(square_from_direction(d))
    # z = 1 - r^2 loses half the digits of the polar angle near the zenith.
    assert np.abs(back - d).max() < np.sqrt(rounding(np.float64))


def test_map_is_equal_area(rng):
    d = upper(rng, 200_000)
    counts, _, _ = np.histogram2d(*square_from_direction(d).T, bins=8, range=[[-1, 1]] * 2)
    expected = len(d) / 64
    # Chi-square with 63 degrees of freedom: 63 + 6 sigma.
    assert ((counts - expected) ** 2 / expected).sum() < 63 + 6 * np.sqrt(2 * 63)


@given(st.integers(1, 40))
def test_solid_angles_sum_to_hemisphere(side):
    # Roundings of side^2 additions wander as the root of their number.
    tolerance = 8 * np.finfo(float).eps * side
    np.testing.assert_allclose(
        HemisphereGrid(side).solid_angles.sum(), 2 * np.pi, rtol=tolerance
    )


@pytest.mark.parametrize("side", [1, 2, 3, 9, 25])
def test_taps_reproduce_nodes_and_sum_to_one(side, rng):
    grid = HemisphereGrid(side)
    values = rng.normal(size=grid.n_nodes)
    nodes, weights = grid.taps(grid.directions)
    # sqrt(eps) from the map at the zenith, times the node spacing.
    assert np.allclose((values[nodes] * weights).sum(1), values, atol=1e-6 * side)
    nodes, weights = grid.taps(upper(rng, 1000))
    assert np.abs(weights.sum(1) - 1).max() < 4 * np.finfo(np.float32).eps
    assert (weights >= 0).all()
    assert nodes.min() >= 0
    assert nodes.max() < max(grid.n_nodes, 4)


def test_interpolation_error_falls_with_the_spacing(rng):
    d = upper(rng, 4000)

    def error(side):
        grid = HemisphereGrid(side)
        nodes, weights = grid.taps(d)
        return np.sqrt(
            np.mean(((grid.directions[:, 2][nodes] * weights).sum(1) - d[:, 2]) ** 2)
        )

    slope = np.log(error(9) / error(33)) / np.log(32 / 8)
    # Second order, less what the map's creases on the diagonals cost (z = 1 - max(u, v)^2).
    assert 1.5 < slope < 2.3


def test_below_the_horizon_reads_the_horizon():
    d = np.array([[0.6, 0.0, -0.8], [1.0, 0.0, 0.0]])
    below, horizon = square_from_direction(d)
    assert np.array_equal(below, horizon)


@pytest.mark.stability
def test_zenith_and_its_neighbourhood_are_finite():
    tiny = np.array([[0, 0, 1.0], [1e-13, 1e-13, 1.0], [1e-300, 0, 1.0], [0, -1e-9, 1.0]])
    assert np.isfinite(square_from_direction(tiny)).all()


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="side"):
        HemisphereGrid(0)
    with pytest.raises(ShapeError, match="directions"):
        HemisphereGrid(3).taps(np.zeros((3, 2)))


class TestSoftenedCosine:
    @given(st.floats(-1, 1))
    def test_is_the_cosine_or_a_foot_above_it(self, z):
        value = float(softened_cosine(np.array(z)))
        # Between max(z, 0) and a quarter of the softness above it, at the horizon itself.
        assert max(z, 0) <= value <= max(z, 0) + HORIZON_SOFTNESS / 4 * (1 + 1e-15)
        if z >= HORIZON_SOFTNESS:
            assert value == z
        if z <= -HORIZON_SOFTNESS:
            assert value == 0

    @settings(deadline=None)  # the kernel is compiled at the first call
    @given(st.floats(-1, 1))
    def test_of_one_number_is_that_of_arrays(self, z):
        # fused multiply-adds may round once less
        assert np.isclose(softened_cosine_of(z), softened_cosine(np.array(z)), rtol=1e-14)

    def test_value_and_slope_are_continuous(self):
        z = np.linspace(-2 * HORIZON_SOFTNESS, 2 * HORIZON_SOFTNESS, 4001)
        step = z[1] - z[0]
        slope = np.diff(softened_cosine(z)) / step
        assert slope.min() >= 0
        assert slope.max() <= 1 + 1e-12
        # The second derivative is 1 / 2w inside the band.
        assert np.abs(np.diff(slope)).max() < 1.01 * step / (2 * HORIZON_SOFTNESS)

    def test_keeps_the_dtype(self):
        assert softened_cosine(np.zeros(2, np.float32)).dtype == np.float32
