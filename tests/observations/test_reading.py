"""Texels in chosen frames: the store, the directions and the resampling put together."""

import numpy as np
import pytest

from reflfield.capture.lights import Light
from reflfield.observations.photographed_pairs import PhotographedPairs
from reflfield.observations.resampling_options import (
    ResamplingOptions,
)
from reflfield.observations.store import ObservationStore, Observed, note_gaps
from reflfield.observations.texel_reading import NodeColumns, TexelReader, grid_sides
from reflfield.observations.texel_samples import transform
from reflfield.sphere.hemisphere import HemisphereGrid

from .rigs import dome, tilted_frames, write_samples

SIDES = (3, 5)


@pytest.fixture
def reader_of(tmp_path, rng):
    """Return a function from a capture and samples to a reader of them."""

    def make(capture, samples, *, domain="linear", sides=SIDES, **observed):
        n = len(samples)
        write_samples(tmp_path / "store", capture, samples)
        note_gaps(tmp_path / "store", float(np.isnan(samples).mean()))
        seen = {
            "views": np.ones((n, capture.n_views), bool),
            "lights": np.ones((n, capture.n_lights), bool),
            "pairs": PhotographedPairs.of(capture),
        }
        return TexelReader(
            store=ObservationStore(tmp_path / "store", Observed(**(seen | observed))),
            capture=capture,
            positions=rng.uniform(-0.1, 0.1, size=(n, 3)),
            local_from_world=tilted_frames(rng, n),
            sides=sides,
            options=ResamplingOptions(domain=domain),
        )

    return make


@pytest.fixture
def reader(reader_of, rng):
    return reader_of(dome(6, 7), rng.random((40, 6, 7, 3)))


class TestSides:
    def test_follow_the_counts(self):
        assert grid_sides(dome(12, 32), ResamplingOptions()) == (5, 7)
        assert grid_sides(dome(12, 32), ResamplingOptions(view_side=4, light_side=9)) == (4, 9)

    def test_what_does_not_vary_gets_one(self):
        chosen = ResamplingOptions(view_side=9, light_side=9)
        assert grid_sides(dome(1, 1), chosen) == (1, 1)
        unknown = tuple(Light(f"l{i}", "unknown") for i in range(3))
        assert grid_sides(dome(6, 3, lights=unknown), chosen) == (9, 1)


class TestReader:
    def test_values_are_samples_over_cosines(self, reader, rounding):
        texels = np.array([31, 4])
        got = reader.transformed(texels)
        stored = reader.store.read(texels).reshape(2, 6, 7, 3).astype(float)
        for i, t in enumerate(texels):
            for j, light in enumerate(reader.capture.lights):
                towards = light.position - reader.positions[t]
                normal = reader.local_from_world[t, 2]
                cosine = normal @ towards / np.linalg.norm(towards)
                if cosine > 0.1:  # above the softened band
                    singles = rounding(np.float32, condition=1 / 0.1)  # of the cosine
                    expected = stored[i, :, j] / cosine
                    np.testing.assert_allclose(got.values[i, :, j], expected, rtol=singles)
                    assert got.light_weights[i, j] == pytest.approx(cosine**2, rel=singles)

    def test_what_is_not_observed_has_no_weight(self, reader_of, rng):
        lights = rng.random((9, 4)) < 0.5
        views = rng.random((9, 5)) < 0.5
        capture = dome(5, 4, missing={(2, 3)})
        reader = reader_of(capture, rng.random((9, 5, 4, 3)), views=views, lights=lights)
        texels = np.array([8, 1, 3, 5])
        got = reader.transformed(texels)
        assert np.array_equal(got.view_weights > 0, views[texels])
        assert not got.light_weights[~lights[texels]].any()
        assert got.pairs.sum() == 19
        assert got.pairs[2, 3] == 0

    def test_spots_that_miss_say_nothing(self, reader_of, rng):
        """A texel outside the cone is dark for a reason that is not its reflectance."""
        aimed = {"position": [0, 0, 2], "cone_angle": 0.3, "falloff_angle": 0.3}
        lights = (
            Light("l0", "spot", direction=[0, 0, -1], **aimed),
            Light("l1", "spot", direction=[1, 0, 0], **aimed),
        )
        reader = reader_of(dome(3, 2, lights=lights), rng.random((4, 3, 2, 3)))
        assert (reader.transformed(np.arange(4)).light_weights > 0).tolist() == [
            [True, False]
        ] * 4

    def test_unknown_light(self, reader_of, rng):
        samples = rng.random((5, 6, 1, 3))
        capture = dome(6, 1, lights=(Light("l0", "unknown"),))
        reader = reader_of(capture, samples, domain="cube_root", sides=(5, 1))
        got = reader.transformed(np.arange(5))
        stored = samples.astype(np.float16).astype(np.float32)
        assert np.array_equal(got.values, transform(stored, "cube_root"))
        assert (got.light_weights == 1).all()
        assert reader.nodes(np.arange(5)).values.shape == (5, 25, 1, 3)

    def test_frames_turn_the_nodes(self, reader_of, rng):
        """A function of the local light alone is found again in any frames."""
        capture = dome(4, 120)
        flat = reader_of(capture, np.zeros((10, 4, 120, 3)), sides=(1, 3))
        local = flat.transformed(np.arange(10))
        slope = HemisphereGrid(3).directions @ [0.3, 0.2, 0.0] + 1
        nodes, weights = local.light_taps
        values = (slope[nodes] * weights).sum(axis=2)
        towards = np.stack([light.directions(flat.positions) for light in capture.lights], 1)
        cosine = np.einsum("nlx,nx->nl", towards, flat.local_from_world[:, 2])
        samples = np.repeat((values * cosine)[:, None, :, None], 4, axis=1).repeat(3, axis=3)
        reader = reader_of(capture, np.maximum(samples, 0), sides=(1, 3))
        reader = reader.rotated(flat.local_from_world)
        object.__setattr__(reader, "positions", flat.positions)
        grid = reader.nodes(np.arange(10))
        seen = grid.light_support > 0.9
        # Halves, the smoothness demanded (0.03 against some ten samples a node).
        assert np.abs(grid.values[:, 0, :, 0] - slope)[seen].max() < 0.05
        turned = reader.rotated(np.roll(flat.local_from_world, 1, axis=1))
        # The normal is now another axis: the function is not found.
        other = turned.nodes(np.arange(10))
        assert np.abs(other.values[:, 0, :, 0] - slope)[other.light_support > 0.9].max() > 0.2

    def test_sizes(self, reader):
        assert reader.n_texels == 40
        assert reader.n_pairs == 9 * 25
        values = reader.transformed(np.arange(40)).values.nbytes
        assert reader.product_bytes_per_texel * 40 > values


class TestColumns:
    def test_rows_are_pairs_of_nodes_and_channels(self, reader):
        columns = NodeColumns(reader, np.array([7, 30, 2]))
        assert columns.shape == (9 * 25 * 3, 3)
        values, weights = columns.read(np.array([2, 0]))
        nodes = reader.nodes(np.array([2, 7]))
        assert np.array_equal(values.T.reshape(2, 9, 25, 3), nodes.values)
        assert np.array_equal(weights.T.reshape(2, 9, 25), nodes.weights)

    def test_order_repeats_and_blocks(self, reader, rng):
        columns = NodeColumns(reader, rng.permutation(40))
        values, weights = columns.read(np.arange(40))
        order = np.concatenate([rng.permutation(40), [3, 3]])
        for part in np.array_split(order, 5):
            some, shares = columns.read(part)
            assert np.array_equal(some, values[:, part])
            assert np.array_equal(shares, weights[:, part])

    @pytest.mark.stability
    def test_texel_that_nothing_sees(self, reader_of, rng):
        views = np.ones((3, 6), bool)
        views[1] = False
        reader = reader_of(dome(6, 7), rng.random((3, 6, 7, 3)), views=views)
        values, weights = NodeColumns(reader, np.arange(3)).read(np.arange(3))
        assert np.isfinite(values).all()
        assert not values[:, 1].any()
        assert weights.any(axis=0).tolist() == [True, False, True]


class TestLuminance:
    def test_is_the_raw_sample_where_observed_and_nan_elsewhere(self, reader_of, rng):
        lights = rng.random((9, 4)) < 0.5
        views = rng.random((9, 5)) < 0.5
        capture = dome(5, 4, missing={(2, 3)})
        reader = reader_of(capture, rng.random((9, 5, 4, 3)), views=views, lights=lights)
        texels = np.array([8, 1, 3])
        luminance = reader.luminance(texels)
        pairs = PhotographedPairs.of(capture)
        seen = views[texels][:, :, None] & lights[texels][:, None] & pairs.table
        np.testing.assert_array_equal(np.isfinite(luminance.samples), seen)
        stored = pairs.as_product(reader.store.read(texels).astype(float), np.nan)
        red, green, blue = np.moveaxis(stored, 3, 0)
        expected = 0.2126 * red + 0.7152 * green + 0.0722 * blue
        eps = np.finfo(np.float32).eps
        np.testing.assert_allclose(luminance.samples[seen], expected[seen], rtol=4 * eps)

    def test_directions_are_those_to_cameras_and_lights_in_the_frame(self, reader):
        texels = np.array([31, 4])
        luminance = reader.luminance(texels)
        for i, t in enumerate(texels):
            towards = np.stack([light.position for light in reader.capture.lights])
            towards = towards - reader.positions[t]
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            expected = towards @ reader.local_from_world[t].T.astype(float)
            # Directions of the world are handed on as float32.
            eps = np.finfo(np.float32).eps
            np.testing.assert_allclose(luminance.lights[i], expected, atol=4 * eps)
        assert luminance.views.shape == (2, 6, 3)

    def test_directions_that_do_not_vary_become_one(self, reader_of, rng, rounding):
        unknown = tuple(Light(f"l{i}", "unknown") for i in range(3))
        samples = rng.random((4, 1, 3, 3))
        lights = np.array([[1, 1, 1], [1, 0, 1], [0, 0, 0], [0, 1, 0]], bool)
        reader = reader_of(dome(1, 3, lights=unknown), samples, sides=(1, 1), lights=lights)
        luminance = reader.luminance(np.arange(4))
        assert luminance.samples.shape == (4, 1, 1)
        value = samples.astype(np.float16).astype(float) @ [0.2126, 0.7152, 0.0722]
        assert np.isnan(luminance.samples[2, 0, 0])
        mean = value[1, 0, [0, 2]].mean()
        assert luminance.samples[1, 0, 0] == pytest.approx(mean, rel=rounding(np.float32))
        np.testing.assert_array_equal(luminance.lights, np.tile([0.0, 0, 1], (4, 1, 1)))


class TestShade:
    def test_is_the_mean_over_views_of_what_lies_in_shadow(self, reader_of, rng, rounding):
        samples = rng.random((12, 4, 5, 3))
        views, lights = rng.random((12, 4)) < 0.7, rng.random((12, 5)) < 0.5
        reader = reader_of(dome(4, 5), samples, domain="cube_root", views=views, lights=lights)
        texels = np.array([1, 4, 11])
        shade = reader.shade(texels)
        stored = np.cbrt(samples.astype(np.float16).astype(float))
        for k, t in enumerate(texels):
            for j in range(5):
                seen = views[t] if not lights[t, j] else np.zeros(4, bool)
                assert (shade.weights[k, j] == seen.sum()).all()
                expected = stored[t, seen, j].mean(axis=0) if seen.any() else np.zeros(3)
                tolerance = rounding(np.float32)
                np.testing.assert_allclose(shade.values[k, j], expected, rtol=tolerance)
