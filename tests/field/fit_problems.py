"""Planted models and their samples, for the tests of the fit to samples."""

from dataclasses import replace

import numpy as np

from reflfield.field.basis import BasisProblem
from reflfield.field.clustered_model import ClusteredModel
from reflfield.observations.texel_samples import CHANNEL_BITS, TransformedSamples, all_channels
from tests.observations.rigs import random_taps, random_weights

SIDES = (3, 3)
NODES = (9, 9)


def empty_samples(rng, n, n_views, n_lights, sides=SIDES, *, gaps=False):
    """Random directions and weights; with `gaps`, a third of the values was not measured."""
    channels = all_channels()
    if gaps:
        channels = (rng.random((n, n_views, n_lights, 3)) < 2 / 3) @ CHANNEL_BITS
    return TransformedSamples(
        values=np.zeros((n, n_views, n_lights, 3), np.float32),
        view_taps=random_taps(rng, n, n_views, sides[0]),
        light_taps=random_taps(rng, n, n_lights, sides[1]),
        view_weights=random_weights(rng, n, n_views),
        light_weights=random_weights(rng, n, n_lights),
        pairs=(rng.random((n_views, n_lights)) < 0.9).astype(np.float32),
        channels=channels,
    )


def planted_model(rng, n, *, n_clusters=2, n_components=2, nodes=NODES):
    """Means about 1, bases about 0.3, standard normal coefficients."""
    table = 0.3 * rng.normal(size=(n_clusters, *nodes, n_components + 1, 3))
    table[:, :, :, 0] += 1
    return ClusteredModel(
        cluster=rng.integers(0, n_clusters, n).astype(np.int32),
        coefficients=rng.normal(size=(n, n_components)).astype(np.float32),
        table=np.ascontiguousarray(table.reshape(n_clusters, *nodes, -1), np.float32),
        precision=np.tile(1e-3 * np.eye(n_components), (n_clusters, 1, 1)),
    )


def interpolation(taps, n_nodes):
    """Dense matrices (n, k, n_nodes), entry by entry."""
    nodes, weights = taps
    dense = np.zeros((*nodes.shape[:2], n_nodes))
    for index in np.ndindex(*nodes.shape):
        dense[index[0], index[1], nodes[index]] += weights[index]
    return dense


def predicted(samples, model, texels=None):
    """Values (n, n_views, n_lights, 3) of the model at the samples, by dense products."""
    texels = np.arange(len(samples.values)) if texels is None else texels
    a = interpolation(samples.view_taps, model.table.shape[1])
    b = interpolation(samples.light_taps, model.table.shape[2])
    c = model.cluster[texels]
    nodes = model.mean[c] + np.einsum(
        "tk,tkvlc->tvlc", model.coefficients[texels].astype(float), model.basis[c]
    )
    return np.einsum("tiv,tjl,tvlc->tijc", a, b, nodes)


def sample_weights(samples):
    return samples.view_weights[:, :, None] * samples.light_weights[:, None] * samples.pairs


def value_weights(samples):
    """(n, n_views, n_lights, 3): none where a channel was not measured."""
    return sample_weights(samples)[..., None] * samples.measured()


def measured(samples, model, rng, sigma):
    values = predicted(samples, model)
    values = values + sigma * rng.normal(size=values.shape)
    return replace(samples, values=np.where(samples.measured(), values, 7).astype(np.float32))


def part(samples, texels):
    """Samples of some texels, as a reader gives them."""
    return TransformedSamples(
        values=samples.values[texels],
        view_taps=tuple(a[texels] for a in samples.view_taps),
        light_taps=tuple(a[texels] for a in samples.light_taps),
        view_weights=samples.view_weights[texels],
        light_weights=samples.light_weights[texels],
        pairs=samples.pairs,
    )


def problem_of(samples, model, pool, smoothness=0.0):
    return BasisProblem(samples, model.cluster, model.coefficients, smoothness, pool)
