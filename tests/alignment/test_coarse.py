import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment.coarse_search import (
    COARSE_DEGREES,
    COARSE_ORBITS,
    coarse_grid,
    coarse_peaks,
    tilted_back,
)
from reflfield.sphere.wigner import block_offsets, rotation_blocks


def falling_series(rng, n, n_degrees, dtype):
    """Random series whose degrees weigh less and less, as those of reflectances."""
    degree = np.repeat(np.arange(n_degrees), (2 * np.arange(n_degrees) + 1) ** 2)
    return (rng.standard_normal((n, len(degree))) / (1.0 + degree) ** 2).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n_degrees", [1, 4, 9])
def test_highest_rotation_of_the_orbits_is_that_of_a_direct_sum(
    n_degrees, dtype, rng, rounding
):
    series = falling_series(rng, 20, n_degrees, dtype)
    low = min(n_degrees, COARSE_DEGREES)
    grid = coarse_grid(low, COARSE_ORBITS, None, np.dtype(dtype).name)
    n = block_offsets(low)[-1]
    direct = series[:, :n].astype(np.float64) @ rotation_blocks(grid.rotations, low).T
    rotations, heights = coarse_peaks(series, n_degrees, 4, None)
    tolerance = rounding(dtype, operations=n, scale=np.abs(series).sum(axis=1).max())
    np.testing.assert_allclose(heights, direct.max(axis=1), atol=tolerance)
    if n_degrees > 1:
        best = grid.rotations[direct.argmax(axis=1)]
        np.testing.assert_allclose(rotations[:, 0], best, atol=1e-12)  # copied, not computed


def test_grid_covers_all_rotations_evenly():
    grid = coarse_grid(2, COARSE_ORBITS, None, "float64")
    random = Rotation.random(20000, random_state=0).as_matrix().reshape(-1, 9)
    trace = (random @ grid.rotations.reshape(-1, 9).T).max(axis=1)
    angle = np.rad2deg(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    # 2,048 balls that filled all rotations without overlap would have a radius of 11 degrees.
    assert angle.max() < 18.0
    assert angle.mean() < 9.6


@pytest.mark.stability
def test_maxima_at_the_tilt_limit_have_a_start_inside_it(rng):
    series = falling_series(rng, 30, 6, np.float32)
    for limit in (0.02, 0.3, 1.0):
        rotations, heights = coarse_peaks(series, 6, 4, limit)
        filled = np.isfinite(rotations[..., 2, 2])
        assert filled[:, 0].all()
        assert (rotations[filled][:, 2, 2] >= np.cos(limit) - 1e-12).all()
        assert np.isfinite(heights).all()


def test_tilting_back_keeps_what_is_allowed(rounding):
    turns = Rotation.random(50, random_state=2).as_matrix()
    back = tilted_back(turns, 0.8)
    inside = turns[:, 2, 2] >= np.cos(0.8)
    np.testing.assert_array_equal(back[inside], turns[inside])  # turned by no angle
    np.testing.assert_allclose(back[~inside, 2, 2], np.cos(0.8), rtol=rounding(float, 3))
    np.testing.assert_allclose(np.linalg.det(back), 1.0, rtol=rounding(float, 9))
