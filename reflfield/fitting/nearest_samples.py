r"""What a texel's own samples tell of views left out, without any model.

The sample for view v and light l is predicted by the mean of the texel's samples under other
lights, those for near directions first:

.. math:: \hat f(v, l) = \frac{\sum_i w_i f_i}{\sum_i w_i}, \qquad
          w_i = \exp\Big(-\frac{|v - v_i|^2 + |l - l_i|^2}{2 h^2}\Big)

(Nadaraya and Watson's estimate). Samples under the same light are no use: they tell what a matt
texel shows from another view, and nothing of other lights. Where there are none but those,
they are taken. Functions of the half vector that predict no better say
nothing of the object: a texel is not one place of a surface. That is so of a hull that closes a
bowl with a lid, where a texel shows another place of the inside from each view.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.fitting.robust_weights import HUBER, squared_weight
from reflfield.fitting.texel_sample_fit import SampleBlock, SampleBlocks

# Widths h that are tried, chords of the unit sphere: about the distances of directions in
# captures of 12 x 12 to 64 x 64 photographs.
WIDTHS = (0.1, 0.15, 0.2, 0.3)
# Pairs of samples that are looked at with each width, about: a second. Of dense captures only
# some of the samples are predicted.
MOST_PAIRS = 100_000_000
# Weight of a sample however far it is, so that there is always a mean.
LEAST_WEIGHT = 1e-30
# Square of the chord between directions of lights that count as one.
SAME_LIGHT = 1e-6


def nearest_samples_error(
    fitted: SampleBlocks, measured: SampleBlocks, pool: ThreadPoolExecutor
) -> float:
    """Weighted root mean square error on samples of which the others are told.

    Parameters
    ----------
    fitted, measured : SampleBlocks
        Samples of the same texels: those that are known, and those that are predicted.
    pool : ThreadPoolExecutor

    Returns
    -------
    float
        With the best of `WIDTHS`, in the units of `texel_sample_fit.solve_coefficients`; 0
        where nothing can be predicted.
    """
    apart = _error(fitted, measured, pool, SAME_LIGHT)
    return apart if apart > 0 else _error(fitted, measured, pool, -1.0)


def _error(
    fitted: SampleBlocks, measured: SampleBlocks, pool: ThreadPoolExecutor, apart: float
) -> float:
    """`nearest_samples_error` by samples whose lights are so far apart, squared, at least."""
    numbers = range(fitted.n_blocks)
    pairs = sum(pool.map(lambda n: _pairs(fitted[n], measured[n]), numbers))
    every = max(1, -(-pairs // MOST_PAIRS))

    def one(number: int) -> NDArray[np.float64]:
        sums = np.zeros((len(WIDTHS), 2))
        known, asked = (_arrays(blocks[number]) for blocks in (fitted, measured))
        for width, out in zip(WIDTHS, sums, strict=True):
            _add_errors(known, asked, every, (-0.5 / width**2, apart), out)
        return sums

    parts = list(pool.map(one, numbers))
    squares, count = np.sum([np.zeros((len(WIDTHS), 2)), *parts], axis=0).T
    return float(np.sqrt((squares / np.maximum(count, 1)).min()))


def _pairs(known: SampleBlock, asked: SampleBlock) -> int:
    """Pairs of a known and an asked sample of one texel."""
    return int(np.diff(known.first) @ np.diff(asked.first))


def _arrays(block: SampleBlock) -> tuple[Any, ...]:
    """First sample of each texel; directions (n_samples, 6) and values of the samples."""
    row = np.repeat(np.arange(len(block.texels)), np.diff(block.first))
    views, lights = block.views[row, block.view], block.lights[row, block.light]
    return block.first, np.concatenate([views, lights], axis=1), block.values


@numba.njit(cache=True, nogil=True)
def _mean(known: Any, row: int, towards: Any, kernel: Any, mean: Any) -> None:
    """Mean of a texel's samples for one channel each; NaN where there is none."""
    first, directions, values = known
    scale, apart = kernel
    total = np.zeros(3)
    mean[:] = 0.0
    for i in range(first[row], first[row + 1]):
        of_view = of_light = 0.0
        for axis in range(3):
            of_view += (directions[i, axis] - towards[axis]) ** 2
            of_light += (directions[i, 3 + axis] - towards[3 + axis]) ** 2
        if of_light < apart:
            continue
        weight = np.exp(scale * (of_view + of_light)) + LEAST_WEIGHT
        for c in range(3):
            if not np.isnan(values[i, c]):
                mean[c] += weight * values[i, c]
                total[c] += weight
    for c in range(3):
        mean[c] = mean[c] / total[c] if total[c] > 0.0 else np.nan


@numba.njit(cache=True, nogil=True)
def _add_errors(known: Any, asked: Any, every: int, kernel: Any, out: Any) -> None:
    """Add weighted squared errors of the asked samples, and how many values they are."""
    first, directions, values = asked
    mean = np.zeros(3)
    for row in range(len(first) - 1):
        for s in range(first[row] + row % every, first[row + 1], every):
            _mean(known, row, directions[s], kernel, mean)
            for c in range(3):
                y, shown = values[s, c], np.float32(mean[c])
                if not np.isnan(y) and not np.isnan(shown):
                    out[0] += squared_weight(y, shown, HUBER) * (y - shown) ** 2
                    out[1] += 1.0
