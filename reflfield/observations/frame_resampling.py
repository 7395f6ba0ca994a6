r"""Scattered directions of each texel onto the common nodes of its own frame.

A texel sees the same lights from every camera that sees it, so its samples stand on
a product of directions and the least squares problem separates: with the prior
covariance P of a smooth function on the nodes (both directions alike),

.. math:: X = R_v Y R_l^\top, \quad R = P A^\top (A P A^\top + W^{-1})^{-1},

A being the interpolation from nodes to the texel's directions. Values are
resampled transformed (to their cube root by default) after division
by the softened cosine of the light.

A node counts as observed as far as directions actually seen lie near it
(`Nodes.weights`); what the prior continues beyond them carries weight 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.observations.texel_samples import (
    ALL_CHANNELS,
    Channels,
    TransformedSamples,
    interpolation_matrices,
)
from reflfield.util.cholesky import cholesky_factor, solve_columns

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int32]
Indices = NDArray[np.intp]

# A node with less than this summed interpolation weight was not observed.
LEAST_SUPPORT = 0.1
# What a node counts that was photographed but, being clipped, not measured.
CONTINUED = 0.05
# Sweeps that fill pairs never photographed before the separable solve.
FILLING_SWEEPS = 4


@lru_cache(maxsize=16)
def prior_covariance(side: int, smoothness: float) -> NDArray[np.float64]:
    """Covariance (n_nodes, n_nodes) of a smooth function on a hemisphere grid.

    The inverse of ``smoothness * (sum of squared differences between neighbours)
    + 1e-3 * smoothness``, in units of a sample's variance.

    Examples
    --------
    Two by two nodes: a constant has variance 1000 / 4 at each node, smoothness 1.

    >>> prior_covariance(2, 1.0).mean().round(3)
    np.float64(250.0)
    """
    if side == 1:
        return np.full((1, 1), 1e3 / smoothness, np.float64)
    node = np.arange(side * side).reshape(side, side)
    first = np.concatenate([node[:, :-1].ravel(), node[:-1].ravel()])
    second = np.concatenate([node[:, 1:].ravel(), node[1:].ravel()])
    difference = np.zeros((len(first), side * side))
    rows = np.arange(len(first))
    difference[rows, first], difference[rows, second] = 1.0, -1.0
    precision = smoothness * (difference.T @ difference + 1e-3 * np.eye(side * side))
    return np.linalg.solve(precision, np.eye(side * side)).astype(np.float64)


@dataclass(frozen=True, eq=False)
class Nodes:
    """Resampled texels.

    Parameters
    ----------
    values : (n, n_view_nodes, n_light_nodes, 3) float32
        Transformed, without the light's cosine; smooth continuation where not observed.
    view_support, light_support : (n, n_nodes) float32
        Share in [0, 1] to which each node was observed.
    pair_support : (n, n_view_nodes, n_light_nodes[, 3]) float32, optional
        Summed interpolation weight of the pairs photographed, of each channel where values
        were not measured; None where all were.
    """

    values: Floats
    view_support: Floats
    light_support: Floats
    pair_support: Floats | None = None

    @property
    def weights(self) -> Floats:
        """Share to which each pair of nodes, and channel where they differ, is observed.

        (n, n_view_nodes, n_light_nodes[, 3]).
        """
        product = self.view_support[:, :, None] * self.light_support[:, None, :]
        if self.pair_support is None:
            return product
        if self.pair_support.ndim == 4:
            product = product[..., None]
        return np.minimum(product, self.pair_support)


def resample(
    transformed: TransformedSamples, sides: tuple[int, int], smoothness: float
) -> Nodes:
    """Smooth functions on the nodes that explain the samples, texel by texel.

    Parameters
    ----------
    transformed : TransformedSamples
    sides : (int, int)
        Sides of the view and light grids.
    smoothness : float
        See `ResamplingOptions`.

    Returns
    -------
    Nodes

    Notes
    -----
    Two solves per texel, of the size of the number of views and of lights that count. Pairs
    that were never photographed are filled from the fit, `FILLING_SWEEPS` times, and count as
    observed only as far as photographed ones lie near them. Of a texel of which some values
    were not measured each channel is resampled by itself, from its own views and lights.
    """
    n, n_nodes = len(transformed.values), (sides[0] ** 2, sides[1] ** 2)
    values = np.zeros((n, *n_nodes, 3), np.float32)
    supports = (np.zeros((n, n_nodes[0]), np.float32), np.zeros((n, n_nodes[1]), np.float32))
    _resample_texels(
        transformed.values,
        (transformed.view_taps, transformed.light_taps),
        (transformed.view_weights, transformed.light_weights),
        (prior_covariance(sides[0], smoothness), prior_covariance(sides[1], smoothness)),
        (1 if sides[0] == 1 else 4, 1 if sides[1] == 1 else 4),
        transformed.pairs > 0,
        transformed.channels,
        FILLING_SWEEPS,
        values,
        supports,
    )
    for support in supports:
        np.minimum(support, 1.0, out=support)
        support[support < LEAST_SUPPORT] = 0.0
    if transformed.pairs.all() and not transformed.has_gaps:
        return Nodes(values, *supports)
    to_views = interpolation_matrices(transformed.view_taps, sides[0])
    to_lights = interpolation_matrices(transformed.light_taps, sides[1])
    return Nodes(values, *supports, _pair_support(transformed, to_views, to_lights))


@numba.njit(cache=True, nogil=True)
def _gather_taps(
    nodes: Ints, taps: Floats, counted: Indices, n_taps: int, support: Floats
) -> None:
    """Add the weights of the directions that count to the nodes' support."""
    for direction in counted:
        for tap in range(n_taps):
            support[nodes[direction, tap]] += taps[direction, tap]


@numba.njit(cache=True, nogil=True)
def _dense_taps(
    nodes: Ints, taps: Floats, counted: Indices, n_taps: int, n_nodes: int
) -> Floats:
    """Interpolation (k, n_nodes) at the directions that count."""
    dense = np.zeros((len(counted), n_nodes), np.float32)
    for i, direction in enumerate(counted):
        for tap in range(n_taps):
            dense[i, nodes[direction, tap]] += taps[direction, tap]
    return dense


@numba.njit(cache=True, nogil=True)
def _spread_over_nodes(
    nodes: Ints, taps: Floats, half: Doubles, counted: Indices, prior: Doubles, n_taps: int
) -> tuple[Doubles, Doubles]:
    """H A P of shape (k, n_nodes), and H A P A^T H + 1; H is the root of the weights."""
    spread = np.zeros((len(counted), len(prior)))
    for i, direction in enumerate(counted):
        for tap in range(n_taps):
            row = prior[nodes[direction, tap]]
            factor = half[i] * taps[direction, tap]
            for node in range(len(row)):
                spread[i, node] += factor * row[node]
    system = np.eye(len(counted))
    for i in range(len(counted)):
        for j, direction in enumerate(counted):
            for tap in range(n_taps):
                factor = half[j] * taps[direction, tap]
                system[i, j] += factor * spread[i, nodes[direction, tap]]
    return spread, system


@numba.njit(cache=True, nogil=True)
def _operator(
    nodes: Ints, taps: Floats, weights: Floats, counted: Indices, prior: Doubles, n_taps: int
) -> Floats:
    """Matrix (n_nodes, k) from the samples that count to the nodes.

    A constant may vary 1e5 times as much as a sample: in float32 the solve would lose
    three of seven digits.
    """
    half = np.sqrt(weights[counted].astype(np.float64))
    spread, system = _spread_over_nodes(nodes, taps, half, counted, prior, n_taps)
    # Never singular: 1 was added to all eigenvalues.
    cholesky_factor(system, len(system))
    solve_columns(system, spread)
    operator = np.zeros((len(prior), len(counted)), np.float32)
    for i in range(len(counted)):
        for node in range(len(prior)):
            operator[node, i] = half[i] * spread[i, node]
    return operator


@numba.njit(cache=True, nogil=True)
def _both(left: Floats, right: Floats, values: Floats, out: Floats) -> None:
    """Left @ values @ right^T for each channel: (a, b), (c, d), (b, d, 3) to (a, c, 3)."""
    n_channels = values.shape[2]
    a, (c, d) = left.shape[0], right.shape
    halfway = (left @ values.reshape(-1, n_channels * d)).reshape(a, d, n_channels)
    folded = np.zeros((a, n_channels, d), np.float32)
    for i in range(a):
        for j in range(d):
            for channel in range(n_channels):
                folded[i, channel, j] = halfway[i, j, channel]
    resampled = (folded.reshape(n_channels * a, d) @ right.T).reshape(a, n_channels, c)
    for i in range(a):
        for channel in range(n_channels):
            for j in range(c):
                out[i, j, channel] = resampled[i, channel, j]


@numba.njit(cache=True, nogil=True)
def _weighted_mean(
    values: Floats,
    counted: tuple[Indices, Indices],
    weights: tuple[Floats, Floats],
    measured: Bools,
) -> Floats:
    """Mean (n_channels,) of one texel's samples: where the filling starts."""
    total, weight = np.zeros(values.shape[2]), 1e-6
    for i in counted[0]:
        for j in counted[1]:
            if measured[i, j]:
                share = weights[0][i] * weights[1][j]
                weight += share
                for channel in range(values.shape[2]):
                    total[channel] += share * values[i, j, channel]
    return (total / weight).astype(np.float32)


@numba.njit(cache=True, nogil=True)
def _resample_texels(
    values: Floats,
    taps: tuple[tuple[Ints, Floats], tuple[Ints, Floats]],
    weights: tuple[Floats, Floats],
    priors: tuple[Doubles, Doubles],
    n_taps: tuple[int, int],
    pairs: Bools,
    channels: Channels,
    n_sweeps: int,
    out: Floats,
    supports: tuple[Floats, Floats],
) -> None:
    """Fill nodes (n, n_view_nodes, n_light_nodes, 3) and supports, texel by texel."""
    for t in range(len(values)):
        counted = (np.flatnonzero(weights[0][t]), np.flatnonzero(weights[1][t]))
        for k in range(2):
            nodes, shares = taps[k]
            _gather_taps(nodes[t], shares[t], counted[k], n_taps[k], supports[k][t])
        if len(counted[0]) == 0 or len(counted[1]) == 0:
            continue
        own_taps = ((taps[0][0][t], taps[0][1][t]), (taps[1][0][t], taps[1][1][t]))
        own_weights = (weights[0][t], weights[1][t])
        if len(channels) == 0 or _whole(channels[t], counted, pairs):
            _resample_channels(
                values[t],
                own_taps,
                own_weights,
                priors,
                n_taps,
                counted,
                pairs,
                n_sweeps,
                out[t],
            )
            continue
        for c in range(3):
            measured = pairs & ((channels[t] & (1 << c)) > 0)
            of_channel = _with_any(measured, counted)
            if len(of_channel[0]) == 0:
                continue
            one = np.zeros((out.shape[1], out.shape[2], 1), np.float32)
            _resample_channels(
                _of_channel(values[t], c),
                own_taps,
                own_weights,
                priors,
                n_taps,
                of_channel,
                measured,
                n_sweeps,
                one,
            )
            for node in np.ndindex(one.shape[:2]):
                out[t, node[0], node[1], c] = one[node[0], node[1], 0]


@numba.njit(cache=True, nogil=True)
def _of_channel(values: Floats, channel: int) -> Floats:
    """Copy (a, b, 1) of one channel of (a, b, 3), in the layout that is compiled already."""
    copy = np.zeros((values.shape[0], values.shape[1], 1), np.float32)
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            copy[i, j, 0] = values[i, j, channel]
    return copy


@numba.njit(cache=True, nogil=True)
def _whole(channels: Channels, counted: tuple[Indices, Indices], pairs: Bools) -> bool:
    """Whether every channel of every sample that counts was measured."""
    for i in counted[0]:
        for j in counted[1]:
            if pairs[i, j] and channels[i, j] != ALL_CHANNELS:
                return False
    return True


@numba.njit(cache=True, nogil=True)
def _with_any(measured: Bools, counted: tuple[Indices, Indices]) -> tuple[Indices, Indices]:
    """Views and lights that count and of which something was measured."""
    views = np.zeros(measured.shape[0], np.bool_)
    lights = np.zeros(measured.shape[1], np.bool_)
    for i in counted[0]:
        for j in counted[1]:
            if measured[i, j]:
                views[i] = lights[j] = True
    return np.flatnonzero(views), np.flatnonzero(lights)


@numba.njit(cache=True, nogil=True)
def _resample_channels(
    values: Floats,
    taps: tuple[tuple[Ints, Floats], tuple[Ints, Floats]],
    weights: tuple[Floats, Floats],
    priors: tuple[Doubles, Doubles],
    n_taps: tuple[int, int],
    counted: tuple[Indices, Indices],
    measured: Bools,
    n_sweeps: int,
    out: Floats,
) -> None:
    """Nodes of one texel from its measured samples (n_views, n_lights, n_channels)."""
    of_view = _operator(taps[0][0], taps[0][1], weights[0], counted[0], priors[0], n_taps[0])
    of_light = _operator(taps[1][0], taps[1][1], weights[1], counted[1], priors[1], n_taps[1])
    own = np.zeros((len(counted[0]), len(counted[1]), values.shape[2]), np.float32)
    expected = np.zeros_like(own) + _weighted_mean(values, counted, weights, measured)
    n_missing = _take(values, counted, measured, expected, own)
    _both(of_view, of_light, own, out)
    if n_missing == 0:
        return
    to_view = _dense_taps(taps[0][0], taps[0][1], counted[0], n_taps[0], len(priors[0]))
    to_light = _dense_taps(taps[1][0], taps[1][1], counted[1], n_taps[1], len(priors[1]))
    for _ in range(n_sweeps):
        _both(to_view, to_light, out, expected)
        _take(values, counted, measured, expected, own)
        _both(of_view, of_light, own, out)


@numba.njit(cache=True, nogil=True)
def _take(
    values: Floats,
    counted: tuple[Indices, Indices],
    measured: Bools,
    expected: Floats,
    own: Floats,
) -> int:
    """Samples that count, and what is expected of those not measured, whose number it gives."""
    n_missing = 0
    for i, view in enumerate(counted[0]):
        for j, light in enumerate(counted[1]):
            if measured[view, light]:
                own[i, j] = values[view, light]
            else:
                own[i, j] = expected[i, j]
                n_missing += 1
    return n_missing


def _pair_support(
    transformed: TransformedSamples, to_views: Floats, to_lights: Floats
) -> Floats:
    """Interpolation weight (n, n_view_nodes, n_light_nodes[, 3]) of what was measured."""
    seen = (transformed.view_weights > 0)[:, :, None] & (transformed.light_weights > 0)[:, None]
    counted = (seen * transformed.pairs)[..., None]
    if transformed.has_gaps:
        counted = counted * transformed.measured()
    support = apply_both(np.swapaxes(to_views, 1, 2), np.swapaxes(to_lights, 1, 2), counted)
    support = np.where(support < LEAST_SUPPORT, np.float32(0), support)
    if not transformed.has_gaps:
        return support[..., 0]
    # Where a photograph shows the texel but says too little, what its other samples continue to
    # counts a little: of directions that are clipped on all texels nothing else is known.
    known = np.asarray(counted.any(axis=(1, 2)))[:, None, None]
    shown = (seen * transformed.pairs)[..., None]
    reach = apply_both(np.swapaxes(to_views, 1, 2), np.swapaxes(to_lights, 1, 2), shown)
    continued = CONTINUED * np.minimum(reach, np.float32(1.0)) * (reach >= LEAST_SUPPORT)
    return np.maximum(support, continued * known).astype(np.float32)


def apply_both(left: Floats, right: Floats, values: Floats) -> Floats:
    """Products left @ values @ right^T for each texel and channel.

    Parameters
    ----------
    left : (n, a, b) float32
    right : (n, c, d) float32
    values : (n, b, d, n_channels) float32

    Returns
    -------
    (n, a, c, n_channels) float32

    Examples
    --------
    >>> left, right = np.ones((1, 1, 2)), np.full((1, 1, 3), 10.0)
    >>> apply_both(left, right, np.ones((1, 2, 3, 1))).ravel()
    array([60.])
    """
    n, a, b, c = values.shape
    halfway = (left @ values.reshape(n, a, b * c)).reshape(n, -1, b, c)
    # (n, nodes, b, c) -> contract b by batched GEMM with channels folded into rows.
    folded = np.swapaxes(halfway, 2, 3).reshape(n, -1, b) @ np.swapaxes(right, 1, 2)
    return np.swapaxes(folded.reshape(n, halfway.shape[1], c, -1), 2, 3)
