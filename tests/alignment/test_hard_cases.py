"""Hard cases of the alignment that no other file holds, and how errors grow."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment import RefinementOptions, align, search
from reflfield.alignment.correlation import spectrum
from reflfield.alignment.newton_ascent import follow
from reflfield.sphere.coupling import Coupled, couple, rotate_coupled
from reflfield.sphere.harmonic_projection import Projector
from reflfield.sphere.rotations import frames_from_normals, rotation_angle
from reflfield.sphere.wigner import rotation_blocks

pytestmark = pytest.mark.stability
# Coarser and shorter than the default, where only differences count.
QUICK = RefinementOptions(side=15, rounds=2)


def lobes(rng, n, band_limit):
    """Random functions whose energy falls with the degree, like reflectances."""
    falling = 1.0 / (1.0 + np.floor(np.sqrt(np.arange(band_limit**2))))
    return rng.standard_normal((n, band_limit**2, band_limit**2)) * falling[:, None] * falling


def turned(target, turns):
    return rotate_coupled(target, rotation_blocks(turns, target.n_degrees, str(target.dtype)))


def as_type(coupled, dtype):
    return Coupled(coupled.band_limits, tuple(b.astype(dtype) for b in coupled.blocks))


def degrees(rotations, truth):
    return np.rad2deg(rotation_angle(np.swapaxes(truth, 1, 2) @ rotations))


@pytest.mark.parametrize(
    ("dtype", "largest"),
    [(np.float32, 1e-6), pytest.param(np.float64, 1e-14, marks=pytest.mark.slow)],
)
def test_correlation_error_grows_slowly_with_the_degree(dtype, largest, rng):
    limits, errors = np.array([2, 4, 8, 12]), []
    turns = Rotation.random(8, random_state=1).as_matrix()
    for limit in limits:
        a, b = couple(lobes(rng, 1, limit)), couple(lobes(rng, 1, limit))
        # The same sum in long double: products of the exact coefficients with float64 blocks.
        blocks = rotation_blocks(turns, a.n_degrees).astype(np.longdouble)
        exact = blocks @ spectrum(a, b)[0].astype(np.longdouble)
        series = spectrum(as_type(a, dtype), as_type(b, dtype))
        value = follow(series, np.zeros(len(turns), np.int64), turns, 0)[1][:, 0]
        scale = float(a.norms()[0] * b.norms()[0])
        errors.append(np.sqrt(np.mean(np.float64(value - exact) ** 2)) / scale)
    assert max(errors) < largest
    slope = np.polyfit(np.log(limits), np.log(errors), 1)[0]
    # Rounding of sums of some L^4 terms adds up like its root at most, over norms of all.
    assert slope < 2.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_error_does_not_depend_on_the_scale(dtype, rng):
    target = couple(lobes(rng, 1, 6))
    truth = Rotation.random(12, random_state=8).as_matrix()
    source = as_type(turned(target, truth), dtype)
    scales, errors = 10.0 ** np.arange(-12, 13, 4.0), []
    for scale in scales:
        scaled = source.scaled(np.full(12, scale))
        errors.append(degrees(search(scaled, as_type(target, dtype)).rotations, truth).max())
    assert max(errors) < 0.05  # what is demanded of a peak
    slope = np.polyfit(np.log(scales), np.log(np.maximum(errors, 1e-9)), 1)[0]
    assert abs(slope) < 0.01


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1.0, 1e6, 1e12])
def test_scale_of_samples_moves_no_frame(scale, scene):
    frames = scene.relief_frames(20, 12)[::3]
    d = scene.dome_directions()
    samples = scene.sample_texels(frames, d, d).astype(np.float64)
    plain = align(samples, d, d, refine=False)
    scaled = align(samples * scale, d, d, refine=False)
    error = degrees(scaled.local_from_base, plain.local_from_base)
    # Other roundings of float32 samples; steps shorter than .05 degrees may end a round.
    assert error.max() < 0.05


def test_float32_and_float64_find_the_same(rng):
    target = couple(lobes(rng, 1, 8))
    truth = Rotation.random(30, random_state=3).as_matrix()
    double = turned(target, truth)
    one = search(double, target)
    two = search(as_type(double, np.float32), as_type(target, np.float32))
    assert degrees(one.rotations, two.rotations).max() < 0.02
    np.testing.assert_allclose(one.score, two.score, atol=1e-5)
    np.testing.assert_allclose(one.margin, two.margin, atol=1e-3)


def test_half_turn_symmetry_has_two_equal_peaks_and_a_margin_that_knows_it(rng):
    target = couple(lobes(rng, 1, 5).astype(np.float32))
    half = turned(target, np.diag([-1.0, -1.0, 1.0])[None])
    both = Coupled(
        target.band_limits,
        tuple(a + b for a, b in zip(target.blocks, half.blocks, strict=True)),
    )
    truth = Rotation.random(10, random_state=4).as_matrix()
    source = turned(both, truth)
    blind, aware = search(source, both), search(source, both, half_turns=[True])
    assert blind.margin.max() < 1e-3
    assert aware.margin.min() > 0.01
    error = np.minimum(
        degrees(aware.rotations, truth),
        degrees(aware.rotations, truth @ np.diag([-1.0, -1.0, 1.0])),
    )
    assert error.max() < 0.05


def test_maximum_behind_a_saddle_is_not_pruned(scene):
    """Texels whose approach with few degrees ends at a saddle of the whole series."""
    texels = [1910, 2034, 3666, 7493, 7625, 9124, 9125, 9249, 9250, 9251]
    frames, directions = scene.relief_frames()[texels], scene.dome_directions(scene.RINGS_151)
    projector = Projector(directions, directions, (8, 8))
    source, target = (
        couple(projector.project(scene.sample_texels(these, directions, directions)))
        for these in (frames, np.eye(3)[None])
    )
    maxima = search(source, target)
    planted = np.swapaxes(frames, 1, 2)
    peaks = follow(spectrum(source, target.units()), np.arange(len(frames)), planted, 30)[1]
    # The peaks that were taken in their place are .6 to 1.1 % lower.
    np.testing.assert_allclose(maxima.score, peaks[:, 0] / source.norms(), rtol=1e-3)


def test_rotational_symmetry_leaves_the_in_plane_angle_and_nothing_else_undetermined(scene):
    d = scene.dome_directions()
    frames = scene.relief_frames(20, 12)[::3]
    samples = scene.sample_texels(frames, d, d, nu=20.0, nv=20.0)
    alignment = align(samples, d, d, refine=QUICK)
    assert alignment.symmetries == ("all",)
    # The turn about the normal is the one nearest the base frame.
    twist = alignment.local_from_base[:, 0, 1] - alignment.local_from_base[:, 1, 0]
    assert np.abs(twist).max() < 1e-6
    assert scene.frame_errors(alignment.local_from_base, frames)[0].mean() < 0.2


@pytest.mark.parametrize(("steep", "degrees_off"), [(50.0, 1.5), (65.0, 8.0)])
def test_steep_texels_are_found_and_lead_no_other_astray(steep, degrees_off, scene):
    rng = np.random.default_rng(0)
    azimuth, n = rng.uniform(0, 2 * np.pi, 60), 52
    tilt = np.deg2rad(np.where(np.arange(60) < n, rng.uniform(0, 30, 60), steep))
    normals = np.stack(
        [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)], axis=1
    )
    frames = frames_from_normals(normals, np.tile([1.0, 0.0, 0.0], (60, 1)))
    d = scene.dome_directions()
    samples = scene.sample_texels(frames, d, d)
    error = scene.frame_errors(align(samples, d, d).local_from_base, frames)[0]
    # A half-turn symmetry that is overlooked would leave all normals 17 degrees off.
    assert error[:n].mean() < 1.0
    # Of a texel this steep the dome shows about a third of what lies above its own horizon.
    assert np.median(error[n:]) < degrees_off


def test_duplicates_get_one_answer_and_do_no_harm(scene):
    d = scene.dome_directions()
    frames = scene.relief_frames(20, 12)[::4]
    samples = scene.sample_texels(frames, d, d)
    together = np.concatenate([samples, samples, samples[:1].repeat(9, 0)])
    alignment = align(together, d, d, refine=QUICK)
    n = len(frames)
    # Equal samples in other rows of a block: the same operations, in another order of sums.
    assert (
        degrees(alignment.local_from_base[:n], alignment.local_from_base[n : 2 * n]).max()
        < 1e-3
    )
    assert (
        degrees(
            alignment.local_from_base[2 * n :], alignment.local_from_base[:1].repeat(9, 0)
        ).max()
        < 1e-3
    )


@pytest.mark.slow
def test_error_grows_in_proportion_to_noise_on_samples(scene, rng):
    d = scene.dome_directions()
    frames = scene.relief_frames(20, 12)[::4]
    samples = scene.sample_texels(frames, d, d)
    levels, errors = np.array([0.05, 0.2, 0.8]), []
    clean = align(samples, d, d, refine=QUICK).local_from_base
    for level in levels:
        noise = level * samples.std() * rng.standard_normal(samples.shape, np.float32)
        noisy = align(samples + noise, d, d, refine=QUICK).local_from_base
        errors.append(degrees(noisy, clean).mean())
    slope = np.polyfit(np.log(levels), np.log(errors), 1)[0]
    assert 0.6 < slope < 1.4
