"""Clustered fit of one view: all texels in one pass over their samples.

The frames are those of photometric stereo and stay. Some texels, drawn at random, shape the
completion, the clusters and the functions of each; millions of others would not change them.
Then every texel is read once: its samples give coefficients in the completion's basis, these
its cluster, and the samples again the coefficients in the cluster's functions. The cost of a
texel does not depend on their number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.factorization.clustering import Clusters, nearest
from reflfield.field.clustered_model import ClusteredModel
from reflfield.field.coefficients import solve_coefficients
from reflfield.observations.texel_reading import TexelReader
from reflfield.observations.texel_samples import TransformedSamples
from reflfield.util.blas_threads import thread_pool

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class OneViewFit:
    """What all blocks of texels of one view share.

    Parameters
    ----------
    reader : TexelReader
        In the final frames, on the final grid.
    completion : ClusteredModel
        Mean and basis of the completion as one cluster, on that grid.
    clusters : Clusters
        In the space of the completion's coefficients.
    model : ClusteredModel
        Whose functions the coefficients are for.
    """

    reader: TexelReader
    completion: ClusteredModel
    clusters: Clusters
    model: ClusteredModel


def completed_block(
    shared: tuple[TexelReader, ClusteredModel], texels: Indices
) -> dict[str, Floats]:
    """Coefficients of some texels in the basis of a completion, from their samples."""
    reader, completion = shared
    return {"coefficients": _completed(reader.transformed(texels), completion)}


def _completed(samples: TransformedSamples, completion: ClusteredModel) -> Floats:
    cluster = np.zeros(len(samples.values), np.int32)
    with thread_pool(1) as pool:
        return solve_coefficients(samples, cluster, completion, pool)[0]


def texels_block(fit: OneViewFit, texels: Indices) -> dict[str, NDArray[Any]]:
    """Cluster and coefficients of some texels."""
    samples = fit.reader.transformed(texels)
    cluster = nearest(_completed(samples, fit.completion), fit.clusters)[0]
    with thread_pool(1) as pool:
        coefficients, _ = solve_coefficients(samples, cluster, fit.model, pool, bounded=True)
    return {"cluster": cluster, "coefficients": coefficients}


def with_texels(
    model: ClusteredModel, texels: Indices, cluster: NDArray[np.int32], coefficients: Floats
) -> ClusteredModel:
    """Model with clusters and coefficients of some texels."""
    clusters, all_coefficients = model.cluster.copy(), model.coefficients.copy()
    clusters[texels], all_coefficients[texels] = cluster, coefficients
    return replace(model, cluster=clusters, coefficients=all_coefficients)
