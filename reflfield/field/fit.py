r"""Basis and coefficients fitted to the samples themselves.

Aligned texels of one cluster see one reflectance from many directions. Instead of
resampling each texel and fitting the result, the model

.. math:: u_{tij} = \sum_{n \in T_i} \sum_{m \in T_j} a_{in} b_{jm}
          \Big( M_{nm} + \sum_k c_{tk} B_{k,nm} \Big)

is fitted to all samples u (in the domain) of all texels at once: T and a, b are the taps
and weights of a sample's view and light. Mean M and basis B of every cluster follow by
conjugate gradients on the regularised normal equations, coefficients c by a small solve
per texel with a Gaussian prior; the two alternate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.checks import check_ranges
from reflfield.errors import InputError
from reflfield.field.bounds import exceeds, probes, raise_top
from reflfield.observations.texel_samples import ALL_CHANNELS, Channels, RootedSamples
from reflfield.progress import report, track

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
Reader = Callable[[NDArray[np.intp]], RootedSamples]

# Partial sums are formed for this many parts and added in order, so that the result does
# not depend on the number of workers.
N_PARTS = 8
# Root mean square of the means of usual samples, as cube roots.
USUAL_SIZE = 0.35
# Squares of this size stand for zero; far below what any unit of the data gives.
LEAST_ENERGY = 1e-200


# The prior of a texel beyond its bounds grows by this, so many times at most.
STRENGTHENING, STRENGTHENINGS = 4.0, 8
# Standard deviations that coefficients may thereby differ from what the samples give.
ALLOWED_DEVIATION = 3.0


# Largest values of options; beyond them a run takes days, or no machine holds the tables.
MOST = {"rounds": 1000, "iterations": 10_000, "max_bytes": 1 << 40, "fineness": 16}


@dataclass(frozen=True)
class SampleFitOptions:
    """Effort and regularisation of the fit to the samples.

    Parameters
    ----------
    rounds : int
        Alternations of basis and coefficients.
    iterations : int
        Conjugate gradient steps of each basis solve.
    smoothness : float
        Weight of squared differences between neighbouring nodes against one sample at
        each node.
    frame_spread_deg : float
        Standard deviation about each axis that the aligned frames are taken to have: half
        way through the rounds they are improved against the model, held by that much.
        0 keeps them.
    fineness : float
        Intervals between nodes in the second half of the rounds over those of the grid of the
        resampling (`field.fineness`). 1 keeps that grid.
    max_bytes : int
        Samples of the texels that shape the basis are held in memory up to this size;
        coefficients are found for all texels, block by block.
    """

    rounds: int = 4
    iterations: int = 12
    smoothness: float = 0.05
    frame_spread_deg: float = 1.0
    fineness: float = 4 / 3
    max_bytes: int = 192 << 20

    def __post_init__(self) -> None:
        for name, most in MOST.items():
            if not 1 <= getattr(self, name) <= most:
                raise InputError(
                    f"{name}: expected at least 1 and at most {most}, "
                    f"received {getattr(self, name)}"
                )
        check_ranges(self, {"smoothness": (0, 1e6), "frame_spread_deg": (0, 180)})

    def halves(self) -> tuple[SampleFitOptions, SampleFitOptions]:
        """Rounds before and after the frames are improved, one at least of each.

        Examples
        --------
        >>> [half.rounds for half in SampleFitOptions(rounds=5).halves()]
        [2, 3]
        """
        first = max(1, self.rounds // 2)
        return replace(self, rounds=first), replace(self, rounds=max(1, self.rounds - first))


@dataclass(frozen=True, eq=False)
class ClusteredModel:
    """Mean and basis of every cluster with the texels' coefficients.

    Parameters
    ----------
    cluster : (n_texels,) int32
    coefficients : (n_texels, K) float32
    table : (n_clusters, n_view_nodes, n_light_nodes, (K + 1) * 3) float32
        Mean, then basis; channel fastest.
    precision : (n_clusters, K, K) float64
        Inverse prior covariance of the coefficients times the noise variance.
    residuals : tuple of float
        Root mean square over the fitted samples after each round.
    """

    cluster: Ints
    coefficients: Floats
    table: Floats
    precision: NDArray[np.float64]
    residuals: tuple[float, ...] = ()

    @property
    def mean(self) -> Floats:
        """(n_clusters, n_view_nodes, n_light_nodes, 3)."""
        return self.table[..., :3]

    @property
    def basis(self) -> Floats:
        """(n_clusters, K, n_view_nodes, n_light_nodes, 3)."""
        parts = self.table.reshape(*self.table.shape[:3], -1, 3)
        return np.moveaxis(parts[..., 1:, :], 3, 1)


@numba.njit(cache=True, nogil=True)
def _touched(nodes: Ints, weights: Floats, found: Ints) -> int:
    """Number of light nodes that samples of one texel lie between; they are put in `found`."""
    is_touched = np.zeros(len(found), np.bool_)
    for j in range(len(nodes)):
        if weights[j] != 0:
            for tap in range(4):
                is_touched[nodes[j, tap]] = True
    count = 0
    for node in range(len(found)):
        if is_touched[node]:
            found[count] = node
            count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _clear(plane: Floats, touched: Ints) -> None:
    for a in touched:
        for k in range(plane.shape[1]):
            plane[a, k] = 0


@numba.njit(cache=True, nogil=True, fastmath=True)
def _at_view(table: Floats, nodes: Ints, weights: Floats, touched: Ints, out: Floats) -> None:
    """Functions of the light alone, at the nodes that matter."""
    _clear(out, touched)
    for tap in range(4):
        weight = weights[tap]
        if weight != 0:
            plane = table[nodes[tap]]
            for a in touched:
                for k in range(out.shape[1]):
                    out[a, k] += weight * plane[a, k]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _at_light(plane: Floats, nodes: Ints, weights: Floats, out: Floats) -> None:
    out[:] = 0
    for tap in range(4):
        weight = weights[tap]
        for k in range(out.shape[0]):
            out[k] += weight * plane[nodes[tap], k]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _spread(plane: Floats, nodes: Ints, weights: Floats, values: Floats) -> None:
    for tap in range(4):
        weight = weights[tap]
        for k in range(values.shape[0]):
            plane[nodes[tap], k] += weight * values[k]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _add_normal_equations(
    values: Floats,
    weights: Floats,
    channels: Channels,
    plane: Floats,
    light_nodes: Ints,
    light_taps: Floats,
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    squares: NDArray[np.float64],
) -> None:
    """Add one texel's samples from one view: values (n_lights, 3), weights (n_lights,).

    `channels` (n_lights,) has the bits of those that were measured.
    """
    n_components = len(right)
    at = np.zeros(plane.shape[1], np.float32)
    for j in range(len(values)):
        if weights[j] == 0:
            continue
        _at_light(plane, light_nodes[j], light_taps[j], at)
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
def _solve_texel(
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    precision: NDArray[np.float64],
    n_values: int,
    coefficients: Floats,
    squares: NDArray[np.float64],
) -> None:
    """Coefficients of one texel; its squared residual falls by what they explain."""
    full = np.tril(normal) + np.tril(normal, -1).T
    found = np.linalg.solve(full + precision, right)
    coefficients[:] = found
    explained = 2 * np.dot(found, right) - np.dot(found, np.dot(full, found))
    squares[0] = max(squares[0] - explained, 0.0)
    # Each coefficient that the samples determine takes one of the values, of mean weight:
    # without this the noise is underestimated, the prior is too weak, and texels with few
    # samples overfit.
    determined = np.trace(np.linalg.solve(full + precision, full))
    squares[1] *= max(1.0 - determined / n_values, 0.0)


@numba.njit(cache=True, nogil=True)
def _solve_bounded(
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    precision: NDArray[np.float64],
    n_values: int,
    at_probes: Floats,
    top: Floats,
    coefficients: Floats,
    squares: NDArray[np.float64],
) -> None:
    """Coefficients of one texel, with as strong a prior as keeps it within its bounds.

    The stronger prior moves first what the samples say least of. It goes no further than their
    errors allow: a texel that they show to be unlike its cluster remains so.
    """
    before = squares.copy()
    _solve_texel(normal, right, precision, n_values, coefficients, squares)
    noise = max(squares[0] / max(squares[1], 1e-30), np.trace(precision) / len(right))
    most = squares[0] + ALLOWED_DEVIATION**2 * len(right) * noise
    step = 0
    while step < STRENGTHENINGS and exceeds(at_probes, coefficients, top):
        step += 1
        stronger = precision * STRENGTHENING**step
        weaker, rest = coefficients.copy(), before.copy()
        _solve_texel(normal, right, stronger, n_values, coefficients, rest)
        if rest[0] > most:
            coefficients[:] = weaker
            return
        squares[:] = rest


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
    values: Floats,
    view_nodes: Ints,
    view_taps: Floats,
    light_nodes: Ints,
    light_taps: Floats,
    view_weights: Floats,
    light_weights: Floats,
    pairs: Floats,
    channels: Channels,
    cluster: Ints,
    table: Floats,
    precision: NDArray[np.float64],
    at_probes: Floats,
    coefficients: Floats,
    squares: NDArray[np.float64],
) -> None:
    n_components = precision.shape[1]
    plane = np.zeros(table.shape[2:], np.float32)
    lit = np.zeros(table.shape[2], np.int32)
    every = np.full(values.shape[2], ALL_CHANNELS, np.uint8)
    for t in range(len(values)):
        touched = lit[: _touched(light_nodes[t], light_weights[t], lit)]
        normal = np.zeros((n_components, n_components))
        right = np.zeros(n_components)
        n_values = 0
        top = np.zeros(3, np.float32)
        for i in np.flatnonzero(view_weights[t]):
            weights = view_weights[t, i] * light_weights[t] * pairs[i]
            measured = channels[t, i] if len(channels) else every
            n_values += _count_values(weights, measured)
            raise_top(values[t, i], weights, measured, top)
            taps = (view_nodes[t, i], view_taps[t, i])
            _at_view(table[cluster[t]], *taps, touched, plane)
            _add_normal_equations(
                values[t, i],
                weights,
                measured,
                plane,
                light_nodes[t],
                light_taps[t],
                normal,
                right,
                squares[t],
            )
        if squares[t, 1] > 0 and n_components > 0:
            c = cluster[t]
            _solve_bounded(
                *(normal, right, precision[c], n_values, at_probes[c], top),
                *(coefficients[t], squares[t]),
            )


@numba.njit(cache=True, nogil=True, fastmath=True)
def _spread_view(
    values: Floats,
    weights: Floats,
    channels: Channels,
    plane: Floats,
    light_nodes: Ints,
    light_taps: Floats,
    factor: Floats,
    of_samples: bool,
    spread: Floats,
) -> None:
    """Add the adjoint of one texel's samples from one view to `spread`."""
    at = np.zeros(plane.shape[1], np.float32)
    for j in range(len(values)):
        if weights[j] == 0:
            continue
        _at_light(plane, light_nodes[j], light_taps[j], at)
        for c in range(3):
            value = values[j, c]
            if not of_samples:
                value = np.float32(0)
                for k in range(len(factor)):
                    value += factor[k] * at[3 * k + c]
            weight = weights[j] * (channels[j] >> c & 1)
            for k in range(len(factor)):
                at[3 * k + c] = factor[k] * weight * value
        _spread(spread, light_nodes[j], light_taps[j], at)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _spread_over_views(
    spread: Floats, nodes: Ints, weights: Floats, touched: Ints, out: Floats
) -> None:
    for tap in range(4):
        if weights[tap] != 0:
            target = out[nodes[tap]]
            for a in touched:
                for k in range(target.shape[1]):
                    target[a, k] += weights[tap] * spread[a, k]


@numba.njit(cache=True, nogil=True)
def _accumulate(
    values: Floats,
    view_nodes: Ints,
    view_taps: Floats,
    light_nodes: Ints,
    light_taps: Floats,
    view_weights: Floats,
    light_weights: Floats,
    pairs: Floats,
    channels: Channels,
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
    every = np.full(values.shape[2], ALL_CHANNELS, np.uint8)
    for t in range(len(values)):
        touched = lit[: _touched(light_nodes[t], light_weights[t], lit)]
        factor[1:] = coefficients[t]
        for i in np.flatnonzero(view_weights[t]):
            weights = view_weights[t, i] * light_weights[t] * pairs[i]
            taps = (view_nodes[t, i], view_taps[t, i])
            _clear(spread, touched)
            if not of_samples:
                _at_view(table[cluster[t]], *taps, touched, plane)
            _spread_view(
                values[t, i],
                weights,
                channels[t, i] if len(channels) else every,
                plane,
                light_nodes[t],
                light_taps[t],
                factor,
                of_samples,
                spread,
            )
            _spread_over_views(spread, *taps, touched, out[cluster[t]])


def _arguments(rooted: RootedSamples, part: slice) -> tuple[NDArray[np.generic], ...]:
    return (
        rooted.values[part],
        rooted.view_taps[0][part],
        rooted.view_taps[1][part],
        rooted.light_taps[0][part],
        rooted.light_taps[1][part],
        rooted.view_weights[part],
        rooted.light_weights[part],
        rooted.pairs,
        rooted.channels[part],
    )


def _parts(n: int) -> Iterator[slice]:
    edges = np.linspace(0, n, N_PARTS + 1).astype(int)
    return (slice(a, b) for a, b in pairwise(edges) if b > a)


@dataclass(frozen=True, eq=False)
class _BasisProblem:
    """Normal equations of mean and basis for fixed coefficients."""

    rooted: RootedSamples
    cluster: Ints
    coefficients: Floats
    smoothness: float
    pool: ThreadPoolExecutor

    def sums(self, table: Floats, of_samples: bool) -> Floats:
        def part_sum(part: slice) -> Floats:
            out = np.zeros_like(table)
            _accumulate(
                *_arguments(self.rooted, part),
                self.cluster[part],
                self.coefficients[part],
                table,
                of_samples,
                out,
            )
            return out

        total = np.zeros_like(table)
        for out in self.pool.map(part_sum, _parts(len(self.cluster))):
            total += out
        return total

    def samples_per_node(self, n_clusters: int, n_nodes: int) -> NDArray[np.float32]:
        """Mean weight of a pair of nodes in each cluster; scales the regularisation."""
        rooted = self.rooted
        weight = np.einsum(
            "ti,ij,tj->t", rooted.view_weights, rooted.pairs, rooted.light_weights
        )
        if rooted.has_gaps:
            pairs = rooted.pairs * rooted.measured().mean(axis=3, dtype=np.float32)
            weight = np.einsum("ti,tij,tj->t", rooted.view_weights, pairs, rooted.light_weights)
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


def solve_coefficients(
    rooted: RootedSamples,
    cluster: Ints,
    model: ClusteredModel,
    pool: ThreadPoolExecutor,
    *,
    bounded: bool = False,
) -> tuple[Floats, NDArray[np.float64]]:
    """Coefficients of texels for a fixed basis.

    Parameters
    ----------
    rooted : RootedSamples
        Samples of n texels.
    cluster : (n,) int32
    model : ClusteredModel
        Its `table` and `precision` are used.
    pool : ThreadPoolExecutor
    bounded : bool
        Whether a texel may be nowhere brighter than its samples and, by a factor, than the
        mean of its cluster: where it was not observed its coefficients may say anything.

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
            *_arguments(rooted, part),
            cluster[part],
            model.table,
            model.precision,
            at_probes,
            coefficients[part],
            squares[part],
        )

    for _ in pool.map(solve, _parts(len(cluster))):
        pass
    return coefficients, squares


def normalised(model: ClusteredModel, noise: float, chosen: NDArray[np.intp]) -> ClusteredModel:
    """Centre and whiten the coefficients of each cluster; the fit stays the same.

    The mean of the coefficients moves into the mean function, their covariance into the
    basis, so that the prior is ``noise`` times the identity.

    Parameters
    ----------
    model : ClusteredModel
    noise : float
        Variance of a sample about the fit.
    chosen : (k,) int
        Texels whose coefficients count.
    """
    table = model.table.reshape(*model.table.shape[:3], -1, 3).copy()
    coefficients = model.coefficients.copy()
    precision = model.precision.copy()
    n_components = coefficients.shape[1]
    for c in range(len(table)):
        members = chosen[model.cluster[chosen] == c]
        if len(members) <= 2 * n_components or n_components == 0:
            continue
        centre = coefficients[members].mean(axis=0)
        covariance = np.cov(coefficients[members].T.astype(np.float64)).reshape(
            n_components, n_components
        )
        values, vectors = np.linalg.eigh(covariance)
        if not values[-1] > 0:  # all alike
            continue
        scale = np.sqrt(np.maximum(values, 1e-6 * values[-1]))
        rows = model.cluster == c
        table[c, :, :, 0] += np.einsum("vlkc,k->vlc", table[c, :, :, 1:], centre)
        coefficients[rows] = (coefficients[rows] - centre) @ (vectors / scale)
        table[c, :, :, 1:] = np.einsum(
            "vlkc,km->vlmc", table[c, :, :, 1:], (vectors * scale).astype(np.float32)
        )
        precision[c] = noise * np.eye(n_components)
    return replace(
        model,
        table=np.ascontiguousarray(table.reshape(model.table.shape)),
        coefficients=coefficients,
        precision=precision,
    )


def fit_samples(
    read: Reader,
    start: ClusteredModel,
    observed: NDArray[np.intp],
    bytes_per_texel: int,
    options: SampleFitOptions,
    *,
    workers: int = 1,
    seed: int = 0,
) -> ClusteredModel:
    """Fit mean, basis and coefficients to the samples, starting from a given model.

    Parameters
    ----------
    read : callable
        From texel indices to their `RootedSamples` in the aligned frames.
    start : ClusteredModel
        Clusters, coefficients, mean and basis to start from (grid fit).
    observed : (k,) int
        Texels that have samples.
    bytes_per_texel : int
        Memory that `read` needs for one texel.
    options : SampleFitOptions
    workers : int
        Threads; the result does not depend on it.
    seed : int
        Chooses the texels that shape the basis.

    Returns
    -------
    ClusteredModel
        With `residuals` of every round.

    Raises
    ------
    InputError
        If no texel is observed.
    """
    model = fit_basis(
        read, start, observed, bytes_per_texel, options, workers=workers, seed=seed
    )
    coefficients = model.coefficients.copy()
    step = max(64, options.max_bytes // bytes_per_texel // 2)
    blocks = [observed[i : i + step] for i in range(0, len(observed), step)]
    with ThreadPoolExecutor(workers) as pool:
        for block in track(blocks, len(blocks), "coefficients of all texels"):
            found, _ = solve_coefficients(
                read(block), model.cluster[block], model, pool, bounded=True
            )
            coefficients[block] = found
    return replace(model, coefficients=coefficients)


def fit_basis(
    read: Reader,
    start: ClusteredModel,
    observed: NDArray[np.intp],
    bytes_per_texel: int,
    options: SampleFitOptions,
    *,
    workers: int = 1,
    seed: int = 0,
) -> ClusteredModel:
    """Fit mean and basis to the samples of as many texels as fit in memory.

    Parameters, returns and errors as `fit_samples`; coefficients of other texels are those
    that they were given.
    """
    if not len(observed):
        raise InputError("observed: expected texels with samples, received none")
    n_chosen = int(np.clip(options.max_bytes // bytes_per_texel, 256, len(observed)))
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.choice(observed, min(n_chosen, len(observed)), replace=False))
    with ThreadPoolExecutor(workers) as pool:
        return _alternate(read(chosen), start, chosen, options, pool)


def of_usual_size(model: ClusteredModel) -> ClusteredModel:
    """Same model with coefficients as large as for means of root mean square `USUAL_SIZE`.

    The basis is of unit size when it comes from a grid, and the coefficients are in the unit of
    the samples. How strongly smoothness then holds the basis back would depend on that unit.
    """
    size = float(np.sqrt(np.mean(np.square(model.mean, dtype=np.float64)))) / USUAL_SIZE
    if not size > 0:
        return model
    table = model.table.copy()
    table[..., 3:] *= np.float32(size)
    return replace(
        model,
        table=table,
        coefficients=model.coefficients / np.float32(size),
        precision=model.precision * size**2,
    )


def _alternate(
    rooted: RootedSamples,
    model: ClusteredModel,
    chosen: NDArray[np.intp],
    options: SampleFitOptions,
    pool: ThreadPoolExecutor,
) -> ClusteredModel:
    """Alternate between basis and coefficients of the chosen texels."""
    cluster = model.cluster[chosen]
    for turn in range(options.rounds):
        report("fitting the basis to the samples", turn, options.rounds)
        problem = _BasisProblem(
            rooted, cluster, model.coefficients[chosen], options.smoothness, pool
        )
        model = replace(model, table=problem.solve(model.table, options.iterations))
        found, squares = solve_coefficients(rooted, cluster, model, pool)
        noise = float(squares[:, 0].sum() / max(squares[:, 1].sum(), 1e-30))
        coefficients = model.coefficients.copy()
        coefficients[chosen] = found
        model = replace(
            model,
            coefficients=coefficients,
            residuals=(*model.residuals, float(np.sqrt(noise))),
        )
        model = normalised(model, noise, chosen)
    report("fitting the basis to the samples", options.rounds, options.rounds)
    return model
