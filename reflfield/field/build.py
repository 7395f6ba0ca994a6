"""Construction of a field from fitted parts: factor the functions, quantise everything."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from reflfield.errors import InputError
from reflfield.field.array_schemas import check_arrays, check_indices, node_side
from reflfield.field.indirect_light import IndirectLight, no_indirect_light
from reflfield.field.quantisation import (
    SMALLEST_TURN,
    check_finite,
    codes_from_rotations,
    lattice_codes,
    lattice_points,
    smallest_codes,
)
from reflfield.field.reflectance_field import (
    ClusteredField,
    Domain,
    LightModel,
    Visibility,
    check_options,
)
from reflfield.field.tucker_coding import factor_table, unfactor_table
from reflfield.util.blas_threads import one_core_blas
from reflfield.util.validation import check_shape

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
        of every number of the functions, in root mean square over the nodes, transformed:
        each adds a twelfth of its square to the squared error. 0: as fine as is
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
        Mean of the transformed samples at the nodes of the two grids.
    basis : (n_clusters, K, n_view_nodes, n_light_nodes, 3) float
        Basis functions of the transformed samples.
    domain : {"cube_root", "square_root", "linear"}
        What was applied to the samples.
    indirect : IndirectLight, optional
        What texels show in traced shadows; black by default.
    """

    local_from_world: NDArray[np.floating]
    cluster: NDArray[np.integer]
    coefficients: NDArray[np.floating]
    mean: NDArray[np.floating]
    basis: NDArray[np.floating]
    domain: Domain = "cube_root"
    indirect: IndirectLight | None = None


def build_field(
    surface: BaseSurface,
    reflectance: FittedReflectance,
    *,
    visibility: Visibility = "kept",
    light_model: LightModel = "known",
    metadata: Mapping[str, Any] | None = None,
    quantisation: Quantisation | None = None,
) -> ClusteredField:
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
    ClusteredField

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
        arrays = surface_arrays(surface) | _reflectance_arrays(reflectance, bits)
    check_arrays({name: (a.dtype.name, a.shape) for name, a in arrays.items()})
    built = ClusteredField(
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


def surface_arrays(surface: BaseSurface) -> dict[str, NDArray[Any]]:
    """Mesh, texture coordinates and texels on lattices."""
    check_finite("positions", surface.positions)
    check_finite("uv", surface.uv)
    check_shape("uv", surface.uv, (len(surface.positions), 2))
    faces = check_indices("faces", np.asarray(surface.faces), 0, len(surface.positions))
    vertices, faces = neighbours_in_a_row(faces, len(surface.positions))
    corners = lattice_points(
        np.asarray(surface.positions)[vertices], POSITION_STEPS, np.float64
    )
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
    check_indices("cluster", cluster, 0, len(mean))
    coefficients = np.asarray(reflectance.coefficients)
    check_shape("coefficients", coefficients, (len(cluster), basis.shape[1]))
    check_shape("local_from_world", reflectance.local_from_world, (len(cluster), 3, 3))
    for name in ("mean", "basis", "coefficients"):
        check_finite(name, getattr(reflectance, name))
    if reflectance.indirect is not None:
        check_shape("indirect", reflectance.indirect.coefficients, (len(cluster), None))
        check_finite("indirect", reflectance.indirect.functions)
        check_finite("indirect", reflectance.indirect.gain)
        check_finite("indirect", reflectance.indirect.coefficients)


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
        **indirect_arrays(reflectance.indirect, len(reflectance.cluster), step),
    }


def indirect_arrays(
    indirect: IndirectLight | None, n_texels: int, step: float
) -> dict[str, NDArray[Any]]:
    """Indirect light; its coefficients in steps, as the basis functions are of unit size."""
    light = indirect or no_indirect_light(n_texels)
    coefficients = np.asarray(light.coefficients, np.float64)
    # The step is a share of the means, which may be far darker.
    step = max(step, float(np.abs(coefficients).max(initial=0.0)) * FINEST_SHARE) or 1.0
    codes = np.rint(coefficients / step)
    return {
        "indirect_functions": np.ascontiguousarray(light.functions, np.float32),
        "indirect_coefficients": smallest_codes(codes.astype(np.int32)),
        "indirect_scale": np.array([step], np.float32),
        "bounce_gain": np.asarray(light.gain, np.float32),
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
        fitted = table[c].reshape(n_functions, -1).astype(np.float64)
        read = decoded[c].reshape(n_functions, -1).astype(np.float64)
        members = np.flatnonzero(np.asarray(reflectance.cluster) == c)
        gram = read[1:] @ read[1:].T / read.shape[1]
        between = fitted[1:] @ read[1:].T / read.shape[1]
        shift = (fitted[0] - read[0]) @ read[1:].T / read.shape[1]
        moments = np.asarray(reflectance.coefficients)[members] @ between + shift
        codes[members], scale[c] = lattice_codes(moments, gram, step)
    return codes, scale


def quantisation_error(fitted: FittedReflectance, field: ClusteredField) -> float:
    """Root mean square error of quantisation over texels and nodes, of transformed values.

    From the Gram matrices of the functions before and after; no texel's nodes are formed.
    """
    total, n_nodes = 0.0, fitted.mean[0].size
    for c in range(field.n_clusters):
        members = np.flatnonzero(np.asarray(fitted.cluster) == c)
        before = np.concatenate([fitted.mean[c][None], fitted.basis[c]]).reshape(-1, n_nodes)
        after = np.moveaxis(field.node_table[c], 2, 0).reshape(-1, n_nodes)
        both = np.concatenate([before, after]).astype(np.float64)
        ones = np.ones((len(members), 1))
        factors = np.concatenate(
            [ones, fitted.coefficients[members], -ones, -field.coefficients[members]], axis=1
        )
        total += np.sum((factors @ (both @ both.T)) * factors)
    return float(np.sqrt(max(total, 0.0) / (n_nodes * max(len(fitted.cluster), 1))))


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
