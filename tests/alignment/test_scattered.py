"""Frames refined on raw samples at each texel's own directions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment.refinement import RefinementOptions, SampleSet
from reflfield.alignment.scattered import refine_scattered
from reflfield.errors import ShapeError

N = 400
SPREAD = 0.05
OPTIONS = RefinementOptions(side=15, rounds=4, spread=SPREAD)


class Source:
    """A sample set, read as it stands."""

    def __init__(self, data):
        self.data = data
        self.shape = data.samples.shape

    def read(self, rows):
        return self.data.part(rows)


def directions(rng, count):
    """(N, count, 3) of the upper hemisphere, other ones for each texel."""
    d = rng.normal(size=(N, count, 3))
    d[..., 2] = np.abs(d[..., 2]) + 0.3
    return d / np.linalg.norm(d, axis=2, keepdims=True)


@pytest.fixture(scope="module")
def sparse(scene):
    """Sparse, noisy samples of smooth frames, frames a few degrees off, and true ones."""
    rng = np.random.default_rng(5)
    truth = scene.relief_frames(25, 16)
    views, lights = directions(rng, 12), directions(rng, 12)
    samples = np.concatenate(
        [scene.sample_texels(truth[i : i + 1], views[i], lights[i]) for i in range(N)]
    )
    samples *= 1 + 0.02 * rng.normal(size=samples.shape)
    samples[rng.random(samples.shape) < 0.3] = np.nan
    off = Rotation.from_rotvec(SPREAD * rng.normal(size=(N, 3))).as_matrix()
    data = SampleSet(samples.astype(np.float32), views, lights)
    return data, off @ truth, truth


def refined(data, start, options=OPTIONS, **keywords):
    return refine_scattered(Source(data), start, np.zeros(N, np.int32), options, **keywords)


def normal_error(frames, truth):
    """Root mean square angle between normals, degrees."""
    cosine = np.sum(frames[:, 2] * truth[:, 2], axis=1).clip(-1, 1)
    return np.rad2deg(np.sqrt(np.mean(np.arccos(cosine) ** 2)))


def test_frames_come_closer_to_the_truth(sparse):
    data, start, truth = sparse
    assert normal_error(refined(data, start), truth) < 0.6 * normal_error(start, truth)


def test_frames_are_rotations_and_on_average_not_turned(sparse, rounding):
    data, start, _ = sparse
    frames = refined(data, start)
    products = frames @ np.swapaxes(frames, 1, 2)
    np.testing.assert_allclose(
        products, np.tile(np.eye(3), (N, 1, 1)), atol=rounding(np.float64, operations=200)
    )
    turns = np.sum(frames @ np.swapaxes(start, 1, 2), axis=0)
    # The nearest rotation of a symmetric positive matrix is the identity.
    np.testing.assert_allclose(
        turns, turns.T, atol=rounding(np.float64, operations=10 * N, scale=N)
    )


@pytest.mark.parametrize("n_threads", [2, 3])
def test_threads_and_blocks_do_not_change_the_frames(sparse, monkeypatch, n_threads):
    data, start, _ = sparse
    whole = refined(data, start)
    monkeypatch.setattr("reflfield.alignment.scattered.BLOCK_BYTES", 1 << 16)
    np.testing.assert_array_equal(refined(data, start, n_threads=n_threads), whole)


@pytest.mark.stability
@pytest.mark.parametrize("scale", [2.0**-100, 2.0**100])
def test_scale_of_the_samples_does_not_matter(sparse, scale):
    data, start, _ = sparse
    scaled = SampleSet(data.samples * np.float32(scale), data.views, data.lights)
    # Powers of two scale without rounding.
    np.testing.assert_array_equal(refined(scaled, start), refined(data, start))


@pytest.mark.stability
def test_texels_without_samples_keep_their_frames(sparse):
    data, start, _ = sparse
    samples = data.samples.copy()
    samples[::7] = np.nan
    samples[3] = 0.0
    lacking = SampleSet(samples, data.views, data.lights)
    frames = refined(lacking, start)
    assert np.isfinite(frames).all()
    # But for the gauge, which all frames share.
    turns = frames[::7] @ np.swapaxes(start[::7], 1, 2)
    np.testing.assert_allclose(turns, np.broadcast_to(turns[:1], turns.shape), atol=1e-12)


@pytest.mark.stability
def test_infinity_is_unobserved_as_nan_is(sparse):
    data, start, _ = sparse
    infinite = np.where(np.isnan(data.samples), np.float32(np.inf), data.samples)
    infinite[::2] *= np.where(np.isinf(infinite[::2]), -1, 1)
    signed = SampleSet(infinite, data.views, data.lights)
    np.testing.assert_array_equal(refined(signed, start), refined(data, start))


@pytest.mark.stability
def test_nothing_observed_at_all_leaves_the_frames(sparse):
    data, start, _ = sparse
    nothing = SampleSet(np.full_like(data.samples, np.nan), data.views, data.lights)
    np.testing.assert_allclose(refined(nothing, start), start, atol=1e-12)


def test_frames_of_other_texels_are_refused(sparse):
    data, start, _ = sparse
    with pytest.raises(ShapeError, match="local_from_base"):
        refined(data, start[:-1])
