"""Splines of view and light, and the sums over samples that fit them."""

import numpy as np
import pytest
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial.transform import Rotation

from reflfield.alignment.refinement import (
    LEAST_TOUCH,
    RefinementOptions,
    SharpAlignment,
    fit_sharp_targets,
)
from reflfield.alignment.sample_sources import SampleSet
from reflfield.alignment.spline_targets import (
    SplineTargets,
    Texels,
    back_project,
    empty_placement,
    expect,
    place,
)

SIDE, FLOOR = 9, 0.3


def upper(rng, n, lowest=0.1):
    """Directions in the upper hemisphere, z above `lowest`."""
    z = rng.uniform(lowest, 1.0, n)
    azimuth = rng.uniform(0, 2 * np.pi, n)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=1)


def placed(directions, frame, side=SIDE):
    placement = empty_placement(len(directions), side)
    place(directions, frame, placement)
    return placement


def fitted(data, frames, brightness, options):
    """Nodes of one target fitted from zero."""
    state = SharpAlignment(
        SplineTargets.zeros(1, data.samples.shape[1:], SIDE),
        frames,
        brightness,
        np.zeros(len(frames), np.int32),
        frames,
    )
    return fit_sharp_targets(data, state, options, 1).targets.values


@pytest.mark.reference
def test_taps_are_scipys_splines(references, rng, rounding):
    frame = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    directions = upper(rng, 200, 0.4)
    placement = placed(directions, frame)
    first, taps = placement.first, placement.taps
    ours = np.zeros((200, SIDE * SIDE))
    for i in range(200):
        for a in range(4):
            for b in range(4):
                ours[i, first[i] + a * SIDE + b] = taps[i, 2, a] * taps[i, 0, b]
    np.testing.assert_allclose(
        ours, references.spline_matrix(directions @ frame.T, SIDE), atol=rounding(np.float32, 8)
    )


def test_slopes_are_derivatives_of_the_place(rng):
    directions, h = upper(rng, 50, 0.3), 1e-6
    frame = Rotation.from_rotvec([0.05, 0.1, -0.2]).as_matrix()

    def position(turn):
        local = directions @ (Rotation.from_rotvec(turn).as_matrix() @ frame).T
        return 0.5 * (SIDE - 3) * local[:, :2] / np.sqrt(1 + local[:, 2:])

    slopes = placed(directions, frame).slopes
    for k, axis in enumerate(h * np.eye(3)):
        slope = (position(axis) - position(-axis)) / (2 * h)
        # Float32 of numbers of order SIDE; differences err by h squared and eps / h.
        np.testing.assert_allclose(slopes[:, [k, 3 + k]], slope, atol=1e-5)


@pytest.fixture
def problem(rng):
    """Few texels, with gaps, of a random target in known frames."""
    n, views, lights = 6, upper(rng, 7, 0.4), upper(rng, 5, 0.4)
    frames = Rotation.from_rotvec(rng.normal(0, 0.05, (n, 3))).as_matrix()
    samples = rng.uniform(0.1, 2.0, (n, 7, 5)).astype(np.float32)
    samples[rng.random(samples.shape) < 0.3] = np.nan
    samples[0, 0, 0] = np.inf
    return SampleSet(samples, views, lights), frames, rng.uniform(0.5, 2.0, n)


@pytest.fixture
def dense(problem, references):
    """Interpolation matrix, samples and weights of all observed samples."""
    data, frames, brightness = problem
    rows, values, weights = [], [], []
    for i, frame in enumerate(frames):
        both = np.kron(
            references.spline_matrix(data.views @ frame.T, SIDE),
            references.spline_matrix(data.lights @ frame.T, SIDE),
        )
        y = data.samples[i].ravel()
        seen = np.isfinite(y)
        rows.append(brightness[i] * both[seen])
        values.append(y[seen])
        weights.append(1.0 / (FLOOR * brightness[i] + np.abs(y[seen])))
    return np.concatenate(rows), np.concatenate(values), np.concatenate(weights)


@pytest.mark.reference
def test_sums_are_those_of_the_dense_matrices(problem, dense, rng, rounding):
    data, frames, brightness = problem
    t, y, w = dense
    nodes = rng.standard_normal((SIDE**2, SIDE**2)).astype(np.float32)
    sums, touched = np.zeros(nodes.shape), np.zeros(nodes.shape)
    views, lights = data.directions()
    sides = (SIDE, SIDE)
    texels = Texels(data.samples, views, lights, frames, brightness, sides, FLOOR)
    back_project(texels, nodes, True, sums, touched)
    tolerance = rounding(np.float32, operations=256 + len(y), scale=np.abs(t.T @ (w * y)).max())
    np.testing.assert_allclose(
        sums.ravel(), t.T @ (w * (y - t @ nodes.ravel())), atol=tolerance
    )
    scale = np.repeat(brightness, [np.isfinite(s).sum() for s in data.samples])
    np.testing.assert_allclose(touched.ravel(), t.T @ (w * scale), atol=tolerance)
    # Without samples: the product with the normal equations, with its sign turned.
    sums[:], before = 0.0, touched.copy()
    back_project(texels, nodes, False, sums, touched)
    np.testing.assert_allclose(sums.ravel(), -t.T @ (w * (t @ nodes.ravel())), atol=tolerance)
    np.testing.assert_array_equal(touched, before)


def test_expected_samples_are_those_of_dense_matrices(problem, references, rng, rounding):
    data, frames, _ = problem
    nodes = rng.standard_normal((SIDE**2, SIDE**2)).astype(np.float32)
    view, light = placed(data.views, frames[0]), placed(data.lights, frames[0])
    light.first[2] = -1
    line, out = np.zeros(SIDE**2, np.float32), np.zeros((7, 5), np.float32)
    expect(nodes, view, light, line, out)
    views, lights = (
        references.spline_matrix(directions @ frames[0].T, SIDE)
        for directions in (data.views, data.lights)
    )
    direct = views @ nodes @ lights.T
    assert np.isnan(out[:, 2]).all()
    keep = [0, 1, 3, 4]
    tolerance = rounding(np.float32, operations=256, scale=np.abs(nodes).max())
    np.testing.assert_allclose(out[:, keep], direct[:, keep], atol=tolerance)


@pytest.mark.reference
@pytest.mark.parametrize("n_steps", [1, 6])
def test_fit_takes_the_steps_of_scipys_conjugate_gradients(problem, dense, n_steps):
    data, frames, brightness = problem
    t, y, w = dense
    options = RefinementOptions(side=SIDE, fit_steps=n_steps)
    nodes = fitted(data, frames, brightness, options).ravel()
    scale = np.repeat(brightness, [np.isfinite(s).sum() for s in data.samples])
    touched = t.T @ (w * scale)
    size = (len(touched), len(touched))
    normal = LinearOperator(size, lambda x: t.T @ (w * (t @ x)))
    divide = LinearOperator(size, lambda x: x / (touched + LEAST_TOUCH * touched.mean()))
    expected = cg(normal, t.T @ (w * y), M=divide, rtol=0.0, maxiter=n_steps)[0]
    # Float32 products; each step multiplies their error by a few.
    tolerance = 3.0**n_steps * 1e2 * np.finfo(np.float32).eps * np.abs(expected).max()
    np.testing.assert_allclose(nodes, expected, atol=tolerance)


@pytest.mark.stability
def test_texels_that_show_nothing_leave_the_target_alone(problem):
    data, frames, _ = problem
    options = RefinementOptions(side=SIDE)
    assert not fitted(data, frames, np.zeros(len(frames)), options).any()
    black = SampleSet(np.zeros_like(data.samples), data.views, data.lights)
    assert not fitted(black, frames, np.ones(len(frames)), options).any()
