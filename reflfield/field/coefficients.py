"""Coefficients of texels for a fixed basis: a small solve per texel with a Gaussian prior.

Where a texel would be brighter than its bounds allow (`field.bounds`) its prior grows, no
further than the errors of its samples let it.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.field.bounds import exceeds, probes, raise_top
from reflfield.field.clustered_model import ClusteredModel
from reflfield.field.sample_sums import (
    KernelSamples,
    Taps,
    at_light,
    at_view,
    kernel_samples,
    parts,
    touched_nodes,
)
from reflfield.observations.texel_samples import ALL_CHANNELS, Channels, TransformedSamples
from reflfield.util.cholesky import cholesky_factor, solve_columns, solve_vector

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int32]

# The prior of a texel beyond its bounds grows by this, so many times at most.
STRENGTHENING, STRENGTHENINGS = 4.0, 8
# Standard deviations that coefficients may differ from what the samples give.
ALLOWED_DEVIATION = 3.0


@numba.njit(cache=True, nogil=True, fastmath=True)
def _weighted_rows(
    values: Floats,
    weights: Floats,
    channels: Channels,
    plane: Floats,
    light_taps: Taps,
    rows: Doubles,
    rest: Doubles,
) -> tuple[int, float]:
    """Basis at one texel's samples from one view, and what the mean leaves, times root weights.

    Rows (3 * n_lights, K) and rest (3 * n_lights,) are filled for the channels that were
    measured, whose number and summed weight are returned; `channels` (n_lights,) has the bits.
    """
    n_components = rows.shape[1]
    at = np.zeros(plane.shape[1], np.float32)
    nodes, taps = light_taps
    n, total = 0, 0.0
    for j in range(len(values)):
        if weights[j] == 0:
            continue
        at_light(plane, nodes[j], taps[j], at)
        root = np.sqrt(weights[j])
        for c in range(3):
            if not channels[j] >> c & 1:
                continue
            rest[n] = root * (values[j, c] - at[c])
            for k in range(n_components):
                rows[n, k] = root * at[3 * (k + 1) + c]
            total += weights[j]
            n += 1
    return n, total


@numba.njit(cache=True, nogil=True, fastmath=True)
def _add_normal_equations(
    rows: Doubles,
    rest: Doubles,
    normal: Doubles,
    right: Doubles,
    squares: Doubles,
) -> None:
    """Add rows of a least squares problem; four at a time, so that sums are read less often.

    Of `normal` the lower triangle is right; what lies above it is not.
    """
    n_components = len(right)
    # Whole vectors of four.
    ends = np.minimum((np.arange(n_components) // 4 + 1) * 4, n_components)
    whole = len(rows) // 4 * 4
    for i in range(0, whole, 4):
        a, b, c, d = rows[i], rows[i + 1], rows[i + 2], rows[i + 3]
        for k in range(n_components):
            p, q, r, s = a[k], b[k], c[k], d[k]
            right[k] += p * rest[i] + q * rest[i + 1] + r * rest[i + 2] + s * rest[i + 3]
            into = normal[k]
            for m in range(ends[k]):
                into[m] += p * a[m] + q * b[m] + r * c[m] + s * d[m]
    for i in range(whole, len(rows)):
        for k in range(n_components):
            right[k] += rows[i, k] * rest[i]
            for m in range(ends[k]):
                normal[k, m] += rows[i, k] * rows[i, m]
    for i in range(len(rest)):
        squares[0] += rest[i] * rest[i]


@numba.njit(cache=True, nogil=True)
def _trace(matrix: Doubles) -> float:
    total = 0.0
    for k in range(len(matrix)):
        total += matrix[k, k]
    return total


@numba.njit(cache=True, nogil=True)
def _solve_texel(
    normal: Doubles,
    right: Doubles,
    precision: Doubles,
    n_values: int,
    coefficients: Floats,
    squares: Doubles,
) -> None:
    """Coefficients of one texel; its squared residual falls by what they explain.

    They stay as they are if they are not determined.
    """
    n = len(right)
    full, factor, mean = np.zeros((n, n)), np.zeros((n, n)), right.copy()
    for k in range(n):
        for m in range(n):
            full[k, m] = normal[max(k, m), min(k, m)]
            factor[k, m] = full[k, m] + precision[k, m]
    if not cholesky_factor(factor, n):
        return
    solve_vector(factor, mean)
    explained = 0.0
    for k in range(n):
        coefficients[k] = mean[k]
        image = 0.0
        for m in range(n):
            image += full[k, m] * mean[m]
        explained += mean[k] * (2 * right[k] - image)
    squares[0] = max(squares[0] - explained, 0.0)
    # Each coefficient that the samples determine takes one of the values, of mean weight:
    # without this the noise is underestimated, the prior is too weak, and texels with few
    # samples overfit.
    solve_columns(factor, full)
    squares[1] *= max(1.0 - _trace(full) / n_values, 0.0)


@numba.njit(cache=True, nogil=True)
def _solve_bounded(
    normal: Doubles,
    right: Doubles,
    precision: Doubles,
    n_values: int,
    at_probes: Floats,
    top: Floats,
    deviation: float,
    coefficients: Floats,
    squares: Doubles,
) -> None:
    """Coefficients of one texel, with as strong a prior as keeps it within its bounds.

    The stronger prior first changes what the samples determine least. It goes no further than
    their errors allow: a texel that they show to be unlike its cluster remains so.
    """
    before = squares.copy()
    _solve_texel(normal, right, precision, n_values, coefficients, squares)
    noise = max(squares[0] / max(squares[1], 1e-30), _trace(precision) / len(right))
    most = squares[0] + deviation**2 * len(right) * noise
    step = 0
    while step < STRENGTHENINGS and exceeds(at_probes, coefficients, top):
        step += 1
        stronger = precision * STRENGTHENING**step
        weaker, rest = coefficients.copy(), before.copy()
        _solve_texel(normal, right, stronger, n_values, coefficients, rest)
        if rest[0] > most:
            for k in range(len(weaker)):
                coefficients[k] = weaker[k]
            return
        squares[0], squares[1] = rest[0], rest[1]


@numba.njit(cache=True, nogil=True)
def _solve_coefficients(
    samples: KernelSamples,
    cluster: Ints,
    table: Floats,
    precision: Doubles,
    at_probes: Floats,
    deviation: float,
    coefficients: Floats,
    squares: Doubles,
) -> None:
    n_components = precision.shape[1]
    plane = np.zeros(table.shape[2:], np.float32)
    lit = np.zeros(table.shape[2], np.int32)
    every = np.full(samples.values.shape[2], ALL_CHANNELS, np.uint8)
    rows = np.zeros((3 * samples.values.shape[2], n_components))
    rest = np.zeros(len(rows))
    for t in range(len(samples.values)):
        light_taps = (samples.light_nodes[t], samples.light_taps[t])
        touched = lit[: touched_nodes(light_taps[0], samples.light_weights[t], lit)]
        normal = np.zeros((n_components, n_components))
        right = np.zeros(n_components)
        n_values = 0
        top = np.zeros(3, np.float32)
        for i in np.flatnonzero(samples.view_weights[t]):
            values = samples.values[t, i]
            weights = samples.view_weights[t, i] * samples.light_weights[t] * samples.pairs[i]
            measured = samples.channels[t, i] if len(samples.channels) else every
            raise_top(values, weights, measured, top)
            taps = (samples.view_nodes[t, i], samples.view_taps[t, i])
            at_view(table[cluster[t]], taps, touched, plane)
            n, total = _weighted_rows(values, weights, measured, plane, light_taps, rows, rest)
            _add_normal_equations(rows[:n], rest[:n], normal, right, squares[t])
            squares[t, 1] += total
            n_values += n
        if squares[t, 1] > 0 and n_components > 0:
            c = cluster[t]
            _solve_bounded(
                *(normal, right, precision[c], n_values, at_probes[c], top, deviation),
                *(coefficients[t], squares[t]),
            )


def solve_coefficients(
    samples: TransformedSamples,
    cluster: Ints,
    model: ClusteredModel,
    pool: ThreadPoolExecutor,
    *,
    bounded: bool = False,
    deviation: float = ALLOWED_DEVIATION,
) -> tuple[Floats, Doubles]:
    """Coefficients of texels for a fixed basis.

    Parameters
    ----------
    samples : TransformedSamples
        Samples of n texels.
    cluster : (n,) int32
    model : ClusteredModel
        Its `table` and `precision` are used.
    pool : ThreadPoolExecutor
    bounded : bool
        Whether a texel may be nowhere brighter than its samples and, by a factor, than the
        mean of its cluster: where it was not observed its coefficients are undetermined.
    deviation : float
        Standard deviations that coefficients may thereby differ from what the samples give.

    Returns
    -------
    coefficients : (n, K) float32
        Zero for a texel without samples.
    squares : (n, 2) float64
        Weighted squared residual of each texel, and its degrees of freedom: total weight
        (channels counted), less the share of the values that coefficients are determined by.
    """
    n_components = model.precision.shape[1]
    coefficients = np.zeros((len(cluster), n_components), np.float32)
    squares = np.zeros((len(cluster), 2))
    at_probes = probes(model.table)[:, : None if bounded else 0]

    def solve(part: slice) -> None:
        _solve_coefficients(
            kernel_samples(samples, part),
            cluster[part],
            model.table,
            model.precision,
            at_probes,
            deviation,
            coefficients[part],
            squares[part],
        )

    for _ in pool.map(solve, parts(len(cluster))):
        pass
    return coefficients, squares
