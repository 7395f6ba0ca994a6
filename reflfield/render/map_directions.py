"""Directions of an environment map's pixels, and the rotation of a map into a world.

A map is a latitude-longitude image, row 0 at the zenith. Pixels are areas: the
centre of pixel (row, column) has ``u = (column + 1/2) / width`` and
``v = (row + 1/2) / height``, polar angle ``theta = pi v``. Conventions differ in
what the azimuth means, and in which axis is up:

==========  ====  ===========================================================
convention  up    direction
==========  ====  ===========================================================
openexr     +Y    (sin(2 pi u) sin(theta), cos(theta), -cos(2 pi u) sin(theta))
mitsuba     +Y    the same
blender     +Z    (cos(a) sin(theta), sin(a) sin(theta), cos(theta)), a = pi - 2 pi u
==========  ====  ===========================================================

So the centre of the image is +Z for the first two and +X for Blender; a quarter of the
image to the left of it lie +X and +Y.

The OpenEXR library puts the *centres* of the corner pixels on the poles and the
seam, Mitsuba 3.9 those of the first and last rows on the poles; maps in
circulation do not, and neither does this module. The difference is half a pixel.

A map whose frame in the world is not stated takes the shortest rotation that brings
its up axis to the world's (`world_from_map`):

==========  ============  =======================================
convention  world's up    the centre of the image is seen towards
==========  ============  =======================================
openexr     +Y            +Z (the map's frame is the world's)
openexr     +Z            -Y
blender     +Z            +X (the map's frame is the world's)
blender     +Y            +X
==========  ============  =======================================

A quarter of the image to the left of the centre lies what a viewer who faces the centre, the
world's up above, has to the left.

References
----------
.. [1] OpenEXR, ImfEnvmap.h: longitude pi/2 is +X, 0 is +Z.
.. [2] Mitsuba 3, src/emitters/envmap.cpp.
.. [3] Blender, intern/cycles/kernel/camera/projection.h:
       u = (atan2(y, x) - pi) / (-2 pi).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.errors import InputError
from reflfield.util.late_import import LateImport
from reflfield.util.validation import unit_direction

transform: Any = LateImport("scipy.spatial.transform")

Array = NDArray[np.float64]

# Axis that the zenith row of a map shows, in the map's own frame.
MAP_UP = {"openexr": (0.0, 1.0, 0.0), "mitsuba": (0.0, 1.0, 0.0), "blender": (0.0, 0.0, 1.0)}


def direction_from_uv(u: ArrayLike, v: ArrayLike, convention: str) -> Array:
    """Directions of image coordinates, in the frame of the map.

    Parameters
    ----------
    u, v : (...) array_like
        Image coordinates in [0, 1], v down.
    convention : {"openexr", "mitsuba", "blender"}
        See the module.

    Returns
    -------
    (..., 3) float64
        Unit vectors.

    Examples
    --------
    >>> direction_from_uv(0.25, 0.5, "openexr").round(12) + 0.0
    array([1., 0., 0.])
    >>> direction_from_uv(0.25, 0.5, "blender").round(12) + 0.0
    array([0., 1., 0.])
    """
    theta, turn = np.pi * np.asarray(v, np.float64), 2 * np.pi * np.asarray(u, np.float64)
    ring, height = np.sin(theta), np.cos(theta)
    if convention == "blender":
        azimuth = np.pi - turn
        return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), height], axis=-1)
    return np.stack([ring * np.sin(turn), height, -ring * np.cos(turn)], axis=-1)


def world_from_map(convention: str, up: ArrayLike, rotation_deg: float = 0.0) -> Array:
    """Rotation of a map's zenith to a direction of the world.

    Parameters
    ----------
    convention : {"openexr", "mitsuba", "blender"}
        Says which axis of the map is up.
    up : (3,) array_like
        World direction that the map's zenith is rotated to, by the shortest rotation; where
        the two are opposite, by 180 degrees about X.
    rotation_deg : float
        Angle by which the map is then rotated about `up`, degrees, counter-clockwise seen
        from above.

    Returns
    -------
    (3, 3) float64

    Raises
    ------
    InputError
        If `up` is no direction or the angle not finite.

    Examples
    --------
    A map with +Y up in a world with +Z up: its centre, +Z, is seen towards -Y.

    >>> (world_from_map("openexr", [0, 0, 1]) @ [0, 0, 1]).round(12) + 0.0
    array([ 0., -1.,  0.])
    >>> (world_from_map("openexr", [0, 0, 1], 90) @ [0, 0, 1]).round(12) + 0.0
    array([1., 0., 0.])
    """
    axis = unit_direction("up", up)
    if not np.isfinite(rotation_deg):
        raise InputError(
            f"rotation of the map: expected a finite number of degrees, received {rotation_deg}"
        )
    about_up = transform.Rotation.from_rotvec(np.radians(float(rotation_deg) % 360.0) * axis)
    upright = _shortest_rotation(np.array(MAP_UP[convention]), axis)
    return np.asarray((about_up * upright).as_matrix())


def _shortest_rotation(first: Array, second: Array) -> Any:
    """Rotation of least angle that takes one unit vector to another."""
    axis, cosine = np.cross(first, second), float(first @ second)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:  # parallel; opposite vectors leave the axis open
        return transform.Rotation.from_rotvec([0.0 if cosine > 0 else np.pi, 0.0, 0.0])
    return transform.Rotation.from_rotvec(np.arctan2(sine, cosine) / sine * axis)
