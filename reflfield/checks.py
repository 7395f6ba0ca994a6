"""Checks on arrays that enter public functions: expected, received, remedy."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.errors import InputError, ShapeError

# A direction read from a text file with six digits is unit to about 1e-6;
# anything farther off is another quantity, not rounding.
UNIT_TOLERANCE = 1e-4


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
        want is None or want == got for want, got in zip(expected, array.shape, strict=True)
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
