"""The refinement on samples: directions common to all texels, and each texel's own."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment.refinement import RefinementOptions, SampleSet, refine_targets
from reflfield.errors import ShapeError

OPTIONS = RefinementOptions(side=11, rounds=3)


@pytest.fixture(scope="module")
def relief(scene):
    """Samples of some texels from common directions, and frames near the true ones."""
    views, lights = scene.dome_directions(), scene.dome_directions()[::2]
    truth = scene.relief_frames(30, 20)[::4]
    off = Rotation.from_rotvec(0.03 * np.random.default_rng(3).normal(size=(len(truth), 3)))
    samples = scene.sample_texels(truth, views, lights)
    return SampleSet(samples, views, lights), off.as_matrix() @ truth


def refined(data, frames):
    return refine_targets(data, frames, np.zeros(len(frames), np.int32), 1, OPTIONS)


def test_directions_given_for_each_texel_give_the_same_as_common_ones(relief):
    data, start = relief
    n = len(start)
    views, lights = np.tile(data.views, (n, 1, 1)), np.tile(data.lights, (n, 1, 1))
    own = SampleSet(data.samples, views, lights)
    targets, frames = refined(data, start)
    own_targets, own_frames = refined(own, start)
    np.testing.assert_array_equal(own_targets.values, targets.values)
    np.testing.assert_array_equal(own_frames, frames)


def test_turning_each_base_frame_turns_the_answer_along(relief, rng):
    data, start = relief
    turn = Rotation.random(len(start), rng=rng).as_matrix()
    back = np.swapaxes(turn, 1, 2)
    turned = SampleSet(data.samples, data.views @ back, data.lights @ back)
    _, frames = refined(data, start)
    _, found = refined(turned, start @ back)
    # Six Gauss-Newton steps against targets in float32, of condition about a hundred; a texel
    # whose step is judged the other way by rounding may end a quarter of a small step apart.
    error = np.abs(found @ turn - frames).max(axis=(1, 2))
    assert np.median(error) < 1e2 * 6 * np.finfo(np.float32).eps
    assert error.max() < 1e-3


def test_part_takes_the_directions_along(relief, rng):
    data, start = relief
    own = SampleSet(data.samples, rng.normal(size=(len(start), 81, 3)), data.lights)
    part = own.part(np.array([5, 2]))
    np.testing.assert_array_equal(part.views, own.views[[5, 2]])
    np.testing.assert_array_equal(part.lights, data.lights)


def test_directions_of_other_texels_are_refused(relief):
    data, start = relief
    with pytest.raises(ShapeError, match="views"):
        SampleSet(data.samples, data.views[:-1], data.lights)
    with pytest.raises(ShapeError, match="lights"):
        SampleSet(data.samples, data.views, np.tile(data.lights, (len(start) - 1, 1, 1)))
