"""Flat things: planes and relief plates."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from capture_sim.errors import scene_error
from capture_sim.materials.textures import encoded_values, read_image
from capture_sim.objects.mesh import (
    Array,
    SurfaceMesh,
    check_size,
    fan,
    grid_faces,
    joined,
    unit,
)
from capture_sim.tables import TableReader

HeightField = Callable[[Array], Array]


def plane(reader: TableReader, folder: Path) -> SurfaceMesh:
    """Rectangle in the xy plane, seen from above."""
    size = _plate_size(reader, (0.2, 0.2))
    flat = _height_field_mesh(size, (2, 2), lambda uv: np.zeros(len(uv)), "plane")
    return SurfaceMesh(
        flat.vertices, flat.faces, flat.uv, flat.normals, flat.tangents, True, name="plane"
    )


def relief(reader: TableReader, folder: Path) -> SurfaceMesh:
    """Plate on the xy plane with a relief on top."""
    size = _plate_size(reader, (0.16, 0.16))
    depth = reader.number("height", 0.006, low=0.0, high=1e3)
    thickness = reader.number("thickness", 0.01, low=0.0, high=1e3)
    facets = reader.count("facets", 256, low=2, high=2048)
    check_size("a relief", 2 * facets**2)
    pattern = reader.choice("pattern", "logo", [*_RELIEFS, "image"])
    shape = _image_relief(reader, folder) if pattern == "image" else _RELIEFS[pattern]
    counts = (facets + 1, facets + 1)
    top = _height_field_mesh(size, counts, lambda uv: thickness + depth * shape(uv), "relief")
    return top if thickness == 0.0 else joined([top, *_box(top)], "relief")


def _plate_size(reader: TableReader, default: tuple[float, float]) -> Array:
    size = reader.vector("size", default, length=2)
    if not ((size >= 1e-6) & (size <= 1e3)).all():
        raise scene_error(
            reader.name("size"), "two lengths in [1e-06, 1000]", size.tolist(), "metres"
        )
    return size


def _height_field_mesh(
    size: Array, counts: tuple[int, int], height: HeightField, name: str
) -> SurfaceMesh:
    """Rectangle in the xy plane about the origin, lifted by ``height(uv)``."""
    v, u = np.meshgrid(
        np.linspace(0, 1, counts[0]), np.linspace(0, 1, counts[1]), indexing="ij"
    )
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    vertices = np.column_stack([(uv - 0.5) * size, height(uv)])
    step = 0.25 / max(counts)
    slope = np.stack(
        [
            (height(np.clip(uv + e, 0, 1)) - height(np.clip(uv - e, 0, 1)))
            / ((np.clip(uv + e, 0, 1) - np.clip(uv - e, 0, 1)).sum(axis=1) * length)
            for e, length in zip(step * np.eye(2), size, strict=True)
        ],
        axis=1,
    )
    ones, zeros = np.ones(len(uv)), np.zeros(len(uv))
    return SurfaceMesh(
        vertices=vertices,
        faces=grid_faces(*counts),
        uv=uv,
        normals=unit(np.column_stack([-slope, ones])),
        tangents=unit(np.column_stack([ones, zeros, slope[:, 0]])),
        name=name,
    )


def _box(top: SurfaceMesh) -> list[SurfaceMesh]:
    """Four walls from the border of the top down to z = 0, and the bottom."""
    side = round(len(top.vertices) ** 0.5)
    index = np.arange(side * side).reshape(side, side)
    walls = [
        (index[0], [0.0, -1.0, 0.0]),
        (index[:, -1], [1.0, 0.0, 0.0]),
        (index[-1, ::-1], [0.0, 1.0, 0.0]),
        (index[::-1, 0], [-1.0, 0.0, 0.0]),
    ]
    parts = [_wall(top, border, np.array(normal)) for border, normal in walls]
    loop = np.concatenate([border[:-1] for border, _ in walls])
    rim = top.vertices[loop] * [1.0, 1.0, 0.0]
    bottom = fan(rim, np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]), top.uv[loop])
    return [*parts, bottom]


def _wall(top: SurfaceMesh, border: NDArray[np.intp], normal: Array) -> SurfaceMesh:
    upper = top.vertices[border]
    n = len(border)
    tangent = unit(upper[-1] * [1.0, 1.0, 0.0] - upper[0] * [1.0, 1.0, 0.0])
    return SurfaceMesh(
        vertices=np.concatenate([upper * [1.0, 1.0, 0.0], upper]),
        faces=grid_faces(2, n),
        uv=np.tile(top.uv[border], (2, 1)),
        normals=np.tile(normal, (2 * n, 1)),
        tangents=np.tile(tangent, (2 * n, 1)),
    )


def _bevel(distance: Array, width: float = 0.02) -> Array:
    """1 inside (negative distance), 0 outside, smooth over `width`."""
    t = np.clip(0.5 - distance / width, 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def logo_relief(uv: Array) -> Array:
    """Emblem: a ring around an eight-pointed star with a raised boss.

    Examples
    --------
    >>> logo_relief(np.array([[0.5, 0.5], [0.02, 0.02]])).round(2)
    array([1., 0.])
    """
    x, y = (uv - 0.5).T
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    ring = _bevel(np.abs(radius - 0.40) - 0.035)
    star = _bevel(radius - (0.23 + 0.07 * np.cos(8.0 * angle)))
    boss = np.sqrt(np.maximum(1.0 - (radius / 0.12) ** 2, 0.0))
    rays = _bevel(np.abs(np.mod(angle / np.pi * 12, 1.0) - 0.5) - 0.2, 0.3)
    rays *= _bevel(np.abs(radius - 0.40) - 0.02)
    return np.maximum.reduce([0.55 * ring + 0.25 * rays, 0.6 * star, 0.6 * star + 0.4 * boss])


def wave_relief(uv: Array) -> Array:
    """Crossed cosine waves in [0, 1].

    Examples
    --------
    >>> wave_relief(np.array([[0.0, 0.0], [0.125, 0.125]])).round(2)
    array([1., 0.])
    """
    x, y = np.cos(2.0 * np.pi * 4.0 * uv).T
    return np.asarray(0.5 + 0.25 * (x + y))


def bump_relief(uv: Array) -> Array:
    """Round bumps on a grid of 5 x 5, in [0, 1].

    Examples
    --------
    >>> bump_relief(np.array([[0.5, 0.5], [0.6, 0.6]])).round(2)
    array([1., 0.])
    """
    cell = np.mod(5.0 * uv, 1.0) - 0.5
    distance2 = np.sum((cell / 0.42) ** 2, axis=1)
    return np.asarray(np.maximum(1.0 - distance2, 0.0) ** 1.5)


_RELIEFS: dict[str, HeightField] = {
    "logo": logo_relief,
    "waves": wave_relief,
    "bumps": bump_relief,
}


def _image_relief(reader: TableReader, folder: Path) -> HeightField:
    """Height field from the brightness of an image, v up."""
    stored = read_image(reader.file("file", folder))
    table = encoded_values(stored.dtype)
    # Row by row: three channels as float64 would take 24 times the memory of the image.
    pixels = np.stack([table[row].mean(axis=1) for row in stored])
    height, width = pixels.shape

    def relief(uv: Array) -> Array:
        x = np.clip(uv[:, 0] * width - 0.5, 0.0, width - 1.0)
        y = np.clip((1.0 - uv[:, 1]) * height - 0.5, 0.0, height - 1.0)
        left, top = x.astype(np.int64), y.astype(np.int64)
        right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
        fx, fy = x - left, y - top
        upper = pixels[top, left] * (1 - fx) + pixels[top, right] * fx
        lower = pixels[bottom, left] * (1 - fx) + pixels[bottom, right] * fx
        return np.asarray(upper * (1 - fy) + lower * fy)

    return relief
