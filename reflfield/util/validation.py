"""Checks on arrays that enter public functions: expected, received, remedy."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.errors import InputError, ShapeError

# A direction read from a text file with six digits is unit to about 1e-6;
# anything farther off is another quantity, not rounding.
UNIT_TOLERANCE = 1e-4


def check_ranges(options: object, ranges: Mapping[str, tuple[float, float]]) -> None:
    """Demand numbers between a least and a most, both included, of some attributes.

    Raises
    ------
    InputError
        Names the first one outside.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> check_ranges(SimpleNamespace(blur=0.7), {"blur": (0, 100)})
    """
    for name, (least, most) in ranges.items():
        if not least <= getattr(options, name) <= most:
            raise InputError(
                f"{name}: expected {least} to {most}, received {getattr(options, name)}"
            )


def check_shape(
    name: str, array: NDArray[np.generic], expected: tuple[int | None, ...]
) -> None:
    """Demand a shape; None stands for any length.

    Parameters
    ----------
    name : str
        Argument name, quoted in the message.
    array : ndarray
        Array to look at.
    expected : tuple of int or None
        Length demanded of each axis.

    Raises
    ------
    ShapeError
        If the number of axes or a length differs.

    Examples
    --------
    >>> check_shape("lights", np.zeros((4, 3)), (None, 3))
    """
    fits = array.ndim == len(expected) and all(
        n is None or n == length for n, length in zip(expected, array.shape, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in expected) + ")"
        raise ShapeError(f"{name}: expected shape {wanted}, received {array.shape}")


def unit_directions(name: str, directions: ArrayLike) -> NDArray[np.float64]:
    """Directions as float64 of exactly unit length.

    Parameters
    ----------
    name : str
        Argument name, quoted in the message.
    directions : (n, 3) array_like
        Vectors whose length differs from 1 by at most `UNIT_TOLERANCE`.

    Returns
    -------
    (n, 3) float64
        The directions, normalised to rounding.

    Raises
    ------
    ShapeError
        If the shape is not (n, 3).
    InputError
        If a vector is not finite or not of unit length.

    Examples
    --------
    >>> unit_directions("views", [[0, 0, 1.00001]])
    array([[0., 0., 1.]])
    """
    vectors = np.asarray(directions, dtype=np.float64)
    check_shape(name, vectors, (None, 3))
    lengths = np.linalg.norm(vectors, axis=1)
    off = ~(np.abs(lengths - 1.0) <= UNIT_TOLERANCE)
    if off.any():
        row = int(np.flatnonzero(off)[0])
        raise InputError(
            f"{name}: expected unit vectors, received length {lengths[row]:.6g} in row {row}; "
            "divide each row by its length"
        )
    return vectors / lengths[:, None]


def unit_direction(name: str, vector: ArrayLike) -> NDArray[np.float64]:
    """Unit vector of a direction of any length.

    Parameters
    ----------
    name : str
        Argument name, quoted in the message.
    vector : (3,) array_like

    Returns
    -------
    (3,) float64

    Raises
    ------
    InputError
        If it is not three finite numbers, or zero.

    Examples
    --------
    >>> unit_direction("up", [0, 2, 0])
    array([0., 1., 0.])
    """
    array = np.asarray(vector, np.float64)
    if array.shape != (3,) or not np.isfinite(array).all() or not array.any():
        raise InputError(
            f"{name}: expected three finite numbers, not all zero, received {array.tolist()}"
        )
    # By the largest first: the squares of very large or small numbers leave the range.
    array = array / np.abs(array).max()
    return np.asarray(array / np.linalg.norm(array))


# Rotations in files are rounded to a few digits.
ROTATION_TOLERANCE = 1e-3


def not_a_rotation_because(matrix: NDArray[np.float64]) -> str:
    """What keeps a matrix from being a rotation of space; empty if nothing does.

    Examples
    --------
    >>> not_a_rotation_because(np.eye(3)), not_a_rotation_because(np.diag([1.0, 1.0, -1.0]))
    ('', 'a mirror image (determinant -1)')
    """
    if matrix.shape != (3, 3):
        return f"an array of shape {matrix.shape}"
    if not np.isfinite(matrix).all():
        return "numbers that are not finite"
    if np.abs(matrix).max() > 2 or not np.allclose(
        matrix @ matrix.T, np.eye(3), rtol=0, atol=ROTATION_TOLERANCE
    ):
        return "scale or shear"
    if np.linalg.det(matrix) < 0:
        return "a mirror image (determinant -1)"
    return ""
