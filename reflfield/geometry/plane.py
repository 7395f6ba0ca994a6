"""Flat base geometry for captures with one fixed camera: the image laid on a plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.errors import GeometryError
from reflfield.geometry.uv_atlas import Atlas
from reflfield.util.image_boxes import bounding_box

Array = NDArray[np.float64]

# Cells along each side under a perspective camera, whose pixels are not evenly spaced on
# the plane: in between, texture coordinates are interpolated.
_PERSPECTIVE_CELLS = 64


def image_plane(camera: Camera, silhouette: NDArray[np.floating] | None = None) -> Atlas:
    """Rectangle of the world plane z = 0 that the camera's image shows.

    The texture is the image: u runs along its columns, v up its rows, and a texel is a
    pixel. With a silhouette, both are cropped to its bounding box.

    Parameters
    ----------
    camera : Camera
        Looks at the plane; orthographic cameras give exact texels, perspective ones
        texels interpolated over a grid of 64 x 64 cells.
    silhouette : (height, width) float, optional
        Coverage of the object.

    Returns
    -------
    Atlas
        One chart, facing the camera, `height` x `width` texels.

    Raises
    ------
    GeometryError
        If the silhouette covers nothing or the camera does not see the plane everywhere
        in the rectangle.

    Examples
    --------
    One pixel per metre, looking down:

    >>> pose = np.diag([1.0, -1.0, -1.0, 1.0])
    >>> camera = Camera("v", "orthographic", 3, 2, 1.0, 1.0, 1.5, 1.0, pose)
    >>> image_plane(camera).positions[:, :2].tolist()
    [[-1.5, 1.0], [1.5, 1.0], [-1.5, -1.0], [1.5, -1.0]]
    """
    left, top, right, bottom = _rectangle(camera, silhouette)
    cells = 1 if camera.kind == "orthographic" else _PERSPECTIVE_CELLS
    row, col = np.mgrid[: cells + 1, : cells + 1].reshape(2, -1)
    across = np.stack([col, row], axis=1) / cells
    pixels = np.array([left, top]) + across * np.array([right - left, bottom - top])
    up = 1.0 if _faces_up(camera) else -1.0
    return Atlas(
        positions=on_plane(camera, pixels),
        faces=_grid_faces(cells),
        uv=np.stack([across[:, 0], 1.0 - across[:, 1]], axis=1),
        chart=np.zeros(2 * cells * cells, dtype=np.int32),
        normals=np.tile([0.0, 0.0, up], (len(pixels), 1)),
        height=bottom - top,
        width=right - left,
    )


def _rectangle(
    camera: Camera, silhouette: NDArray[np.floating] | None
) -> tuple[int, int, int, int]:
    """First column and row, and those behind the last ones."""
    if silhouette is None:
        return 0, 0, camera.width, camera.height
    covered = np.asarray(silhouette) >= 0.5
    if not covered.any():
        raise GeometryError(
            f"silhouette of view {camera.id!r}: expected the object, received no pixel covered"
        )
    rows, cols = bounding_box(covered, margin=0)
    return cols.start, rows.start, cols.stop, rows.stop


def _faces_up(camera: Camera) -> bool:
    """True if the camera sees the side of the plane that faces +Z."""
    if camera.kind == "orthographic":
        return bool(camera.forward[2] < 0.0)
    return bool(camera.centre[2] > 0.0)


def on_plane(camera: Camera, pixels: Array) -> Array:
    """Where the rays of pixels meet z = 0, (n, 3)."""
    origins, directions = camera.rays(pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -origins[:, 2] / directions[:, 2]
    seen = np.isfinite(distance)
    if camera.kind != "orthographic":
        seen &= distance > 0.0
    if not seen.all():
        raise GeometryError(
            f"camera {camera.id!r}: expected to see the world plane z = 0 in the whole image, "
            "received rays that miss it; turn the world so that the sample lies in z = 0"
        )
    points = origins + distance[:, None] * directions
    points[:, 2] = 0.0
    return points


def _grid_faces(cells: int) -> NDArray[np.int32]:
    """Two triangles per cell of a grid stored row by row, counter-clockwise in the image."""
    row, col = np.mgrid[:cells, :cells].reshape(2, -1)
    top_left = row * (cells + 1) + col
    bottom_left = top_left + cells + 1
    lower = np.stack([top_left, bottom_left, bottom_left + 1], axis=1)
    upper = np.stack([top_left, bottom_left + 1, top_left + 1], axis=1)
    return np.concatenate([lower, upper]).astype(np.int32)
