"""Texel table: which point of the surface each texel of the texture stands for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import GeometryError
from reflfield.geometry.mesh import unit_or_zero
from reflfield.geometry.uv_atlas import Atlas
from reflfield.util.late_import import LateImport

ndimage: Any = LateImport("scipy.ndimage")

Array = NDArray[np.float64]

# Slack of the test "texel centre inside triangle", in barycentric units: rounding of the
# UV coordinates must not open a crack between two triangles that share an edge.
_EDGE_SLACK = 1e-7

# Candidate (triangle, texel) pairs looked at together: bounds the memory at about 100 MB.
_BLOCK_PAIRS = 1 << 20

# Ring of texels around each chart that repeats the nearest texel, so that bilinear lookups at
# the rim of a chart read the chart.
GUTTER = 2


@dataclass(frozen=True, eq=False)
class TexelTable:
    """Surface samples, one for each texel whose centre lies in a chart.

    Texels are ordered by row, then column. Row 0 is the top of the texture
    (v = 1); the centre of texel (row, col) has ``u = (col + .5) / width`` and
    ``v = 1 - (row + .5) / height``.

    Parameters
    ----------
    height, width : int
        Size of the texture.
    pixel : (n, 2) int32
        Row and column.
    position : (n, 3) float64
        Point of the surface, metres: the object may be small and far from the origin.
    local_from_world : (n, 3, 3) float32
        Rows tangent (along increasing u), binormal, smooth normal; orthonormal
        and right-handed also in mirrored charts.
    area : (n,) float32
        Surface area of the texel, square metres.
    face : (n,) int32
        Triangle.
    barycentric : (n, 3) float32
        Weights of the triangle's corners.
    chart : (n,) int32
        Chart of the triangle.
    mirrored : (n_charts,) bool
        True where the texture shows the chart mirrored: there the binormal points
        along decreasing v.
    face_normal : (n, 3) float32
        Normal of the triangle itself.
    texel_of_pixel : (height, width) int32
        Texel at or, inside the gutter, nearest to each pixel; -1 elsewhere.
    """

    height: int
    width: int
    pixel: NDArray[np.int32]
    position: Array
    local_from_world: NDArray[np.float32]
    area: NDArray[np.float32]
    face: NDArray[np.int32]
    barycentric: NDArray[np.float32]
    chart: NDArray[np.int32]
    mirrored: NDArray[np.bool_]
    face_normal: NDArray[np.float32]
    texel_of_pixel: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.pixel)

    @property
    def normal(self) -> NDArray[np.float32]:
        """Smooth unit normals, (n, 3)."""
        return self.local_from_world[:, 2]

    @cached_property
    def spacing(self) -> float:
        """Median distance between neighbouring texels, metres."""
        return float(np.sqrt(np.median(self.area)))

    def subset(self, texels: NDArray[np.integer] | slice) -> TexelTable:
        """Return a table of some texels; `texel_of_pixel` keeps the whole numbering."""
        rows = ("pixel", "position", "local_from_world", "area", "face", "barycentric", "chart")
        chosen = {name: getattr(self, name)[texels] for name in (*rows, "face_normal")}
        return TexelTable(
            height=self.height,
            width=self.width,
            mirrored=self.mirrored,
            texel_of_pixel=self.texel_of_pixel,
            **chosen,
        )


def texel_table(atlas: Atlas) -> TexelTable:
    """Rasterise the charts of an atlas at the centres of its texels.

    A texel belongs to the triangle that holds its centre (the first one where
    triangles touch), so no part of the surface is counted twice.

    Parameters
    ----------
    atlas : Atlas

    Returns
    -------
    TexelTable

    Raises
    ------
    GeometryError
        If no texel centre falls into any chart.

    Examples
    --------
    >>> atlas = Atlas(
    ...     positions=[[0, 0, 0], [1, 0, 0], [0, 1, 0]], faces=[[0, 1, 2]],
    ...     uv=[[0, 0], [1, 0], [0, 1]], chart=[0], normals=[[0, 0, 1]] * 3,
    ...     height=4, width=4)
    >>> texels = texel_table(atlas)
    >>> len(texels), texels.position[0]
    (10, array([0.125, 0.875, 0.   ]))
    >>> texels.local_from_world[0]
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]], dtype=float32)
    """
    pixel_number, face, weights = _covered_texels(atlas)
    if not len(face):
        raise GeometryError(
            f"atlas: expected charts that cover texel centres of a {atlas.width} x "
            f"{atlas.height} texture, received none; raise the texture resolution"
        )
    corners = atlas.faces[face]
    position = np.einsum("nk,nkd->nd", weights, atlas.positions[corners])
    normal = unit_or_zero(np.einsum("nk,nkd->nd", weights, atlas.normals[corners]))
    u_axis, v_axis = texture_axes(atlas)
    texel_area = np.linalg.norm(np.cross(u_axis, v_axis), axis=1) / (atlas.height * atlas.width)
    shape = (atlas.height, atlas.width)
    return TexelTable(
        height=atlas.height,
        width=atlas.width,
        pixel=np.stack(np.unravel_index(pixel_number, shape), axis=1).astype(np.int32),
        position=position,
        local_from_world=frames(normal, u_axis[face]).astype(np.float32),
        area=texel_area[face].astype(np.float32),
        face=face.astype(np.int32),
        barycentric=weights.astype(np.float32),
        chart=atlas.chart[face],
        mirrored=atlas.mirrored,
        face_normal=atlas.mesh.face_normals[face].astype(np.float32),
        texel_of_pixel=_nearest_texel(pixel_number, shape),
    )


def texture_axes(atlas: Atlas) -> tuple[Array, Array]:
    r"""Derivatives of the surface along the texture axes of each triangle.

    With edges :math:`e_1, e_2` in space and :math:`(a_1, b_1), (a_2, b_2)` in UV,
    :math:`\partial P / \partial u = (b_2 e_1 - b_1 e_2) / (a_1 b_2 - a_2 b_1)`
    and likewise for v.

    Parameters
    ----------
    atlas : Atlas

    Returns
    -------
    u_axis, v_axis : (n_faces, 3) float64
        Metres per unit of u and of v; zero for triangles without UV area.
    """
    corners, uv = atlas.positions[atlas.faces], atlas.uv[atlas.faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    (a1, b1), (a2, b2) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    determinant = a1 * b2 - a2 * b1
    scale = np.divide(1.0, determinant, out=np.zeros_like(a1), where=determinant != 0.0)
    u_axis = (b2 * scale)[:, None] * first - (b1 * scale)[:, None] * second
    v_axis = (a1 * scale)[:, None] * second - (a2 * scale)[:, None] * first
    return u_axis, v_axis


def frames(normal: Array, towards: Array) -> Array:
    """Right-handed frames: normal exact, tangent as near `towards` as possible.

    Parameters
    ----------
    normal : (n, 3) float64
        Unit vectors.
    towards : (n, 3) float64
        Wanted direction of the tangent, any length. Where it is null or parallel
        to the normal, the world axis most across the normal replaces it.

    Returns
    -------
    local_from_world : (n, 3, 3) float64
        Rows tangent, binormal, normal.

    Examples
    --------
    >>> frames(np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 3.0, 1.0]]))[0, 0]
    array([0., 1., 0.])
    """
    wanted = unit_or_zero(towards)
    spare = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    across = np.linalg.norm(np.cross(normal, wanted), axis=1) > 1e-4
    wanted = np.where(across[:, None], wanted, spare)
    tangent = unit_or_zero(wanted - (wanted * normal).sum(axis=1, keepdims=True) * normal)
    return np.stack([tangent, np.cross(normal, tangent), normal], axis=1)


def _covered_texels(atlas: Atlas) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Pixel number, triangle and barycentric weights of each covered texel centre."""
    parts = [_inside(atlas, face, pixel) for face, pixel in _candidates(atlas)]
    pixel, face, weights = (np.concatenate(part) for part in zip(*parts, strict=True))
    # Triangles that share an edge may both claim a texel on it: the first keeps it.
    order = np.lexsort((face, pixel))
    pixel, face, weights = pixel[order], face[order], weights[order]
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    return pixel[first], face[first], weights[first]


def _candidates(atlas: Atlas) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield blocks of (triangle, pixel number) for all texels in the triangles' boxes."""
    x, y = _texel_coordinates(atlas)
    limits = np.array([atlas.width, atlas.height])
    corners = np.stack([x, y], axis=-1)[atlas.faces]
    low = np.clip(np.ceil(corners.min(axis=1) - 1e-6), 0, limits).astype(np.int64)
    high = np.clip(np.floor(corners.max(axis=1) + 1e-6) + 1, low, limits).astype(np.int64)
    size = high - low
    counts = size.prod(axis=1)
    ends = np.cumsum(counts)
    starts = ends - counts
    total = int(ends[-1]) if len(ends) else 0
    for begin in range(0, max(total, 1), _BLOCK_PAIRS):
        number = np.arange(begin, min(begin + _BLOCK_PAIRS, total))
        face = np.searchsorted(ends, number, side="right")
        row, col = np.divmod(number - starts[face], np.maximum(size[face, 0], 1))
        yield face, (row + low[face, 1]) * atlas.width + col + low[face, 0]


def _inside(
    atlas: Atlas, face: NDArray[np.int64], pixel: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Of candidate pairs, keep those whose texel centre lies in the triangle."""
    x, y = _texel_coordinates(atlas)
    row, col = np.divmod(pixel, atlas.width)
    corners = atlas.faces[face]
    xs, ys = x[corners] - col[:, None], y[corners] - row[:, None]
    # Twice the areas of the triangles that the texel centre makes with the edges.
    parts = np.roll(xs, -1, 1) * np.roll(ys, -2, 1) - np.roll(xs, -2, 1) * np.roll(ys, -1, 1)
    total = parts.sum(axis=1, keepdims=True)
    weights = np.divide(parts, total, out=np.full_like(parts, -1.0), where=total != 0.0)
    covered = weights.min(axis=1) >= -_EDGE_SLACK
    kept = np.clip(weights[covered], 0.0, 1.0)
    return pixel[covered], face[covered], kept / kept.sum(axis=1, keepdims=True)


def _texel_coordinates(atlas: Atlas) -> tuple[Array, Array]:
    """Columns and rows of the UV vertices; integers are texel centres."""
    u, v = atlas.uv.T
    return u * atlas.width - 0.5, (1.0 - v) * atlas.height - 0.5


def _nearest_texel(
    pixel_number: NDArray[np.int64], shape: tuple[int, int]
) -> NDArray[np.int32]:
    """Texel numbers in texture space, the gutter filled with the nearest."""
    texel = np.full(shape[0] * shape[1], -1, dtype=np.int32)
    texel[pixel_number] = np.arange(len(pixel_number), dtype=np.int32)
    texel = texel.reshape(shape)
    distance, (row, col) = ndimage.distance_transform_edt(texel < 0, return_indices=True)
    return np.where(distance <= GUTTER + 0.5, texel[row, col], -1).astype(np.int32)
