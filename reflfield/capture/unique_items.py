"""Cameras and lights that several photographs share, told by their numbers."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.lights import Light

Item = TypeVar("Item", Camera, Light)

# Photographs of one camera or light repeat its numbers; beyond this many digits they may
# differ by the rounding of whatever wrote them.
SAME_DIGITS = 9


@dataclass
class UniqueItems:
    """Items in order of first appearance, found again by the numbers that define them."""

    index: dict[Hashable, int] = field(default_factory=dict)
    items: list[Any] = field(default_factory=list)

    def add(self, key: Hashable, item: Item) -> int:
        """Index of the item with this key."""
        if key not in self.index:
            self.index[key] = len(self.items)
            self.items.append(item)
        return self.index[key]


def leading_digits(numbers: NDArray[np.float64]) -> tuple[float | str, ...]:
    """Equal for numbers that agree in `SAME_DIGITS` digits of the largest of them.

    Examples
    --------
    >>> leading_digits(np.array([1e-12, 3.0])) == leading_digits(np.array([0.0, 3.0]))
    True
    >>> leading_digits(np.array([1e-12])) == leading_digits(np.array([2e-12]))
    False
    """
    largest = float(np.abs(numbers).max(initial=0.0)) or 1.0
    rounded = np.round(numbers.ravel() / largest, SAME_DIGITS) + 0.0  # no negative zeros
    return (f"{largest:.{SAME_DIGITS - 1}e}", *rounded.tolist())


def camera_key(camera: Camera) -> Hashable:
    """Equal for cameras that differ by the rounding of whatever wrote them."""
    inner = np.array([camera.fl_x, camera.fl_y, camera.cx, camera.cy, camera.skew])
    pose = camera.camera_from_world
    return (
        camera.kind,
        camera.width,
        camera.height,
        *leading_digits(inner),
        *camera.distortion,
        *leading_digits(pose[:3, :3]),
        *leading_digits(pose[:3, 3]),
    )


def numbered(items: Sequence[Item], letter: str) -> tuple[Item, ...]:
    """Items with ids of a letter and their number, such as v000."""
    digits = max(3, len(str(len(items) - 1)))
    return tuple(replace(item, id=f"{letter}{i:0{digits}d}") for i, item in enumerate(items))
