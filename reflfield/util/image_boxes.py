"""Part of an image that holds what is marked in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def bounding_box(covered: ArrayLike, margin: int = 4) -> tuple[slice, slice]:
    """Rows and columns that hold all True pixels and a margin around them.

    Parameters
    ----------
    covered : (h, w) array_like of bool
    margin : int
        In pixels, cut at the border.

    Returns
    -------
    tuple of two slice
        Everything, if no pixel is True.

    Examples
    --------
    >>> box = bounding_box(np.eye(10, dtype=bool)[:, :4], margin=1)
    >>> (box[0].start, box[0].stop), (box[1].start, box[1].stop)
    ((0, 5), (0, 4))
    """
    inside = np.asarray(covered, dtype=bool)
    if not inside.any():
        return slice(0, inside.shape[0]), slice(0, inside.shape[1])
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    top, left = max(int(rows[0]) - margin, 0), max(int(columns[0]) - margin, 0)
    bottom = min(int(rows[-1]) + 1 + margin, inside.shape[0])
    right = min(int(columns[-1]) + 1 + margin, inside.shape[1])
    return slice(top, bottom), slice(left, right)
