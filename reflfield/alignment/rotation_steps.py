"""Small operations on 3x3 rotations inside compiled kernels.

Loops in place of array expressions: those compile seconds of shape checks and messages.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True, nogil=True)
def copy_matrix(source: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Entries of a 3x3 matrix into another."""
    for i in range(3):
        for k in range(3):
            out[i, k] = source[i, k]


@numba.njit(cache=True, nogil=True)
def copy_vector(source: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Entries of a vector into another's first (a slice takes seconds to compile)."""
    for k in range(len(source)):
        out[k] = source[k]


@numba.njit(cache=True, nogil=True)
def half_turn_about_z(rotation: NDArray[np.float64]) -> None:
    """Rotate the target of a rotation by half a turn about z, in place."""
    for i in range(3):
        rotation[i, 0], rotation[i, 1] = -rotation[i, 0], -rotation[i, 1]


@numba.njit(cache=True, nogil=True)
def scale_vector(vector: NDArray[np.float64], n: int, factor: float) -> None:
    """Multiply the first n entries in place."""
    for i in range(n):
        vector[i] *= factor


@numba.njit(cache=True, nogil=True)
def rotate_right(
    r: NDArray[np.float64], w: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    """``r @ exp(w)`` for a small rotation vector, through its quaternion."""
    angle = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    scale = 0.5 - angle * angle / 48.0 if angle < 1e-3 else np.sin(0.5 * angle) / angle
    q0, q1, q2, q3 = np.cos(0.5 * angle), w[0] * scale, w[1] * scale, w[2] * scale
    xx, xy, xz = 1.0 - 2.0 * (q2 * q2 + q3 * q3), q1 * q2 - q0 * q3, q1 * q3 + q0 * q2
    yx, yy, yz = q1 * q2 + q0 * q3, 1.0 - 2.0 * (q1 * q1 + q3 * q3), q2 * q3 - q0 * q1
    zx, zy, zz = q1 * q3 - q0 * q2, q2 * q3 + q0 * q1, 1.0 - 2.0 * (q1 * q1 + q2 * q2)
    for i in range(3):
        x, y, z = r[i, 0], r[i, 1], r[i, 2]
        out[i, 0] = x * xx + 2.0 * (y * yx + z * zx)
        out[i, 1] = y * yy + 2.0 * (x * xy + z * zy)
        out[i, 2] = z * zz + 2.0 * (x * xz + y * yz)


@numba.njit(cache=True, nogil=True)
def cosine_between(a: NDArray[np.float64], b: NDArray[np.float64], half_turn: bool) -> float:
    """Cosine of the angle between two rotations, or, if larger, with b half turned about z."""
    x, y, z = 0.0, 0.0, 0.0
    for i in range(3):
        x += a[i, 0] * b[i, 0]
        y += a[i, 1] * b[i, 1]
        z += a[i, 2] * b[i, 2]
    nearest = max(x + y + z, z - x - y) if half_turn else x + y + z
    return 0.5 * (nearest - 1.0)


@numba.njit(cache=True, nogil=True)
def copy_nearest(
    source: NDArray[np.float64], half_turn: bool, out: NDArray[np.float64]
) -> None:
    """A rotation, or it half turned about z if that is nearer to `out`, into `out`."""
    x, y = 0.0, 0.0
    for i in range(3):
        x += source[i, 0] * out[i, 0]
        y += source[i, 1] * out[i, 1]
    copy_matrix(source, out)
    if half_turn and x + y < 0.0:
        half_turn_about_z(out)
