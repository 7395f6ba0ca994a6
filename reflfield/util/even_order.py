"""Numbers in an order of which every beginning is spread evenly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Steps of this share of a whole leave the most even gaps.
GOLDEN_SHARE = (5**0.5 - 1) / 2


def even_order(n: int) -> NDArray[np.intp]:
    """Order of n numbers of which the first few are spread evenly over all.

    Parameters
    ----------
    n : int

    Returns
    -------
    (n,) int
        A permutation.

    Examples
    --------
    >>> even_order(8)
    array([0, 5, 2, 7, 4, 1, 6, 3])
    """
    return np.argsort(np.arange(n) * GOLDEN_SHARE % 1.0)
