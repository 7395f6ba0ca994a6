"""Bilinear densities on the unit square that depend on parameters, and their warp.

Tables are linearly interpolated between the stored parameter values; within a
table, values are bilinear. The warp is that of sampling the density: first the
row by its marginal, then the column by its conditional distribution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Slices:
    """Parameter slices that points fall between: indices and weights.

    Parameters
    ----------
    index : (n_corners, n) int64
        Slice of each corner of the parameter cell.
    weight : (n_corners, n) float64
        Linear weights; their sum over the corners is 1.
    """

    index: Index
    weight: Array

    @classmethod
    def between(cls, nodes: Sequence[Array], parameters: Sequence[Array]) -> Slices:
        """Corners of the cells that hold the parameters; outside, the nearest.

        Parameters
        ----------
        nodes : sequence of (n_nodes,) float64
            Increasing stored values of each parameter.
        parameters : sequence of (n,) float64
            Value of each parameter at each point.

        Examples
        --------
        >>> cells = Slices.between([np.array([0.0, 1.0, 3.0])], [np.array([1.5])])
        >>> cells.index.ravel(), cells.weight.ravel()
        (array([1, 2]), array([0.75, 0.25]))
        """
        n_points = len(parameters[0])
        index, weight = np.zeros((1, n_points), np.int64), np.ones((1, n_points))
        for stored, value in zip(nodes, parameters, strict=True):
            index = index * len(stored)
            if len(stored) == 1:
                continue
            low = np.clip(np.searchsorted(stored, value, side="right") - 1, 0, len(stored) - 2)
            span = stored[low + 1] - stored[low]
            t = np.clip((value - stored[low]) / span, 0.0, 1.0)
            index = np.concatenate([index + low, index + low + 1])
            weight = np.concatenate([weight * (1.0 - t), weight * t])
        return cls(index, weight)

    def gather(self, table: Array, position: Index) -> Array:
        """Interpolated values of ``table[slice, position]``, (n,) float64."""
        return np.einsum("cn,cn->n", self.weight, table[self.index, position])


@dataclass(frozen=True, eq=False)
class BilinearTable:
    """Bilinear function on the unit square for each parameter slice.

    Parameters
    ----------
    values : (n_slices, height, width) float64
        Values at the nodes; the first and last node lie on the border.

    Examples
    --------
    >>> table = BilinearTable(np.array([[[0.0, 1.0], [2.0, 3.0]]]))
    >>> centre = np.array([[0.5, 0.5]])
    >>> table.evaluate(centre, Slices.between([np.zeros(1)], [np.zeros(1)]))
    array([1.5])
    """

    values: Array

    def evaluate(self, points: Array, slices: Slices) -> Array:
        """Value at each point (x, y) of the unit square, (n,) float64."""
        corner, t = self.cells(points)
        left, right = self.sides(corner, t, slices)
        return (1.0 - t[:, 0]) * left + t[:, 0] * right

    def cells(self, points: Array) -> tuple[Index, Array]:
        """Lower corner (column, row) of the cell of each point, and the place in it."""
        size = np.array(self.values.shape[:0:-1])
        scaled = points * (size - 1)
        corner = np.clip(scaled.astype(np.int64), 0, size - 2)
        return corner, scaled - corner

    def sides(self, corner: Index, t: Array, slices: Slices) -> tuple[Array, Array]:
        """Values on the left and right side of each cell at the height of the point."""
        width = self.values.shape[2]
        flat = self.values.reshape(len(self.values), -1)
        at = corner[:, 0] + width * corner[:, 1]
        lower, upper = 1.0 - t[:, 1], t[:, 1]
        left = lower * slices.gather(flat, at) + upper * slices.gather(flat, at + width)
        right = lower * slices.gather(flat, at + 1) + upper * slices.gather(
            flat, at + width + 1
        )
        return left, right


@dataclass(frozen=True, eq=False)
class Warp:
    """Sampling warp of a bilinear density, inverted.

    Parameters
    ----------
    density : BilinearTable
        Node values, normalised so that each slice sums to 1 over its cells.
    conditional : (n_slices, height * width) float64
        Integral along each row from its left end to each node.
    marginal : (n_slices, height) float64
        Integral over all rows up to each.

    References
    ----------
    J. Dupuy and W. Jakob, "An adaptive parameterization for efficient material
    acquisition and rendering", ACM TOG 37(6), 2018.
    """

    density: BilinearTable
    conditional: Array
    marginal: Array

    @classmethod
    def of(cls, values: Array) -> Warp:
        """Warp of densities (n_slices, height, width) >= 0, not all 0 in a slice."""
        rows = _running_means(values)
        marginal = _running_means(rows[:, :, -1])
        total = marginal[:, -1]
        rows /= total[:, None, None]
        return cls(
            BilinearTable(values / total[:, None, None]),
            rows.reshape(len(values), -1),
            marginal / total[:, None],
        )

    def invert(self, points: Array, slices: Slices) -> Array:
        """Uniform sample that the warp carries to each point, (n, 2) float64.

        Parameters
        ----------
        points : (n, 2) float64
            Places (x, y) in the unit square.
        slices : Slices
            Parameters of each point.

        Examples
        --------
        The warp of a constant density is the identity:

        >>> warp = Warp.of(np.ones((1, 3, 4)))
        >>> at = Slices.between([np.zeros(1)], [np.zeros(1)])
        >>> warp.invert(np.array([[0.3, 0.9]]), at).round(12)
        array([[0.3, 0.9]])
        """
        corner, t = self.density.cells(points)
        width = self.density.values.shape[2]
        left, right = self.density.sides(corner, t, slices)
        start, row = corner[:, 1] * width, corner[:, 1]
        # Along x: mass of the row left of the point over the mass of the row.
        within = t[:, 0] * (left + 0.5 * t[:, 0] * (right - left))
        here = start + corner[:, 0]
        before = self._blend(here, width, t, slices)
        lower = slices.gather(self.conditional, start + width - 1)
        upper = slices.gather(self.conditional, start + 2 * width - 1)
        row_mass = (1.0 - t[:, 1]) * lower + t[:, 1] * upper
        x = (before + within) / np.where(row_mass > 0.0, row_mass, 1.0)
        # Along y: mass of everything below.
        y = slices.gather(self.marginal, row)
        y += t[:, 1] * (lower + 0.5 * t[:, 1] * (upper - lower))
        return np.clip(np.stack([x, y], axis=1), 0.0, 1.0)

    def _blend(self, here: Index, width: int, t: Array, slices: Slices) -> Array:
        below = slices.gather(self.conditional, here)
        above = slices.gather(self.conditional, here + width)
        return (1.0 - t[:, 1]) * below + t[:, 1] * above


def _running_means(values: Array) -> Array:
    """Trapezoidal integral along the last axis from its start, unit spacing."""
    integral = np.zeros_like(values)
    np.cumsum(0.5 * (values[..., 1:] + values[..., :-1]), axis=-1, out=integral[..., 1:])
    return integral
