"""How many lobes the samples of some texels support: by views that are left out.

Tables and coefficients are fitted to the samples of the other views, with one lobe, two, and so
on; the weighted error on the views left out tells what each more is worth. More lobes take
more of the file and of the time, so a lobe has to take away a share of the error.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from reflfield.fitting.nearest_samples import nearest_samples_error
from reflfield.fitting.texel_sample_fit import (
    START_WIDTHS,
    SampleBlock,
    SampleBlocks,
    fit_to_samples,
    solve_coefficients,
    start_model,
    with_start_colors,
)

# Samples that tables are fitted to here: telling numbers of lobes apart takes few.
LEFT_OUT_ROWS = 100_000
# Rounds of tables and coefficients of one lobe, and of several, which part slowly.
ROUNDS, ROUNDS_OF_SEVERAL = 4, 8
MOST_LOBES = len(START_WIDTHS)
# One view of so many is left out, two at least left in.
EVERY, LEAST_VIEWS = 7, 3
# Error that the fewest lobes may have over the least.
TOLERANCE = 0.05


def rounds_of(n_lobes: int) -> int:
    """Rounds of tables and coefficients."""
    return ROUNDS if n_lobes == 1 else ROUNDS_OF_SEVERAL


def views_left_out(n_views: int) -> NDArray[np.bool_]:
    """(n_views,) True for every seventh; none where too few would be left.

    Examples
    --------
    >>> np.flatnonzero(views_left_out(26))
    array([ 3, 10, 17, 24])
    >>> np.flatnonzero(views_left_out(4)), np.flatnonzero(views_left_out(2))
    (array([3]), array([], dtype=int64))
    """
    left_out = np.zeros(n_views, np.bool_)
    if n_views >= LEAST_VIEWS:
        left_out[min(EVERY // 2, n_views - 1) :: EVERY] = True
    return left_out


def of_views(blocks: SampleBlocks, among: NDArray[np.bool_]) -> SampleBlocks:
    """The samples of some views only; `among` is (n_views,) bool."""

    def read(number: int) -> SampleBlock:
        block = blocks[number]
        kept = among[block.camera]
        before = np.concatenate([[0], np.cumsum(kept)])
        return replace(
            block,
            first=before[block.first],
            view=block.view[kept],
            light=block.light[kept],
            values=block.values[kept],
            camera=block.camera[kept],
        )

    return SampleBlocks(read, blocks.n_blocks, blocks.budget)


def left_out_errors(
    blocks: SampleBlocks,
    frames: NDArray[np.float32],
    left_out: NDArray[np.bool_],
    pool: ThreadPoolExecutor,
    smoothness: float,
    seed: int = 0,
) -> tuple[NDArray[np.float64], float]:
    """Weighted root mean square error on views left out, with one lobe, two, and so on.

    Parameters
    ----------
    blocks : SampleBlocks
        Of some texels.
    frames : (n_texels, 3, 3) float32
        Of all texels.
    left_out : (n_views,) bool
    pool : ThreadPoolExecutor
    smoothness : float
        Of the lobes.
    seed : int

    Returns
    -------
    errors : (MOST_LOBES,) float64
    nearest : float
        That of the mean of the texels' nearest samples; see `nearest_samples`.
    """
    fitted, measured = of_views(blocks, ~left_out), of_views(blocks, left_out)
    errors = []
    for n_lobes in range(1, MOST_LOBES + 1):
        model = with_start_colors(fitted, start_model(frames, n_lobes), pool)
        rounds = rounds_of(n_lobes)
        model, _ = fit_to_samples(
            fitted, model, pool, rounds, smoothness, seed, most_rows=LEFT_OUT_ROWS
        )
        errors.append(solve_coefficients(measured, model, pool)[1])
    return np.array(errors), nearest_samples_error(fitted, measured, pool)


def fewest_lobes(errors: Sequence[float] | NDArray[np.floating]) -> int:
    """The fewest lobes whose error is near the least.

    Parameters
    ----------
    errors : (n,) array_like
        With one lobe, two, and so on.

    Returns
    -------
    int

    Examples
    --------
    A vase of three materials; clay:

    >>> fewest_lobes([0.0481, 0.0423, 0.0359, 0.0351]), fewest_lobes([0.02, 0.0199, 0.0201])
    (3, 1)
    """
    return int(np.argmax(np.asarray(errors) <= (1 + TOLERANCE) * np.min(errors))) + 1
