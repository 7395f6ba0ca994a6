"""Kernels that all sums over samples share: functions on the nodes at directions of samples.

A table (n_view_nodes, n_light_nodes, width) is interpolated at a sample's view first, which
leaves functions of the light alone, and only at the light nodes that the texel's samples lie
between.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.observations.texel_samples import Channels, TransformedSamples

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
# Nodes and interpolation weights of some directions.
Taps = tuple[Ints, Floats]

# Partial sums are formed for this many parts and added in order, so that the result does
# not depend on the number of workers.
N_PARTS = 8


class KernelSamples(NamedTuple):
    """Arrays of some texels' samples as the kernels take them; see `TransformedSamples`."""

    values: Floats
    view_nodes: Ints
    view_taps: Floats
    light_nodes: Ints
    light_taps: Floats
    view_weights: Floats
    light_weights: Floats
    pairs: Floats
    channels: Channels


def kernel_samples(samples: TransformedSamples, part: slice) -> KernelSamples:
    """Samples of some texels for the kernels."""
    return KernelSamples(
        values=samples.values[part],
        view_nodes=samples.view_taps[0][part],
        view_taps=samples.view_taps[1][part],
        light_nodes=samples.light_taps[0][part],
        light_taps=samples.light_taps[1][part],
        view_weights=samples.view_weights[part],
        light_weights=samples.light_weights[part],
        pairs=samples.pairs,
        channels=samples.channels[part],
    )


@numba.njit(cache=True, nogil=True)
def touched_nodes(nodes: Ints, weights: Floats, touched: Ints) -> int:
    """Put the light nodes that samples of one texel lie between in `touched`; their number."""
    is_touched = np.zeros(len(touched), np.bool_)
    for j in range(len(nodes)):
        if weights[j] != 0:
            for tap in range(4):
                is_touched[nodes[j, tap]] = True
    count = 0
    for node in range(len(touched)):
        if is_touched[node]:
            touched[count] = node
            count += 1
    return count


@numba.njit(cache=True, nogil=True)
def clear(plane: Floats, touched: Ints) -> None:
    """Zero the rows (n_light_nodes, width) of the nodes that matter."""
    for a in touched:
        for k in range(plane.shape[1]):
            plane[a, k] = 0


@numba.njit(cache=True, nogil=True, fastmath=True)
def at_view(table: Floats, taps: Taps, touched: Ints, out: Floats) -> None:
    """Functions of the light alone, at the nodes that matter."""
    nodes, weights = taps
    clear(out, touched)
    for tap in range(4):
        weight = weights[tap]
        if weight != 0:
            plane = table[nodes[tap]]
            for a in touched:
                for k in range(out.shape[1]):
                    out[a, k] += weight * plane[a, k]


@numba.njit(cache=True, nogil=True, fastmath=True)
def at_light(plane: Floats, nodes: Ints, weights: Floats, out: Floats) -> None:
    """Interpolate functions of the light (n_light_nodes, width) at one light."""
    a, b, c, d = plane[nodes[0]], plane[nodes[1]], plane[nodes[2]], plane[nodes[3]]
    p, q, r, s = weights[0], weights[1], weights[2], weights[3]
    for k in range(out.shape[0]):
        out[k] = (p * a[k] + q * b[k]) + (r * c[k] + s * d[k])


def parts(n: int) -> Iterator[slice]:
    """Slices of n texels, `N_PARTS` at most."""
    edges = np.linspace(0, n, N_PARTS + 1).astype(int)
    return (slice(a, b) for a, b in pairwise(edges) if b > a)
