"""Mean and basis of every cluster with the texels' coefficients, and its normal forms."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]

# Root mean square of the means of usual samples, as cube roots.
USUAL_SIZE = 0.35


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
