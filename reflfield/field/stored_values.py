"""What the stored arrays of a field may hold: indices inside, steps and scales above zero.

A checksum says that bytes are those that were written, not that a field wrote them. Values
that would turn into infinities, NaN or accesses outside of arrays are refused where a file is
read.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError, ShapeError
from reflfield.field.array_schemas import Schema, check_indices
from reflfield.field.quantisation import SMALLEST_TURN, check_finite

# Largest magnitude of a step, scale or function: times any code it stays finite as a single.
LARGEST_VALUE = 1e25
# Lengths of axes that are zero in a field of nothing; all others are at least one.
MAY_BE_ZERO = ("n_components", "n_indirect_components")
# No array of a field is longer; keeps products of lengths short.
LONGEST_AXIS = 1 << 60
# Copies while an array is unpacked; memory of a texel and a vertex decoded; copies of the table
# of functions while it is made, measured.
COPIES_UNPACKED, COPIES_OF_TABLE = 4, 2.2
BYTES_PER_TEXEL, BYTES_PER_VERTEX = 200, 64

_ABOVE_ZERO = (
    "turn_step", "function_scale", "function_gain", "view_scale", "light_scale", "core_scale",
    "indirect_scale", "diffuse_scale", "lobe_weight_scale", "lobe_scale",
)  # fmt: skip
_BOXES = ("position_box", "uv_box")


def check_lengths(lengths: Mapping[str, int], schema: Schema) -> None:
    """Demand a surface, texels, a texture and functions of at least one term.

    Parameters
    ----------
    lengths : mapping of str to int
        Of all named axes, from `reflectance_field.check_arrays`.
    schema : dict
        Arrays of the field's model.

    Raises
    ------
    ShapeError
        Names the axis and the arrays that have it.
    """
    for axis, length in lengths.items():
        if length < 1 and axis not in MAY_BE_ZERO:
            having = ", ".join(name for name, (_, axes) in schema.items() if axis in axes)
            raise ShapeError(f"{having}: expected {axis} of at least 1, received {length}")


def memory_needed(shapes: Mapping[str, tuple[int, ...]], n_bytes: Mapping[str, int]) -> float:
    """Memory that a field takes at most while it is read and decoded, bytes, by estimate.

    Parameters
    ----------
    shapes : mapping of str to tuple of int
        Of all stored arrays.
    n_bytes : mapping of str to int
        Their sizes in memory.

    Returns
    -------
    float
    """
    texel = BYTES_PER_TEXEL
    if "cluster" in shapes:
        texel += 8 * shapes["coefficients"][1]
        table = _table_bytes(shapes)
    else:
        texel += 8 * shapes["lobe_weights"][1]
        table = 4.0 * prod(shapes["lobes"])
    decoded = texel * shapes["turns"][0] + BYTES_PER_VERTEX * shapes["positions"][0]
    packed = COPIES_UNPACKED * max(n_bytes.values())
    return sum(n_bytes.values()) + decoded + max(packed, COPIES_OF_TABLE * table)


def _table_bytes(shapes: Mapping[str, tuple[int, ...]]) -> float:
    """Size of the largest array on the way to a clustered field's table of functions."""
    nodes = prod(shapes[f"{which}_factor"][0] for which in ("view", "light"))
    # Along one axis after the other.
    ranks = [shapes[f"{which}_factor"][-1] for which in ("function", "view")]
    half = max(ranks[0] * nodes, prod(ranks) * shapes["light_factor"][0])
    return 12.0 * max(prod(shapes["function_gain"]) * nodes, half)


def check_stored(name: str, array: NDArray[Any], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Demand values that a field can have in one of its stored arrays.

    Parameters
    ----------
    name : str
        Of the field's schema.
    array : ndarray
    shapes : mapping of str to tuple of int
        Of all stored arrays.

    Raises
    ------
    InputError
        Names the array.
    """
    ends = {
        "faces": (0, shapes["positions"][0]),
        "texel_of_pixel": (-1, shapes["turns"][0]),
        "cluster": (0, shapes.get("coefficient_scale", (0,))[0]),
    }
    if name in ends:
        check_indices(name, array, *ends[name])
    if array.dtype.kind == "f":
        _check_numbers(name, array)


def _check_numbers(name: str, array: NDArray[Any]) -> None:
    check_finite(name, array)
    largest = float(np.abs(array).max(initial=0.0))
    if largest > LARGEST_VALUE:
        raise InputError(f"{name}: expected at most {LARGEST_VALUE:g}, received {largest:g}")
    steps = array[-1:] if name in _BOXES else array
    if name in (*_ABOVE_ZERO, *_BOXES) and not (steps > 0).all():
        raise InputError(f"{name}: expected steps above zero, received {float(steps.min()):g}")
    if name in ("coefficient_scale", "diffuse_table") and (array < 0).any():
        raise InputError(f"{name}: expected no negative value, received {float(array.min()):g}")
    # As a single it may have been rounded down.
    if name == "turn_step" and not 0.999 * SMALLEST_TURN <= float(array[0]) <= 1.0:
        raise InputError(
            f"{name}: expected {SMALLEST_TURN} to 1 radian, received {float(array[0]):g}"
        )
