import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment import align
from reflfield.alignment.expectation_maximisation import TargetFit
from reflfield.alignment.horizon_imputation import (
    Horizon,
    impute_and_ascend,
    impute_targets,
)
from reflfield.alignment.rotation_search import search
from reflfield.sphere.coupling import Coupled, couple, rotate_coupled
from reflfield.sphere.harmonic_projection import Projector
from reflfield.sphere.wigner import rotation_blocks

OPTIONS = {"max_tilt": None, "n_threads": 1}


@pytest.fixture(scope="module")
def horizon(scene):
    directions = scene.dome_directions()
    return Horizon.of(Projector(directions, directions, (6, 6)))


def turned(target, turns):
    blocks = rotation_blocks(turns, target.n_degrees, str(target.dtype))
    return rotate_coupled(target, blocks)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_unseen_part_of_the_target_itself_is_found_exactly(horizon, dtype, rng, rounding):
    target = couple(rng.standard_normal((1, 36, 36)).astype(dtype))
    turns = Rotation.random(7, random_state=0).as_matrix()
    whole = turned(target, turns).scaled(np.linspace(0.2, 3.0, 7))
    whole_again = horizon.imputed(horizon.seen(whole), target, turns)
    # Two products with operators of 36 rows, stored in float32, and two recombinations.
    tolerance = rounding(np.float32, operations=4 * 36, scale=float(whole.norms().max()))
    for a, b in zip(whole_again.blocks, whole.blocks, strict=True):
        np.testing.assert_allclose(a, b, atol=tolerance)


@pytest.mark.stability
def test_zero_functions_and_opposites_are_left_alone(horizon, rng):
    target = couple(rng.standard_normal((1, 36, 36)))
    turns = np.tile(np.eye(3), (2, 1, 1))
    seen = horizon.seen(turned(target, turns))
    hard = seen.scaled(np.array([0.0, -1.0]))
    for a, b in zip(horizon.imputed(hard, target, turns).blocks, hard.blocks, strict=True):
        np.testing.assert_array_equal(a, b)


def test_imputation_finds_rotations_of_functions_cut_at_the_horizon(horizon, rng):
    falling = 1.0 / (1.0 + np.floor(np.sqrt(np.arange(36)))) ** 2
    target = couple(rng.standard_normal((1, 36, 36)) * falling[:, None] * falling)
    # A reflectance is zero below its own horizon; of a function that is not, a tilted dome may
    # cut off most, and the search then finds another rotation.
    target = horizon.seen(target).units()
    turns = Rotation.from_rotvec(rng.normal(0, 0.4, (40, 3))).as_matrix()
    cut = horizon.seen(turned(target, turns))
    maxima = search(cut, target)
    imputed = impute_and_ascend(cut, target, maxima, horizon, 30, OPTIONS)

    def error(rotations):
        chord = np.linalg.norm(rotations - turns, axis=(1, 2)) / np.sqrt(2.0)
        return np.rad2deg(np.median(chord))

    assert error(maxima.rotations) > 2.0
    assert error(imputed.rotations) < 0.5  # where the steps of a round fall below .05 degrees


def test_history_of_the_imputation_never_falls(horizon, rng):
    target = couple(rng.standard_normal((1, 36, 36))).units()
    turns = Rotation.from_rotvec(rng.normal(0, 0.3, (30, 3))).as_matrix()
    cut = horizon.seen(turned(target, turns))
    fit = TargetFit(target, search(cut, target), np.array([0.1]))
    history = impute_targets(cut, fit, horizon, 5, OPTIONS).history
    assert len(history) > 1
    assert (np.diff(history) >= 0).all()


def test_tilted_texels_are_no_longer_drawn_to_the_base_frame(scene):
    frames = scene.relief_frames(slope=0.6)[::40]
    directions = scene.dome_directions()
    samples = scene.sample_texels(frames, directions, directions)
    result = align(samples, directions, directions, refine=False)
    steep = frames[:, 2, 2] < np.cos(np.deg2rad(10.0))
    normals = result.local_from_base[steep][:, 2]
    outwards = frames[steep][:, 2] * [1, 1, 0]
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    towards = np.rad2deg(np.sum((normals - frames[steep][:, 2]) * outwards, axis=1))
    # 2.8 degrees towards the base normal if what is unseen counts as dark.
    assert abs(towards.mean()) < 0.5


def test_band_limit_one_is_seen_whole():
    up = np.array([[0.0, 0.0, 1.0]])
    horizon = Horizon.of(Projector(up, up, (1, 1)))
    one = Coupled((1, 1), (np.ones((1, 1, 1)),))
    np.testing.assert_allclose(horizon.seen(one).blocks[0], 1.0, rtol=1e-6)  # stored in float32
