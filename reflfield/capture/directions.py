"""Unit directions from points of a surface to cameras and lights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from reflfield.util.late_import import LateImport

if TYPE_CHECKING:
    from reflfield.capture import point_kernels as kernels
else:
    kernels = LateImport("reflfield.capture.point_kernels")

# Of a point that is where the camera is: its direction comes out as zero.
LEAST_DISTANCE = np.finfo(np.float64).tiny


class Whereabouts(NamedTuple):
    """Where a camera or a light is: at a point, or infinitely far in some direction."""

    place: NDArray[np.float64]  # (3,): position, or unit direction towards it
    is_point: bool


def directions_towards(
    points: NDArray[np.float64], targets: Sequence[Whereabouts], dtype: DTypeLike = np.float64
) -> NDArray[Any]:
    """Unit directions (n, n_targets, 3) from points (n, 3) to cameras or lights.

    Examples
    --------
    >>> above = Whereabouts(np.array([0.0, 0.0, 2.0]), is_point=True)
    >>> aside = Whereabouts(np.array([1.0, 0.0, 0.0]), is_point=False)
    >>> directions_towards(np.zeros((1, 3)), [above, aside])
    array([[[0., 0., 1.],
            [1., 0., 0.]]])
    """
    places = np.array([target.place for target in targets], np.float64).reshape(-1, 3)
    are_points = np.array([target.is_point for target in targets], np.bool_)
    directions = np.zeros((len(points), len(targets), 3), dtype)
    points = np.ascontiguousarray(points)
    kernels.unit_towards(points, places, are_points, LEAST_DISTANCE, directions)
    return directions
