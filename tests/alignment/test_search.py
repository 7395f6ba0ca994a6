import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment import rotation_search, search
from reflfield.alignment.correlation import spectrum
from reflfield.alignment.newton_ascent import follow
from reflfield.alignment.rotation_search import odd_share, rotation_about
from reflfield.errors import InputError, ShapeError
from reflfield.sphere.coupling import Coupled, couple, rotate_coupled, uncouple
from reflfield.sphere.rotations import rotation_angle
from reflfield.sphere.wigner import rotation_blocks

# Of a correlation in singles, relative to the norms (`test_correlation_is_exact`).
SINGLES = 5e-6


def lobes(rng, n, band_limit, dtype=np.float64):
    """Random functions whose energy falls with the degree, like reflectances."""
    falling = 1.0 / (1.0 + np.floor(np.sqrt(np.arange(band_limit**2))))
    shape = (n, band_limit**2, band_limit**2)
    return (rng.standard_normal(shape) * falling[:, None] * falling).astype(dtype)


def error_of(rotations, truth):
    return np.rad2deg(rotation_angle(np.swapaxes(truth, 1, 2) @ rotations))


def turned_copies(target, truth):
    blocks = rotation_blocks(truth, target.n_degrees, str(target.dtype))
    return rotate_coupled(target, blocks)


@pytest.mark.reference
@pytest.mark.parametrize("band_limit", [4, 8, 12])
@pytest.mark.parametrize(("dtype", "bound"), [(np.float64, 1e-12), (np.float32, 5e-6)])
def test_correlation_is_exact(band_limit, dtype, bound, references, rng):
    # The bounds are those that issue and design demand.
    a, b = lobes(rng, 2, band_limit)
    source, target = couple(a[None].astype(dtype)), couple(b[None].astype(dtype))
    turns = Rotation.random(2, random_state=11).as_matrix()
    series = spectrum(source, target)
    value = follow(series, np.zeros(2, np.int64), turns, 0)[1][:, 0]
    expected = [references.double_wigner_sum(a, b, turn) for turn in turns]
    scale = np.linalg.norm(a) * np.linalg.norm(b)
    assert np.abs(value - expected).max() < bound * scale


@pytest.mark.reference
def test_the_papers_forms_agree_with_the_exact_one(references, rng, rounding):
    a, b = lobes(rng, 2, 4)
    turn = Rotation.random(random_state=3).as_matrix()
    exact = references.double_wigner_sum(a, b, turn)
    sums = rounding(float, operations=16 * 16, scale=np.linalg.norm(a) * np.linalg.norm(b))
    assert references.quadrature_sum(a, b, turn) == pytest.approx(exact, abs=sums)
    assert references.rank_k_sum(a, b, turn, 16) == pytest.approx(exact, abs=sums)
    assert abs(references.rank_k_sum(a, b, turn, 4) - exact) > 1e-6 * abs(exact)


@pytest.mark.parametrize("band_limit", [4, 8])
def test_derivatives_match_differences(band_limit, rng):
    source, target = couple(lobes(rng, 1, band_limit)), couple(lobes(rng, 1, band_limit))
    series, row = spectrum(source, target), np.zeros(1, np.int64)
    h = 1e-4

    def value(turn):
        return follow(series, row, turn[None], 0)[1][0, 0]

    for turn in (
        np.eye(3),
        np.diag([1.0, -1, -1]),
        Rotation.random(random_state=4).as_matrix(),
    ):
        derivatives = follow(series, row, turn[None], 0)[1][0]
        step = [rotation_about(axis[None], h)[0] for axis in np.eye(3)]
        gradient = [(value(turn @ e) - value(turn @ e.T)) / (2 * h) for e in step]
        scale = np.abs(derivatives[1:4]).max()
        # Differences of a function of degree 2 L - 2: relative error (h degree)^2 / 6.
        np.testing.assert_allclose(
            derivatives[1:4], gradient, atol=scale * (h * 2 * band_limit) ** 2
        )
        second = [
            (value(turn @ e) + value(turn @ e.T) - 2 * derivatives[0]) / h**2 for e in step
        ]
        np.testing.assert_allclose(
            derivatives[4:7], second, atol=1e-4 * np.abs(derivatives[4:7]).max()
        )


@pytest.mark.parametrize("limits", [(8, 8), (4, 4), (6, 3), (1, 8), (8, 1)])
def test_planted_rotations_come_back(limits, rng):
    a = rng.standard_normal((1, limits[0] ** 2, limits[1] ** 2)).astype(np.float32)
    target = couple(a)
    truth = Rotation.random(100, random_state=2).as_matrix()
    maxima = search(turned_copies(target, truth), target)
    assert error_of(maxima.rotations, truth).max() < 0.05  # what the issue demands of a peak
    np.testing.assert_allclose(maxima.score, 1.0, atol=1e-5)  # float32 sums
    assert maxima.margin.min() > 0.01


@pytest.mark.stability
@pytest.mark.parametrize("beta", [0.0, 1e-9, np.pi / 2, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_poles_of_the_euler_angles_are_not_special(beta, dtype, rng, bounded):
    target = couple(lobes(rng, 1, 6, dtype))
    truth = Rotation.from_euler("ZYZ", [[0.3, beta, -1.2], [0.0, beta, 0.0]]).as_matrix()
    maxima = search(turned_copies(target, truth), target)
    bounded.at_most(
        error_of(maxima.rotations, truth),
        0.05,
        case="rotation exactly at beta = 0 or pi",
        quantity="planted rotation, degrees",
        source="accuracy demanded of a peak",
        dtype=dtype,
    )


@pytest.mark.stability
def test_found_maximum_is_the_global_one(rng):
    # Unrelated functions: no high peak stands out, the hardest search there is.
    source, target = couple(lobes(rng, 12, 6, np.float32)), couple(lobes(rng, 1, 6, np.float32))
    grid = Rotation.random(20000, random_state=1).as_matrix()
    values = spectrum(source, target) @ rotation_blocks(grid, 11, "float32").T
    brute = values.max(axis=1) / (source.norms() * target.norms())
    maxima = search(source, target, n_peaks=8)
    assert np.sum(maxima.score < brute - 1e-5) <= 1  # rounding; one miss in 12 is tolerated


def nearly_symmetric(target, odd):
    """What changes sign with a half turn about z, scaled."""
    blocks = [block.copy() for block in target.blocks]
    for j, block in enumerate(blocks):
        block[:, (j + 1) % 2 :: 2] *= odd
    return Coupled(target.band_limits, tuple(blocks))


@pytest.mark.stability
@pytest.mark.parametrize("odd", [0.0, 1e-3, 0.02])
def test_of_two_sides_that_hardly_differ_the_better_is_found(odd, rng):
    target = nearly_symmetric(couple(lobes(rng, 1, 6)), odd)
    assert odd_share(target) < rotation_search.SYMMETRIC_SHARE
    truth = Rotation.random(100, random_state=5).as_matrix()
    result = search(turned_copies(target, truth), target)
    rotations = result.rotations
    if odd == 0.0:
        other = rotations @ np.diag([-1.0, -1.0, 1.0])
        assert np.minimum(error_of(rotations, truth), error_of(other, truth)).max() < 0.05
    else:
        assert error_of(rotations, truth).max() < 0.05
    # The odd part counts against the other side twice, whose peak lies a little aside.
    np.testing.assert_allclose(result.margin, 2 * odd_share(target), rtol=0.03, atol=1e-6)


@pytest.mark.parametrize("half_turns", [(), (True,)])
def test_climbing_one_of_two_sides_loses_nothing(half_turns, rng, monkeypatch):
    target = nearly_symmetric(couple(lobes(rng, 1, 6)), 0.02)
    truth = Rotation.random(100, random_state=6).as_matrix()
    source = turned_copies(target, truth)
    noise = 0.3 * lobes(rng, 100, 6)
    source = couple(uncouple(source) + noise)
    short = search(source, target, half_turns=half_turns)
    tie = rotation_search.SYMMETRIC_SHARE
    monkeypatch.setattr(rotation_search, "SYMMETRIC_SHARE", 0.0)
    full = search(source, target, half_turns=half_turns)
    # Of two sides within a thousandth, the full search keeps the one that it ascends first.
    assert np.all(short.score >= full.score * (1 - 1e-6))
    same = short.score <= full.score * (1 + 1e-6)
    assert same.mean() > 0.9
    assert error_of(short.rotations, full.rotations)[same].max() < 0.05
    # As large as what one of the two sides may lack: observed 3e-4.
    np.testing.assert_allclose(short.margin, full.margin, rtol=0, atol=tie)


def nearly_round(target, rest):
    """What varies with the turn about z, scaled."""
    blocks = [block.copy() for block in target.blocks]
    for j, block in enumerate(blocks):
        block[:, np.arange(2 * j + 1) != j] *= rest
    return Coupled(target.band_limits, tuple(blocks))


@pytest.mark.stability
def test_on_a_ridge_no_other_turn_is_better(rng):
    # All turns about the normal of a dull lobe score alike, within a per cent: the way along
    # the ridge to its top is longer than what a peak approached with few degrees tells.
    target = nearly_round(couple(lobes(rng, 1, 6)), 0.05)
    truth = Rotation.random(200, random_state=8).as_matrix()
    source = uncouple(turned_copies(target, truth))
    source = couple(source + 0.05 * lobes(rng, len(truth), 6))
    maxima = search(source, target, margins=False)
    angles = np.tile(np.arange(24) * np.pi / 12, len(truth))
    about = rotation_about(np.tile([0.0, 0.0, 1.0], (len(angles), 1)), angles)
    others = np.repeat(maxima.rotations, 24, axis=0) @ about
    rows = np.repeat(np.arange(len(truth)), 24)
    heights = follow(spectrum(source, target.units()), rows, others, 12)[1][:, 0]
    highest = heights.reshape(-1, 24).max(axis=1) / source.norms()
    assert np.all(highest <= maxima.score + 1e-5)


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1e6, 1e12])
def test_scale_does_not_matter(scale, rng):
    target = couple(lobes(rng, 1, 5, np.float32))
    truth = Rotation.random(5, random_state=8).as_matrix()
    source = turned_copies(target, truth)
    plain, scaled = search(source, target), search(source.scaled(np.full(5, scale)), target)
    assert error_of(scaled.rotations, plain.rotations).max() < 0.01
    np.testing.assert_allclose(scaled.score, plain.score, rtol=0, atol=SINGLES)


@pytest.mark.stability
def test_error_grows_in_proportion_to_the_noise(rng):
    target = couple(lobes(rng, 1, 6))
    truth = Rotation.random(60, random_state=9).as_matrix()
    clean = turned_copies(target, truth)
    noise = couple(rng.standard_normal((60, 36, 36)))
    levels = np.array([1e-4, 1e-3, 1e-2])
    errors = []
    for level in levels:
        blocks = zip(clean.blocks, noise.blocks, strict=True)
        noisy = type(clean)(clean.band_limits, tuple(c + level * e for c, e in blocks))
        errors.append(error_of(search(noisy, target).rotations, truth).mean())
    slope = np.polyfit(np.log(levels), np.log(errors), 1)[0]
    assert 0.8 < slope < 1.2


def test_tilt_limit_is_kept(rng):
    target = couple(lobes(rng, 1, 5, np.float32))
    truth = Rotation.from_euler(
        "ZYZ", [[0.2, b, 0.4] for b in (0.1, 0.8, 1.5, 2.5)]
    ).as_matrix()
    maxima = search(turned_copies(target, truth), target, max_tilt=1.0)
    tilt = np.arccos(np.clip(maxima.rotations[:, 2, 2], -1, 1))
    assert tilt.max() <= 1.0 + 1e-6
    assert error_of(maxima.rotations, truth)[:2].max() < 0.05


def test_best_of_several_targets_is_found(rng):
    targets = couple(lobes(rng, 5, 5, np.float32))
    truth = Rotation.random(40, random_state=5).as_matrix()
    label = np.arange(40) % 5
    maxima = search(turned_copies(targets[label], truth), targets)
    assert np.array_equal(maxima.cluster, label)
    assert error_of(maxima.rotations, truth).max() < 0.05


def test_round_lobe_has_no_margin_and_a_zero_function_no_score(rng):
    axial = np.zeros((1, 25, 25), np.float32)
    zonal = np.arange(5) ** 2 + np.arange(5)
    axial[0, zonal[:, None], zonal[None, :]] = rng.standard_normal((5, 5))
    target = couple(axial)
    maxima = search(target, target)
    assert maxima.margin[0] < 2 * SINGLES
    nothing = search(target.scaled(np.zeros(1)), target)
    assert nothing.score[0] == 0.0
    assert nothing.margin[0] == 0.0
    assert np.array_equal(nothing.rotations[0], np.eye(3))


def test_threads_do_not_change_a_bit(rng):
    target = couple(lobes(rng, 1, 4, np.float32))
    source = couple(lobes(rng, 600, 4, np.float32))
    one, two = search(source, target), search(source, target, n_threads=2)
    assert np.array_equal(one.rotations, two.rotations)
    assert np.array_equal(one.margin, two.margin)


def test_bad_arguments_are_refused(rng):
    a, b = couple(lobes(rng, 2, 4)), couple(lobes(rng, 1, 3))
    with pytest.raises(InputError, match="target: expected band limits"):
        search(a, b)
    with pytest.raises(InputError, match="max_tilt"):
        search(a, a[:1], max_tilt=4.0)
    with pytest.raises(ShapeError, match="start"):
        search(a, a[:1], start=np.eye(3))


def test_of_targets_that_are_alike_the_first_is_taken(rng):
    """Turned copies correlate as well as each other, but for roundings."""
    target = couple(lobes(rng, 1, 6, np.float32))
    truth = Rotation.random(43, random_state=rng).as_matrix()
    copies = turned_copies(target, truth)
    assert not search(copies[3:], copies[:3]).cluster.any()
