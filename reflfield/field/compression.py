"""From completed texels to clusters with mean and basis: clustered local PCA.

The columns are already of low rank after completion, so clusters and their bases are
found among the completion's coefficients (a few numbers a texel) and lifted; the
result is that of local PCA on the completed columns.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from reflfield.errors import InputError
from reflfield.factorization import Completion, LocalPCA
from reflfield.field.fit import ClusteredModel, SampleFitOptions
from reflfield.field.model import Quantisation

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class CompressionOptions:
    """Size of the field and how it is fitted.

    Parameters
    ----------
    n_clusters, n_components : int
        Clusters, and basis functions of each beside its mean.
    fit : {"auto", "samples", "grid"}
        "grid": local PCA of the resampled texels, as in the paper. "samples": from there,
        mean, basis and coefficients are fitted to the samples themselves. "auto" fits to
        the samples where a texel has fewer of them than the grids have nodes.
    rank : int
        Rank of the completion in the aligned frames.
    training_texels : int
        Texels that shape the completion's basis.
    samples : SampleFitOptions
    quantisation : Quantisation
    """

    n_clusters: int = 8
    n_components: int = 6
    fit: str = "auto"
    rank: int = 16
    training_texels: int = 8192
    samples: SampleFitOptions = field(default_factory=SampleFitOptions)
    quantisation: Quantisation = field(default_factory=Quantisation)

    def __post_init__(self) -> None:
        if self.fit not in ("auto", "samples", "grid"):
            raise InputError(
                f"fit: expected 'auto', 'samples' or 'grid', received {self.fit!r}"
            )
        for name, least in (("n_clusters", 1), ("n_components", 0), ("rank", 1)):
            if getattr(self, name) < least:
                raise InputError(
                    f"{name}: expected at least {least}, received {getattr(self, name)}"
                )

    def fits_samples(self, n_samples: int, n_pairs: int) -> bool:
        """Whether to fit to the samples, of which a texel has at most `n_samples`."""
        return self.fit == "samples" or (self.fit == "auto" and n_samples < n_pairs)


def cluster_completed(
    completion: Completion,
    coefficients: Floats,
    observed: NDArray[np.intp],
    node_counts: tuple[int, int],
    options: CompressionOptions,
    seed: int = 0,
) -> ClusteredModel:
    """Local PCA of completed texels.

    Parameters
    ----------
    completion : Completion
        Basis and mean of the columns; rows are (view node, light node, channel).
    coefficients : (n_texels, rank) float32
        Of all texels, about the mean.
    observed : (k,) int
        Texels that have samples; the others get cluster 0 and zero coefficients.
    node_counts : (int, int)
        View and light nodes.
    options : CompressionOptions
    seed : int

    Returns
    -------
    ClusteredModel
        With a prior from the spread of each cluster's coefficients.
    """
    n_components = min(options.n_components, completion.rank)
    local = LocalPCA(options.n_clusters, n_components, seed=seed).fit(
        np.ascontiguousarray(coefficients[observed].T)
    )
    means = completion.mean + local.means @ completion.basis.T
    bases = completion.basis @ local.bases  # (n_clusters, n_rows, K)
    table = np.concatenate([means[:, :, None], bases], axis=2)
    table = table.reshape(len(means), *node_counts, 3, n_components + 1)
    table = np.swapaxes(table, 3, 4).reshape(len(means), *node_counts, -1)
    model = ClusteredModel(
        cluster=np.zeros(len(coefficients), np.int32),
        coefficients=np.zeros((len(coefficients), n_components), np.float32),
        table=np.ascontiguousarray(table, np.float32),
        precision=_precision(local.labels, local.coefficients, completion.noise),
    )
    model.cluster[observed] = local.labels
    model.coefficients[observed] = local.coefficients
    return model


def _precision(
    labels: NDArray[np.int32], coefficients: NDArray[np.floating], noise: float
) -> NDArray[np.float64]:
    """Noise variance over the variance of each coefficient in each cluster."""
    n_clusters, n_components = int(labels.max()) + 1, coefficients.shape[1]
    precision = np.zeros((n_clusters, n_components, n_components))
    for cluster in range(n_clusters):
        variance = coefficients[labels == cluster].astype(np.float64).var(axis=0)
        floor = max(1e-6 * variance.max(initial=0.0), 1e-12)
        np.fill_diagonal(
            precision[cluster], max(noise, 1e-6) ** 2 / np.maximum(variance, floor)
        )
    return precision


def fill_unobserved(
    model: ClusteredModel, positions: NDArray[np.floating], observed: NDArray[np.intp]
) -> ClusteredModel:
    """Give texels without samples cluster and coefficients of the nearest that has some.

    Parameters
    ----------
    model : ClusteredModel
    positions : (n_texels, 3) float
        Metres.
    observed : (k,) int
        Texels that have samples.

    Returns
    -------
    ClusteredModel
    """
    empty = np.setdiff1d(np.arange(len(positions)), observed)
    if not len(empty):
        return model
    _, nearest = cKDTree(positions[observed]).query(positions[empty])
    cluster, coefficients = model.cluster.copy(), model.coefficients.copy()
    cluster[empty] = cluster[observed[nearest]]
    coefficients[empty] = coefficients[observed[nearest]]
    return ClusteredModel(cluster, coefficients, model.table, model.precision, model.residuals)
