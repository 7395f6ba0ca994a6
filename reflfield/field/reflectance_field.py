"""The reflectance field: what a texel sends to any viewer under any light.

A texel holds the number of its cluster, a local frame and K coefficients. A
cluster holds a mean and K basis functions of two directions, on the nodes of
two `HemisphereGrid`. The sample for view v and light l, both in the texel's
frame, is

    value(v, l) = s(l) D^-1( mean(v, l) + sum_k coefficient_k basis_k(v, l) ),

bilinear on both grids, with D the `domain`: the signed cube root by default.
Samples are radiance divided by the irradiance of a surface facing the light,
so the cosine (and, unless it was factored out, the shadow) is included: s is that
cosine, rounded at the horizon (`sphere.hemisphere.softened_cosine`), or 1 where the
direction of the light does not vary. It stands outside the interpolation because its
root falls to the horizon too steeply for any grid.

Where shadows were factored out, a texel that a light does not reach shows indirect light
(`field.indirect`): a mean and a few functions of the light's direction in the world, shared by
all texels, with coefficients of its own.

Arrays are kept as they are stored, quantised (`field.tucker_coding`, `field.quantisation`);
properties decode them when first asked for. A field opened from a file reads only what is
used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import isqrt
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import FieldFileError, InputError, ShapeError
from reflfield.field.indirect_light import IndirectLight
from reflfield.field.observed_sphere import MOST_OBSERVED
from reflfield.field.quantisation import (
    QuantisedBox,
    check_finite,
    rotations_from_codes,
)
from reflfield.field.tucker_coding import unfactor_table
from reflfield.util.blas_threads import one_core_blas
from reflfield.util.validation import unit_direction

Domain = Literal["cube_root", "square_root", "linear"]
Visibility = Literal["kept", "factored"]
LightModel = Literal["known", "unknown"]

# Domain to the power that undoes it.
INVERSE_POWER = {"cube_root": 3, "square_root": 2, "linear": 1}
VISIBILITIES = ("kept", "factored")
LIGHT_MODELS = ("known", "unknown")

# Largest sample that a field may show, 1/sr, by the sum of its terms; sums of samples under
# lights of any ordinary unit stay finite as singles.
LARGEST_SAMPLE = 1e33

_CODES = ("int8", "int16", "int32")

# Stored arrays in file order: the dtypes allowed and the axes, by name. An axis
# that appears in several arrays must have one length; a number is a fixed one.
ARRAYS: dict[str, tuple[tuple[str, ...], tuple[str | int, ...]]] = {
    "positions": (("uint16",), ("n_vertices", 3)),
    # Files of earlier versions hold float32, which far from the origin is too coarse.
    "position_box": (("float32", "float64"), (4,)),
    "faces": (("int32",), ("n_faces", 3)),
    "uv": (("uint16",), ("n_vertices", 2)),
    "uv_box": (("float32",), (3,)),
    "texel_of_pixel": (("int32",), ("height", "width")),
    "turns": (("int16",), ("n_texels", 3)),
    "turn_step": (("float32",), (1,)),
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
    "indirect_functions": (("float32",), ("n_indirect_functions", "n_harmonics", 3)),
    "indirect_coefficients": (_CODES, ("n_texels", "n_indirect_components")),
    "indirect_scale": (("float32",), (1,)),
}


@dataclass(frozen=True, eq=False)
class ReflectanceField:
    """A fitted reflectance field. Made by `build.build_field` or `file.open_field`.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        Stored arrays by the names of `ARRAYS`, quantised.
    view_side, light_side : int
        Sides of the two `HemisphereGrid`; 1 means that direction does not vary.
    domain : {"cube_root", "square_root", "linear"}
        Domain of mean and basis.
    visibility : {"kept", "factored"}
        "kept": shadows are in the samples; "factored": they are to be traced.
    light_model : {"known", "unknown"}
        "unknown": one constant, unknown light; samples are radiance itself.
    metadata : dict
        Options, versions and counts of the run that made the field; plain
        JSON values.
    """

    arrays: Mapping[str, NDArray[Any]]
    view_side: int
    light_side: int
    domain: Domain = "cube_root"
    visibility: Visibility = "kept"
    light_model: LightModel = "known"
    metadata: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def positions(self) -> NDArray[np.float64]:
        """(n_vertices, 3) float64 vertices, metres, world frame."""
        check_finite("position_box", self.arrays["position_box"])
        box = self.arrays["position_box"].astype(np.float64)
        points = QuantisedBox(self.arrays["positions"], box).decode()
        return points.astype(np.float64, copy=False)

    @cached_property
    def uv(self) -> NDArray[np.float32]:
        """(n_vertices, 2) float32 texture coordinates, v up."""
        check_finite("uv_box", self.arrays["uv_box"])
        return QuantisedBox(self.arrays["uv"], self.arrays["uv_box"]).decode()

    @cached_property
    def faces(self) -> NDArray[np.int32]:
        """(n_faces, 3) int32 vertex indices."""
        return check_indices("faces", self.arrays["faces"], 0, len(self.arrays["positions"]))

    @cached_property
    def texel_of_pixel(self) -> NDArray[np.int32]:
        """(height, width) int32 nearest texel, -1 where none; row 0 is v = 1."""
        return check_indices(
            "texel_of_pixel", self.arrays["texel_of_pixel"], -1, len(self.arrays["cluster"])
        )

    @cached_property
    def cluster(self) -> NDArray[np.int32]:
        """(n_texels,) int32 cluster of each texel."""
        wide = self.arrays["cluster"].astype(np.int32)
        return check_indices("cluster", wide, 0, self.n_clusters)

    @cached_property
    def local_from_world(self) -> NDArray[np.float32]:
        """(n_texels, 3, 3) float32 aligned frames."""
        step = float(self.arrays["turn_step"][0])
        return rotations_from_codes(self.arrays["turns"], step)

    @cached_property
    def coefficients(self) -> NDArray[np.float32]:
        """(n_texels, K) float32 weights of the basis functions."""
        scale = self.arrays["coefficient_scale"][self.cluster]
        return self.arrays["coefficients"].astype(np.float32) * scale

    @cached_property
    def node_table(self) -> NDArray[np.float32]:
        """(n_clusters, n_view_nodes, n_light_nodes, K + 1, 3): mean, then basis.

        Component and channel run fastest, so that one tap reads one run of
        memory. This is the largest thing a field needs: 31 MB for 16 clusters of
        10 components on 11 x 11 nodes for each direction, 411 MB on 21 x 21.
        """
        for name in ("function", "view", "light", "core"):
            check_finite(f"{name}_scale", self.arrays[f"{name}_scale"])
        check_finite("function_gain", self.arrays["function_gain"])
        check_finite("colour_factor", self.arrays["colour_factor"])
        with one_core_blas(), np.errstate(over="ignore", invalid="ignore"):
            table = unfactor_table(self.arrays)
        self._check_samples("functions", table, 1, self.coefficients)
        return np.ascontiguousarray(np.moveaxis(table, 1, 3))

    @cached_property
    def indirect(self) -> IndirectLight:
        """Indirect light, in the domain; see `field.indirect`."""
        functions, scale = (self.arrays[f"indirect_{n}"] for n in ("functions", "scale"))
        codes = self.arrays["indirect_coefficients"].astype(np.float32)
        self._check_samples("indirect_functions", functions, 0, codes * scale)
        return IndirectLight(functions, codes * scale, self.observed_lights)

    def _check_samples(
        self, name: str, functions: NDArray[Any], axis: int, weights: NDArray[Any]
    ) -> None:
        """Demand functions, the mean first, whose weighted sums stay finite as samples."""
        others = tuple(i for i in range(functions.ndim) if i != axis)
        most = np.maximum(functions.max(axis=others), -functions.min(axis=others))
        of_weights = np.maximum(weights.max(axis=0, initial=0), -weights.min(axis=0, initial=0))
        bound = float(most[0] + most[1:].astype(np.float64) @ of_weights.astype(np.float64))
        limit = LARGEST_SAMPLE ** (1.0 / self.inverse_power)
        if not bound <= limit:  # nor is NaN
            wrong = (
                f"{name}: expected finite numbers, in all at most {limit:.3g}, received "
                f"{bound:.3g}; make the field again"
            )
            path = getattr(self.arrays, "path", None)
            raise InputError(wrong) if path is None else FieldFileError(f"{path}: {wrong}")

    @cached_property
    def observed_lights(self) -> NDArray[np.float64] | None:
        """(n, 3) unit directions that the capture's lights came from; None if not stated.

        Raises
        ------
        InputError
            If the metadata state something else than directions.
        """
        stated = self.metadata.get("observed_lights")
        if stated is None:
            return None
        try:
            directions = np.asarray(stated, np.float64).reshape(-1, 3)
            lengths = np.linalg.norm(directions, axis=1, keepdims=True)
            if not (np.abs(lengths - 1.0) < 0.1).all() or len(directions) > MOST_OBSERVED:
                raise ValueError
        except (TypeError, ValueError, OverflowError):
            raise InputError(
                f"metadata: observed_lights: expected at most {MOST_OBSERVED} unit directions, "
                f"received {stated!r:.100}"
            ) from None
        return directions / lengths

    @property
    def mean(self) -> NDArray[np.float32]:
        """(n_clusters, n_view_nodes, n_light_nodes, 3) float32."""
        return self.node_table[..., 0, :]

    @property
    def basis(self) -> NDArray[np.float32]:
        """(n_clusters, K, n_view_nodes, n_light_nodes, 3) float32."""
        return np.moveaxis(self.node_table[..., 1:, :], 3, 1)

    @cached_property
    def component_weights(self) -> NDArray[np.float32]:
        """(n_texels, K + 1) float32: 1 for the mean, then the coefficients."""
        ones = np.ones((self.n_texels, 1), np.float32)
        return np.concatenate([ones, self.coefficients], axis=1)

    @property
    def n_texels(self) -> int:
        """Number of texels."""
        return len(self.cluster)

    @property
    def n_clusters(self) -> int:
        """Number of clusters."""
        return len(self.arrays["coefficient_scale"])

    @property
    def n_components(self) -> int:
        """Number of basis functions of a cluster."""
        return int(self.arrays["coefficient_scale"].shape[1])

    @property
    def up(self) -> NDArray[np.float64]:
        """(3,) unit world direction that is up, of the capture; +Z where it is not stated.

        Raises
        ------
        InputError
            If the metadata state something else than a direction.
        """
        stated = self.metadata.get("up", (0.0, 0.0, 1.0))
        try:
            return unit_direction("metadata: up", stated)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(
                f"metadata: up: expected three finite numbers, not all zero, received "
                f"{stated!r:.100}"
            ) from error

    @property
    def inverse_power(self) -> int:
        """Power that leads from the domain back to samples."""
        return INVERSE_POWER[self.domain]


def check_options(domain: str, visibility: str, light_model: str) -> None:
    """Demand known words for the three options of a field.

    Raises
    ------
    InputError
        If one is unknown.
    """
    for name, value, known in (
        ("domain", domain, tuple(INVERSE_POWER)),
        ("visibility", visibility, VISIBILITIES),
        ("light_model", light_model, LIGHT_MODELS),
    ):
        if value not in known:
            raise InputError(f"{name}: expected one of {list(known)}, received {value!r}")


def check_arrays(declared: Mapping[str, tuple[str, tuple[int, ...]]]) -> dict[str, int]:
    """Demand all arrays of a field, in allowed dtypes and consistent shapes.

    Parameters
    ----------
    declared : mapping of str to (dtype name, shape)
        Nothing but names, dtypes and shapes is looked at.

    Returns
    -------
    dict of str to int
        Length of each named axis.

    Raises
    ------
    ShapeError
        If an array is missing or unknown, or a dtype or shape does not fit.
    """
    if set(declared) != set(ARRAYS):
        raise ShapeError(f"arrays: expected {sorted(ARRAYS)}, received {sorted(declared)}")
    lengths: dict[str, int] = {}
    for name, (dtypes, axes) in ARRAYS.items():
        dtype, shape = declared[name]
        if dtype not in dtypes:
            raise ShapeError(f"{name}: expected dtype {' or '.join(dtypes)}, received {dtype}")
        _check_axes(name, shape, axes, lengths)
    if lengths["n_functions"] != lengths["n_components"] + 1:
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
        got == (lengths.setdefault(axis, got) if isinstance(axis, str) else axis)
        for got, axis in zip(shape, axes, strict=True)
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
