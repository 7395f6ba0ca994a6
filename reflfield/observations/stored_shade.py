"""What texels show in shadows, as a stage keeps it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.lights import Light
from reflfield.observations.shade import Shade

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class StoredShade:
    """Transformed samples of some texels under lights that do not reach them.

    Parameters
    ----------
    texels : (n,) int
    values : (n, m, 3) float16
        Mean over the views, in units of `unit`.
    weights : (n, m, 3) bool
        Where there is a sample.
    light : (n, m) int
        Light of the capture, of each texel ascending.
    unit : float
        Of the values.
    lights : tuple of Light
        Of the capture.
    positions : (n_texels, 3) float64
        Of all texels.
    """

    texels: Indices
    values: NDArray[np.float16]
    weights: NDArray[np.bool_]
    light: NDArray[np.integer[Any]]
    unit: float
    lights: tuple[Light, ...]
    positions: NDArray[np.float64]

    def rows(self, rows: Indices) -> Shade:
        """Shade of some of the texels."""
        points, kept = self.positions[self.texels[rows]], self.light[rows][..., None]
        towards = [light.directions(points).astype(np.float32) for light in self.lights]
        return Shade(
            values=self.values[rows].astype(np.float32) * np.float32(self.unit),
            weights=self.weights[rows].astype(np.float32),
            lights=np.take_along_axis(np.stack(towards, axis=1), kept, axis=1),
        )

    def only(self, kept: Indices) -> StoredShade:
        """The shade of some of the texels, as it is kept."""
        return StoredShade(
            *(self.texels[kept], self.values[kept], self.weights[kept], self.light[kept]),
            *(self.unit, self.lights, self.positions),
        )
