"""Hard cases of the alignment that no other file holds, and how errors grow."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment import RefinementOptions, align, search
from reflfield.alignment.correlation import spectrum
from reflfield.alignment.newton_ascent import follow
from reflfield.alignment.refinement import SharpAlignment, fit_sharp_targets
from reflfield.alignment.sample_sources import SampleSet
from reflfield.alignment.spline_targets import SplineTargets
from reflfield.sphere.coupling import Coupled, couple, rotate_coupled
from reflfield.sphere.harmonic_projection import Projector
from reflfield.sphere.rotations import frames_from_normals, rotation_angle
from reflfield.sphere.wigner import rotation_blocks

pytestmark = pytest.mark.stability
# Coarser and shorter than the default, where only differences count.
QUICK = RefinementOptions(side=15, rounds=2)
# Of a correlation in singles, relative to the norms (`test_correlation_is_exact`).
SINGLES = 5e-6


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
    ("dtype", "largest", "limits"),
    [(np.float32, 1e-6, (2, 4, 8, 12)), (np.float64, 1e-14, (2, 3, 4, 6, 8))],
)
def test_correlation_error_grows_slowly_with_the_degree(dtype, largest, limits, rng, bounded):
    errors = []
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
    bounded.at_most(
        errors,
        largest,
        case="correlation against the direct sum",
        quantity="error over the norms",
        source="1e-14 demanded by the design, ten roundings in float32",
        dtype=dtype,
    )
    slope = np.polyfit(np.log(limits), np.log(errors), 1)[0]
    # Rounding of sums of some L^4 terms adds up like its root at most, over norms of all.
    assert slope < 2.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_error_does_not_depend_on_the_scale(dtype, rng, bounded):
    target = couple(lobes(rng, 1, 6))
    truth = Rotation.random(12, random_state=8).as_matrix()
    source = as_type(turned(target, truth), dtype)
    scales, errors = 10.0 ** np.arange(-12, 13, 4.0), []
    for scale in scales:
        scaled = source.scaled(np.full(12, scale))
        errors.append(degrees(search(scaled, as_type(target, dtype)).rotations, truth).max())
    bounded.at_most(
        errors,
        0.05,
        case="scale 1e-12 to 1e12",
        quantity="planted rotation, degrees",
        source="accuracy demanded of a peak",
        dtype=dtype,
    )
    slope = np.polyfit(np.log(scales), np.log(np.maximum(errors, 1e-9)), 1)[0]
    assert abs(slope) < 0.01


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1.0, 1e6, 1e12])
def test_scale_of_samples_moves_no_frame(scale, scene, bounded):
    frames = scene.relief_frames(20, 12)[::3]
    d = scene.dome_directions()
    samples = scene.sample_texels(frames, d, d).astype(np.float64)
    plain = align(samples, d, d, refine=False)
    scaled = align(samples * scale, d, d, refine=False)
    error = degrees(scaled.local_from_base, plain.local_from_base)
    bounded.at_most(
        error,
        0.05,
        case="scale 1e-12 to 1e12",
        quantity="change of frames, degrees",
        source="steps shorter than this may end a round",
        dtype=np.float32,  # in which samples are read
    )


def test_float32_and_float64_find_the_same(rng, bounded):
    target = couple(lobes(rng, 1, 8))
    truth = Rotation.random(30, random_state=3).as_matrix()
    double = turned(target, truth)
    one = search(double, target)
    two = search(as_type(double, np.float32), as_type(target, np.float32))
    bounded.at_most(
        degrees(one.rotations, two.rotations),
        0.02,
        case="float32 against float64",
        quantity="difference of rotations, degrees",
        source="root of eps over the curvature of a peak",
        dtype=np.float32,
    )
    np.testing.assert_allclose(one.score, two.score, rtol=0, atol=SINGLES)
    np.testing.assert_allclose(one.margin, two.margin, rtol=0, atol=2 * SINGLES)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_half_turn_symmetry_has_two_equal_peaks_and_a_margin_that_knows_it(dtype, rng, bounded):
    target = couple(lobes(rng, 1, 5).astype(dtype))
    half = turned(target, np.diag([-1.0, -1.0, 1.0])[None])
    both = Coupled(
        target.band_limits,
        tuple(a + b for a, b in zip(target.blocks, half.blocks, strict=True)),
    )
    truth = Rotation.random(10, random_state=4).as_matrix()
    source = turned(both, truth)
    blind, aware = search(source, both), search(source, both, half_turns=[True])
    about = {"case": "two-fold symmetry", "dtype": dtype}
    bounded.at_most(
        blind.margin,
        1e-3,
        quantity="margin of two equal peaks",
        source="heights of peaks to the accuracy of a step",
        **about,
    )
    assert aware.margin.min() > 0.01
    error = np.minimum(
        degrees(aware.rotations, truth),
        degrees(aware.rotations, truth @ np.diag([-1.0, -1.0, 1.0])),
    )
    bounded.at_most(
        error,
        0.05,
        quantity="planted rotation up to a half turn, degrees",
        source="accuracy demanded of a peak",
        **about,
    )


def test_maximum_behind_a_saddle_is_not_pruned(scene, bounded):
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
    bounded.at_most(
        1 - maxima.score * source.norms() / peaks[:, 0],
        1e-3,
        case="a maximum behind a saddle",
        quantity="share of the highest score that is missed",
        source="the next peaks are .6 to 1.1 % lower",
        dtype=np.float32,
    )


def test_rotational_symmetry_leaves_the_in_plane_angle_and_nothing_else_undetermined(
    scene, bounded
):
    d = scene.dome_directions()
    frames = scene.relief_frames(20, 12)[::3]
    samples = scene.sample_texels(frames, d, d, nu=20.0, nv=20.0)
    alignment = align(samples, d, d, refine=QUICK)
    assert alignment.symmetries == ("all",)
    # The turn about the normal is the one nearest the base frame.
    twist = alignment.local_from_base[:, 0, 1] - alignment.local_from_base[:, 1, 0]
    about = {"case": "rotational symmetry", "dtype": np.float32}
    bounded.at_most(
        np.abs(twist),
        1e-6,
        quantity="turn about the normal from the base frame, radians",
        source="of equal frames the nearest to the base is chosen, in float32",
        **about,
    )
    bounded.at_most(
        scene.frame_errors(alignment.local_from_base, frames)[0].mean(),
        0.2,
        quantity="mean error of normals, degrees",
        source="two rounds of refinement in the design's table",
        **about,
    )


@pytest.mark.parametrize(("steep", "degrees_off"), [(50.0, 1.5), (65.0, 8.0)])
def test_steep_texels_are_found_and_lead_no_other_astray(steep, degrees_off, scene, bounded):
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
    if steep < 60:
        assert np.median(error[n:]) < degrees_off
        return
    bounded.at_most(
        np.median(error[n:]),
        degrees_off,
        case="tilt past 60 degrees",
        quantity="median error of normals, degrees",
        source="the dome shows a third of what lies above their horizons",
        dtype=np.float32,
    )


def test_duplicates_get_one_answer_and_do_no_harm(scene, bounded):
    d = scene.dome_directions()
    frames = scene.relief_frames(20, 12)[::4]
    samples = scene.sample_texels(frames, d, d)
    together = np.concatenate([samples, samples, samples[:1].repeat(9, 0)])
    alignment = align(together, d, d, refine=QUICK)
    n = len(frames)
    copies = alignment.local_from_base[n:]
    originals = alignment.local_from_base[np.concatenate([np.arange(n), np.zeros(9, int)])]
    bounded.at_most(
        degrees(copies, originals),
        1e-3,
        case="duplicates",
        quantity="difference of equal texels' frames, degrees",
        source="the same operations, in another order of sums",
        dtype=np.float32,
    )


def test_noise_and_gaps_move_frames_by_little(scene, rng, bounded):
    """Two per cent of noise and half of the samples unobserved, before refinement."""
    d = scene.dome_directions()
    frames = scene.relief_frames(20, 12)[::4]
    samples = scene.sample_texels(frames, d, d)
    noise = 0.02 * samples.max() * rng.standard_normal(samples.shape, np.float32)
    hidden = rng.random(samples.shape) < 0.5
    observed = np.where(
        hidden, rng.choice([np.nan, np.inf, -np.inf], samples.shape), samples + noise
    )
    alignment = align(observed.astype(np.float32), d, d, refine=False)
    again = align(np.where(hidden, np.nan, observed).astype(np.float32), d, d, refine=False)
    bounded.at_most(
        scene.frame_errors(alignment.local_from_base, frames)[0].mean(),
        2.0,
        case="noise, and half the samples unobserved",
        quantity="mean error of normals, degrees",
        source="twice the .88 of the noise-free search, for half the samples and noise",
        dtype=np.float32,
    )
    bounded.at_most(
        np.abs(alignment.local_from_base - again.local_from_base),
        0.0,
        case="NaN and infinity where nothing was observed",
        quantity="change of frames by what stands there",
        source="values that are not observed are not read",
        dtype=np.float32,
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


def test_target_of_two_samples_stays_of_their_size(bounded):
    """Conjugate gradients end where only rounding is left, which they would amplify."""
    tilts = Rotation.from_euler("y", [[10.0], [30.0], [50.0]], degrees=True)
    directions = tilts.apply([0.0, 0.0, 1.0])
    samples = np.full((2, 3, 3), np.nan)
    samples[0, 0, 1] = samples[1, 2, 0] = 1.0
    data = SampleSet(samples.astype(np.float32), directions, directions)
    targets = SplineTargets.zeros(1, (3, 3), 7)
    state = SharpAlignment.begin(data, np.tile(np.eye(3), (2, 1, 1)), np.zeros(2, int), targets)
    options = RefinementOptions(side=7, fit_steps=50)
    for _ in range(4):
        state = fit_sharp_targets(data, state, options, 1)
    bounded.at_most(
        np.abs(state.targets.values).max(),
        3.2,
        case="one observed sample",
        quantity="largest node of their target, over the samples",
        source="(4/3)^4 = 3.2: largest tap of a B-spline over its squared taps, four axes",
    )
