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

Arrays are kept as they are stored, quantised; properties decode them when
first asked for. A field opened from a file reads only what is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import isqrt
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from reflfield.checks import check_shape
from reflfield.errors import InputError, ShapeError
from reflfield.field.quantisation import (
    CodeKind,
    QuantisedArray,
    check_finite,
    check_kind,
    codes_from_rotations,
    encode,
    quantise,
    rotations_from_codes,
    scale_of,
)

Domain = Literal["cube_root", "square_root", "linear"]
Visibility = Literal["kept", "factored"]
LightModel = Literal["known", "unknown"]

# Domain to the power that undoes it.
INVERSE_POWER = {"cube_root": 3, "square_root": 2, "linear": 1}
VISIBILITIES = ("kept", "factored")
LIGHT_MODELS = ("known", "unknown")

_CODES = ("int8", "int16", "float16")

# Stored arrays in file order: the dtypes allowed and the axes, by name. An axis
# that appears in several arrays must have one length; a number is a fixed one.
ARRAYS: dict[str, tuple[tuple[str, ...], tuple[str | int, ...]]] = {
    "positions": (("float32",), ("n_vertices", 3)),
    "faces": (("int32",), ("n_faces", 3)),
    "uv": (("float32",), ("n_vertices", 2)),
    "texel_of_pixel": (("int32",), ("height", "width")),
    "base_frames": (("uint16",), ("n_texels", 3)),
    "local_frames": (("uint16",), ("n_texels", 3)),
    "cluster": (("uint8", "uint16"), ("n_texels",)),
    "coefficients": (_CODES, ("n_texels", "n_components")),
    "coefficient_scale": (("float32",), ("n_clusters", "n_components")),
    "mean": (_CODES, ("n_clusters", "n_view_nodes", "n_light_nodes", 3)),
    "mean_scale": (("float32",), ("n_clusters",)),
    "basis": (_CODES, ("n_clusters", "n_components", "n_view_nodes", "n_light_nodes", 3)),
    "basis_scale": (("float32",), ("n_clusters", "n_components")),
}


@dataclass(frozen=True)
class Quantisation:
    """How many bits the parts of a field get.

    Parameters
    ----------
    coefficients, basis, mean : {"int8", "int16", "float16"}
        Code of each part. Coefficients and basis have one scale for each
        cluster and component, the mean one for each cluster.

    Raises
    ------
    InputError
        If a kind is unknown.
    """

    coefficients: CodeKind = "int16"
    basis: CodeKind = "int8"
    mean: CodeKind = "int16"

    def __post_init__(self) -> None:
        for name in ("coefficients", "basis", "mean"):
            check_kind(f"quantisation.{name}", getattr(self, name))


@dataclass(frozen=True, eq=False)
class BaseSurface:
    """Base geometry and its texels, as `build_field` takes them.

    Parameters
    ----------
    positions : (n_vertices, 3) float
        Vertices, metres, world frame.
    faces : (n_faces, 3) int
        Vertex indices, counter-clockwise from outside.
    uv : (n_vertices, 2) float
        Texture coordinates in [0, 1], v up.
    texel_of_pixel : (height, width) int
        Nearest texel of each texture pixel, gutter included; -1 where none.
        Row 0 is the top, v = 1.
    base_from_world : (n_texels, 3, 3) float
        Base frames, rows tangent, binormal, normal.
    """

    positions: NDArray[np.floating]
    faces: NDArray[np.integer]
    uv: NDArray[np.floating]
    texel_of_pixel: NDArray[np.integer]
    base_from_world: NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class FittedReflectance:
    """Frames, clusters, coefficients and bases, as `build_field` takes them.

    Parameters
    ----------
    local_from_world : (n_texels, 3, 3) float
        Aligned frames, rows tangent, binormal, normal.
    cluster : (n_texels,) int
        Cluster of each texel.
    coefficients : (n_texels, K) float
        Weights of the basis of the texel's cluster; K may be 0.
    mean : (n_clusters, n_view_nodes, n_light_nodes, 3) float
        Mean sample in the domain, at the nodes of the two grids.
    basis : (n_clusters, K, n_view_nodes, n_light_nodes, 3) float
        Basis functions in the domain.
    domain : {"cube_root", "square_root", "linear"}
        What was applied to the samples.
    """

    local_from_world: NDArray[np.floating]
    cluster: NDArray[np.integer]
    coefficients: NDArray[np.floating]
    mean: NDArray[np.floating]
    basis: NDArray[np.floating]
    domain: Domain = "cube_root"


@dataclass(frozen=True, eq=False)
class ReflectanceField:
    """A fitted reflectance field. Build with `build_field` or `open_field`.

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
    def positions(self) -> NDArray[np.float32]:
        """(n_vertices, 3) float32 vertices, metres, world frame."""
        check_finite("positions", self.arrays["positions"])
        return self.arrays["positions"]

    @cached_property
    def uv(self) -> NDArray[np.float32]:
        """(n_vertices, 2) float32 texture coordinates, v up."""
        check_finite("uv", self.arrays["uv"])
        return self.arrays["uv"]

    @cached_property
    def faces(self) -> NDArray[np.int32]:
        """(n_faces, 3) int32 vertex indices."""
        return _indices("faces", self.arrays["faces"], 0, len(self.arrays["positions"]))

    @cached_property
    def texel_of_pixel(self) -> NDArray[np.int32]:
        """(height, width) int32 nearest texel, -1 where none; row 0 is v = 1."""
        return _indices(
            "texel_of_pixel", self.arrays["texel_of_pixel"], -1, len(self.arrays["cluster"])
        )

    @cached_property
    def cluster(self) -> NDArray[np.int32]:
        """(n_texels,) int32 cluster of each texel."""
        wide = self.arrays["cluster"].astype(np.int32)
        return _indices("cluster", wide, 0, len(self.arrays["mean_scale"]))

    @cached_property
    def base_from_world(self) -> NDArray[np.float32]:
        """(n_texels, 3, 3) float32 base frames."""
        return rotations_from_codes(self.arrays["base_frames"])

    @cached_property
    def local_from_world(self) -> NDArray[np.float32]:
        """(n_texels, 3, 3) float32 aligned frames."""
        return rotations_from_codes(self.arrays["local_frames"])

    @cached_property
    def coefficients(self) -> NDArray[np.float32]:
        """(n_texels, K) float32 weights of the basis functions."""
        scale = self.arrays["coefficient_scale"][self.cluster]
        return self.arrays["coefficients"].astype(np.float32) * scale

    @property
    def mean(self) -> NDArray[np.float32]:
        """(n_clusters, n_view_nodes, n_light_nodes, 3) float32, decoded at each call."""
        return QuantisedArray(self.arrays["mean"], self.arrays["mean_scale"]).decode()

    @property
    def basis(self) -> NDArray[np.float32]:
        """(n_clusters, K, n_view_nodes, n_light_nodes, 3) float32, decoded at each call."""
        return QuantisedArray(self.arrays["basis"], self.arrays["basis_scale"]).decode()

    @cached_property
    def node_table(self) -> NDArray[np.float32]:
        """(n_clusters, n_view_nodes, n_light_nodes, K + 1, 3): mean, then basis.

        Component and channel run fastest, so that one tap reads one run of
        memory. This is the largest thing a field needs: 31 MB for 16 clusters of
        10 components on 11 x 11 nodes for each direction, 411 MB on 21 x 21.
        """
        mean = self.mean
        n_clusters, n_views, n_lights, _ = mean.shape
        table = np.zeros((n_clusters, n_views, n_lights, self.n_components + 1, 3), np.float32)
        table[..., 0, :] = mean
        table[..., 1:, :] = np.moveaxis(self.basis, 1, 3)
        return table

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
        return len(self.arrays["mean_scale"])

    @property
    def n_components(self) -> int:
        """Number of basis functions of a cluster."""
        return int(self.arrays["basis_scale"].shape[1])

    @property
    def inverse_power(self) -> int:
        """Power that leads from the domain back to samples."""
        return INVERSE_POWER[self.domain]


def build_field(
    surface: BaseSurface,
    reflectance: FittedReflectance,
    *,
    visibility: Visibility = "kept",
    light_model: LightModel = "known",
    metadata: Mapping[str, Any] | None = None,
    quantisation: Quantisation | None = None,
) -> ReflectanceField:
    """Quantise fitted parts into a field.

    Parameters
    ----------
    surface : BaseSurface
        Base geometry and texels.
    reflectance : FittedReflectance
        Frames, clusters, coefficients, mean and basis. The sides of the grids
        follow from the node counts, which are squares.
    visibility : {"kept", "factored"}
        Whether shadows are in the samples or to be traced.
    light_model : {"known", "unknown"}
        Whether the lights were known.
    metadata : mapping, optional
        Plain JSON values to keep with the field.
    quantisation : Quantisation, optional
        Bits of each part.

    Returns
    -------
    ReflectanceField

    Raises
    ------
    ShapeError
        If shapes disagree or a node count is not a square.
    InputError
        If a number is not finite, a frame is no rotation, an index is out of
        range, or an option is unknown.

    Examples
    --------
    A square of one texel that sends back a tenth of the light to everywhere:

    >>> surface = BaseSurface(
    ...     positions=np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32),
    ...     faces=np.array([[0, 1, 2], [0, 2, 3]]),
    ...     uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32),
    ...     texel_of_pixel=np.zeros((1, 1), int),
    ...     base_from_world=np.eye(3)[None],
    ... )
    >>> reflectance = FittedReflectance(
    ...     local_from_world=np.eye(3)[None], cluster=np.zeros(1, int),
    ...     coefficients=np.zeros((1, 0)), mean=np.full((1, 1, 1, 3), 0.1),
    ...     basis=np.zeros((1, 0, 1, 1, 3)), domain="linear",
    ... )
    >>> field = build_field(surface, reflectance)
    >>> field.view_side, field.n_texels, round(float(field.mean[0, 0, 0, 0]), 6)
    (1, 1, 0.1)
    """
    bits = quantisation or Quantisation()
    arrays = _surface_arrays(surface) | _reflectance_arrays(reflectance, bits)
    sizes = check_arrays({name: (a.dtype.name, a.shape) for name, a in arrays.items()})
    built = ReflectanceField(
        arrays=arrays,
        view_side=node_side("mean", sizes["n_view_nodes"]),
        light_side=node_side("mean", sizes["n_light_nodes"]),
        domain=reflectance.domain,
        visibility=visibility,
        light_model=light_model,
        metadata=dict(metadata or {}),
    )
    check_options(built.domain, built.visibility, built.light_model)
    # Reading the properties checks finiteness and the ranges of indices.
    for name in ("positions", "uv", "faces", "texel_of_pixel", "cluster"):
        getattr(built, name)
    return built


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


def _surface_arrays(surface: BaseSurface) -> dict[str, NDArray[Any]]:
    return {
        "positions": np.ascontiguousarray(surface.positions, np.float32),
        "faces": np.ascontiguousarray(surface.faces, np.int32),
        "uv": np.ascontiguousarray(surface.uv, np.float32),
        "texel_of_pixel": np.ascontiguousarray(surface.texel_of_pixel, np.int32),
        "base_frames": codes_from_rotations(surface.base_from_world),
    }


def _reflectance_arrays(
    reflectance: FittedReflectance, bits: Quantisation
) -> dict[str, NDArray[Any]]:
    mean = np.asarray(reflectance.mean)
    basis = np.asarray(reflectance.basis)
    check_shape("mean", mean, (None, None, None, 3))
    check_shape("basis", basis, (len(mean), None, *mean.shape[1:]))
    cluster = np.asarray(reflectance.cluster)
    check_shape("cluster", cluster, (None,))
    _indices("cluster", cluster, 0, len(mean))
    coefficients = np.asarray(reflectance.coefficients, np.float64)
    check_shape("coefficients", coefficients, (len(cluster), basis.shape[1]))
    check_finite("coefficients", coefficients)
    largest = np.zeros(basis.shape[:2])
    np.maximum.at(largest, cluster, np.abs(coefficients))
    coefficient_scale = scale_of(largest, bits.coefficients)
    mean_codes = quantise(mean, bits.mean, n_group_axes=1)
    basis_codes = quantise(basis, bits.basis, n_group_axes=2)
    return {
        "local_frames": codes_from_rotations(reflectance.local_from_world),
        "cluster": cluster.astype(np.uint8 if len(mean) <= 256 else np.uint16),
        "coefficients": encode(coefficients, coefficient_scale[cluster], bits.coefficients),
        "coefficient_scale": coefficient_scale,
        "mean": mean_codes.codes,
        "mean_scale": mean_codes.scale,
        "basis": basis_codes.codes,
        "basis_scale": basis_codes.scale,
    }


def _indices(name: str, indices: NDArray[Any], lowest: int, end: int) -> NDArray[Any]:
    """Return `indices` after a look at their range; kernels read unchecked."""
    if indices.size and not (lowest <= int(indices.min()) and int(indices.max()) < end):
        raise InputError(
            f"{name}: expected indices from {lowest} to {end - 1}, received "
            f"{int(indices.min())} to {int(indices.max())}"
        )
    return indices
