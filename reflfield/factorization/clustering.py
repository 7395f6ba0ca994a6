"""Clusters of points, each with its own mean and subspace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.util.progress import report

Array = NDArray[Any]
SEEDING_DIMENSIONS = 16
SEEDING_ITERATIONS = 5
# Seeds tried, on so many points (and one more per cluster), for so many iterations each.
STARTS = 4
START_POINTS = 8192
START_ITERATIONS = 10
# Points whose distances to all clusters are held at once.
POINTS_AT_ONCE = 8192
# Iterations stop when the squared error falls by less than this share.
MIN_PROGRESS = 1e-4


@dataclass(frozen=True)
class Clusters:
    """Points x as means[c] + bases[c] z.

    Attributes
    ----------
    labels : (n,) int32
    means : (n_clusters, d) float
    bases : (n_clusters, d, n_components) float
        Orthonormal; zero vectors where a cluster spans fewer.
    variances : (n_clusters, n_components) float64
        Of the coordinates along the basis vectors.
    """

    labels: NDArray[np.int32]
    means: Array
    bases: Array
    variances: Array


def cluster_columns(
    points: Array,
    n_clusters: int,
    n_components: int,
    iterations: int,
    rng: np.random.Generator,
) -> tuple[Clusters, tuple[float, ...]]:
    """Alternate between subspaces of clusters and nearest subspaces of points.

    Parameters
    ----------
    points : (n, d) float
        Of mean zero, leading principal components first.
    n_clusters, n_components, iterations : int
        Iterations stop early when the error no longer falls.
    rng : numpy.random.Generator
        For the start.

    Returns
    -------
    Clusters
        The last one.
    history : tuple of float
        Error relative to the points' own size after each iteration; never rises.
    """
    initial = best_start(points, n_clusters, n_components, rng)
    clusters, errors = alternate(points, initial, iterations)
    size = max(float((points.astype(np.float64) ** 2).sum()), 1e-300)
    return clusters, tuple(float(np.sqrt(error / size)) for error in errors)


def alternate(
    points: Array, clusters: Clusters, iterations: int
) -> tuple[Clusters, list[float]]:
    """Alternate assignment and update; return clusters and squared error of each iteration.

    The labels of the clusters that come in need not be those of the points.
    """
    n_clusters, _, n_components = clusters.bases.shape
    errors: list[float] = []
    for iteration in range(iterations):
        report("local PCA", iteration, iterations)
        labels, squared = nearest(points, clusters)
        errors.append(float(squared.sum()))
        labels = without_empty(labels, squared, n_clusters)
        converged = np.array_equal(labels, clusters.labels) or _converged(errors)
        clusters = updated(points, labels, n_clusters, n_components)
        if converged:
            break
    report("local PCA", iterations, iterations)
    return clusters, errors


def _converged(errors: list[float]) -> bool:
    return len(errors) > 1 and errors[-1] >= (1 - MIN_PROGRESS) * errors[-2]


def nearest(points: Array, clusters: Clusters) -> tuple[NDArray[np.int32], Array]:
    r"""Cluster of least reconstruction error, and that squared error, of every point.

    :math:`d^2 = |x|^2 - 2 x \cdot \mu + |\mu|^2 - |P^\top x - P^\top \mu|^2`.

    Examples
    --------
    >>> x_axis, y_axis = np.eye(2)[:, :1], np.eye(2)[:, 1:]
    >>> lines = np.stack([x_axis, y_axis])
    >>> two = Clusters(np.zeros(0, np.int32), np.zeros((2, 2)), lines, np.zeros((2, 1)))
    >>> labels, squared = nearest(np.array([[3.0, 1.0], [0.5, 2.0]]), two)
    >>> labels, squared
    (array([0, 1], dtype=int32), array([1.  , 0.25]))
    """
    n_clusters, d, n_components = clusters.bases.shape
    stacked = clusters.bases.transpose(1, 0, 2).reshape(d, n_clusters * n_components)
    shifts = np.einsum("cdk,cd->ck", clusters.bases, clusters.means)
    mean_squares = (clusters.means**2).sum(axis=1)
    labels = np.zeros(len(points), dtype=np.int32)
    squared = np.zeros(len(points))
    for start in range(0, len(points), POINTS_AT_ONCE):
        part = points[start : start + POINTS_AT_ONCE]
        distances = mean_squares - 2 * (part @ clusters.means.T)
        along = (part @ stacked).reshape(len(part), n_clusters, n_components) - shifts
        distances -= np.einsum("nck,nck->nc", along, along)
        best = distances.argmin(axis=1)
        labels[start : start + len(part)] = best
        least = distances[np.arange(len(part)), best] + (part**2).sum(axis=1)
        squared[start : start + len(part)] = np.maximum(least, 0)
    return labels, squared


def updated(
    points: Array, labels: NDArray[np.int32], n_clusters: int, n_components: int
) -> Clusters:
    """Means and leading principal components of every cluster."""
    d = points.shape[1]
    means = np.zeros((n_clusters, d), dtype=points.dtype)
    bases = np.zeros((n_clusters, d, n_components), dtype=points.dtype)
    variances = np.zeros((n_clusters, n_components))
    order = np.argsort(labels, kind="stable")
    ends = np.searchsorted(labels[order], np.arange(n_clusters + 1))
    for cluster in range(n_clusters):
        members = points[order[ends[cluster] : ends[cluster + 1]]]
        if len(members) == 0:
            continue
        means[cluster] = members.mean(axis=0, dtype=np.float64)
        if n_components:
            spanned = min(n_components, len(members) - 1, d)
            values, vectors = principal(members - means[cluster], spanned)
            bases[cluster, :, :spanned] = vectors
            variances[cluster, :spanned] = values
    return Clusters(labels, means, bases, variances)


def principal(centred: Array, n_components: int) -> tuple[Array, Array]:
    """Variances and directions of the leading principal components."""
    covariance = (centred.T @ centred).astype(np.float64) / len(centred)
    values, vectors = np.linalg.eigh(covariance)
    leading = slice(len(values) - 1, len(values) - 1 - n_components, -1)
    if n_components == len(values):
        leading = slice(None, None, -1)
    return np.maximum(values[leading], 0), vectors[:, leading]


def without_empty(
    labels: NDArray[np.int32], squared: Array, n_clusters: int
) -> NDArray[np.int32]:
    """Give each empty cluster one of the worst reconstructed points of larger clusters."""
    counts = np.bincount(labels, minlength=n_clusters)
    empty = np.flatnonzero(counts == 0)
    if len(empty) == 0:
        return labels
    labels = labels.copy()
    worst = iter(np.argsort(-squared, kind="stable"))
    for cluster in empty:
        for point in worst:
            if counts[labels[point]] > 1:
                counts[labels[point]] -= 1
                labels[point] = cluster
                break
    return labels


# --- start -------------------------------------------------------------------------------


def best_start(
    points: Array, n_clusters: int, n_components: int, rng: np.random.Generator
) -> Clusters:
    """Clusters of a share of the points, the best of several seeds after a few iterations."""
    chosen = np.arange(len(points))
    if len(points) > START_POINTS + n_clusters:
        chosen = np.sort(rng.choice(len(points), START_POINTS + n_clusters, replace=False))
    share = points[chosen]
    best: Clusters | None = None
    least = np.inf
    for _ in range(STARTS if n_components else 1):
        labels = seeded_labels(share[:, :SEEDING_DIMENSIONS], n_clusters, rng)
        clusters = updated(share, labels, n_clusters, n_components)
        clusters, _ = alternate(share, clusters, START_ITERATIONS)
        error = float(nearest(share, clusters)[1].sum())
        if best is None or error < least:
            best, least = clusters, error
    assert best is not None
    return best


def seeded_labels(
    points: Array, n_clusters: int, rng: np.random.Generator
) -> NDArray[np.int32]:
    """Labels of k-means++ and a few iterations of k-means."""
    centres = points[kmeans_plus_plus(points, n_clusters, rng)]
    no_bases = np.zeros((*centres.shape, 0), dtype=points.dtype)
    clusters = Clusters(np.zeros(0, np.int32), centres, no_bases, np.zeros((n_clusters, 0)))
    labels, squared = nearest(points, clusters)
    for _ in range(SEEDING_ITERATIONS):
        labels = without_empty(labels, squared, n_clusters)
        labels, squared = nearest(points, updated(points, labels, n_clusters, 0))
    return without_empty(labels, squared, n_clusters)


def kmeans_plus_plus(points: Array, n_clusters: int, rng: np.random.Generator) -> Array:
    """Indices of starting points, each drawn with probability ~ squared distance to the rest.

    D. Arthur, S. Vassilvitskii, "k-means++: the advantages of careful seeding", SODA 2007.
    """
    chosen = np.zeros(n_clusters, dtype=np.intp)
    chosen[0] = rng.integers(len(points))
    squared = ((points - points[chosen[0]]) ** 2).sum(axis=1).astype(np.float64)
    for i in range(1, n_clusters):
        total = squared.sum()
        if total > 0:
            chosen[i] = np.searchsorted(np.cumsum(squared), rng.random() * total, "right")
        else:
            chosen[i] = rng.integers(len(points))
        chosen[i] = min(chosen[i], len(points) - 1)
        distances = ((points - points[chosen[i]]) ** 2).sum(axis=1)
        np.minimum(squared, distances, out=squared)
    return chosen
