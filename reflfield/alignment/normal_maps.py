"""Recovered frames as texture-space maps of normals and tangents."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.util.validation import check_shape


def local_map(
    local_from_base: NDArray[np.floating],
    texel_of_pixel: NDArray[np.integer],
    axis: str = "normal",
) -> NDArray[np.float32]:
    """One axis of the recovered frames in the texels' base frames.

    This is what a tangent-space normal map holds, as signed unit vectors.

    Parameters
    ----------
    local_from_base : (n_texels, 3, 3) float
        Rows tangent, binormal, normal.
    texel_of_pixel : (h, w) int
        Texel of each pixel of the map, -1 where there is none.
    axis : {"normal", "tangent", "binormal"}
        Which row to show.

    Returns
    -------
    (h, w, 3) float32
        Zero where there is no texel.

    Raises
    ------
    ShapeError
        If an array has the wrong shape.
    InputError
        If the axis is unknown or a texel index is out of range.

    Examples
    --------
    >>> local_map(np.eye(3)[None], np.array([[0, -1]]))
    array([[[0., 0., 1.],
            [0., 0., 0.]]], dtype=float32)
    """
    check_shape("local_from_base", local_from_base, (None, 3, 3))
    check_shape("texel_of_pixel", texel_of_pixel, (None, None))
    rows = {"tangent": 0, "binormal": 1, "normal": 2}
    if axis not in rows:
        raise InputError(f"axis: expected one of {sorted(rows)}, received {axis!r}")
    if texel_of_pixel.size and not -1 <= texel_of_pixel.min() <= texel_of_pixel.max() < len(
        local_from_base
    ):
        raise InputError(
            f"texel_of_pixel: expected indices from -1 to {len(local_from_base) - 1}, received "
            f"{texel_of_pixel.min()} to {texel_of_pixel.max()}"
        )
    with_none = np.zeros((len(local_from_base) + 1, 3), np.float32)
    with_none[:-1] = local_from_base[:, rows[axis]]
    return with_none[texel_of_pixel]


def world_map(
    local_from_base: NDArray[np.floating],
    base_from_world: NDArray[np.floating],
    texel_of_pixel: NDArray[np.integer],
    axis: str = "normal",
) -> NDArray[np.float32]:
    """One axis of the recovered frames in world coordinates.

    Parameters
    ----------
    local_from_base : (n_texels, 3, 3) float
        Rows tangent, binormal, normal, in the base frames.
    base_from_world : (n_texels, 3, 3) float
        Base frames, rows tangent, binormal, normal, in the world.
    texel_of_pixel, axis
        See `local_map`.

    Returns
    -------
    (h, w, 3) float32
        Zero where there is no texel.

    Raises
    ------
    ShapeError, InputError
        As `local_map`.

    Examples
    --------
    >>> base = np.array([[[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]])
    >>> world_map(np.eye(3)[None], base, np.array([[0]]))
    array([[[1., 0., 0.]]], dtype=float32)
    """
    check_shape("local_from_base", local_from_base, (None, 3, 3))
    check_shape("base_from_world", base_from_world, (len(local_from_base), 3, 3))
    return local_map(local_from_base @ base_from_world, texel_of_pixel, axis)
