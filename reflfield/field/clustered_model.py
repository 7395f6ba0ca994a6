"""Mean and basis of every cluster with the texels' coefficients; normal forms, finer grids.

Texels of one cluster sample one reflectance in frames of their own, so together they sample it
more densely than the cameras and lights of the dome do, which the grid of the resampling
follows. The fit to the samples begins on that grid and ends on a refined one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import ShapeError

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]

# Root mean square of the means of usual samples, as cube roots.
USUAL_SIZE = 0.35
# Largest table of the functions of all clusters on a refined grid, in float32: a fit holds
# about fourteen copies.
MAX_TABLE_BYTES = 32 << 20


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


def refined_sides(sides: tuple[int, int], n_functions: int, factor: float) -> tuple[int, int]:
    """Sides of grids with up to `factor` times as many intervals between nodes.

    Fewer where the functions would take more than `MAX_TABLE_BYTES`. Odd sides stay odd, so
    that the zenith stays a node.

    Parameters
    ----------
    sides : (int, int)
        Of the view and light grids; 1 where the direction does not vary, which stays.
    n_functions : int
        Of three channels, over all clusters.
    factor : float
        Grid refinement factor, at least 1.

    Returns
    -------
    (int, int)
        Not below `sides`.

    Examples
    --------
    >>> refined_sides((7, 7), 8 * 7, 4 / 3), refined_sides((13, 13), 16 * 11, 4 / 3)
    ((9, 9), (13, 13))
    >>> refined_sides((1, 13), 8 * 7, 2)
    (1, 25)
    """
    intervals = np.array(sides) - 1
    longest = int(intervals.max(initial=0))
    for n_intervals in range(int(factor * longest), longest, -1):
        refined = intervals * n_intervals // longest
        # An even number of intervals stays even.
        refined -= (refined - intervals) % 2
        view, light = (int(side) for side in np.maximum(refined, intervals) + 1)
        if 12 * n_functions * view**2 * light**2 <= MAX_TABLE_BYTES:
            return view, light
    return sides


def on_refined_grid(model: ClusteredModel, sides: tuple[int, int]) -> ClusteredModel:
    """Interpolate mean and basis bilinearly onto the nodes of finer grids.

    The functions are the same where every old node is a new one.

    Parameters
    ----------
    model : ClusteredModel
    sides : (int, int)
        Of the new view and light grids.

    Returns
    -------
    ClusteredModel

    Raises
    ------
    ShapeError
        If a direction varies on one of the grids only.
    """
    n_views, n_lights = model.table.shape[1:3]
    view, light = _interpolation(n_views, sides[0]), _interpolation(n_lights, sides[1])
    table = np.einsum("vi,lj,cijk->cvlk", view, light, model.table, optimize=True)
    return replace(model, table=np.ascontiguousarray(table, np.float32))


def _interpolation(n_nodes: int, side: int) -> NDArray[np.float32]:
    """(side**2, n_nodes) weights of the old nodes at the new ones."""
    old = round(n_nodes**0.5)
    if (old == 1) != (side == 1):
        raise ShapeError(f"sides: expected {old} where a direction does not vary, got {side}")
    if old == 1:
        return np.ones((1, 1), np.float32)
    positions = np.linspace(0.0, old - 1.0, side)
    line = np.maximum(1.0 - np.abs(positions[:, None] - np.arange(old)), 0.0)
    return np.kron(line, line).astype(np.float32)
