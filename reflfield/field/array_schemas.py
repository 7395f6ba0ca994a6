"""Stored arrays of fields: names, dtypes and axes of each model, and their checks."""

from __future__ import annotations

from collections.abc import Mapping
from math import isqrt
from typing import Any

from numpy.typing import NDArray

from reflfield.errors import InputError, ShapeError
from reflfield.field.half_vector import DIFFUSE_NODES, LOBE_NODES, SKEW_NODES

_CODES = ("int8", "int16", "int32")

# Stored arrays in file order: the dtypes allowed and the axes, by name. An axis
# that appears in several arrays must have one length; a number is a fixed one.
Schema = dict[str, tuple[tuple[str, ...], tuple[str | int, ...]]]

SURFACE_ARRAYS: Schema = {
    "positions": (("uint16",), ("n_vertices", 3)),
    # Files of earlier versions hold float32, which far from the origin is too coarse.
    "position_box": (("float32", "float64"), (4,)),
    "faces": (("int32",), ("n_faces", 3)),
    "uv": (("uint16",), ("n_vertices", 2)),
    "uv_box": (("float32",), (3,)),
    "texel_of_pixel": (("int32",), ("height", "width")),
    "turns": (("int16",), ("n_texels", 3)),
    "turn_step": (("float32",), (1,)),
}
INDIRECT_ARRAYS: Schema = {
    "indirect_functions": (("float32",), ("n_indirect_functions", "n_harmonics", 3)),
    "indirect_coefficients": (_CODES, ("n_texels", "n_indirect_components")),
    "indirect_scale": (("float32",), (1,)),
    # Not in files before version 6, whose fields trace no bounced light.
    "bounce_gain": (("float32",), (3,)),
}
# Of a field of clusters with mean and basis on the nodes of two grids.
ARRAYS: Schema = {
    **SURFACE_ARRAYS,
    "cluster": (("uint8", "uint16"), ("n_texels",)),
    "coefficients": (_CODES, ("n_texels", "n_components")),
    "coefficient_scale": (("float32",), ("n_clusters", "n_components")),
    "function_factor": (_CODES, ("n_clusters", "n_functions", "function_rank")),
    "function_scale": (("float32",), ("function_rank",)),
    "function_gain": (("float32",), ("n_clusters", "n_functions")),
    "view_factor": (_CODES, ("n_view_nodes", "view_rank")),
    "view_scale": (("float32",), ("view_rank",)),
    "light_factor": (_CODES, ("n_light_nodes", "light_rank")),
    "light_scale": (("float32",), ("light_rank",)),
    "colour_factor": (("float32",), (3, 3)),
    "core": (_CODES, ("function_rank", "view_rank", "light_rank", 3)),
    "core_scale": (("float32",), (1,)),
    **INDIRECT_ARRAYS,
}
# Of a field of functions of the half vector: cube roots over steps. Colours are green, red
# less green and blue less green.
HALF_VECTOR_ARRAYS: Schema = {
    **SURFACE_ARRAYS,
    "diffuse": (_CODES, ("n_texels", 3)),
    "diffuse_scale": (("float32",), (1,)),
    "lobe_weights": (_CODES, ("n_texels", "n_lobes")),
    "lobe_weight_scale": (("float32",), ("n_lobes",)),
    "lobes": (_CODES, (LOBE_NODES, "n_lobes", 3)),
    "lobe_scale": (("float32",), ("n_lobes",)),
    # Not in files of version 4, whose lobes have none.
    "lobe_skews": (("int8",), ("n_lobes", SKEW_NODES, 3)),
    "diffuse_table": (("float32",), (DIFFUSE_NODES,)),
    **INDIRECT_ARRAYS,
}
SCHEMAS: dict[str, Schema] = {"clustered": ARRAYS, "half_vector": HALF_VECTOR_ARRAYS}


def check_arrays(
    declared: Mapping[str, tuple[str, tuple[int, ...]]], model: str = "clustered"
) -> dict[str, int]:
    """Demand all arrays of a field, in allowed dtypes and consistent shapes.

    Parameters
    ----------
    declared : mapping of str to (dtype name, shape)
        Nothing but names, dtypes and shapes is looked at.
    model : {"clustered", "half_vector"}

    Returns
    -------
    dict of str to int
        Length of each named axis.

    Raises
    ------
    ShapeError
        If an array is missing or unknown, or a dtype or shape does not fit.
    """
    schema = SCHEMAS[model]
    if set(declared) != set(schema):
        raise ShapeError(f"arrays: expected {sorted(schema)}, received {sorted(declared)}")
    lengths: dict[str, int] = {}
    for name, (dtypes, axes) in schema.items():
        dtype, shape = declared[name]
        if dtype not in dtypes:
            raise ShapeError(f"{name}: expected dtype {' or '.join(dtypes)}, received {dtype}")
        _check_axes(name, shape, axes, lengths)
    if model == "clustered" and lengths["n_functions"] != lengths["n_components"] + 1:
        raise ShapeError(
            f"function_factor: expected {lengths['n_components'] + 1} functions, the mean and "
            f"one a component, received {lengths['n_functions']}"
        )
    if lengths["n_indirect_functions"] != lengths["n_indirect_components"] + 1:
        raise ShapeError(
            f"indirect_functions: expected {lengths['n_indirect_components'] + 1}, the mean "
            f"and one a component, received {lengths['n_indirect_functions']}"
        )
    node_side("indirect_functions", lengths["n_harmonics"])
    return lengths


def node_side(name: str, n_nodes: int) -> int:
    """Side of a square grid of `n_nodes` nodes.

    Raises
    ------
    ShapeError
        If `n_nodes` is not the square of a positive number.
    """
    side = isqrt(n_nodes)
    if n_nodes < 1 or side * side != n_nodes:
        raise ShapeError(f"{name}: expected a square number of nodes, received {n_nodes}")
    return side


def _check_axes(
    name: str, shape: tuple[int, ...], axes: tuple[str | int, ...], lengths: dict[str, int]
) -> None:
    fits = len(shape) == len(axes) and all(
        length == (lengths.setdefault(axis, length) if isinstance(axis, str) else axis)
        for length, axis in zip(shape, axes, strict=True)
    )
    if not fits:
        wanted = ", ".join(
            f"{axis} = {lengths[axis]}" if axis in lengths else str(axis) for axis in axes
        )
        raise ShapeError(f"{name}: expected shape ({wanted}), received {shape}")


def check_indices(name: str, indices: NDArray[Any], lowest: int, end: int) -> NDArray[Any]:
    """Return indices after a look at their range; kernels read them unchecked.

    Raises
    ------
    InputError
        If one is out of range.
    """
    if indices.size and not (lowest <= int(indices.min()) and int(indices.max()) < end):
        raise InputError(
            f"{name}: expected indices from {lowest} to {end - 1}, received "
            f"{int(indices.min())} to {int(indices.max())}"
        )
    return indices
