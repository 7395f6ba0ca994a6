"""Rotations. The conventions of this header hold everywhere in the package.

* Rotations are active: ``R @ v`` is the rotated vector in the same frame.
* Quaternions are scalar first, ``(w, x, y, z)``, with ``w >= 0``.
* Euler angles are zyz, ``R = Rz(alpha) @ Ry(beta) @ Rz(gamma)``, radians.
* A local frame is stored as ``local_from_world`` (or ``local_from_base``): its
  rows are tangent, binormal and normal, right-handed, so ``local_from_world @ d``
  is the direction `d` in local coordinates.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.util.late_import import LateImport

transform: Any = LateImport("scipy.spatial.transform")
Array = NDArray[np.float64]


def matrix_from_quaternion(quaternion: ArrayLike) -> Array:
    """Rotation matrices of unit quaternions.

    Parameters
    ----------
    quaternion : (..., 4) array_like
        ``(w, x, y, z)``; normalised here.

    Returns
    -------
    (..., 3, 3) float64

    Examples
    --------
    >>> matrix_from_quaternion([0.0, 0.0, 0.0, 1.0])
    array([[-1.,  0.,  0.],
           [ 0., -1.,  0.],
           [ 0.,  0.,  1.]])
    """
    q = np.asarray(quaternion, dtype=np.float64)
    # Written out, as scipy does it: opening a field need not import scipy.
    w, x, y, z = np.moveaxis(q, -1, 0)
    length = np.sqrt(x * x + y * y + z * z + w * w)
    w, x, y, z = w / length, x / length, y / length, z / length
    entries = (
        *(x * x - y * y - z * z + w * w, 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), -x * x + y * y - z * z + w * w, 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), -x * x - y * y + z * z + w * w),
    )
    return np.stack(entries, axis=-1).reshape(*q.shape[:-1], 3, 3)


def quaternion_from_matrix(matrix: ArrayLike) -> Array:
    """Unit quaternions ``(w, x, y, z)``, ``w >= 0``, of rotation matrices.

    Parameters
    ----------
    matrix : (..., 3, 3) array_like
        Proper rotations.

    Returns
    -------
    (..., 4) float64

    Examples
    --------
    >>> quaternion_from_matrix(np.eye(3))
    array([1., 0., 0., 0.])
    """
    m = np.asarray(matrix, dtype=np.float64)
    flat = transform.Rotation.from_matrix(m.reshape(-1, 3, 3)).as_quat(
        canonical=True, scalar_first=True
    )
    return flat.reshape(*m.shape[:-2], 4)


def rotation_angle(matrix: ArrayLike) -> Array:
    """Angle of rotation of each matrix, radians, accurate near zero.

    Examples
    --------
    >>> float(rotation_angle([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).round(12))
    1.570796326795
    """
    m = np.asarray(matrix, dtype=np.float64)
    flat = transform.Rotation.from_matrix(m.reshape(-1, 3, 3)).magnitude()
    return flat.reshape(m.shape[:-2])


def frames_from_normals(normals: ArrayLike, tangent_hints: ArrayLike) -> Array:
    """Right-handed frames with these normals and tangents near the hints.

    Parameters
    ----------
    normals : (n, 3) array_like
        Unit normals.
    tangent_hints : (n, 3) array_like
        Preferred tangents; a hint along the normal is replaced by the world
        axis that is farthest from it.

    Returns
    -------
    (n, 3, 3) float64
        Rows tangent, binormal, normal.

    Examples
    --------
    >>> frames_from_normals([[0.0, 0.0, 1.0]], [[2.0, 0.0, 1.0]])[0]
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    normal = np.asarray(normals, dtype=np.float64)
    hint = np.asarray(tangent_hints, dtype=np.float64)
    # Times powers of two, exactly, so that squares of hints of any length stay in range.
    hint = np.ldexp(hint, -np.frexp(np.abs(hint).max(axis=1, keepdims=True))[1])
    tangent = hint - np.sum(hint * normal, axis=1, keepdims=True) * normal
    length = np.linalg.norm(tangent, axis=1)
    # Below this share of its length the hint's direction is mostly rounding.
    lost = ~(length > 1e-6 * np.maximum(np.linalg.norm(hint, axis=1), 1e-300))
    if lost.any():
        axis = np.eye(3)[np.argmin(np.abs(normal[lost]), axis=1)]
        along = np.sum(axis * normal[lost], axis=1, keepdims=True)
        tangent[lost] = axis - along * normal[lost]
        length[lost] = np.linalg.norm(tangent[lost], axis=1)
    tangent /= length[:, None]
    return np.stack([tangent, np.cross(normal, tangent), normal], axis=1)
