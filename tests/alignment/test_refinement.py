"""The refinement on samples: directions common to all texels, and each texel's own."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment.gauss_newton import hold
from reflfield.alignment.refinement import (
    RefinementOptions,
    SharpAlignment,
    fit_sharp_targets,
    improve_frames,
    refine,
)
from reflfield.alignment.sample_sources import SampleSet
from reflfield.alignment.spline_targets import SplineTargets
from reflfield.errors import InputError, ShapeError

OPTIONS = RefinementOptions(side=11, rounds=3)
# Of the frames to start from about the true ones, each axis, radians.
SPREAD = 0.03


@pytest.fixture(scope="module")
def relief(scene):
    """Samples of some texels from common directions, frames near the true ones, true ones."""
    views, lights = scene.dome_directions(), scene.dome_directions()[::2]
    truth = scene.relief_frames(30, 20)[::4]
    off = Rotation.from_rotvec(SPREAD * np.random.default_rng(3).normal(size=(len(truth), 3)))
    samples = scene.sample_texels(truth, views, lights)
    return SampleSet(samples, views, lights), off.as_matrix() @ truth, truth


def begun(data, frames, targets=None):
    """All texels of one cluster in these frames."""
    if targets is None:
        targets = SplineTargets.zeros(1, data.samples.shape[1:], OPTIONS.side)
    return SharpAlignment.begin(data, frames, np.zeros(len(frames), np.int32), targets)


def refined(data, frames):
    state = refine(data, begun(data, frames), OPTIONS, 1)
    return state.targets, state.frames


@pytest.mark.slow
def test_directions_given_for_each_texel_give_the_same_as_common_ones(relief):
    data, start, _ = relief
    n = len(start)
    views, lights = np.tile(data.views, (n, 1, 1)), np.tile(data.lights, (n, 1, 1))
    own = SampleSet(data.samples, views, lights)
    targets, frames = refined(data, start)
    own_targets, own_frames = refined(own, start)
    np.testing.assert_array_equal(own_targets.values, targets.values)
    np.testing.assert_array_equal(own_frames, frames)


def test_turning_each_base_frame_turns_the_answer_along(relief, rng):
    data, start, _ = relief
    turn = Rotation.random(len(start), rng=rng).as_matrix()
    back = np.swapaxes(turn, 1, 2)
    turned = SampleSet(data.samples, data.views @ back, data.lights @ back)
    _, frames = refined(data, start)
    _, other = refined(turned, start @ back)
    # Six Gauss-Newton steps against targets in float32, of condition about a hundred.
    error = np.abs(other @ turn - frames).max(axis=(1, 2))
    assert np.median(error) < 1e2 * 6 * np.finfo(np.float32).eps
    # A step that rounding judges the other way ends a quarter of a small one apart.
    assert error.max() < 1e-3


def test_part_takes_the_directions_along(relief, rng):
    data, start, _ = relief
    own = SampleSet(data.samples, rng.normal(size=(len(start), 81, 3)), data.lights)
    part = own.part(np.array([5, 2]))
    np.testing.assert_array_equal(part.views, own.views[[5, 2]])
    np.testing.assert_array_equal(part.lights, data.lights)


def test_directions_of_other_texels_are_refused(relief):
    data, start, _ = relief
    with pytest.raises(ShapeError, match="views"):
        SampleSet(data.samples, data.views[:-1], data.lights)
    with pytest.raises(ShapeError, match="lights"):
        SampleSet(data.samples, data.views, np.tile(data.lights, (len(start) - 1, 1, 1)))


@pytest.fixture(scope="module")
def sharp(relief):
    """Target fitted to all samples in the true frames, and those frames."""
    data, _, truth = relief
    options = RefinementOptions(side=11, fit_steps=12)
    return fit_sharp_targets(data, begun(data, truth), options, 1).targets


def error_of(frames, truth):
    """Root mean square angle, degrees."""
    turns = Rotation.from_matrix(frames @ np.swapaxes(truth, 1, 2)).magnitude()
    return np.rad2deg(np.sqrt(np.mean(turns**2)))


def improved(relief, sharp, samples, spread):
    data, start, _ = relief
    some = SampleSet(samples.astype(np.float32), data.views, data.lights)
    options = RefinementOptions(side=11, spread=spread)
    return improve_frames(some, begun(some, start, sharp), options, 8, 1).frames


@pytest.mark.stability
def test_prior_of_the_true_spread_beats_both_the_samples_and_the_start(relief, sharp, rng):
    data, start, truth = relief
    noisy = data.samples + 0.01 * rng.normal(size=data.samples.shape)
    few = np.where(rng.random(noisy.shape) < 0.03, noisy, np.nan)
    held = error_of(improved(relief, sharp, few, SPREAD), truth)
    free = error_of(improved(relief, sharp, few, np.inf), truth)
    assert held < 0.9 * error_of(start, truth)
    assert held < 0.9 * free


@pytest.mark.stability
def test_prior_keeps_a_texel_of_one_sample_and_gives_way_to_many(relief, sharp, rng):
    data, start, truth = relief
    one = np.full(data.samples.shape, np.nan)
    one[:, 40, 20] = data.samples[:, 40, 20]
    # One sample, whose residual is the noise that it is weighed by, moves a frame by less
    # than the spread.
    assert error_of(improved(relief, sharp, one, SPREAD), start) < np.rad2deg(SPREAD)
    # Thousands, with an error of the coarse target alone, outweigh it.
    held = error_of(improved(relief, sharp, data.samples, SPREAD), truth)
    free = error_of(improved(relief, sharp, data.samples, np.inf), truth)
    # What is left of the prior: observed .04.
    np.testing.assert_allclose(held, free, rtol=0.1)
    np.testing.assert_array_less(
        error_of(improved(relief, sharp, data.samples, 1e-4 * SPREAD), start),
        0.1 * error_of(start, truth),
    )


def test_spread_must_be_positive():
    with pytest.raises(InputError, match="spread"):
        RefinementOptions(spread=0.0)


def test_normal_equations_of_the_prior_are_its_derivatives(rng):
    start = Rotation.random(rng=rng).as_matrix()
    away, strength = np.array([0.02, -0.01, 0.03]), 7.0

    def energy(step):
        frame = (Rotation.from_rotvec(step) * Rotation.from_rotvec(away)).as_matrix() @ start
        return strength * Rotation.from_matrix(frame @ start.T).magnitude() ** 2

    normal = np.zeros((5, 5))
    hold(Rotation.from_rotvec(away).as_matrix() @ start, start, strength, normal)
    h = 1e-4
    steps = h * np.eye(3)
    slope = np.array([energy(s) - energy(-s) for s in steps]) / (2 * h)
    curvature = np.array([energy(s) + energy(-s) - 2 * energy(0 * s) for s in steps]) / h**2
    # The skew part falls short of the turn by its sine, and the curvature bends alike:
    # both relative, by the turn squared; the differences by h squared and eps / h squared.
    angle2 = np.sum(away**2)
    np.testing.assert_allclose(-2 * normal[4, :3], slope, rtol=angle2)
    np.testing.assert_allclose(2 * np.diag(normal)[:3], curvature, rtol=angle2 + 1e-6)
    np.testing.assert_allclose(normal[4, 4], energy(np.zeros(3)), rtol=angle2)
