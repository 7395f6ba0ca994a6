"""Values that were not measured, channel by channel: coloured lamps, clipped pixels."""

from dataclasses import replace

import numpy as np
import pytest

from reflfield.capture.color_spaces import LUMINANCE
from reflfield.capture.lights import Light
from reflfield.observations import frame_resampling
from reflfield.observations.frame_resampling import (
    CONTINUED,
    resample,
)
from reflfield.observations.image_projection import directions_of
from reflfield.observations.photographed_pairs import PhotographedPairs
from reflfield.observations.resampling_options import (
    ResamplingOptions,
)
from reflfield.observations.store import ObservationStore, Observed, create_samples, note_gaps
from reflfield.observations.texel_reading import (
    NodeColumns,
    TexelReader,
    luminance_of,
)
from reflfield.observations.texel_samples import (
    CHANNEL_BITS,
    local_directions,
    transformed_samples,
)
from reflfield.sphere.hemisphere import softened_cosine

from .rigs import dome, hemisphere, texel_samples, tilted_frames, transformed, write_samples
from .test_resampling import SOLVE, weighted_solution

N = 12


def coloured_lights(n):
    """One red, one green and one blue lamp in turn."""
    return tuple(
        Light(f"l{j}", "point", position=2 * d, intensity=np.eye(3)[j % 3])
        for j, d in enumerate(hemisphere(n))
    )


@pytest.fixture
def reader_of(tmp_path, rng):
    """Return a function from lights and a colour to a reader of matt texels."""

    def make(n_views, n_lights, colour, shadowed=False):
        capture = dome(n_views, n_lights, lights=coloured_lights(n_lights))
        positions = rng.uniform(-0.05, 0.05, (N, 3)) * [1, 1, 0]
        frames = tilted_frames(rng, N)
        _, lights = directions_of(capture, positions)
        cosine = softened_cosine(local_directions(frames, lights)[..., 2])
        samples = cosine[:, None, :, None] * np.asarray(colour) * np.ones((1, n_views, 1, 1))
        has_colour = np.stack([light.intensity > 0 for light in capture.lights])
        write_samples(tmp_path / "store", capture, np.where(has_colour, samples, np.nan))
        lit = np.full((N, n_lights), not shadowed)
        seen = Observed(np.ones((N, n_views), bool), lit, PhotographedPairs.of(capture))
        return TexelReader(
            store=ObservationStore(tmp_path / "store", seen),
            capture=capture,
            positions=positions,
            local_from_world=frames,
            sides=(3, 5),
            options=ResamplingOptions(domain="cube_root"),
        )

    return make


@pytest.mark.parametrize(("n_lights", "tolerance"), [(3, 0.06), (12, 0.01)])
def test_grey_under_coloured_lamps_is_grey(reader_of, n_lights, tolerance):
    """A third of each value would come out, were what a lamp lacks taken for black."""
    nodes = reader_of(4, n_lights, [0.3, 0.3, 0.3]).nodes(np.arange(N))
    observed = nodes.weights > CONTINUED
    assert observed.any(axis=(0, 1, 2)).all()
    # The prior draws what little is known a little to nothing: of one lamp at the horizon.
    np.testing.assert_allclose(nodes.values[observed] ** 3, 0.3, rtol=tolerance)


def test_node_is_observed_in_the_colours_of_the_lamps_near_it(reader_of):
    reader = reader_of(4, 3, [0.3, 0.2, 0.1])
    read = reader.transformed(np.arange(N))
    weights = reader.nodes(np.arange(N)).weights
    assert weights.shape == (N, 9, 25, 3)
    for t, m, c in np.ndindex(N, 25, 3):
        # Lamp c is the only one of its colour.
        near = read.light_taps[1][t, c][read.light_taps[0][t, c] == m]
        lit = read.light_weights[t, c] > 0
        # With that of the views, which is at most one: more than the least support.
        share = near.sum() * read.view_weights[t].sum()
        if not lit or share < 0.1:
            assert weights[t, :, m, c].max() <= np.float32(CONTINUED)
        if lit and near.sum() > 0.5:
            assert weights[t, :, m, c].max() > 2 * CONTINUED


def test_columns_have_a_weight_for_each_row(reader_of):
    reader = reader_of(4, 3, [0.3, 0.2, 0.1])
    values, weights = NodeColumns(reader, np.arange(N)).read(np.array([3, 1]))
    assert values.shape == weights.shape == (9 * 25 * 3, 2)
    np.testing.assert_array_equal(
        weights.T.reshape(2, 9, 25, 3), reader.nodes(np.array([3, 1])).weights[[0, 1]]
    )


def test_a_trace_of_gaps_leaves_a_weight_for_each_pair_of_nodes(reader_of):
    reader = reader_of(4, 3, [0.3, 0.2, 0.1])
    note_gaps(reader.store.location, 0.001)
    _, weights = NodeColumns(reader, np.arange(N)).read(np.array([3, 1]))
    least = reader.nodes(np.array([3, 1])).weights.min(axis=3)
    np.testing.assert_array_equal(weights.T.reshape(2, 9, 25), least)


def test_what_is_clipped_everywhere_is_continued_and_counts_a_little(rng):
    """Else nothing is known there, and a node that no texel observed would be black."""
    whole = texel_samples(rng, 2, 6, 7, samples=np.full((2, 6, 7, 3), 0.3, np.float32))
    samples = whole.samples.copy()
    under_first_lights = whole.pairs.light < 3
    samples[:, under_first_lights, 1], samples[1, ..., 2] = np.nan, np.nan
    frames = np.tile(np.eye(3, dtype=np.float32), (2, 1, 1))
    clipped = transformed_samples(replace(whole, samples=samples), frames, (1, 5), "linear")
    nodes = resample(clipped, (1, 5), 0.03)
    weights = nodes.weights[:, 0]
    zenith = 12  # of 5 x 5, amid the first lights
    assert weights[0, zenith, 1] == np.float32(CONTINUED)
    assert weights[0, zenith, 0] > 5 * CONTINUED
    # The blue of the second texel was measured nowhere: nothing is continued.
    assert not weights[1, :, 2].any()


@pytest.mark.reference
def test_values_not_measured_against_a_weighted_solve(rng, monkeypatch, rounding):
    """Clipped pixels, anywhere: each channel by itself."""
    smooth = np.array([1.0, 2.0, 0.5]) + 0.2 * rng.normal(size=(2, 12, 10, 3))
    whole = transformed(rng, 2, 12, 10, (5, 5), values=smooth.astype(np.float32))
    measured = rng.random((2, 12, 10, 3)) < 0.8
    values = np.where(measured, whole.values, np.float32(77))
    gaps = replace(whole, values=values, channels=measured @ CHANNEL_BITS)
    monkeypatch.setattr(frame_resampling, "FILLING_SWEEPS", 300)
    nodes = resample(gaps, (5, 5), 0.3)
    for t in range(2):
        for c in range(3):
            pairs = measured[t, ..., c].astype(np.float32)
            of_channel = replace(whole, pairs=pairs)
            expected = weighted_solution(of_channel, (5, 5), 0.3, t)[..., c]
            error = np.abs(nodes.values[t, ..., c] - expected).max()
            assert error < rounding(np.float32, **SOLVE, scale=3)


def test_luminance_of_a_lamp_of_one_colour_is_that_under_white_light(reader_of):
    colour = np.array([0.4, 0.2, 0.1])
    reader = reader_of(4, 12, colour)
    samples = reader.measured(np.arange(N))
    cosine = softened_cosine(local_directions(reader.local_from_world, samples.lights)[..., 2])
    luminance = luminance_of(samples, cosine).reshape(N, 4, 12)
    expected = np.broadcast_to((cosine * (colour @ LUMINANCE))[:, None], luminance.shape)
    # Halves round to eleven bits, and below 2^-14 to 2^-25: a channel, and the ratio of two.
    np.testing.assert_allclose(luminance, expected, rtol=3 * 2.0**-11, atol=3 * 2.0**-25)


def test_luminance_beside_whole_samples_is_exact_for_one_colour(rng, rounding):
    colour = np.array([0.4, 0.2, 0.1])
    brightness = rng.uniform(0.5, 2.0, (3, 4, 5, 1))
    values = (brightness * colour).astype(np.float32)
    gaps = rng.random(values.shape) < 0.3
    gaps[:, 0] = False
    samples = texel_samples(rng, 3, 4, 5, samples=np.where(gaps, np.nan, values))
    nothing = gaps.all(axis=3)
    luminance = luminance_of(samples, np.ones((3, 5), np.float32)).reshape(3, 4, 5)
    assert np.isnan(luminance[nothing]).all()
    expected = (values @ LUMINANCE)[~nothing]
    # Three channels, each by the ratio of two.
    tolerance = rounding(np.float32, operations=9)
    np.testing.assert_allclose(luminance[~nothing], expected, rtol=tolerance)


def test_shade_is_the_mean_of_what_was_measured(reader_of, rounding):
    reader = reader_of(4, 6, [0.3, 0.2, 0.1], shadowed=True)
    shade = reader.shade(np.arange(N))
    samples = reader.measured(np.arange(N)).samples.reshape(N, 4, 6, 3).astype(float)
    expected = np.nan_to_num(np.cbrt(samples[:, 0]))  # views agree
    assert np.array_equal(shade.weights, 4.0 * ~np.isnan(samples[:, 0]))
    np.testing.assert_allclose(shade.values, expected, rtol=rounding(np.float32))


def test_samples_of_which_nothing_was_measured_are_counted(reader_of):
    reader = reader_of(4, 6, [0.3, 0.2, 0.1])
    usual = reader.count_fitted(np.arange(N))
    assert usual.unmeasured == 0
    stored = reader.store.samples
    values = stored[:]
    values[2, 6:12] = np.nan
    changed = create_samples(reader.store.location, N, reader.store.observed.pairs)
    changed[:] = values
    counts = reader.count_fitted(np.arange(N))
    n_counted = int((reader.transformed(np.array([2])).light_weights > 0).sum())
    assert counts.unmeasured == n_counted
    assert counts.fitted == usual.fitted - n_counted
