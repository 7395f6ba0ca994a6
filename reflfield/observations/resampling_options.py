"""Options of the resampling onto the nodes of texels' frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reflfield.errors import InputError
from reflfield.observations.texel_samples import POWERS


@dataclass(frozen=True)
class ResamplingOptions:
    """Grids and smoothness of the resampling.

    Parameters
    ----------
    view_side, light_side : int
        Nodes along each side of the two hemisphere grids. 0 chooses from the
        number of views or lights (`side_for`); directions that do not vary get 1.
    domain : {"cube_root", "square_root", "linear"}
        What is applied to samples before they are resampled and factored.
    smoothness : float
        Weight of the squared differences between neighbouring nodes against one sample.
    visibility : {"factored", "kept", "auto"}
        "factored": samples in cast shadow do not count and shadows are traced again when
        rendering. "kept": shadows are part of the data, as in the paper. "auto" makes both
        fields and keeps the shadows if that is clearly better on the held-out photographs.
    """

    view_side: int = 0
    light_side: int = 0
    domain: str = "cube_root"
    smoothness: float = 0.03
    visibility: str = "factored"

    def __post_init__(self) -> None:
        for name in ("view_side", "light_side"):
            if not 0 <= getattr(self, name) <= 64:
                raise InputError(f"{name}: expected 0 to 64, received {getattr(self, name)}")
        if self.domain not in POWERS:
            known = list(POWERS)
            raise InputError(f"domain: expected one of {known}, received {self.domain!r}")
        if not 0 < self.smoothness <= 1e6:
            raise InputError(
                f"smoothness: expected > 0, at most 1e6, received {self.smoothness}"
            )
        if self.visibility not in ("factored", "kept", "auto"):
            raise InputError(
                "visibility: expected 'factored', 'kept' or 'auto', received "
                f"{self.visibility!r}"
            )


def side_for(n_directions: int) -> int:
    """Side of a grid about as dense as `n_directions` on the upper hemisphere.

    Odd, so that the zenith is a node; at least 5, at most 13.

    Examples
    --------
    >>> [side_for(n) for n in (1, 12, 32, 81, 151)]
    [1, 5, 7, 11, 13]
    """
    if n_directions <= 1:
        return 1
    return int(np.clip(int(1.2 * np.sqrt(n_directions)) | 1, 5, 13))
