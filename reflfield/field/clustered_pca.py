"""From completed texels to clusters with mean and basis: clustered local PCA.

The columns are already of low rank after completion, so clusters and their bases are
found among the completion's coefficients (a few numbers a texel) and lifted; the
result is that of local PCA on the completed columns.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import isqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from reflfield.errors import InputError
from reflfield.factorization import ClusteredBasis, Completion, LocalPCA
from reflfield.field.clustered_model import ClusteredModel
from reflfield.field.half_vector import HalfVectorOptions
from reflfield.field.sample_fit import SampleFitOptions
from reflfield.sphere.hemisphere import HemisphereGrid
from reflfield.util.validation import check_ranges

Floats = NDArray[np.float32]

# Samples that a texel must have on average for each coefficient to be fitted to them.
SAMPLES_PER_COEFFICIENT = 4
# Samples of a texel, on average, above which the grids are dense enough.
MOST_SAMPLES = 4096
# Beyond what doubles can have, some 310 dB.
MOST_PSNR = 1000

# Noise and coefficients have at least this share of the largest variance of a coefficient.
LEAST_SPREAD = 1e-9

# Pairs of nodes that one which no texel showed is a mean of, the less the farther.
NEAREST_PAIRS = 8


# Clusters, components and relative step, usually, and of one view under known lights.
USUAL_COUNTS, ONE_VIEW_COUNTS = (8, 6, 0.5), (16, 12, 0.25)
# Models of a field.
CLUSTERED, HALF_VECTOR = "clustered", "half_vector"


@dataclass(frozen=True)
class CompressionOptions:
    """Size of the field and how it is fitted.

    Parameters
    ----------
    model : {"auto", "clustered", "half_vector"}
        "clustered": clustered local PCA in aligned frames, as in the paper. "half_vector":
        functions of the half vector that all texels share, with coefficients and frames of
        each texel fitted to the photographs; the lights must be known. "auto" takes
        "half_vector" for a solid object under known lights where a texel has enough samples
        and neither `fit` nor `comparison.without_alignment` asks for the other.
    half_vector : HalfVectorOptions
    n_clusters, n_components : int or "auto"
        Clusters, and basis functions of each beside its mean. "auto" is 8 and 6, and for one
        view under known lights, whose normals are those of photometric stereo, 16 and 12: in
        such frames highlights stand at the angles of the view and vary more.
    fit : {"auto", "samples", "grid"}
        "grid": local PCA of the resampled texels, as in the paper. "samples": from there,
        mean, basis and coefficients are fitted to the samples themselves. "auto" makes
        both fields and takes the one that is clearly better on the held-out photographs.
        Without any, in doubt, or where a texel has fewer samples than coefficients or
        thousands of them, their number decides: see `fits_samples`.
    rank : int
        Rank of the completion in the aligned frames.
    training_texels : int
        Texels that shape the completion's basis.
    samples : SampleFitOptions
    size : int
        Bytes that the file may have, 0: as many as `relative_step` gives. Clusters, components
        and quantisation are then chosen by the error that they leave; see
        `field.step_search`.
    psnr : float
        LDR PSNR, dB, that the field is to have on the samples that it is made of, 0: as it
        comes. Clusters, components and quantisation are then chosen for the smallest file.
    relative_step : float or "auto"
        Quantisation step of the field over the root mean square residual of the fit. At a
        half, quantisation adds some percent to the error; see `Quantisation`. "auto" is a half,
        and of one view under known lights a quarter: its fields are small.
    """

    model: str = "auto"
    half_vector: HalfVectorOptions = field(default_factory=HalfVectorOptions)
    n_clusters: int | Literal["auto"] = "auto"
    n_components: int | Literal["auto"] = "auto"
    fit: str = "auto"
    rank: int = 16
    training_texels: int = 8192
    samples: SampleFitOptions = field(default_factory=SampleFitOptions)
    size: int = 0
    psnr: float = 0.0
    relative_step: float | Literal["auto"] = "auto"

    def __post_init__(self) -> None:
        if self.model not in ("auto", CLUSTERED, HALF_VECTOR):
            raise InputError(
                f"model: expected 'auto', 'clustered' or 'half_vector', received {self.model!r}"
            )
        if self.fit not in ("auto", "samples", "grid"):
            raise InputError(
                f"fit: expected 'auto', 'samples' or 'grid', received {self.fit!r}"
            )
        for name, least, most in (
            ("n_clusters", 1, 65_536),
            ("n_components", 0, 1024),
            ("rank", 1, 1024),
            ("training_texels", 1, 1 << 24),
            ("size", 0, 1 << 40),
        ):
            if name.startswith("n_") and getattr(self, name) == "auto":
                continue
            if not least <= getattr(self, name) <= most:
                raise InputError(
                    f"{name}: expected at least {least} and at most {most}, "
                    f"received {getattr(self, name)}"
                )
        if self.size and self.psnr:
            raise InputError(
                f"size, psnr: expected one of them, received {self.size} bytes and "
                f"{self.psnr} dB"
            )
        check_ranges(self, {"psnr": (0, MOST_PSNR)})
        if self.relative_step != "auto":
            check_ranges(self, {"relative_step": (1e-3, 1e3)})

    @property
    def clusters(self) -> int:
        """Number of clusters; the usual one where none is stated."""
        return USUAL_COUNTS[0] if self.n_clusters == "auto" else self.n_clusters

    @property
    def components(self) -> int:
        """Number of components; the usual one where none is stated."""
        return USUAL_COUNTS[1] if self.n_components == "auto" else self.n_components

    @property
    def step(self) -> float:
        """Relative step; the usual one where none is stated."""
        return USUAL_COUNTS[2] if self.relative_step == "auto" else self.relative_step

    def with_counts(
        self, clusters: int, components: int, relative_step: float
    ) -> CompressionOptions:
        """Options with these counts and step in place of "auto".

        Examples
        --------
        >>> options = CompressionOptions(n_components=4).with_counts(12, 10, 0.5)
        >>> options.n_clusters, options.n_components, options.relative_step
        (12, 4, 0.5)
        """
        if "auto" not in (self.n_clusters, self.n_components, self.relative_step):
            return self
        return replace(
            self,
            n_clusters=clusters if self.n_clusters == "auto" else self.n_clusters,
            n_components=components if self.n_components == "auto" else self.n_components,
            relative_step=relative_step if self.relative_step == "auto" else self.relative_step,
        )

    def fits_samples(self, n_samples: float) -> bool:
        """Whether to fit to the samples, of which a texel has `n_samples` on average.

        With a few samples a texel, its coefficients would follow their errors; on dense
        domes the grids lose little and the samples of enough texels do not fit in memory.
        """
        enough = SAMPLES_PER_COEFFICIENT * self.components
        return self.fit == "samples" or (
            self.fit == "auto" and enough <= n_samples <= MOST_SAMPLES
        )


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
    local = clusters_of(coefficients[observed], options, seed)
    return lifted_clusters(completion, local, observed, len(coefficients), node_counts)


def clusters_of(coefficients: Floats, options: CompressionOptions, seed: int) -> ClusteredBasis:
    """Clusters of texels by their coefficients (n, rank) in the basis of a completion."""
    n_components = min(options.components, coefficients.shape[1])
    local = LocalPCA(options.clusters, n_components, seed=seed)
    return local.fit(np.ascontiguousarray(coefficients.T))


def lifted_clusters(
    completion: Completion,
    local: ClusteredBasis,
    observed: NDArray[np.intp],
    n_texels: int,
    node_counts: tuple[int, int],
) -> ClusteredModel:
    """Model of clusters of the observed texels; the others get cluster 0 and zeros."""
    n_components = local.coefficients.shape[1]
    means = completion.mean + local.means @ completion.basis.T
    bases = completion.basis @ local.bases  # (n_clusters, n_rows, K)
    table = np.concatenate([means[:, :, None], bases], axis=2)
    table = table.reshape(len(means), *node_counts, 3, n_components + 1)
    table = np.swapaxes(table, 3, 4).reshape(len(means), *node_counts, -1)
    _fill_empty_nodes(table, completion.empty_rows.reshape(*node_counts, 3)[..., 0])
    # Of the coefficients in an orthonormal basis; here per row of the columns.
    left_out = local.residual**2 * completion.rank / len(completion.mean)
    model = ClusteredModel(
        cluster=np.zeros(n_texels, np.int32),
        coefficients=np.zeros((n_texels, n_components), np.float32),
        table=np.ascontiguousarray(table, np.float32),
        precision=_precision(
            local.labels, local.coefficients, completion.noise, local.n_clusters
        ),
        residuals=(float(np.sqrt(left_out + completion.noise**2)),),
    )
    model.cluster[observed] = local.labels
    model.coefficients[observed] = local.coefficients
    return model


def completion_model(
    completion: Completion, node_counts: tuple[int, int], n_texels: int
) -> ClusteredModel:
    """Mean and basis of a completion as a model of one cluster, with its prior."""
    rank, used = completion.rank, completion.coefficients[~completion.sparse_columns]
    table = np.concatenate([completion.mean[:, None], completion.basis], axis=1)
    table = table.reshape(1, *node_counts, 3, rank + 1)
    table = np.swapaxes(table, 3, 4).reshape(1, *node_counts, -1)
    _fill_empty_nodes(table, completion.empty_rows.reshape(*node_counts, 3)[..., 0])
    labels = np.zeros(len(used), np.int32)
    return ClusteredModel(
        cluster=np.zeros(n_texels, np.int32),
        coefficients=np.zeros((n_texels, rank), np.float32),
        table=np.ascontiguousarray(table, np.float32),
        precision=_precision(labels, used, completion.noise, 1),
    )


def _fill_empty_nodes(table: NDArray[np.floating], empty: NDArray[np.bool_]) -> None:
    """Give pairs of nodes that no texel showed what the nearest pairs have that some did.

    The completion leaves them black. `table` is (n_clusters, n_view_nodes, n_light_nodes, n),
    `empty` (n_view_nodes, n_light_nodes).
    """
    if not empty.any() or empty.all():
        return
    view, light = (HemisphereGrid(isqrt(n)).directions for n in empty.shape)
    v, m = np.nonzero(empty)
    known = np.nonzero(~empty)
    near = cKDTree(np.hstack([view[known[0]], light[known[1]]]))
    count = min(NEAREST_PAIRS, len(known[0]))
    distance, index = near.query(np.hstack([view[v], light[m]]), k=range(1, count + 1))
    weights = 1.0 / np.square(distance)
    weights /= weights.sum(axis=1, keepdims=True)
    from_known = table[:, known[0][index], known[1][index]]
    table[:, v, m] = np.einsum("cnkf,nk->cnf", from_known, weights)


def _precision(
    labels: NDArray[np.int32],
    coefficients: NDArray[np.floating],
    noise: float,
    n_clusters: int,
) -> NDArray[np.float64]:
    """Noise variance over the variance of each coefficient in each cluster.

    Both are floored relative to the spread of all coefficients, so that the unit of the
    data does not matter; a cluster without spread gets the floor, its coefficients zero.
    """
    n_components = coefficients.shape[1]
    precision = np.tile(np.eye(n_components), (n_clusters, 1, 1))
    spread = float(coefficients.astype(np.float64).var(axis=0).max(initial=0.0))
    least = max(LEAST_SPREAD * spread, np.finfo(np.float64).tiny)
    for cluster in np.unique(labels):
        variance = coefficients[labels == cluster].astype(np.float64).var(axis=0)
        floor = max(1e-6 * variance.max(initial=0.0), least)
        ratio = max(noise**2, least) / np.maximum(variance, floor)
        np.fill_diagonal(precision[cluster], ratio)
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
        The model itself if every texel has samples.

    Raises
    ------
    InputError
        If no texel has samples.
    """
    if not len(observed):
        raise InputError("observed: expected texels with samples, received none")
    empty = np.setdiff1d(np.arange(len(positions)), observed)
    if not len(empty):
        return model
    _, nearest = cKDTree(positions[observed]).query(positions[empty])
    cluster, coefficients = model.cluster.copy(), model.coefficients.copy()
    cluster[empty] = cluster[observed[nearest]]
    coefficients[empty] = coefficients[observed[nearest]]
    return replace(model, cluster=cluster, coefficients=coefficients)
