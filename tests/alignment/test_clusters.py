"""Materials told apart: on the samples, and by harmonics alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from reflfield.alignment import RefinementOptions, SampleSet, align, in_plane_rotation
from reflfield.alignment.material_clusters import tell_apart
from reflfield.alignment.material_distance import distances, residual_features
from reflfield.alignment.refinement import SharpAlignment
from reflfield.alignment.spline_targets import SplineTargets
from reflfield.sphere.hemisphere import LOWEST_Z
from reflfield.sphere.rotations import frames_from_normals

# Coarser and shorter than the default, so that each test takes seconds.
QUICK = RefinementOptions(side=17, rounds=3, last_steps=2)
SIMILAR = ({"nu": 8.0, "nv": 60.0}, {"nu": 12.0, "nv": 60.0})
FAR_APART = (
    {"nu": 8.0, "nv": 60.0},
    {"nu": 60.0, "nv": 60.0, "diffuse": 0.1, "specular": 0.2},
    {"nu": 4.0, "nv": 4.0, "diffuse": 0.5},
    {"nu": 5.0, "nv": 200.0, "diffuse": 0.05, "specular": 0.3},
)


def tilted_frames(rng, n, spread=0.35):
    slope = rng.normal(0.0, spread / 2, (n, 2)).clip(-spread, spread)
    normals = np.concatenate([slope, np.ones((n, 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    angle = rng.uniform(-0.5, 0.5, n)
    return frames_from_normals(
        normals, np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
    )


def mixture(scene, rng, materials, n):
    """Texels of several materials in random order: frames, directions, samples, labels."""
    frames, label = tilted_frames(rng, n), rng.permutation(np.arange(n) % len(materials))
    directions = scene.dome_directions()
    samples = np.zeros((n, len(directions), len(directions)), np.float32)
    for k, material in enumerate(materials):
        mine = label == k
        samples[mine] = scene.sample_texels(frames[mine], directions, directions, **material)
    return frames, directions, samples, label


def agreement(labels, label):
    """Share of equal labels under the best matching of clusters and materials."""
    size = max(labels.max(), label.max()) + 1
    table = np.zeros((size, size), int)
    np.add.at(table, (labels, label), 1)
    return table[linear_sum_assignment(-table)].sum() / len(label)


SHINY_AND_DULL = (SIMILAR[0], {"nu": 20.0, "nv": 20.0, "diffuse": 0.4, "specular": 0.05})


@pytest.mark.parametrize(
    "materials",
    [SIMILAR, pytest.param(FAR_APART, marks=pytest.mark.slow)],
    ids=["similar", "far apart"],
)
def test_materials_are_told_apart_and_normals_as_good_as_alone(materials, scene, rng):
    frames, d, samples, label = mixture(scene, rng, materials, 40 * len(materials))
    alignment = align(samples, d, d, n_clusters=len(materials), refine=QUICK, n_threads=2)
    assert agreement(alignment.cluster, label) >= 0.99
    errors = scene.frame_errors(alignment.local_from_base, frames)[0]
    for k in range(len(materials)):
        mine = label == k
        alone = align(samples[mine], d, d, refine=QUICK, n_threads=2)
        apart = scene.frame_errors(alone.local_from_base, frames[mine])[0]
        # Which texels share a target differs by a few at most; so do the errors.
        assert errors[mine].mean() < 1.2 * apart.mean() + 0.05


def mixed_relief(scene, materials, n):
    """Texels of the paper's relief, of materials at random: as `mixture`."""
    rng, every, d = np.random.default_rng(4), scene.relief_frames(), scene.dome_directions()
    frames = every[np.sort(rng.choice(len(every), n, replace=False))]
    label = rng.integers(0, len(materials), n)
    samples = np.zeros((n, len(d), len(d)), np.float32)
    for k, material in enumerate(materials):
        samples[label == k] = scene.sample_texels(frames[label == k], d, d, **material)
    return frames, d, samples, label


@pytest.mark.slow
def test_a_material_whose_in_plane_angles_the_samples_tell_leaves_the_other_as_it_is(scene):
    frames, d, samples, label = mixed_relief(scene, (SIMILAR[0], FAR_APART[1]), 240)
    alignment = align(samples, d, d, n_clusters=2, n_threads=2)
    assert agreement(alignment.cluster, label) == 1.0
    first = label == 0
    alone = align(samples[first], d, d, n_threads=2)
    apart = scene.frame_errors(alone.local_from_base, frames[first])[0]
    # Its target once took the steps of the other's too, and followed its noise.
    errors = scene.frame_errors(alignment.local_from_base[first], frames[first])[0]
    assert errors.mean() < 1.05 * apart.mean()


@pytest.mark.slow
def test_few_texels_of_a_shiny_and_a_dull_material_are_told_apart(scene):
    # Of these, targets fitted to a third of the views took 64 % to the right material: with so
    # few texels, those views say nothing of the others.
    frames, d, samples, label = mixed_relief(scene, SHINY_AND_DULL, 100)
    alignment = align(samples, d, d, n_clusters=2, n_threads=2)
    assert agreement(alignment.cluster, label) == 1.0
    assert scene.frame_errors(alignment.local_from_base, frames)[0].mean() < 0.2


@pytest.mark.slow
def test_noise_of_two_per_cent_leaves_similar_materials_apart(scene, rng):
    _, d, samples, label = mixture(scene, rng, SIMILAR, 120)
    samples += 0.02 * samples.std() * rng.standard_normal(samples.shape, np.float32)
    alignment = align(samples, d, d, n_clusters=2, refine=QUICK, n_threads=2)
    assert agreement(alignment.cluster, label) >= 0.97


def test_history_never_falls_with_several_clusters(scene, rng):
    _, d, samples, _ = mixture(scene, rng, FAR_APART, 120)
    alignment = align(samples, d, d, n_clusters=4, iterations=8, refine=False)
    assert len(alignment.history) > 1
    assert np.all(np.diff(alignment.history) >= -1e-6)  # float32 sums


@pytest.mark.slow
def test_scores_belong_to_the_cluster_that_texels_end_in(scene, rng, monkeypatch):
    _, d, samples, _ = mixture(scene, rng, FAR_APART[1:3], 80)
    options = RefinementOptions(side=9, rounds=1, last_steps=3)
    right = align(samples, d, d, n_clusters=2, refine=options)
    original = in_plane_rotation.choose

    def contrary(data, state, options, n_steps, n_threads):
        chosen = original(data, state, options, n_steps, n_threads)
        if n_steps == options.last_steps:
            return replace(chosen, cluster=1 - chosen.cluster)
        return chosen

    monkeypatch.setattr(in_plane_rotation, "choose", contrary)
    wrong = align(samples, d, d, n_clusters=2, refine=options)
    assert np.array_equal(wrong.cluster, 1 - right.cluster)
    assert wrong.score.mean() < right.score.mean() - 0.02


@pytest.fixture
def crude(scene, rng):
    """A few texels with gaps, frames, and two random targets on nodes."""
    frames = tilted_frames(rng, 6)
    d = scene.dome_directions()
    samples = scene.sample_texels(frames, d, d)
    samples[rng.random(samples.shape) < 0.2] = np.nan
    values = rng.uniform(0.1, 1.0, (2, 49, 49)).astype(np.float32)
    data = SampleSet(samples, d, d)
    cluster = (np.arange(6) % 2).astype(np.int32)
    return data, SharpAlignment.begin(data, frames, cluster, SplineTargets(values, 7, 7))


@pytest.mark.reference
def test_distance_is_that_of_dense_interpolation(crude, references):
    data, state = crude
    floor = 0.3
    computed = distances(data, state, floor, 1)
    for i, frame in enumerate(state.frames):
        local = data.views @ frame.T
        dense = references.spline_matrix(local, 7)
        y = data.samples[i].astype(np.float64)
        seen = np.isfinite(y) & np.outer(local[:, 2] >= LOWEST_Z, local[:, 2] >= LOWEST_Z)
        w = 1.0 / (floor * data.brightness()[i] + np.abs(y[seen]))
        for k in range(2):
            m = (dense @ state.targets.values[k].astype(np.float64) @ dense.T)[seen]
            cosine = (w * y[seen]) @ m / np.sqrt((w * y[seen]) @ y[seen] * (w * m) @ m)
            # Interpolation is in float32, a few roundings of values near 1.
            assert abs(computed[i, k] - (1.0 - cosine**2)) < 1e-5


def test_features_are_a_part_of_the_distance(crude, rounding):
    data, state = crude
    distance, features = residual_features(data, state, 0.3, 1)
    both = distances(data, state, 0.3, 1)
    # Sums over all samples, whose roundings wander as the root of their number.
    sums = rounding(float, operations=np.sqrt(data.samples[0].size))
    np.testing.assert_allclose(distance, both[np.arange(6), state.cluster], rtol=0, atol=sums)
    part = np.sum(features.astype(np.float64) ** 2, axis=1)
    # Averages over nodes cannot hold more than the whole (Cauchy and Schwarz).
    assert np.all(part > 0.05 * distance)
    assert np.all(part <= distance * (1 + 1e-5))


@pytest.mark.stability
@pytest.mark.parametrize("refine", [False, QUICK], ids=["harmonic", "refined"])
def test_more_clusters_than_texels_and_than_materials(refine, scene, rng):
    _, d, samples, _ = mixture(scene, rng, SIMILAR, 3)
    alignment = align(samples, d, d, n_clusters=8, refine=refine)
    assert 0 <= alignment.cluster.min() <= alignment.cluster.max() < 8
    assert np.isfinite(alignment.local_from_base).all()
    assert alignment.score.min() > 0.5


@pytest.mark.stability
@pytest.mark.parametrize("refine", [False, QUICK], ids=["harmonic", "refined"])
def test_duplicates_of_one_texel_stay_together(refine, scene, rng):
    _, d, samples, _ = mixture(scene, rng, SIMILAR[:1], 1)
    alignment = align(np.tile(samples, (12, 1, 1)), d, d, n_clusters=4, refine=refine)
    assert len(np.unique(alignment.cluster)) == 1
    spread = np.ptp(alignment.local_from_base, axis=0).max()
    # One texel, one answer. Sums of float32 may be ordered differently, and a score is lower by
    # the square of the angle to its maximum.
    assert spread < np.sqrt(np.finfo(np.float32).eps)


@pytest.mark.stability
@pytest.mark.parametrize("refine", [False, QUICK], ids=["harmonic", "refined"])
def test_one_texel_and_none_observed_with_several_clusters(refine, scene, rng):
    _, d, samples, _ = mixture(scene, rng, SIMILAR[:1], 1)
    single = align(samples, d, d, n_clusters=3, refine=refine)
    assert single.local_from_base.shape == (1, 3, 3)
    assert single.score[0] > 0.9
    nothing = align(np.full((4, 81, 81), np.nan), d, d, n_clusters=3, refine=refine)
    assert np.array_equal(nothing.local_from_base, np.tile(np.eye(3), (4, 1, 1)))
    assert np.array_equal(nothing.score, np.zeros(4))


@pytest.mark.slow
@pytest.mark.stability
def test_a_cluster_of_one_texel_is_found_and_does_not_disturb(scene, rng):
    frames, d, samples, _ = mixture(scene, rng, FAR_APART[3:], 60)
    odd = scene.sample_texels(frames[:1], d, d, **FAR_APART[2])
    samples[17] = odd[0]
    samples[3] = np.nan
    alignment = align(samples, d, d, n_clusters=2, refine=QUICK)
    others = np.delete(alignment.cluster, [3, 17])
    assert np.all(others == others[0])
    assert alignment.cluster[17] != others[0]
    assert alignment.score[3] == 0.0


def test_no_division_where_nothing_is_gained(scene, rng):
    """Copies of one texel, exactly known frames: one material, however many are allowed."""
    frames = np.tile(np.eye(3), (20, 1, 1))
    d = scene.dome_directions()
    data = SampleSet(scene.sample_texels(frames, d, d), d, d)
    state = tell_apart(data, frames, 5, QUICK, rng)
    assert len(np.unique(state.cluster)) == 1
