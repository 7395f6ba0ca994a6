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
Ints = NDArray[np.int32]

# The prior of a texel beyond its bounds grows by this, so many times at most.
STRENGTHENING, STRENGTHENINGS = 4.0, 8
# Standard deviations that coefficients may differ from what the samples give.
ALLOWED_DEVIATION = 3.0


@numba.njit(cache=True, nogil=True, fastmath=True)
def _add_normal_equations(
    values: Floats,
    weights: Floats,
    channels: Channels,
    plane: Floats,
    light_taps: Taps,
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    squares: NDArray[np.float64],
) -> None:
    """Add one texel's samples from one view: values (n_lights, 3), weights (n_lights,).

    `channels` (n_lights,) has the bits of those that were measured.
    """
    n_components = len(right)
    at = np.zeros(plane.shape[1], np.float32)
    nodes, taps = light_taps
    for j in range(len(values)):
        if weights[j] == 0:
            continue
        at_light(plane, nodes[j], taps[j], at)
        for c in range(3):
            if not channels[j] >> c & 1:
                continue
            squares[1] += weights[j]
            rest = values[j, c] - at[c]
            squares[0] += weights[j] * rest * rest
            for k in range(n_components):
                moment = weights[j] * at[3 * (k + 1) + c]
                right[k] += moment * rest
                for m in range(k + 1):
                    normal[k, m] += moment * at[3 * (m + 1) + c]


@numba.njit(cache=True, nogil=True)
def _trace(matrix: NDArray[np.float64]) -> float:
    total = 0.0
    for k in range(len(matrix)):
        total += matrix[k, k]
    return total


@numba.njit(cache=True, nogil=True)
def _solve_texel(
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    precision: NDArray[np.float64],
    n_values: int,
    coefficients: Floats,
    squares: NDArray[np.float64],
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
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    precision: NDArray[np.float64],
    n_values: int,
    at_probes: Floats,
    top: Floats,
    deviation: float,
    coefficients: Floats,
    squares: NDArray[np.float64],
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
def _count_values(weights: Floats, channels: Channels) -> int:
    """Number of values that were measured, of samples with weight."""
    count = 0
    for j in range(len(weights)):
        if weights[j] != 0:
            for c in range(3):
                count += channels[j] >> c & 1
    return count


@numba.njit(cache=True, nogil=True)
def _solve_coefficients(
    samples: KernelSamples,
    cluster: Ints,
    table: Floats,
    precision: NDArray[np.float64],
    at_probes: Floats,
    deviation: float,
    coefficients: Floats,
    squares: NDArray[np.float64],
) -> None:
    n_components = precision.shape[1]
    plane = np.zeros(table.shape[2:], np.float32)
    lit = np.zeros(table.shape[2], np.int32)
    every = np.full(samples.values.shape[2], ALL_CHANNELS, np.uint8)
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
            n_values += _count_values(weights, measured)
            raise_top(values, weights, measured, top)
            taps = (samples.view_nodes[t, i], samples.view_taps[t, i])
            at_view(table[cluster[t]], taps, touched, plane)
            _add_normal_equations(
                values,
                weights,
                measured,
                plane,
                light_taps,
                normal,
                right,
                squares[t],
            )
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
) -> tuple[Floats, NDArray[np.float64]]:
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
