"""Frames refined on raw samples at each texel's own directions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment import RefinementOptions, SampleSet, align
from reflfield.alignment.align_texels import frames_of
from reflfield.alignment.model_arrays import arrays_of_model, model_of_arrays
from reflfield.alignment.model_fit import FitOptions, fit_model
from reflfield.alignment.sample_sources import GriddedSamples
from reflfield.errors import ShapeError

N = 240
SPREAD = 0.05
OPTIONS = RefinementOptions(
    side=15, rounds=3, texels_per_cluster=N, spread=SPREAD, samples_per_pair=2.0
)


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
    """Sparse, noisy raw samples; completed ones of frames a few degrees off; true frames."""
    rng = np.random.default_rng(5)
    truth = scene.relief_frames(20, 12)
    views, lights = directions(rng, 16), directions(rng, 16)
    samples = np.concatenate(
        [scene.sample_texels(truth[i : i + 1], views[i], lights[i]) for i in range(N)]
    )
    samples *= 1 + 0.02 * rng.normal(size=samples.shape)
    samples[rng.random(samples.shape) < 0.3] = np.nan
    off = Rotation.from_rotvec(SPREAD * rng.normal(size=(N, 3))).as_matrix()
    d = scene.dome_directions()
    completed = scene.sample_texels(off @ truth, d, d)
    raw = SampleSet(samples.astype(np.float32), views, lights)
    return GriddedSamples.checked(completed, d, d), raw, truth


@pytest.fixture(scope="module")
def plain(sparse):
    gridded, raw, _ = sparse
    return refined(gridded, raw)


def refined(gridded, raw, **keywords):
    source = None if raw is None else Source(raw)
    options = {"band_limit": 6, "refine": OPTIONS} | keywords
    alignment = align(gridded.samples, gridded.views, gridded.lights, raw=source, **options)
    return alignment.local_from_base


def normal_error(frames, truth):
    """Root mean square angle between normals, degrees."""
    cosine = np.sum(frames[:, 2] * truth[:, 2], axis=1).clip(-1, 1)
    return np.rad2deg(np.sqrt(np.mean(np.arccos(cosine) ** 2)))


def test_raw_samples_bring_frames_closer_to_the_truth(sparse, plain):
    gridded, raw, truth = sparse
    harmonic = refined(gridded, raw, refine=False)
    # Four degrees off by the completed samples; the raw ones alone tell the true frames.
    assert normal_error(plain, truth) < 0.6 * normal_error(harmonic, truth)


def test_frames_are_rotations(plain, rounding):
    products = plain @ np.swapaxes(plain, 1, 2)
    tolerance = rounding(np.float64, operations=200)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (N, 1, 1)), atol=tolerance)


def test_gridded_samples_are_scattered_ones_with_common_directions(sparse):
    gridded, _, _ = sparse
    own = SampleSet(
        gridded.samples,
        np.tile(gridded.views, (N, 1, 1)),
        np.tile(gridded.lights, (N, 1, 1)),
    )
    quick = RefinementOptions(side=9, rounds=1, last_steps=1)
    common = refined(gridded, None, refine=quick)
    np.testing.assert_array_equal(refined(gridded, own, refine=quick), common)


@pytest.mark.parametrize("n_threads", [2, 3])
def test_threads_do_not_change_the_frames(sparse, plain, n_threads):
    gridded, raw, _ = sparse
    np.testing.assert_array_equal(refined(gridded, raw, n_threads=n_threads), plain)


def test_a_stored_model_is_the_same_and_blocks_do_not_depend_on_others(sparse):
    gridded, raw, _ = sparse
    options = FitOptions((6, 6), 4, 1, OPTIONS, 0, None, 1)
    model = fit_model(gridded, Source(raw), options)
    stored = model_of_arrays(arrays_of_model(model))
    whole, again = (frames_of(m, gridded, Source(raw), np.arange(N)) for m in (model, stored))
    np.testing.assert_array_equal(again.local_from_base, whole.local_from_base)
    some = np.arange(30, 90)
    part = frames_of(model, gridded, Source(raw), some)
    # Products of matrices with other numbers of rows are rounded otherwise; a texel whose step
    # is judged the other way by that may end a quarter of a small step apart.
    error = np.abs(part.local_from_base - whole.local_from_base[some])
    assert np.median(error) < 1e3 * np.finfo(np.float32).eps


@pytest.mark.stability
@pytest.mark.parametrize("scale", [2.0**-100, 2.0**100])
def test_scale_of_the_samples_does_not_matter(sparse, plain, scale):
    gridded, raw, _ = sparse
    scaled = SampleSet(raw.samples * np.float32(scale), raw.views, raw.lights)
    # Powers of two scale without rounding.
    np.testing.assert_array_equal(refined(gridded, scaled), plain)


@pytest.mark.stability
def test_texels_without_raw_samples_keep_the_frames_of_the_search(sparse):
    gridded, raw, _ = sparse
    samples = raw.samples.copy()
    samples[::7] = np.nan
    samples[3] = 0.0
    frames = refined(gridded, SampleSet(samples, raw.views, raw.lights))
    assert np.isfinite(frames).all()
    # But for the rotation that all frames share.
    harmonic = refined(gridded, raw, refine=False)
    rotations = np.swapaxes(frames[::7], 1, 2) @ harmonic[::7]
    shared = np.swapaxes(harmonic[::7], 1, 2) @ harmonic[::7]
    assert np.abs(rotations - shared).max() < np.sin(3 * SPREAD)


@pytest.mark.stability
def test_infinity_is_unobserved_as_nan_is(sparse, plain):
    gridded, raw, _ = sparse
    infinite = np.where(np.isnan(raw.samples), np.float32(np.inf), raw.samples)
    infinite[::2] *= np.where(np.isinf(infinite[::2]), -1, 1)
    signed = SampleSet(infinite, raw.views, raw.lights)
    np.testing.assert_array_equal(refined(gridded, signed), plain)


@pytest.mark.stability
def test_nothing_observed_at_all_leaves_frames_of_the_search(sparse):
    gridded, raw, _ = sparse
    nothing = SampleSet(np.full_like(raw.samples, np.nan), raw.views, raw.lights)
    harmonic = refined(gridded, raw, refine=False)
    np.testing.assert_array_equal(refined(gridded, nothing), harmonic)


def test_raw_samples_of_other_texels_are_refused(sparse):
    gridded, raw, _ = sparse
    with pytest.raises(ShapeError, match="raw: expected"):
        refined(gridded, raw.part(np.arange(N - 1)))


def test_materials_are_told_apart_on_the_raw_samples(scene):
    rng = np.random.default_rng(7)
    truth, label = scene.relief_frames(20, 12), np.arange(N) % 2
    d, views, lights = scene.dome_directions(), directions(rng, 16), directions(rng, 16)
    samples = np.zeros((N, 16, 16), np.float32)
    completed = scene.sample_texels(truth, d, d)
    for i, k in enumerate(label):
        material = {"nu": (8.0, 12.0)[k], "diffuse": (0.1, 0.3)[k]}
        texel = (truth[i : i + 1], views[i], lights[i])
        samples[i] = scene.sample_texels(*texel, **material)[0]
    # The completed samples are all of one material: whatever is told apart, the raw ones tell.
    raw = SampleSet(samples, views, lights)
    result = align(completed, d, d, 6, n_clusters=2, raw=Source(raw), refine=OPTIONS)
    agreement = np.mean(result.cluster == label)
    # Labels may be swapped; one texel in twenty shows too little of its highlight.
    assert max(agreement, 1 - agreement) > 0.95
