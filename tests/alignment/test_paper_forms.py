"""The forms that the benchmark compares with compute what the paper writes."""

import numpy as np
import pytest

from reflfield.sphere.coupling import couple
from reflfield.sphere.harmonics import real_harmonics
from reflfield.sphere.hemisphere import HemisphereGrid

L = 4
SOME = [0, 77, 300, 511]  # of the 512 rotations of the grid for L = 4


@pytest.fixture
def grid(paper_forms):
    return paper_forms.paper_grid(L)


@pytest.fixture
def functions(rng):
    return rng.standard_normal((2, L * L))


@pytest.fixture
def abrdfs(rng):
    return rng.standard_normal((2, L * L, L * L))


@pytest.mark.reference
def test_direct_and_separated_sums_agree_with_one_rotation_at_a_time(
    functions, grid, paper_forms, references, rounding
):
    a, b = functions
    expected = [a @ references.turn_matrix(grid[i], L) @ b for i in SOME]
    bound = rounding(np.float64, 100, scale=np.linalg.norm(a) * np.linalg.norm(b))
    direct = paper_forms.direct_correlations(a, b, grid)
    assert np.abs(direct[SOME] - expected).max() < bound
    kernel = paper_forms.separation_kernel(L, "float64")
    separated = paper_forms.separated_correlations(a[None], b[None], kernel)[0]
    assert np.abs(separated - direct).max() < bound


@pytest.mark.reference
def test_abrdf_sums_agree_with_one_rotation_at_a_time(
    abrdfs, grid, paper_forms, references, rounding
):
    a, b = abrdfs
    bound = rounding(np.float64, 1000, scale=np.linalg.norm(a) * np.linalg.norm(b))
    direct = paper_forms.direct_abrdf_correlations(a, b, grid[SOME])
    expected = [references.double_wigner_sum(a, b, grid[i]) for i in SOME]
    assert np.abs(direct - expected).max() < bound
    view, light = paper_forms.factors(a[None], 3)
    target = paper_forms.turn_target(b, 3, grid[SOME], "float64")
    factored = paper_forms.factored_correlations(view, light, target, 0)[0]
    expected = [references.rank_k_sum(a, b, grid[i], 3) for i in SOME]
    assert np.abs(factored - expected).max() < bound


def test_highest_of_the_grid_is_found_over_all_its_parts(abrdfs, grid, paper_forms):
    view, light = paper_forms.factors(abrdfs, 2)
    target = paper_forms.turn_target(abrdfs[1], 2, grid, "float64")
    n_parts = len(target.view)
    assert n_parts > 1
    values = [paper_forms.factored_correlations(view, light, target, p) for p in range(n_parts)]
    expected = np.concatenate(values, axis=1).argmax(axis=1)
    assert np.array_equal(paper_forms.factored_maxima(view, light, target), expected)


def test_exact_series_has_its_maximum_where_the_direct_sum_has(
    abrdfs, grid, paper_forms, monkeypatch, rounding
):
    monkeypatch.setattr(paper_forms, "SERIES_AT_ONCE", 100)
    source = couple(abrdfs.astype(np.float32))
    maxima = paper_forms.exact_maxima(source, source[1:], grid)
    for one, index in zip(abrdfs, maxima, strict=True):
        values = paper_forms.direct_abrdf_correlations(one, abrdfs[1], grid)
        # Of a function with itself R and its transpose give the same: rounding decides.
        bound = rounding(np.float32, L**4, scale=np.linalg.norm(one) ** 2)
        assert values[index] > values.max() - bound
        assert values[index] > np.sort(values)[-4]


@pytest.mark.reference
def test_sums_over_samples_agree_with_interpolation_by_the_package(grid, paper_forms, rng):
    nodes = HemisphereGrid(9)
    directions = nodes.directions[20:50]
    a, b = rng.standard_normal((30, 30)), rng.standard_normal((81, 81))
    turn = grid[77]
    local = directions @ turn
    taps, weights = nodes.taps(local)
    matrix = np.zeros((30, 81))
    matrix[np.arange(30)[:, None], taps] = weights * (local[:, 2:] > 0)
    values = paper_forms.sampled_abrdf_correlations(
        a.astype(np.float32), directions, b.astype(np.float32), 9, turn[None]
    )
    expected = np.sum(a * (matrix @ b @ matrix.T))
    # Single precision: shares of nodes and values.
    size = np.abs(a).sum() * np.abs(b).max()
    assert abs(values[0] - expected) < np.finfo(np.float32).eps * size
    line = paper_forms.sampled_correlations(a[0], directions, b[0], 9, turn[None])
    assert line[0] == pytest.approx(a[0] @ matrix @ b[0], abs=1e-6 * np.abs(a[0]).sum())


def test_complex_coefficients_are_those_of_the_same_function(functions, paper_forms, rounding):
    direction = np.array([[0.48, 0.6, 0.64]])
    half = paper_forms.complex_coefficients(functions[0])
    whole = paper_forms.both_signs(half)
    # Order -m of a real function adds the conjugate of order m: degree 1 by hand.
    x, y, z = direction[0]
    root = np.sqrt(3 / (8 * np.pi))
    harmonics = np.array([root * (x - 1j * y), root * np.sqrt(2) * z, -root * (x + 1j * y)])
    value = whole[1, L - 2 : L + 1] @ harmonics
    expected = real_harmonics(direction, L)[0, 1:4] @ functions[0, 1:4]
    assert abs(value - expected) < rounding(np.float64, 10)
