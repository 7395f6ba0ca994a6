"""Mean and basis of every cluster for fixed coefficients, by conjugate gradients.

The normal equations of all samples are regularised by the roughness of the functions over
neighbouring nodes.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.field.sample_sums import (
    KernelSamples,
    Taps,
    at_light,
    at_view,
    clear,
    kernel_samples,
    parts,
    touched_nodes,
)
from reflfield.observations.texel_samples import ALL_CHANNELS, Channels, TransformedSamples

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]

# Squares of this size stand for zero; far below what any unit of the data gives.
LEAST_ENERGY = 1e-200


@numba.njit(cache=True, nogil=True, fastmath=True)
def _spread(plane: Floats, nodes: Ints, weights: Floats, values: Floats) -> None:
    for tap in range(4):
        weight = weights[tap]
        for k in range(values.shape[0]):
            plane[nodes[tap], k] += weight * values[k]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _spread_view(
    values: Floats,
    weights: Floats,
    channels: Channels,
    plane: Floats,
    light_taps: Taps,
    factor: Floats,
    of_samples: bool,
    spread: Floats,
) -> None:
    """Add the adjoint of one texel's samples from one view to `spread`."""
    at = np.zeros(plane.shape[1], np.float32)
    nodes, taps = light_taps
    for j in range(len(values)):
        if weights[j] == 0:
            continue
        at_light(plane, nodes[j], taps[j], at)
        # All channels in one loop, which the compiler can turn into vectors.
        red, green, blue = values[j]
        if not of_samples:
            red = green = blue = np.float32(0)
            for k in range(len(factor)):
                red += factor[k] * at[3 * k]
                green += factor[k] * at[3 * k + 1]
                blue += factor[k] * at[3 * k + 2]
        red *= weights[j] * (channels[j] & 1)
        green *= weights[j] * (channels[j] >> 1 & 1)
        blue *= weights[j] * (channels[j] >> 2 & 1)
        for k in range(len(factor)):
            at[3 * k] = factor[k] * red
            at[3 * k + 1] = factor[k] * green
            at[3 * k + 2] = factor[k] * blue
        _spread(spread, nodes[j], taps[j], at)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _spread_over_views(spread: Floats, taps: Taps, touched: Ints, out: Floats) -> None:
    nodes, weights = taps
    for tap in range(4):
        if weights[tap] != 0:
            target = out[nodes[tap]]
            for a in touched:
                for k in range(target.shape[1]):
                    target[a, k] += weights[tap] * spread[a, k]


@numba.njit(cache=True, nogil=True)
def _accumulate(
    samples: KernelSamples,
    cluster: Ints,
    coefficients: Floats,
    table: Floats,
    of_samples: bool,
    out: Floats,
) -> None:
    """Add A^T W A table to `out`, or A^T W values if `of_samples`."""
    plane = np.zeros(table.shape[2:], np.float32)
    spread = np.zeros(table.shape[2:], np.float32)
    factor = np.ones(table.shape[3] // 3, np.float32)
    lit = np.zeros(table.shape[2], np.int32)
    every = np.full(samples.values.shape[2], ALL_CHANNELS, np.uint8)
    for t in range(len(samples.values)):
        light_taps = (samples.light_nodes[t], samples.light_taps[t])
        touched = lit[: touched_nodes(light_taps[0], samples.light_weights[t], lit)]
        for k in range(coefficients.shape[1]):
            factor[k + 1] = coefficients[t, k]
        for i in np.flatnonzero(samples.view_weights[t]):
            taps = (samples.view_nodes[t, i], samples.view_taps[t, i])
            clear(spread, touched)
            if not of_samples:
                at_view(table[cluster[t]], taps, touched, plane)
            _spread_view(
                samples.values[t, i],
                samples.view_weights[t, i] * samples.light_weights[t] * samples.pairs[i],
                samples.channels[t, i] if len(samples.channels) else every,
                plane,
                light_taps,
                factor,
                of_samples,
                spread,
            )
            _spread_over_views(spread, taps, touched, out[cluster[t]])


@dataclass(frozen=True, eq=False)
class BasisProblem:
    """Normal equations of mean and basis for fixed coefficients."""

    samples: TransformedSamples
    cluster: Ints
    coefficients: Floats
    smoothness: float
    pool: ThreadPoolExecutor

    def sums(self, table: Floats, of_samples: bool) -> Floats:
        """Add up A^T W A table over all texels, or A^T W values if `of_samples`."""

        def part_sum(part: slice) -> Floats:
            out = np.zeros_like(table)
            _accumulate(
                kernel_samples(self.samples, part),
                self.cluster[part],
                self.coefficients[part],
                table,
                of_samples,
                out,
            )
            return out

        total = np.zeros_like(table)
        for out in self.pool.map(part_sum, parts(len(self.cluster))):
            total += out
        return total

    def samples_per_node(self, n_clusters: int, n_nodes: int) -> NDArray[np.float32]:
        """Mean weight of a pair of nodes in each cluster; scales the regularisation."""
        samples = self.samples
        weight = np.einsum(
            "ti,ij,tj->t",
            samples.view_weights,
            samples.pairs,
            samples.light_weights,
        )
        if samples.has_gaps:
            pairs = samples.pairs * samples.measured().mean(axis=3, dtype=np.float32)
            weight = np.einsum(
                "ti,tij,tj->t", samples.view_weights, pairs, samples.light_weights
            )
        total = np.bincount(self.cluster, weight, minlength=n_clusters)
        return np.maximum(total / n_nodes, 1e-6).astype(np.float32)

    def solve(self, table: Floats, iterations: int) -> Floats:
        """Conjugate gradients, each cluster with its own step."""
        n_clusters, n_views, n_lights, _ = table.shape
        density = self.samples_per_node(n_clusters, n_views * n_lights)
        strength = (self.smoothness * density)[:, None, None, None]

        def normal(x: Floats) -> Floats:
            return self.sums(x, of_samples=False) + strength * (roughness(x) + 0.01 * x)

        rest = self.sums(table, of_samples=True) - normal(table)
        direction = rest.copy()
        energy = _dot(rest, rest)
        # Steps stop per cluster once rounding in float32 dominates.
        floor = 1e-10 * np.maximum(energy, LEAST_ENERGY)
        for _ in range(iterations):
            image = normal(direction)
            step = np.where(
                energy > floor, energy / np.maximum(_dot(direction, image), LEAST_ENERGY), 0
            )
            table = table + step.astype(np.float32)[:, None, None, None] * direction
            rest = rest - step.astype(np.float32)[:, None, None, None] * image
            renewed = _dot(rest, rest)
            ratio = (renewed / np.maximum(energy, LEAST_ENERGY)).astype(np.float32)
            direction = rest + ratio[:, None, None, None] * direction
            energy = renewed
        return table


def _dot(a: Floats, b: Floats) -> NDArray[np.float64]:
    n = len(a)
    return np.einsum("cx,cx->c", a.reshape(n, -1), b.reshape(n, -1), dtype=np.float64)


def roughness(table: Floats) -> Floats:
    """Sum of differences to neighbouring nodes along both grids' rows and columns.

    The gradient of half the sum of squared differences; used as the regulariser.
    """
    n_clusters, n_views, n_lights, width = table.shape
    v, m = int(np.sqrt(n_views)), int(np.sqrt(n_lights))
    grid = table.reshape(n_clusters, v, v, m, m, width)
    out = np.zeros_like(grid)
    for axis in range(1, 5):
        difference = np.diff(grid, axis=axis)
        lower = [slice(None)] * 6
        upper = [slice(None)] * 6
        lower[axis], upper[axis] = slice(0, -1), slice(1, None)
        out[tuple(lower)] -= difference
        out[tuple(upper)] += difference
    return out.reshape(table.shape)
