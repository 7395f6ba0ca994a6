"""Rotation search and alignment of whatever functions and samples Hypothesis finds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from reflfield.alignment import RefinementOptions, align, search
from reflfield.alignment.correlation import spectrum
from reflfield.alignment.newton_ascent import follow
from reflfield.sphere.coupling import couple, rotate_coupled
from reflfield.sphere.wigner import rotation_blocks

pytestmark = pytest.mark.stability
LIMIT = 3
# Small integers make functions that are equal, zero, round or symmetric; the others differ in
# size by twelve orders.
ENTRIES = st.one_of(st.integers(-2, 2), st.sampled_from([1e-6, 1e6]))
FUNCTIONS = arrays(np.float64, (LIMIT**2, LIMIT**2), elements=ENTRIES)
UNITS = st.sampled_from([1e-12, 1.0, 1e12])
SEEDS = st.integers(0, 2**31)
DTYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64])
# Samples of a texel: nothing, black, one peak, or anything between.
SAMPLES = arrays(
    np.float64,
    (4, 12, 12),
    elements=st.one_of(st.just(np.nan), st.integers(0, 2), st.sampled_from([1e-6, 1e6])),
    fill=st.sampled_from([0.0, 1.0, np.nan]),
)


def departures(rotations):
    """Largest entry of R^T R - 1, and of det R - 1."""
    gram = np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)
    return max(np.abs(gram).max(), np.abs(np.linalg.det(rotations) - 1.0).max())


def correlations(source, target, rotations):
    """Correlation of one function with a target at some rotations."""
    series = spectrum(source, target)
    return follow(series, np.zeros(len(rotations), np.int64), rotations, 0)[1][:, 0]


@DTYPES
def test_no_rotation_beats_the_one_that_the_search_finds(dtype, bounded):
    offs, losses, planted = [0.0], [0.0], [0.0]

    @settings(max_examples=30, deadline=None)
    @given(FUNCTIONS, FUNCTIONS, UNITS, SEEDS)
    def any_pair(one, other, unit, seed):
        turns = Rotation.random(24, random_state=seed).as_matrix()
        source = couple((one * unit)[None].astype(dtype))
        target = couple((other * unit)[None].astype(dtype))
        # Norms of the functions in the unit of the first, squares of 1e-18 in single precision.
        size = np.linalg.norm(one) * np.linalg.norm(other) or 1.0
        result = search(source, target)
        offs.append(departures(result.rotations))
        assert np.isfinite(result.score).all()
        assert np.isfinite(result.margin).all()
        at = correlations(source, target, np.concatenate([result.rotations, turns]))
        losses.append((at[1:].max() - at[0]) / unit**2 / size)

    @settings(max_examples=20, deadline=None)
    @given(FUNCTIONS, SEEDS)
    def turned_copy(one, seed):
        turn = Rotation.random(1, random_state=seed).as_matrix()
        target = couple(one[None].astype(dtype))
        blocks = rotation_blocks(turn, target.n_degrees, str(target.dtype))
        result = search(rotate_coupled(target, blocks), target)
        if one.any():
            # At the planted rotation it is 1 (Cauchy and Schwarz).
            planted.append(1.0 - result.score[0])

    any_pair()
    turned_copy()
    precision = np.finfo(dtype).eps
    about = {"case": "any functions", "dtype": dtype}
    bounded.at_most(
        offs,
        1e-12,
        quantity="departure of a rotation from one",
        source="products of rotations in double precision",
        **about,
    )
    bounded.at_most(
        losses,
        1e3 * precision,
        quantity="correlation at random rotations over that of the search, less it, over norms",
        source="sums of L^4 products in the data's precision, and the end of Newton's steps",
        **about,
    )
    bounded.at_most(
        planted,
        max(1e3 * precision, 1e-8),
        quantity="1 less the score of a turned copy",
        source="the same; on a ridge Newton's steps end within 1e-4 radians, squared",
        **about,
    )


def test_alignment_of_any_samples_gives_frames(bounded):
    directions = Rotation.from_euler(
        "zy", [[40.0 * i, 20.0 + 15.0 * (i % 4)] for i in range(12)], degrees=True
    ).apply([0.0, 0.0, 1.0])
    quick = RefinementOptions(side=7, rounds=1, last_steps=1)
    offs = [0.0]

    @settings(max_examples=25, deadline=None)
    @given(SAMPLES, UNITS)
    def search_samples(samples, unit):
        made = align(samples * unit, directions, directions, 2, 1, refine=quick)
        offs.append(departures(made.local_from_base))

    search_samples()
    bounded.at_most(
        offs,
        1e-6,
        case="any samples of texels",
        quantity="departure of a frame from a rotation",
        source="frames in single precision",
    )
