"""Texture atlas: the surface cut into charts and laid out in one texture."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from reflfield.checks import check_shape
from reflfield.errors import InputError
from reflfield.geometry.mesh import Mesh

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Atlas:
    """A mesh with texture coordinates; vertices are repeated along chart borders.

    Parameters
    ----------
    positions : (n, 3) float64
        Vertices, metres.
    faces : (m, 3) int32
        Triangles, in the order of the mesh they come from.
    uv : (n, 2) float64
        Texture coordinates in [0, 1]; u to the right, v UP: v = 1 is the top row
        of the texture. (glTF counts v downwards: its v is 1 - v.)
    chart : (m,) int32
        Chart of each triangle, 0 .. n_charts - 1.
    normals : (n, 3) float64
        Smooth unit normals.
    height, width : int
        Size of the texture in texels that the charts were laid out for.

    Raises
    ------
    ShapeError
        If arrays do not fit each other.
    InputError
        If a coordinate leaves [0, 1] or a face names a vertex that does not exist.
    """

    positions: Array
    faces: NDArray[np.int32]
    uv: Array
    chart: NDArray[np.int32]
    normals: Array
    height: int
    width: int

    def __post_init__(self) -> None:
        for name, dtype in _COLUMNS.items():
            array = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            object.__setattr__(self, name, array)
        check_shape("uv", self.uv, (len(self.positions), 2))
        check_shape("normals", self.normals, (len(self.positions), 3))
        check_shape("chart", self.chart, (len(self.faces),))
        if self.height < 1 or self.width < 1:
            raise InputError(
                f"atlas: expected a texture of at least 1 x 1 texels, received "
                f"{self.width} x {self.height}"
            )
        if not ((self.uv >= 0.0) & (self.uv <= 1.0)).all():
            raise InputError(
                f"uv: expected values in [0, 1], received {self.uv.min():.4g} .. "
                f"{self.uv.max():.4g}; divide by the size of the texture"
            )
        _ = self.mesh  # checks positions and faces

    @cached_property
    def mesh(self) -> Mesh:
        """Triangles without texture coordinates, vertices as here."""
        return Mesh(self.positions, self.faces)

    @property
    def n_charts(self) -> int:
        """Number of charts."""
        return int(self.chart.max(initial=-1)) + 1

    @cached_property
    def mirrored(self) -> NDArray[np.bool_]:
        """True for charts that the texture shows mirrored, (n_charts,)."""
        return np.bincount(self.chart, self.uv_areas, minlength=self.n_charts) < 0.0

    @cached_property
    def uv_areas(self) -> Array:
        """Signed area of each triangle in texture space, (m,); negative: mirrored."""
        first, second, third = np.moveaxis(self.uv[self.faces], 1, 0)
        (a1, b1), (a2, b2) = (second - first).T, (third - first).T
        return 0.5 * (a1 * b2 - a2 * b1)


_COLUMNS = {
    "positions": np.float64,
    "faces": np.int32,
    "uv": np.float64,
    "chart": np.int32,
    "normals": np.float64,
}
