"""Sides of grids, domains, and the transform of samples into them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reflfield.observations.resampling_options import (
    side_for,
)
from reflfield.observations.texel_samples import (
    LOWEST_VIEW,
    POWERS,
    interpolation_matrices,
    inverse_transform,
    local_directions,
    transform,
    transformed_samples,
)
from reflfield.sphere.hemisphere import HORIZON_SOFTNESS

from .rigs import (
    directions_at,
    hemisphere,
    identity,
    texel_samples,
    tilted_frames,
)


class TestSides:
    @given(st.integers(2, 10**6))
    def test_are_odd_and_within_bounds(self, n):
        assert side_for(n) % 2 == 1
        assert 5 <= side_for(n) <= 13
        assert side_for(n + 1) >= side_for(n)

    def test_what_does_not_vary(self):
        assert side_for(0) == side_for(1) == 1


class TestDomain:
    @given(st.floats(-1e12, 1e12), st.sampled_from(sorted(POWERS)))
    def test_the_inverse_transform_inverts(self, value, domain):
        back = inverse_transform(transform(np.array([value]), domain), domain)
        assert np.allclose(back, value, rtol=1e-14, atol=1e-300)  # a few eps

    @pytest.mark.parametrize(("domain", "power"), POWERS.items())
    def test_is_odd_and_a_power(self, domain, power, rounding):
        x = np.array([0.0, 1e-12, 0.3, 1.0, 5.0, 1e12])
        tolerance = rounding(np.float64) * x ** (1 / power)
        assert (np.abs(transform(x, domain) - x ** (1 / power)) <= tolerance).all()
        assert np.array_equal(transform(-x, domain), -transform(x, domain))


class TestRooting:
    @pytest.mark.parametrize(("domain", "power"), POWERS.items())
    def test_values_and_weights_at_known_cosines(self, rng, domain, power, rounding):
        samples = rng.random((1, 1, 3, 3)).astype(np.float32)
        texels = texel_samples(
            rng, 1, 1, 3, samples=samples, lights=directions_at(1.0, 0.5, 0.0)
        )
        got = transformed_samples(texels, identity(1), (1, 5), domain)
        # The softened cosine of a light on the horizon is a quarter of the softness.
        cosine = np.array([1.0, 0.5, HORIZON_SOFTNESS / 4])
        weights = cosine ** (2 / power)
        np.testing.assert_allclose(got.light_weights[0], weights, rtol=rounding(np.float32))
        expected = (samples[0, 0] / cosine[:, None]) ** (1 / power)
        assert np.abs(got.values[0, 0] - expected).max() < rounding(
            np.float32, scale=np.abs(expected).max()
        )

    def test_error_of_a_sample_counts_the_same_from_everywhere(self):
        """A small step dy of the sample is a weighted step of one transformed size."""
        z, y, step = np.array([0.9, 0.5, 0.2]), 0.3, 1e-6
        for domain, power in POWERS.items():
            at = transform(z * y / z, domain)
            moved = transform((z * y + z ** (1 - 1 / power) * step) / z, domain) - at
            weighted = moved * np.sqrt(z ** (2 / power))
            # Second order in the step.
            assert np.ptp(weighted) < 1e-4 * weighted.max()

    def test_lights_far_below_the_horizon_do_not_count(self, rng):
        cut = -0.5 * HORIZON_SOFTNESS
        lights = directions_at(0.3, cut + 1e-3, cut - 1e-3, -HORIZON_SOFTNESS, -0.9)
        texels = texel_samples(rng, 1, 2, 5, lights=lights)
        got = transformed_samples(texels, identity(1), (5, 5), "cube_root")
        assert (got.light_weights[0] > 0).tolist() == [True, True, False, False, False]
        assert np.isfinite(got.values).all()
        kept = transformed_samples(texels, identity(1), (5, 1), "cube_root")
        assert (kept.light_weights == 1).all()
        assert np.array_equal(kept.values, np.cbrt(texels.samples).reshape(1, 2, 5, 3))

    def test_views_far_below_the_horizon_do_not_count(self, rng):
        views = directions_at(0.5, -0.1, LOWEST_VIEW + 1e-3, LOWEST_VIEW - 1e-3, -1.0)
        texels = texel_samples(rng, 1, 5, 2, views=views)
        got = transformed_samples(texels, identity(1), (5, 5), "cube_root")
        assert got.view_weights[0].tolist() == [1, 1, 1, 0, 0]
        fixed = transformed_samples(texels, identity(1), (1, 5), "cube_root")
        assert fixed.view_weights[0].tolist() == [1, 1, 1, 1, 1]

    def test_unseen_directions_have_no_weight(self, rng):
        view_seen, light_seen = np.array([[True, False]]), np.array([[False, True, True]])
        texels = texel_samples(rng, 1, 2, 3, view_seen=view_seen, light_seen=light_seen)
        got = transformed_samples(texels, identity(1), (5, 5), "linear")
        assert ((got.view_weights > 0) == view_seen).all()
        assert ((got.light_weights > 0) == light_seen).all()

    def test_taps_are_those_of_the_frame(self, rng, rounding):
        """Turning the world and the frames together changes nothing."""
        texels = texel_samples(rng, 4, 6, 5)
        turn = tilted_frames(rng, 4)
        turned = replace(
            texels,
            views=local_directions(turn, texels.views),
            lights=local_directions(turn, texels.lights),
        )
        frames = tilted_frames(rng, 4)
        one = transformed_samples(texels, frames, (7, 5), "cube_root")
        other = transformed_samples(
            turned, frames @ np.swapaxes(turn, 1, 2), (7, 5), "cube_root"
        )
        at_one = interpolation_matrices(one.view_taps, 7)
        at_other = interpolation_matrices(other.view_taps, 7)
        # Directions agree to float32; the map to the square has a root at the zenith.
        assert np.abs(at_one - at_other).max() < 10 * np.sqrt(np.finfo(np.float32).eps)
        difference = np.abs(one.light_weights - other.light_weights).max()
        assert difference < rounding(np.float32)

    def test_local_directions_against_single_products(self, rng, rounding):
        frames = tilted_frames(rng, 3)
        world = np.tile(hemisphere(4), (3, 1, 1)).astype(np.float32)
        got = local_directions(frames, world)
        for t, k in np.ndindex(3, 4):
            assert np.abs(got[t, k] - frames[t] @ world[t, k]).max() < rounding(np.float32)
