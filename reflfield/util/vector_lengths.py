"""Lengths of vectors that stand in rows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def lengths(vectors: NDArray[np.floating]) -> NDArray[Any]:
    """Lengths (n,) of vectors (n, d), for small d several times as fast as NumPy's norm.

    Examples
    --------
    >>> lengths(np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 2.0]]))
    array([5., 2.])
    """
    return np.asarray(np.sqrt(np.einsum("nd,nd->n", vectors, vectors)))
