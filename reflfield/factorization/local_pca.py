"""Clustered local PCA: a mean and a few basis vectors for each cluster of columns.

The main path is `LocalPCA.fit`: columns are projected onto one global PCA
(`workspace`), clustered there by least reconstruction error (`clustering`),
and the bases lifted back; a last reading of the data gives exact coefficients
and the exact error.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.factorization.clustering import Clusters, cluster_columns, nearest
from reflfield.factorization.column_sources import (
    Columns,
    Reader,
    as_source,
    blocks_of,
    reader_of,
)
from reflfield.factorization.workspace import Workspace, pca_workspace

Array = NDArray[Any]


@dataclass(frozen=True)
class ClusteredBasis:
    """Columns as ``means[c] + bases[c] @ coefficients[column]``, c the column's cluster.

    Attributes
    ----------
    labels : (n_columns,) int32
        Cluster of each column.
    means : (n_clusters, n_rows) float
        Mean of each cluster.
    bases : (n_clusters, n_rows, n_components) float
        Orthonormal vectors by descending variance; zero vectors where the
        cluster spans fewer.
    coefficients : (n_columns, n_components) float
        Coefficients about the mean of the cluster.
    residual : float
        Root mean square of what is left over all entries, exact.
    history : tuple of float
        Relative error in the work space after each iteration; never rises.
    """

    labels: NDArray[np.int32]
    means: NDArray[np.floating]
    bases: NDArray[np.floating]
    coefficients: NDArray[np.floating]
    residual: float
    history: tuple[float, ...]

    @property
    def n_clusters(self) -> int:
        """Number of clusters."""
        return len(self.means)


@dataclass(frozen=True)
class LocalPCA:
    r"""Cluster columns by reconstruction error, with a PCA in each cluster.

    A column x belongs to the cluster with the least

    .. math:: d_c^2 = |x - \mu_c|^2 - |P_c^\top (x - \mu_c)|^2,

    evaluated for all columns and clusters by matrix products; clusters start
    from k-means++ on 16 global principal components and are iterated on 96
    [1]_. Iterating in the space of 96 components costs a tenth of iterating on
    the columns, with the same error.

    One cluster is a PCA, no components are vector quantisation.

    Parameters
    ----------
    n_clusters : int
        Clusters; fewer columns give fewer.
    n_components : int
        Basis vectors of each cluster.
    seed : int
        Of the start.
    iterations : int
        At most so many.
    work_components : int
        Dimension of the space that is iterated in; at least `n_components` is used.
    block : int
        Columns held in memory at once.
    most_columns : int
        Columns, drawn at random, that shape the clusters where there are more; the others
        then join the nearest. Millions of pixels say no more about eight clusters.

    Raises
    ------
    InputError
        If an option is out of range.

    Notes
    -----
    Memory: ``n_columns (work_components + n_components)`` numbers, the bases, and a
    few blocks. The data are read four times. Columns are complete; `complete` makes
    them so.

    References
    ----------
    .. [1] N. Kambhatla, T. K. Leen, "Dimension reduction by local principal component
       analysis", Neural Computation 9, 1997.

    Examples
    --------
    Points on two lines, one dimension each:

    >>> t = np.linspace(-1.0, 1.0, 9)
    >>> lines = np.hstack([np.stack([t, 0 * t, 0 * t + 3]), np.stack([0 * t, t, 0 * t - 3])])
    >>> fit = LocalPCA(n_clusters=2, n_components=1).fit(lines)
    >>> bool(fit.residual < 1e-6), np.bincount(fit.labels).tolist()
    (True, [9, 9])
    """

    n_clusters: int
    n_components: int
    seed: int = 0
    iterations: int = 50
    work_components: int = 96
    block: int = 256
    most_columns: int = 1 << 17

    def __post_init__(self) -> None:
        lowest = {"n_clusters": 1, "n_components": 0, "iterations": 1, "work_components": 1,
                  "block": 1, "most_columns": 1}  # fmt: skip
        for name, smallest in lowest.items():
            if getattr(self, name) < smallest:
                raise InputError(
                    f"{name}: expected at least {smallest}, received {getattr(self, name)}"
                )

    def fit(self, matrix: Any) -> ClusteredBasis:
        """Fit clusters, means and bases.

        Parameters
        ----------
        matrix : (n_rows, n_columns) array_like, zarr array or ColumnSource
            See `as_source`.

        Returns
        -------
        ClusteredBasis
            Labels, means, bases, coefficients and the exact error.

        Raises
        ------
        ShapeError, InputError
            If shapes do not fit, or a value is missing or not finite.
        """
        source = as_source(matrix)
        reader = reader_of(source, 1, self.block)
        n_dimensions = max(self.work_components, self.n_components)
        space = pca_workspace(reader, n_dimensions, self.block, self.seed)
        clusters, history = self._clusters(space.coordinates)
        labels = clusters.labels
        if len(labels) < source.shape[1]:
            labels = nearest(space.coordinates, clusters)[0]
        means, bases = _lifted(space, clusters)
        coefficients, squared = _project(reader, means, bases, labels, self.block)
        return ClusteredBasis(
            labels=labels,
            means=means * reader.dtype.type(reader.scale),
            bases=bases,
            coefficients=coefficients * reader.dtype.type(reader.scale),
            residual=float(np.sqrt(squared / np.prod(source.shape))) * reader.scale,
            history=history,
        )

    def _clusters(self, points: Array) -> tuple[Clusters, tuple[float, ...]]:
        """Clusters of the points, of at most `most_columns` drawn at random."""
        rng = np.random.default_rng(self.seed)
        if len(points) > self.most_columns:
            points = points[np.sort(rng.choice(len(points), self.most_columns, replace=False))]
        n_clusters = min(self.n_clusters, len(points))
        return cluster_columns(points, n_clusters, self.n_components, self.iterations, rng)


def _groups(labels: NDArray[np.integer]) -> Iterator[tuple[int, Columns]]:
    """Every cluster that has members, and their places in `labels`, ascending."""
    order = np.argsort(labels, kind="stable")
    present, starts = np.unique(labels[order], return_index=True)
    for cluster, members in zip(present, np.split(order, starts[1:]), strict=True):
        yield int(cluster), members


def _lifted(space: Workspace, clusters: Clusters) -> tuple[Array, Array]:
    """Means (n_clusters, n_rows) and bases (n_clusters, n_rows, K) in the space of the rows."""
    means = [space.mean + space.basis @ mean for mean in clusters.means]
    bases = [space.basis @ basis for basis in clusters.bases]
    return np.stack(means), np.stack(bases)


def _project(
    reader: Reader, means: Array, bases: Array, labels: NDArray[np.int32], block: int
) -> tuple[Array, float]:
    """Coefficients by orthogonal projection, and the squared residual of all entries."""
    coefficients = np.zeros((len(labels), bases.shape[2]), dtype=reader.dtype)
    squared = 0.0
    for columns in blocks_of(np.arange(len(labels)), block):
        residual = reader.block(columns).values - means[labels[columns]].T
        if bases.shape[2]:
            for cluster, members in _groups(labels[columns]):
                part = residual[:, members].T @ bases[cluster]
                coefficients[columns[members]] = part
                residual[:, members] -= bases[cluster] @ part.T
        np.square(residual, out=residual)
        squared += float(residual.sum(axis=0, dtype=np.float64).sum())
    return coefficients, squared
