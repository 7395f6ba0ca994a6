"""Samples of a reflectance field: any texel, any view, any light.

Of a clustered field, directions are rotated into the texel's frame and interpolated
bilinearly on the grid of views (4 taps) and of lights (4 taps); of a half-vector field, see
`field.half_vector`. A direction below the local horizon reads the horizon. The cosine of the
light is multiplied to what is interpolated (`softened_cosine`): frames follow the data, not
the base geometry, so a light a few degrees below a texel's horizon may still reach it.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.errors import InputError
from reflfield.field.half_vector_evaluation import (
    evaluate_half_vector,
    sum_half_vector_lights,
)
from reflfield.field.quantisation import check_finite
from reflfield.field.reflectance_field import (
    ClusteredField,
    HalfVectorField,
    ReflectanceField,
)
from reflfield.field.texture_field import TextureField
from reflfield.sphere.hemisphere import first_tap, softened_cosine_of, square_from_xyz
from reflfield.util.validation import UNIT_TOLERANCE, check_shape

# Kernel helpers are typed by numba; to mypy their scalars are Any.


# Whole arrays and indices are passed on: a part of an array is an object whose references are
# counted, which takes longer than the taps do.


@numba.njit(cache=True, nogil=True, inline="always")
def _in_frame(frames: Any, t: Any, axis: int, directions: Any, i: Any) -> Any:
    """One coordinate of direction i in the frame of texel t."""
    x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
    return frames[t, axis, 0] * x + frames[t, axis, 1] * y + frames[t, axis, 2] * z


@numba.njit(cache=True, nogil=True)
def _local_taps(frames: Any, t: Any, directions: Any, i: Any, side: int) -> Any:
    """First node, steps to the next column and row, shares of those, local z."""
    x = _in_frame(frames, t, 0, directions, i)
    y = _in_frame(frames, t, 1, directions, i)
    z = _in_frame(frames, t, 2, directions, i)
    if side == 1:
        # One node four times, and no horizon: the direction does not vary.
        return 0, 0, 0, np.float32(0.0), np.float32(0.0), np.float32(1.0)
    u, v = square_from_xyz(x, y, z)
    column, s = first_tap(u, side)
    row, t = first_tap(v, side)
    return row * side + column, 1, side, np.float32(s), np.float32(t), np.float32(z)


@numba.njit(cache=True, nogil=True, inline="always")
def _corner(index: int, taps: Any) -> Any:
    """Node and weight of one of the four corners of `_local_taps`."""
    first, column, row, s, t, _ = taps
    along_s = s if index & 1 else np.float32(1.0) - s
    along_t = t if index & 2 else np.float32(1.0) - t
    return first + (index & 1) * column + (index >> 1) * row, along_s * along_t


@numba.njit(cache=True, nogil=True)
def _inverse_domain(value: Any, power: int) -> Any:
    if not value > 0:
        return np.float32(0.0)
    if power == 3:
        return value * value * value
    if power == 2:
        return value * value
    return value


@numba.njit(cache=True, nogil=True)
def _sum_taps(table: Any, c: Any, view_taps: Any, light_taps: Any, tap_sum: Any) -> None:
    """Sum of the 16 taps in cluster c of all components and channels, into `tap_sum`."""
    tap_sum[:] = np.float32(0.0)
    for a in range(4):
        view_node, view_weight = _corner(a, view_taps)
        for b in range(4):
            light_node, light_weight = _corner(b, light_taps)
            weight = view_weight * light_weight
            for i in range(len(tap_sum)):
                tap_sum[i] += weight * table[c, view_node, light_node, i]


@numba.njit(cache=True, nogil=True)
def _evaluate(
    table: NDArray[np.float32],
    component_weights: NDArray[np.float32],
    cluster: NDArray[np.int32],
    local_from_world: NDArray[np.float32],
    sides: tuple[int, int],
    power: int,
    texels: NDArray[np.int32],
    views: NDArray[np.float32],
    lights: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    n_components = component_weights.shape[1]
    tap_sum = np.zeros(3 * n_components, np.float32)
    nodes = table.reshape((table.shape[0], table.shape[1], table.shape[2], 3 * n_components))
    for i in range(len(texels)):
        texel = texels[i]
        if texel < 0:
            continue
        view_taps = _local_taps(local_from_world, texel, views, i, sides[0])
        light_taps = _local_taps(local_from_world, texel, lights, i, sides[1])
        cosine = np.float32(softened_cosine_of(light_taps[5]))
        if cosine == 0.0:
            continue
        _sum_taps(nodes, cluster[texel], view_taps, light_taps, tap_sum)
        for channel in range(3):
            value = np.float32(0.0)
            for k in range(n_components):
                value += component_weights[texel, k] * tap_sum[3 * k + channel]
            out[i, channel] = cosine * _inverse_domain(value, power)


@numba.njit(cache=True, nogil=True)
def _light_response(
    table: NDArray[np.float32],
    component_weights: NDArray[np.float32],
    cluster: NDArray[np.int32],
    local_from_world: NDArray[np.float32],
    view_side: int,
    texels: NDArray[np.int32],
    views: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    for i in range(len(texels)):
        texel = texels[i]
        if texel < 0:
            continue
        taps = _local_taps(local_from_world, texel, views, i, view_side)
        for a in range(4):
            view_node, corner = _corner(a, taps)
            nodes = table[cluster[texel], view_node]
            for node in range(table.shape[2]):
                for k in range(table.shape[3]):
                    weight = corner * component_weights[texel, k]
                    for channel in range(3):
                        out[i, node, channel] += weight * nodes[node, k, channel]


@numba.njit(cache=True, nogil=True)
def _sum_lights(
    responses: NDArray[np.float32],
    local_from_world: NDArray[np.float32],
    light_side: int,
    power: int,
    texels: NDArray[np.int32],
    lights: NDArray[np.float32],
    irradiances: NDArray[np.float32],
    lit: NDArray[np.bool_],
    out: NDArray[np.float32],
) -> None:
    for i in range(len(texels)):
        texel = texels[i]
        if texel < 0:
            continue
        for j in range(len(lights)):
            if not lit[i % len(lit), j]:
                continue
            taps = _local_taps(local_from_world, texel, lights, j, light_side)
            cosine = np.float32(softened_cosine_of(taps[5]))
            if cosine == 0.0:
                continue
            for channel in range(3):
                value = np.float32(0.0)
                for b in range(4):
                    node, corner = _corner(b, taps)
                    value += corner * responses[i, node, channel]
                radiance = irradiances[j, channel] * _inverse_domain(value, power)
                out[i, channel] += cosine * radiance


def evaluate(
    field: ReflectanceField, texels: ArrayLike, views_world: ArrayLike, lights_world: ArrayLike
) -> NDArray[np.float32]:
    """Samples of texels for pairs of directions.

    Parameters
    ----------
    field : ReflectanceField
        Field to read.
    texels : (n,) int
        Texels; -1 gives zero.
    views_world, lights_world : (n, 3) float
        Unit vectors to the viewer and to the light, world frame.

    Returns
    -------
    (n, 3) float32
        Radiance divided by the irradiance of a surface facing the light,
        1/sr, cosine included, never negative.

    Raises
    ------
    ShapeError
        If the shapes differ.
    InputError
        If a texel does not exist, or the direction of one that does is no unit vector.

    Notes
    -----
    16 taps of K + 1 components and 3 channels a sample of a clustered field, 8 taps of K lobes
    of a half-vector field; no memory beyond the result.
    """
    index, views = _checked(field, texels, "views_world", views_world)
    _, lights = _checked(field, texels, "lights_world", lights_world)
    out = np.zeros((len(index), 3), np.float32)
    if isinstance(field, HalfVectorField):
        evaluate_half_vector(*field.half_vector.arrays, index, views, lights, out)
        return out
    if isinstance(field, TextureField):
        np.multiply(field.colours[index], field.cosines(index, lights)[:, None], out=out)
        out[index < 0] = 0.0
        return out
    field = clustered(field)
    _evaluate(
        field.node_table,
        field.component_weights,
        field.cluster,
        field.local_from_world,
        (field.view_side, field.light_side),
        field.inverse_power,
        index,
        views,
        lights,
        out,
    )
    return out


def clustered(field: ReflectanceField) -> ClusteredField:
    """Demand a clustered field.

    Raises
    ------
    InputError
        If it is of another model.
    """
    if not isinstance(field, ClusteredField):
        raise InputError(
            f"field: expected a clustered field, received one of model {field.model!r}; fit "
            "one with compression.model = 'clustered'"
        )
    return field


def light_response(
    field: ClusteredField, texels: ArrayLike, views_world: ArrayLike
) -> NDArray[np.float32]:
    """Transformed values at all light nodes, for texels seen from given sides.

    Parameters
    ----------
    field : ClusteredField
        Field to read.
    texels : (n,) int
        Texels; -1 gives zero.
    views_world : (n, 3) float
        Unit vectors to the viewer, world frame.

    Returns
    -------
    (n, n_light_nodes, 3) float32
        Mean plus basis at the light nodes of the texel's own frame, in the
        field's domain; may be negative.

    Raises
    ------
    ShapeError
        If the shapes differ.
    InputError
        If a texel does not exist, or the direction of one that does is no unit vector.
    """
    index, views = _checked(field, texels, "views_world", views_world)
    out = np.zeros((len(index), field.light_side**2, 3), np.float32)
    _light_response(
        field.node_table,
        field.component_weights,
        field.cluster,
        field.local_from_world,
        field.view_side,
        index,
        views,
        out,
    )
    return out


def sum_lights(
    field: ReflectanceField,
    texels: ArrayLike,
    views_world: ArrayLike,
    lights_world: ArrayLike,
    irradiances: ArrayLike,
    lit: NDArray[np.bool_] | None = None,
    indirect: bool = True,
) -> NDArray[np.float32]:
    """Radiance of texels under many distant lights that all texels share.

    Parameters
    ----------
    field : ReflectanceField
        Field to read.
    texels : (n,) int
        Texels; -1 gives zero.
    views_world : (n, 3) float
        Unit vectors to the viewer.
    lights_world : (m, 3) float
        Unit vectors to the lights.
    irradiances : (m, 3) float
        Irradiance of a surface facing each light; for a part of an environment
        its radiance times its solid angle.
    lit : (n, m) bool, optional
        True where light j reaches texel i; all by default. Where it does not, the texel shows
        its indirect light, but for bounced light, which has to be traced.
    indirect : bool
        False leaves texels black under lights that do not reach them.

    Returns
    -------
    (n, 3) float32
        Radiance.

    Raises
    ------
    ShapeError
        If shapes differ.
    InputError
        If a texel does not exist, a direction is no unit vector, or an irradiance is not
        finite.

    Notes
    -----
    Of a clustered field the sum over views is done once for each texel, so a light costs 4
    taps of 3 channels whatever K is. Memory is ``n * field.light_nodes * 12`` bytes: pass
    texels by blocks.
    """
    index, views = _checked(field, texels, "views_world", views_world)
    lights = np.ascontiguousarray(lights_world, np.float32)
    check_shape("lights_world", lights, (None, 3))
    _check_unit("lights_world", lights)
    powers = np.ascontiguousarray(irradiances, np.float32)
    check_shape("irradiances", powers, (len(lights), 3))
    check_finite("irradiances", powers)
    # One row serves all texels when nothing is shadowed.
    reached = np.ones((1, len(lights)), np.bool_) if lit is None else np.ascontiguousarray(lit)
    if lit is not None:
        check_shape("lit", reached, (len(index), len(lights)))
    out = np.zeros((len(index), 3), np.float32)
    _add_direct_light(field, index, views, (lights, powers, reached), out)
    if indirect and lit is not None and not field.indirect.is_black:
        shown = field.indirect.under(index, lights, field.inverse_power)
        dark = ~reached & (index >= 0)[:, None]
        out += np.einsum("nmc,mc,nm->nc", shown, powers, dark, optimize=True)
    return out


def _add_direct_light(
    field: ReflectanceField,
    index: NDArray[np.int32],
    views: NDArray[np.float32],
    lights: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]],
    out: NDArray[np.float32],
) -> None:
    """Add what texels send back of lights: directions, irradiances, which reach them."""
    if isinstance(field, HalfVectorField):
        sum_half_vector_lights(*field.half_vector.arrays, index, views, *lights, out)
        return
    if isinstance(field, TextureField):
        directions, powers, reached = lights
        each = np.broadcast_to(directions, (len(index), *directions.shape))
        out += field.colours[index] * ((field.cosines(index, each) * reached) @ powers)
        out[index < 0] = 0.0
        return
    field = clustered(field)
    _sum_lights(
        light_response(field, index, views),
        field.local_from_world,
        field.light_side,
        field.inverse_power,
        index,
        *lights,
        out,
    )


def _checked(
    field: ReflectanceField, texels: ArrayLike, name: str, directions: ArrayLike
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    index = np.ascontiguousarray(texels, np.int32)
    check_shape("texels", index, (None,))
    vectors = np.ascontiguousarray(directions, np.float32)
    check_shape(name, vectors, (len(index), 3))
    if index.size and not (index.min() >= -1 and index.max() < field.n_texels):
        raise InputError(
            f"texels: expected -1 to {field.n_texels - 1}, received "
            f"{int(index.min())} to {int(index.max())}"
        )
    _check_unit(name, vectors, index >= 0)
    return index, vectors


def _check_unit(
    name: str, vectors: NDArray[np.float32], used: NDArray[np.bool_] | None = None
) -> None:
    """Demand unit vectors of the rows that are used; all by default."""
    squares = np.einsum("nd,nd->n", vectors, vectors)
    off = ~(np.abs(squares - 1.0) <= 2.0 * UNIT_TOLERANCE)
    if used is not None:
        off &= used
    if off.any():
        row = int(off.argmax())
        raise InputError(
            f"{name}: expected unit vectors, received {vectors[row].tolist()} in row {row}; "
            "divide each row by its length"
        )
