import numpy as np
import pytest

from reflfield.errors import InputError
from reflfield.sphere.harmonic_projection import (
    Projector,
    direction_operator,
    lower_gram,
    safe_band_limit,
    solid_angles,
)
from reflfield.sphere.hemisphere import HemisphereGrid

GRID = HemisphereGrid(9).directions


def test_lower_hemisphere_gram_and_its_mirror_make_the_identity(rounding):
    gram = lower_gram(7)
    ell = np.floor(np.sqrt(np.arange(49)))
    m = np.arange(49) - ell * ell - ell
    parity = (-1.0) ** (ell + np.abs(m))  # of z -> -z
    total = gram + parity[:, None] * gram * parity
    np.testing.assert_allclose(total, np.eye(49), atol=rounding(np.float64, 50))


def test_smooth_function_of_the_upper_hemisphere_is_recovered():
    # cos^3 vanishes smoothly at the horizon, so band limit 8 holds it to about 1 %.
    operator = direction_operator("views", GRID, 8)
    samples = np.maximum(GRID[:, 2], 0) ** 3
    back = operator.synthesis @ (operator.analysis @ samples)
    assert np.abs(back - samples)[GRID[:, 2] > 0].max() < 0.02


def test_synthesis_is_zero_below_the_horizon_and_what_it_was_above():
    below = np.array([[0.6, 0.0, -0.8], [0.0, 1.0, 0.0]])
    mixed = direction_operator("views", np.concatenate([GRID, below]), 4).synthesis
    assert not mixed[-2:].any()
    above = GRID[:, 2] > 0
    np.testing.assert_array_equal(
        mixed[:-2][above], direction_operator("views", GRID, 4).synthesis[above]
    )


def test_both_directions_match_one_after_the_other(rng, rounding):
    samples = rng.standard_normal((3, 81, 81))
    projector = Projector(GRID, GRID, (4, 6))
    view, light = direction_operator("views", GRID, 4), direction_operator("lights", GRID, 6)
    expected = np.einsum("av,nvl,bl->nab", view.analysis, samples, light.analysis)
    np.testing.assert_allclose(
        projector.project(samples), expected, atol=rounding(np.float64, 81, scale=10)
    )


def test_filling_keeps_observed_samples_and_ignores_what_stands_under_the_others(rng):
    smooth = np.exp(GRID @ np.array([0.3, 0.2, 0.5]))
    samples = (np.outer(smooth, smooth)[None] * np.array([1.0, 3.0])[:, None, None]).astype(
        "f4"
    )
    observed = rng.random(samples.shape) < 0.5
    broken = np.where(observed, samples, np.nan)
    broken[0, ~observed[0]] = np.inf
    projector = Projector(GRID, GRID, (4, 4))
    filled = projector.fill(broken, np.ones((81, 81), np.float32))
    assert np.array_equal(filled[observed], samples[observed])
    inside = GRID[:, 2] > 0.3
    error = np.abs(filled - samples)[:, inside][:, :, inside] / samples[:, inside][:, :, inside]
    assert np.median(error) < 0.1


@pytest.mark.parametrize("gaps", ["scattered", "one side"])
def test_filling_leaves_little_of_a_wrong_prior_and_never_overshoots(gaps, rng):
    smooth = np.exp(GRID @ np.array([0.3, 0.2, 0.5])).astype("f4")
    samples = np.outer(smooth, smooth)[None]
    scattered = rng.random(samples.shape) < 0.5
    one_side = np.broadcast_to((GRID[:, 0] < 0.1)[:, None], samples.shape)
    observed = scattered if gaps == "scattered" else one_side
    projector = Projector(GRID, GRID, (4, 4))
    # A prior that says nothing: all of the missing samples is error at first.
    filled = projector.fill(np.where(observed, samples, np.nan), np.zeros((81, 81), "f4"))
    inside = GRID[:, 2] > 0.3
    error = (filled / samples - 1)[:, inside][:, :, inside]
    left = np.sqrt(np.mean(error[~observed[:, inside][:, :, inside]] ** 2))
    assert left < (0.2 if gaps == "scattered" else 1.0)
    assert np.abs(filled).max() < 1.5 * samples.max()


def test_direction_that_does_not_vary_has_one_coefficient_its_mean(rounding):
    projector = Projector(GRID[40:41], GRID, (1, 5))
    coefficients = projector.project(np.ones((1, 1, 81)))
    assert coefficients.shape == (1, 1, 25)
    back = projector.synthesize(coefficients)
    assert np.median(np.abs(back[0, 0, GRID[:, 2] > 0.3] - 1)) < 0.1


def test_solid_angles_sum_to_the_hemisphere_and_ignore_what_lies_below(rounding):
    below = np.array([[0.6, 0.0, -0.8]])
    shares = solid_angles(np.concatenate([GRID, below]))
    assert shares.sum() == pytest.approx(2 * np.pi, abs=rounding(np.float64, 81))
    assert shares[-1] == 0.0


def test_band_limit_beyond_the_directions_names_the_safe_one():
    few = GRID[GRID[:, 2] > 0.5]
    safe = safe_band_limit(len(few))
    direction_operator("views", few, safe)
    with pytest.raises(InputError, match=f"{safe} is safe"):
        direction_operator("views", few, safe + 1)
