"""Few directional lights that together send what many small patches of the sky send."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DistantLights:
    """A set of directional lights.

    Parameters
    ----------
    directions : (n, 3) float64
        Unit vectors to the lights, world frame.
    irradiances : (n, 3) float64
        Irradiance of a surface that faces each light.
    """

    directions: Array
    irradiances: Array

    def __len__(self) -> int:
        return len(self.directions)


def merged_lights(
    directions: Array, irradiances: Array, energy: Array, n_lights: int
) -> DistantLights:
    """Merge directional lights to few that together send the same.

    Starting from all of them, the cell whose light would err most, by the sum over its
    members of energy times squared distance to the cell's mean direction, is cut in two at
    its mean, until there are enough. Each cell becomes one light: the sum of its
    irradiances, channel by channel, from its energy-weighted mean direction. Nothing is
    random.

    Parameters
    ----------
    directions : (n, 3) float64
        Unit vectors.
    irradiances : (n, 3) float64
        Not negative.
    energy : (n,) float64
        Weight of each, such as its luminance.
    n_lights : int
        Lights wanted; fewer are returned if fewer have energy.

    Returns
    -------
    DistantLights
        Their irradiances sum to the given ones, exactly to rounding.

    References
    ----------
    X. Wu, "Color quantization by dynamic programming and principal analysis", ACM
    Transactions on Graphics 1992 (the criterion, there of colours).
    """
    cells = _split(directions, energy, n_lights)
    return DistantLights(
        directions=np.stack([_mean_direction(directions[c], energy[c]) for c in cells]),
        irradiances=np.stack([irradiances[c].sum(axis=0) for c in cells]),
    )


def _mean_direction(directions: Array, energy: Array) -> Array:
    mean = energy @ directions
    length = np.linalg.norm(mean)
    # Opposite directions of equal energy have no mean; either is as good.
    return mean / length if length > 0 else directions[0]


def _split(directions: Array, energy: Array, n_cells: int) -> list[NDArray[np.intp]]:
    """Index arrays of at most `n_cells` cells, split where the energy spreads most."""
    lit = np.flatnonzero(energy > 0)
    whole = lit if len(lit) else np.arange(1)
    heap = [(-_spread(directions, energy).sum(), 0, whole)]
    finished: list[NDArray[np.intp]] = []
    counter = 1  # breaks ties, so that index arrays are never compared
    while heap and len(heap) + len(finished) < n_cells:
        _, _, cell = heapq.heappop(heap)
        parts = _halves(cell, directions[cell], energy[cell])
        if parts is None:
            finished.append(cell)
            continue
        for part in parts:
            error = _spread(directions[part], energy[part]).sum()
            heapq.heappush(heap, (-error, counter, part))
            counter += 1
    return finished + [cell for _, _, cell in sorted(heap, key=lambda entry: entry[1])]


def _spread(directions: Array, energy: Array) -> Array:
    """Energy times squared distance to the mean, for each axis, (3,)."""
    total = energy.sum()
    if not total > 0:
        return np.zeros(3)
    offsets = directions - energy @ directions / total
    return energy @ offsets**2


def _halves(
    cell: NDArray[np.intp], directions: Array, energy: Array
) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
    """Cut a cell at its mean across the axis of largest spread; None if it cannot be."""
    spread = _spread(directions, energy)
    axis = int(np.argmax(spread))
    if not spread[axis] > 0:
        return None
    coordinate = directions[:, axis]
    upper = coordinate > energy @ coordinate / energy.sum()
    if upper.all() or not upper.any():
        return None
    return cell[~upper], cell[upper]
