"""How bright a texel may be where it was not observed.

Between its samples a texel's coefficients are measured; elsewhere they say what they happen
to say of functions that other texels have shaped. A texel of few samples, or of samples that
contradict each other because the surface lies elsewhere, can then come out many times too
bright under lights and from views that the dome does not have. It is held to the brightest
that it was seen, and to what its cluster shows in the same directions.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.field.clustered_model import ClusteredModel
from reflfield.field.sample_sums import KernelSamples, kernel_samples
from reflfield.observations.texel_samples import ALL_CHANNELS, Channels, TransformedSamples

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]

# A texel is nowhere brighter than its brightest sample, or than this many times the mean of
# its cluster there, transformed: of cube roots, 2.7 times in radiance.
MOST_OF_MEAN = np.float32(1.4)
# Samples of less weight, of light at less than about 5 degrees above the horizon, say little
# of how bright a texel is: they are divided by the cosine of that light.
RELIABLE = 0.2
# Pairs of nodes at which texels are tested; of more, every second row and column.
MOST_PROBES = 1024


def probes(table: Floats) -> Floats:
    """Functions of clusters at pairs of nodes all over both hemispheres.

    Parameters
    ----------
    table : (n_clusters, n_view_nodes, n_light_nodes, (K + 1) * 3) float32
        Mean, then basis, of a `ClusteredModel`.

    Returns
    -------
    (n_clusters, n, K + 1, 3) float32

    Examples
    --------
    >>> probes(np.zeros((2, 25, 25, 6), np.float32)).shape
    (2, 625, 2, 3)
    >>> probes(np.zeros((2, 81, 81, 6), np.float32)).shape
    (2, 625, 2, 3)
    """
    n_clusters, n_views, n_lights, width = table.shape
    v, m = round(n_views**0.5), round(n_lights**0.5)
    step = 1 if n_views * n_lights <= MOST_PROBES else 2
    grid = table.reshape(n_clusters, v, v, m, m, width)
    thinned = grid[:, ::step, ::step, ::step, ::step]
    return np.ascontiguousarray(thinned.reshape(n_clusters, -1, width // 3, 3))


@numba.njit(cache=True, nogil=True)
def raise_top(values: Floats, weights: Floats, channels: Channels, top: Floats) -> None:
    """Raise `top` (3,) to the brightest of one texel's samples from one view.

    Parameters
    ----------
    values : (n_lights, 3) float32
        Transformed (`observations.texel_samples`).
    weights : (n_lights,) float32
    channels : (n_lights,) uint8
        Bits of those that were measured.
    top : (3,) float32
    """
    for j in range(len(values)):
        if weights[j] >= RELIABLE:
            for c in range(3):
                if channels[j] >> c & 1:
                    top[c] = max(top[c], values[j, c])


@numba.njit(cache=True, nogil=True)
def exceeds(at_probes: Floats, coefficients: Floats, top: Floats) -> bool:
    """Whether a texel is somewhere brighter than it was seen and than its cluster allows.

    Parameters
    ----------
    at_probes : (n, K + 1, 3) float32
        Mean and basis of its cluster.
    coefficients : (K,) float32
    top : (3,) float32
        Its brightest samples.

    Returns
    -------
    bool
    """
    for functions in at_probes:
        for c in range(3):
            mean = functions[0, c]
            value = mean
            for k in range(len(coefficients)):
                value += coefficients[k] * functions[k + 1, c]
            if value > max(top[c], MOST_OF_MEAN * mean):
                return True
    return False


def beyond_bounds(
    transformed: TransformedSamples, cluster: Ints, coefficients: Floats, at_probes: Floats
) -> NDArray[np.bool_]:
    """Which texels are somewhere brighter than their samples and their clusters allow.

    Parameters
    ----------
    transformed : TransformedSamples
        Samples of n texels.
    cluster : (n,) int32
    coefficients : (n, K) float32
    at_probes : (n_clusters, n_probes, K + 1, 3) float32
        See `probes`.

    Returns
    -------
    (n,) bool
    """
    beyond = np.zeros(len(cluster), np.bool_)
    samples = kernel_samples(transformed, slice(None))
    _mark_beyond(samples, cluster, coefficients, at_probes, beyond)
    return beyond


@numba.njit(cache=True, nogil=True)
def _mark_beyond(
    samples: KernelSamples,
    cluster: Ints,
    coefficients: Floats,
    at_probes: Floats,
    beyond: NDArray[np.bool_],
) -> None:
    every = np.full(samples.values.shape[2], ALL_CHANNELS, np.uint8)
    for t in range(len(samples.values)):
        top = np.zeros(3, np.float32)
        for i in np.flatnonzero(samples.view_weights[t]):
            weights = samples.view_weights[t, i] * samples.light_weights[t] * samples.pairs[i]
            measured = samples.channels[t, i] if len(samples.channels) else every
            raise_top(samples.values[t, i], weights, measured, top)
        beyond[t] = exceeds(at_probes[cluster[t]], coefficients[t], top)


def beyond_clusters(model: ClusteredModel, texels: NDArray[np.intp]) -> NDArray[np.intp]:
    """Those texels that are somewhere brighter than their clusters allow.

    Samples may still show them to be as bright: see `beyond_bounds`.
    """
    beyond = np.zeros(len(texels), np.bool_)
    at_probes, dark = probes(model.table), np.zeros(3, np.float32)
    _mark_brighter(model.cluster[texels], model.coefficients[texels], at_probes, dark, beyond)
    return texels[beyond]


@numba.njit(cache=True, nogil=True)
def _mark_brighter(
    cluster: Ints,
    coefficients: Floats,
    at_probes: Floats,
    top: Floats,
    beyond: NDArray[np.bool_],
) -> None:
    for t in range(len(cluster)):
        beyond[t] = exceeds(at_probes[cluster[t]], coefficients[t], top)
