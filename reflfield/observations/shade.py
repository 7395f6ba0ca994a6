"""What texels show where no light reaches them directly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Shade:
    """What some texels show where no light reaches them directly.

    Parameters
    ----------
    values : (n, n_lights, 3) float32
        Mean over the views of transformed samples.
    weights : (n, n_lights, 3) float32
        Views that measured it; 0 where the light reaches the texel.
    lights : (n, n_lights, 3) float32
        Unit vectors, world frame.
    """

    values: Floats
    weights: Floats
    lights: Floats
