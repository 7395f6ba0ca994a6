"""Silhouettes made from photographs where none are given."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray


def silhouette_from_photographs(
    photographs: Iterable[NDArray[np.float32]], *, name: str = "view"
) -> NDArray[np.float32]:
    """Coverage (h, w) in [0, 1] of the object in one view's photographs (h, w, 3)."""
    raise NotImplementedError(name)
