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

Arrays are kept as they are stored, quantised (`field.transform`, `field.quantisation`);
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
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from reflfield.checks import check_shape
from reflfield.errors import InputError, ShapeError
from reflfield.field.quantisation import (
    SMALLEST_TURN,
    QuantisedBox,
    check_finite,
    codes_from_rotations,
    lattice_points,
    rotations_from_codes,
)
from reflfield.field.transform import (
    factor_table,
    lattice_codes,
    smallest_codes,
    unfactor_table,
)
from reflfield.scheduling import one_core_blas

Domain = Literal["cube_root", "square_root", "linear"]
Visibility = Literal["kept", "factored"]
LightModel = Literal["known", "unknown"]

# Domain to the power that undoes it.
INVERSE_POWER = {"cube_root": 3, "square_root": 2, "linear": 1}
VISIBILITIES = ("kept", "factored")
LIGHT_MODELS = ("known", "unknown")

_CODES = ("int8", "int16", "int32")

# Stored arrays in file order: the dtypes allowed and the axes, by name. An axis
# that appears in several arrays must have one length; a number is a fixed one.
ARRAYS: dict[str, tuple[tuple[str, ...], tuple[str | int, ...]]] = {
    "positions": (("uint16",), ("n_vertices", 3)),
    "position_box": (("float32",), (4,)),
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
}

# Steps along the longest side of the object: .01 mm of 16 cm, a hundredth of a texel.
POSITION_STEPS = 16383
UV_STEPS = 32767
# Where no step is asked for, this share of the root mean square of the means: beyond what any
# capture holds.
FINEST_SHARE = 1e-5
FINEST_TURN = np.deg2rad(0.01)
COARSEST_TURN = np.deg2rad(1.0)


@dataclass(frozen=True)
class Quantisation:
    """How many bits a field gets.

    Parameters
    ----------
    step : float
        Quantisation step of every coefficient and, weighted by what the texels make of it,
        of every number of the functions, in root mean square over the nodes in the
        domain: each adds a twelfth of its square to the squared error. 0: as fine as is
        of any use.
    turn_deg : float
        Step of the frames, degrees about each axis. 0: the one at which a frame adds as much
        error as a coefficient.

    Raises
    ------
    InputError
        If a number is negative or not finite.
    """

    step: float = 0.0
    turn_deg: float = 0.0

    def __post_init__(self) -> None:
        for name in ("step", "turn_deg"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(
                    f"quantisation.{name}: expected >= 0, received {getattr(self, name)}"
                )


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
    """

    positions: NDArray[np.floating]
    faces: NDArray[np.integer]
    uv: NDArray[np.floating]
    texel_of_pixel: NDArray[np.integer]


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
        check_finite("position_box", self.arrays["position_box"])
        return QuantisedBox(self.arrays["positions"], self.arrays["position_box"]).decode()

    @cached_property
    def uv(self) -> NDArray[np.float32]:
        """(n_vertices, 2) float32 texture coordinates, v up."""
        check_finite("uv_box", self.arrays["uv_box"])
        return QuantisedBox(self.arrays["uv"], self.arrays["uv_box"]).decode()

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
        return _indices("cluster", wide, 0, self.n_clusters)

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
        with one_core_blas():
            table = unfactor_table(self.arrays)
        return np.ascontiguousarray(np.moveaxis(table, 1, 3))

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
        How many bits the numbers get.

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
    _check_reflectance(reflectance)
    sides = [node_side("mean", n) for n in reflectance.mean.shape[1:3]]
    # Sums of several cores end in other last bits with other numbers of them.
    with one_core_blas():
        arrays = _surface_arrays(surface) | _reflectance_arrays(reflectance, bits)
    check_arrays({name: (a.dtype.name, a.shape) for name, a in arrays.items()})
    built = ReflectanceField(
        arrays=arrays,
        view_side=sides[0],
        light_side=sides[1],
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
    if lengths["n_functions"] != lengths["n_components"] + 1:
        raise ShapeError(
            f"function_factor: expected {lengths['n_components'] + 1} functions, the mean and "
            f"one a component, received {lengths['n_functions']}"
        )
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
    check_finite("positions", surface.positions)
    check_finite("uv", surface.uv)
    check_shape("uv", surface.uv, (len(surface.positions), 2))
    faces = _indices("faces", np.asarray(surface.faces), 0, len(surface.positions))
    vertices, faces = neighbours_in_a_row(faces, len(surface.positions))
    corners = lattice_points(np.asarray(surface.positions)[vertices], POSITION_STEPS)
    uv = lattice_points(np.asarray(surface.uv)[vertices], UV_STEPS)
    return {
        "positions": corners.codes,
        "position_box": corners.box,
        "faces": np.ascontiguousarray(faces, np.int32),
        "uv": uv.codes,
        "uv_box": uv.box,
        "texel_of_pixel": np.ascontiguousarray(surface.texel_of_pixel, np.int32),
    }


def neighbours_in_a_row(
    faces: NDArray[np.integer], n_vertices: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Order in which triangles follow their neighbours, and vertices their triangles.

    Parameters
    ----------
    faces : (n, 3) int
    n_vertices : int

    Returns
    -------
    vertices : (n_vertices,) int
        Old number of each new vertex, in the order of first use; unused ones last.
    faces : (n, 3) int
        In the new order and numbers; corners in their cyclic order.

    Examples
    --------
    >>> neighbours_in_a_row(np.array([[3, 1, 2]]), 4)[0]
    array([3, 1, 2, 0])
    """
    corner_of = coo_array(
        (np.ones(faces.size, np.int32), (np.repeat(np.arange(len(faces)), 3), faces.ravel())),
        shape=(len(faces), n_vertices),
    ).tocsr()
    order = reverse_cuthill_mckee(csr_array(corner_of @ corner_of.T), symmetric_mode=True)
    ordered = np.asarray(faces)[order]
    used, first = np.unique(ordered, return_index=True)
    unused = np.setdiff1d(np.arange(n_vertices), used)
    vertices = np.concatenate([used[np.argsort(first)], unused]).astype(np.intp)
    new_number = np.zeros(n_vertices, np.intp)
    new_number[vertices] = np.arange(n_vertices)
    return vertices, new_number[ordered]


def _check_reflectance(reflectance: FittedReflectance) -> None:
    mean, basis = np.asarray(reflectance.mean), np.asarray(reflectance.basis)
    check_shape("mean", mean, (None, None, None, 3))
    check_shape("basis", basis, (len(mean), None, *mean.shape[1:]))
    cluster = np.asarray(reflectance.cluster)
    check_shape("cluster", cluster, (None,))
    _indices("cluster", cluster, 0, len(mean))
    coefficients = np.asarray(reflectance.coefficients)
    check_shape("coefficients", coefficients, (len(cluster), basis.shape[1]))
    check_shape("local_from_world", reflectance.local_from_world, (len(cluster), 3, 3))
    for name in ("mean", "basis", "coefficients"):
        check_finite(name, getattr(reflectance, name))


def _reflectance_arrays(
    reflectance: FittedReflectance, bits: Quantisation
) -> dict[str, NDArray[Any]]:
    mean, basis = np.asarray(reflectance.mean), np.asarray(reflectance.basis)
    cluster = np.asarray(reflectance.cluster)
    table = np.concatenate([mean[:, None], basis], axis=1)
    step = bits.step or FINEST_SHARE * float(np.sqrt(np.mean(np.square(mean)))) or 1.0
    factors = factor_table(table, function_weights(reflectance), step)
    codes, scale = _coefficient_codes(reflectance, table, unfactor_table(factors), step)
    turn = np.deg2rad(bits.turn_deg) or _matching_turn(table, reflectance, bits.step)
    return {
        **factors,
        "turns": codes_from_rotations(reflectance.local_from_world, turn),
        "turn_step": np.array([turn], np.float32),
        "cluster": cluster.astype(np.uint8 if len(mean) <= 256 else np.uint16),
        "coefficients": smallest_codes(codes),
        "coefficient_scale": scale,
    }


def function_weights(reflectance: FittedReflectance) -> NDArray[np.float64]:
    """Root of the sum over texels of each function's squared factor, (n_clusters, K + 1)."""
    n_clusters, n_components = reflectance.basis.shape[:2]
    squares = np.zeros((n_clusters, n_components + 1))
    squares[:, 0] = np.bincount(reflectance.cluster, minlength=n_clusters)
    np.add.at(
        squares[:, 1:],
        reflectance.cluster,
        np.square(reflectance.coefficients, dtype=np.float64),
    )
    return np.sqrt(squares)


def _coefficient_codes(
    reflectance: FittedReflectance,
    table: NDArray[np.floating],
    decoded: NDArray[np.float32],
    step: float,
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Coefficients solved against the functions as they will be read, quantised."""
    n_clusters, n_functions = table.shape[:2]
    codes = np.zeros((len(reflectance.cluster), n_functions - 1), np.int32)
    scale = np.zeros((n_clusters, n_functions - 1), np.float32)
    for c in range(n_clusters):
        given = table[c].reshape(n_functions, -1).astype(np.float64)
        read = decoded[c].reshape(n_functions, -1).astype(np.float64)
        members = np.flatnonzero(np.asarray(reflectance.cluster) == c)
        gram = read[1:] @ read[1:].T / read.shape[1]
        between = given[1:] @ read[1:].T / read.shape[1]
        shift = (given[0] - read[0]) @ read[1:].T / read.shape[1]
        moments = np.asarray(reflectance.coefficients)[members] @ between + shift
        codes[members], scale[c] = lattice_codes(moments, gram, step)
    return codes, scale


def quantisation_error(given: FittedReflectance, field: ReflectanceField) -> float:
    """Root mean square over texels and nodes, in the domain, of what quantisation changed.

    From the Gram matrices of the functions before and after; no texel's nodes are formed.
    """
    total, n_nodes = 0.0, given.mean[0].size
    for c in range(field.n_clusters):
        members = np.flatnonzero(np.asarray(given.cluster) == c)
        before = np.concatenate([given.mean[c][None], given.basis[c]]).reshape(-1, n_nodes)
        after = np.moveaxis(field.node_table[c], 2, 0).reshape(-1, n_nodes)
        both = np.concatenate([before, after]).astype(np.float64)
        ones = np.ones((len(members), 1))
        factors = np.concatenate(
            [ones, given.coefficients[members], -ones, -field.coefficients[members]], axis=1
        )
        total += np.sum((factors @ (both @ both.T)) * factors)
    return float(np.sqrt(max(total, 0.0) / (n_nodes * max(len(given.cluster), 1))))


def _matching_turn(
    table: NDArray[np.floating], reflectance: FittedReflectance, step: float
) -> float:
    """Step of the turns that adds as much error as `step` of a coefficient, radians."""
    if not step > 0:
        return float(FINEST_TURN)
    counts = np.bincount(reflectance.cluster, minlength=len(table))
    slope = np.sqrt(np.average(_squared_slopes(table[:, 0]), weights=counts))
    turn = step / slope if slope > 0 else COARSEST_TURN
    return float(np.clip(turn, max(FINEST_TURN, SMALLEST_TURN), COARSEST_TURN))


def _squared_slopes(mean: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean squared change of each mean per radian of turn about a horizontal axis.

    Nodes of a side of s lie about 2 sqrt(2) / (s - 1) apart where the map is not
    stretched; a turn about a random axis moves a direction by root a half of its angle along
    each of two.
    """
    total = np.zeros(len(mean))
    for axis in (1, 2):
        side = isqrt(mean.shape[axis])
        if side > 1:
            shape = (*mean.shape[:axis], side, side, *mean.shape[axis + 1 :])
            spacing = 2.0 * np.sqrt(2.0) / (side - 1)
            for along in (axis, axis + 1):
                difference = np.diff(mean.reshape(shape), axis=along) / spacing
                inner = tuple(range(1, difference.ndim))
                total += 0.5 * np.mean(np.square(difference, dtype=np.float64), axis=inner)
    return total


def _indices(name: str, indices: NDArray[Any], lowest: int, end: int) -> NDArray[Any]:
    """Return `indices` after a look at their range; kernels read unchecked."""
    if indices.size and not (lowest <= int(indices.min()) and int(indices.max()) < end):
        raise InputError(
            f"{name}: expected indices from {lowest} to {end - 1}, received "
            f"{int(indices.min())} to {int(indices.max())}"
        )
    return indices
