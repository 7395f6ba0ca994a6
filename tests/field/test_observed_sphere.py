"""Functions of direction are what they were where observed, and nearest values elsewhere."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.field.observed_sphere import (
    LARGEST_GAP,
    MOST_OBSERVED,
    bounded_table,
    covered,
    distinct_directions,
    interpolate,
)


def ring(elevation_deg, n, offset_deg=0.0):
    azimuth = np.radians(offset_deg + 360 * np.arange(n) / n)
    level = np.radians(elevation_deg) * np.ones(n)
    level_ring = np.cos(level)
    x, y = level_ring * np.cos(azimuth), level_ring * np.sin(azimuth)
    return np.stack([x, y, np.sin(level)], axis=1)


DOME = np.concatenate([ring(12, 12), ring(40, 9, 10), ring(70, 5), [[0, 0, 1]]])


def smooth(directions):
    """Two functions, of degrees 1 and 3."""
    x, y, z = np.asarray(directions, np.float64).T
    return np.stack([2 + z, 5 * z**3 - 3 * z + x * y], axis=1).astype(np.float32)


def random_directions(rng, n):
    towards = rng.standard_normal((n, 3))
    return towards / np.linalg.norm(towards, axis=1, keepdims=True)


def test_functions_are_unchanged_between_observed_directions(rng):
    towards = random_directions(rng, 3000)
    inside = towards[covered(towards, DOME)]
    # Well inside: a cell of the table (2 degrees) from the border mixes both sides.
    inside = inside[inside[:, 2] > np.sin(np.radians(15))]
    assert len(inside) > 900
    off = interpolate(bounded_table(smooth, DOME), inside) - smooth(inside)
    # Bilinear on steps h = pi / 90: h^2 / 8 times second derivatives, at most 30 of degree 3.
    assert np.abs(off).max() < 30 * (np.pi / 90) ** 2 / 8


def test_functions_stay_in_the_range_of_what_was_observed(rng):
    """The cubic falls to -2 below; observed were values above its minimum on the dome."""
    table = bounded_table(smooth, DOME)
    sampled = random_directions(rng, 20000)
    above = smooth(sampled[covered(sampled, DOME)])
    everywhere = interpolate(table, sampled)
    # A cell's interpolation error, as above.
    slack = 30 * (np.pi / 90) ** 2 / 8
    assert np.all(everywhere >= above.min(axis=0) - slack)
    assert np.all(everywhere <= above.max(axis=0) + slack)
    assert smooth([[0, 0, -1.0]])[0, 0] < above.min(axis=0)[0] - 0.5  # would have left it


def test_below_a_dome_the_nearest_light_counts(rounding):
    table = bounded_table(lambda d: np.asarray(d[:, :1], np.float32), ring(12, 12))
    for elevation in (-10, -30, -50):
        (value,) = interpolate(table, ring(elevation, 1))[0]
        # Towards +X: the light at +X, or between it and its neighbours 30 degrees aside.
        assert np.cos(np.radians(12)) * np.cos(np.radians(30)) < value <= 1.0
    # Straight below all are as near: their mean, of twelve.
    mean = interpolate(table, [[0, 0, -1.0]])[0, 0]
    assert abs(mean) < rounding(np.float32, operations=12)


def test_values_vary_smoothly_over_the_gap():
    table = bounded_table(smooth, DOME)
    path = ring(-30, 720)
    steps = np.abs(np.diff(interpolate(table, path), axis=0)).max(axis=0)
    spread = np.ptp(interpolate(table, path), axis=0)
    # Half a degree a step; no step takes more than a tenth of the range, 1 / 72 if even.
    assert np.all(steps < 0.1 * spread + 1e-4)


@pytest.mark.parametrize(
    ("observed", "inside", "outside"),
    [
        (DOME, [[0, 0, 1], [0.5, 0.5, 0.71]], [[0, 0, -1], [1, 0, -0.3]]),
        (np.concatenate([DOME, ring(-20, 12)]), [[1, 0, 0]], [[0, 0, -1], [0.3, 0, -0.95]]),
        (random_directions(np.random.default_rng(0), 100), [[0, 0, 1], [0, 0, -1]], []),
        (ring(60, 6), [[0, 0, 1]], [[0, 0, -1], [1, 0, 0]]),
        (ring(0, 12), [], [[0, 0, 1], [0, 0, -1]]),
        (ring(30, 2), [], [[0, 0, 1], [1, 0, 0]]),
        (ring(90, 1), [], [[0, 0, 1], [1, 0, 0]]),
    ],
    ids=["dome", "low dome", "sphere", "ring", "equator", "two", "one"],
)
def test_what_lies_between_lights(observed, inside, outside):
    for turn in (np.eye(3), Rotation.from_euler("xyz", [0.3, 1.1, -2.0]).as_matrix()):
        for directions, expected in ((inside, True), (outside, False)):
            towards = np.array(directions, np.float64).reshape(-1, 3) @ turn.T
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            assert np.all(covered(towards, observed @ turn.T) == expected)


def test_one_light_says_the_same_of_all_directions(rng, rounding):
    table = bounded_table(smooth, ring(50, 1))
    values = interpolate(table, random_directions(rng, 50))
    expected = smooth(ring(50, 1))
    taps = rounding(np.float32, scale=np.abs(expected).max())
    np.testing.assert_allclose(values, np.broadcast_to(expected, values.shape), atol=taps)


def test_largest_gap_is_as_stated():
    narrow, wide = np.degrees(LARGEST_GAP) - 1, np.degrees(LARGEST_GAP) + 1
    assert covered([[0, 0, 1]], ring(90 - narrow, 9)).all()
    assert not covered([[0, 0, 1]], ring(90 - wide, 9)).any()


def test_many_directions_are_thinned(rng):
    many = distinct_directions(random_directions(rng, 50000))
    assert 500 < len(many) <= MOST_OBSERVED
    few = random_directions(rng, 151)
    assert np.abs(distinct_directions(few)[:, None] - few).sum(axis=2).min(axis=0).max() < 0.016
