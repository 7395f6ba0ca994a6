"""In-plane angles that only the samples tell."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment import RefinementOptions, SampleSet, align
from reflfield.alignment.frame_ambiguity import in_plane_undetermined, resolve_ambiguity
from reflfield.alignment.in_plane_rotation import (
    N_ANGLES,
    angle_margin,
    at_best_angles,
    distances_by_angle,
    find_angles,
)
from reflfield.alignment.refinement import SharpAlignment
from reflfield.alignment.spline_targets import SplineTargets
from reflfield.sphere.coupling import couple
from reflfield.sphere.harmonic_projection import Projector
from reflfield.sphere.hemisphere import HemisphereGrid

QUICK = RefinementOptions(side=13, rounds=3, last_steps=3)


def frames_of_any_angle(rng, n, tilt):
    """Tilts uniform in angle up to `tilt` degrees, any azimuth, any turn."""
    azimuth, turn = rng.uniform(0, 2 * np.pi, (2, n))
    angles = np.stack([azimuth, rng.uniform(0, np.deg2rad(tilt), n), turn - azimuth], axis=1)
    return np.swapaxes(Rotation.from_euler("ZYZ", angles).as_matrix(), 1, 2)


def leaning(local, lean):
    """(n, k, k) samples of a dull surface whose pile leans along x."""
    up = local[..., 2]
    seen = (up > 0)[:, :, None] & (up > 0)[:, None, :]
    both = local[..., 0][:, :, None] + local[..., 0][:, None, :]
    return np.where(seen, (1.0 + lean * both) * up[:, None, :], 0.0).astype(np.float32)


def errors_less_common_rotation(recovered, truth):
    """Normal and turn errors in degrees after the common turn that fits best."""
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", truth, recovered))
    between = (
        (u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt) @ recovered @ truth.swapaxes(1, 2)
    )
    normal = np.arctan2(np.hypot(between[:, 0, 2], between[:, 1, 2]), between[:, 2, 2])
    turn = np.arctan2(between[:, 0, 1] - between[:, 1, 0], between[:, 0, 0] + between[:, 1, 1])
    return np.rad2deg(normal), np.rad2deg(np.abs(turn))


@pytest.mark.slow
def test_angles_of_a_leaning_pile_are_found(scene, rng):
    d = scene.dome_directions()
    truth = frames_of_any_angle(rng, 100, 45.0)
    samples = leaning(np.einsum("nij,kj->nki", truth, d), 0.3)
    alignment = align(samples, d, d, refine=QUICK, n_threads=2)
    assert alignment.symmetries == ("none",)
    normal, turn = errors_less_common_rotation(alignment.local_from_base, truth)
    # The harmonic search leaves several degrees; turns at random would be off by 90.
    assert np.median(normal) < 1.5
    assert np.median(turn) < 5.0
    assert alignment.margin.max() > 0.0


def test_isotropic_reflectance_keeps_the_angle_of_the_base_frame(scene, rng, rounding):
    d = scene.dome_directions()
    truth = frames_of_any_angle(rng, 60, 45.0)
    samples = leaning(np.einsum("nij,kj->nki", truth, d), 0.0)
    alignment = align(samples, d, d, refine=QUICK, n_threads=2)
    assert alignment.symmetries == ("all",)
    frames = alignment.local_from_base
    # The turn nearest to the base frame leaves no antisymmetric part in the tangent plane.
    left = np.abs(frames[:, 0, 1] - frames[:, 1, 0]).max()
    assert left < rounding(float, operations=9)  # products of matrices


def test_isotropic_reflectance_about_an_axis_that_is_not_z_has_no_angle(scene, rng):
    """Rotations about z tilt its texels; those fit again as soon as normals are improved."""
    d = scene.dome_directions()
    truth = frames_of_any_angle(rng, 60, 45.0)
    data = SampleSet(leaning(np.einsum("nij,kj->nki", truth, d), 0.0), d, d)
    off = Rotation.from_rotvec([np.deg2rad(10.0), 0.0, 0.0]).as_matrix() @ truth
    empty = SplineTargets.zeros(1, (len(d), len(d)), QUICK.side)
    state = SharpAlignment.begin(data, off, np.zeros(60, np.int32), empty)
    assert not find_angles(data, state, QUICK, 2)[1]


@pytest.fixture
def known_state(scene, rng):
    """Twenty upright texels of a leaning pile, each turned by a multiple of 15 degrees."""
    d = scene.dome_directions()
    steps = rng.integers(0, N_ANGLES, 20)
    angle = 2 * np.pi * steps / N_ANGLES
    truth = Rotation.from_rotvec(angle[:, None] * np.array([0.0, 0.0, 1.0])).as_matrix()
    samples = leaning(np.einsum("nij,kj->nki", truth, d), 0.4)
    # The pile is linear in the directions, which bilinear nodes hold nearly exactly.
    side = 25
    nodes = HemisphereGrid(side).directions[None]
    values = leaning(np.where(nodes == 0, 1e-9, nodes), 0.4)
    start = np.tile(np.eye(3), (20, 1, 1))
    data, targets = SampleSet(samples, d, d), SplineTargets(values, side, side)
    state = SharpAlignment.begin(data, start, np.zeros(20, np.int32), targets)
    return data, state, truth


def test_best_of_all_angles_is_the_true_one(known_state, rounding):
    data, state, truth = known_state
    best = at_best_angles(data, state, 0.3, 1)
    np.testing.assert_allclose(best.frames, truth, rtol=0, atol=rounding(float, 3))
    distance = distances_by_angle(data, best, 0.3, 1)
    assert distance.shape == (20, N_ANGLES)
    assert np.all(np.argmin(distance, axis=1) == 0)


def test_margin_is_positive_at_the_best_angle_and_zero_elsewhere(known_state):
    data, state, truth = known_state
    right = replace(state, frames=truth)
    assert angle_margin(data, right, 0.3, False, 1).min() > 1e-3
    away = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix() @ truth
    wrong = replace(state, frames=away)
    assert np.array_equal(angle_margin(data, wrong, 0.3, False, 1), np.zeros(20))


def test_normal_is_found_when_angles_follow_the_tilts(scene, rng):
    """Frames whose tilts all lean to the same local side: their mean is not upright."""
    d = scene.dome_directions()
    target = couple(Projector(d, d, (6, 6)).project(leaning(d[None], 0.2))).units()
    azimuth, tilt = rng.uniform(0, 2 * np.pi, 500), rng.uniform(0, np.pi / 3, 500)
    base_from_local = Rotation.from_euler("ZY", np.stack([azimuth, tilt], axis=1)).as_matrix()
    assert in_plane_undetermined(base_from_local, np.ones(500))
    cluster = np.zeros(500, np.int32)
    resolved = resolve_ambiguity(target, base_from_local, cluster, np.ones(500))
    lean = np.arccos(np.sum(resolved.rotations[:, :, 2] * base_from_local[:, :, 2], axis=1))
    # The pile leans the mean light by a few degrees, the mean frame by thirty.
    assert np.rad2deg(lean).max() < 8.0


def test_mean_normal_is_taken_when_angles_are_random(scene, rng, rounding):
    """The pile leans the mean light; frames of which every tilt comes turned to four sides."""
    d = scene.dome_directions()
    target = couple(Projector(d, d, (6, 6)).project(leaning(d[None], 0.2))).units()
    azimuth, turn = rng.uniform(0, 2 * np.pi, (2, 60))
    angles = np.stack([azimuth, rng.uniform(0, np.pi / 3, 60), turn], axis=1).repeat(4, axis=0)
    angles[:, 2] += np.tile(np.arange(4) * np.pi / 2, 60)
    base_from_local = Rotation.from_euler("ZYZ", angles).as_matrix()
    resolved = resolve_ambiguity(target, base_from_local, np.zeros(240, np.int32), np.ones(240))
    # By four sides the mean normal is the normal; the light leans by .077, and the chance error
    # of so few, .025, does not tell it from that.
    lean = np.linalg.norm(resolved.rotations[:, :, 2] - base_from_local[:, :, 2], axis=1)
    # Targets are in single precision, whose light the mean normal is written down from.
    assert lean.max() < rounding(np.float32)
