"""Normal equations of a texel's frame against differences of its cost."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment.gauss_newton import _add_views, rotate_left
from reflfield.alignment.spline_targets import empty_placement, place

SIDE, N = 9, 12


def directions(rng):
    """Unit vectors well above the horizon of frames that are tilted by little."""
    d = rng.standard_normal((N, 3))
    d[:, 2] = np.abs(d[:, 2]) + 0.8
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_right_side_is_half_the_downhill_slope_of_the_cost(rng):
    views, lights = directions(rng), directions(rng)
    samples = rng.uniform(0.5, 1.5, (N, N)).astype(np.float32)
    target = rng.uniform(0.0, 2.0, (SIDE**2, SIDE**2)).astype(np.float32)
    frame = Rotation.from_rotvec([0.1, -0.15, 0.4]).as_matrix()

    def equations(frame, scale):
        placements = empty_placement(N, SIDE), empty_placement(N, SIDE)
        place(views, frame, placements[0])
        place(lights, frame, placements[1])
        normal, lines = np.zeros((5, 5)), np.zeros((3, SIDE**2), np.float32)
        _add_views(samples, target, placements, (scale, 0.1), lines, normal)
        return normal

    def cost(step):
        turned = np.zeros((3, 3))
        rotate_left(frame, np.append(step[:3], 0.0), np.zeros((3, 3)), turned)
        return equations(turned, np.exp(step[3]))[4, 4]

    slopes = []
    for step in 2e-3 * np.eye(4):
        slopes.append((cost(step) - cost(-step)) / 4e-3)
    downhill = -2 * equations(frame, 1.0)[4, :4]
    # Splines of float32 numbers: rounding of the cost over the step, and its third derivative.
    np.testing.assert_allclose(slopes, downhill, atol=0.01 * np.abs(downhill).max())
    assert equations(frame, 1.0)[1, 4] == pytest.approx(N * N)  # samples that count
