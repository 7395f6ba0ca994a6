"""Lines of neighbouring texels on one side, whatever signs they came with."""

import numpy as np
import pytest

from reflfield.export.coherent_signs import coherent_signs

ROWS, COLUMNS = 24, 31


def lines_of(angle):
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def opposed(lines, texels):
    """Neighbouring pixels whose lines point apart."""
    across = np.einsum("ijk,ijk->ij", lines[texels][:, :-1], lines[texels][:, 1:]) < 0
    down = np.einsum("ijk,ijk->ij", lines[texels][:-1], lines[texels][1:]) < 0
    return int(across.sum() + down.sum())


@pytest.fixture
def grid():
    return np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)


@pytest.mark.parametrize("turns", [0.0, 0.7, 3.0])
def test_of_lines_that_turn_slowly_none_are_opposed(grid, rng, turns):
    angle = np.pi * turns * (np.arange(COLUMNS) / COLUMNS + np.arange(ROWS)[:, None] / ROWS)
    lines = lines_of(angle.ravel()) * rng.choice([-1.0, 1.0], grid.size)[:, None]
    assert opposed(lines, grid) > grid.size / 2
    assert opposed(lines * coherent_signs(lines, grid)[:, None], grid) == 0


def test_around_half_a_turn_one_row_of_pairs_remains(grid, rng):
    y, x = np.mgrid[:ROWS, :COLUMNS]
    angle = 0.5 * np.arctan2(y - 11.5, x - 15.5)
    lines = lines_of(angle.ravel()) * rng.choice([-1.0, 1.0], grid.size)[:, None]
    left = opposed(lines * coherent_signs(lines, grid)[:, None], grid)
    # From the centre to some border, a pair or two for each pixel of the way.
    assert 1 <= left <= 2 * (ROWS + COLUMNS)


def test_charts_apart_and_lines_without_direction(grid, rng):
    grid[:, 15] = -1
    lines = lines_of(np.full(grid.size, 0.3))
    lines[::7] = 0.0
    signs = coherent_signs(lines * rng.choice([-1.0, 1.0], grid.size)[:, None], grid)
    assert set(np.abs(signs)) == {1.0}
    assert coherent_signs(np.zeros((0, 2)), np.full((3, 3), -1)).shape == (0,)
