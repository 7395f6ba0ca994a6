r"""Refinement of frames against the model that is fitted to the samples.

A sample y of a texel is modelled as :math:`D(y) = g(l)\, u(v, l)`: D the transform (cube
root), u the texel's own function (mean, basis and coefficients), :math:`g = s^{1/p}` the
transformed softened cosine s, p the power of the inverse transform. A rotation of the texel's
frame moves its views v and lights l over the nodes. Gauss-Newton steps minimise the squared
differences, as the fit does; the texel's gain is free, and a Gaussian prior holds the frame
to the one given.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.gauss_newton import hold, rotate_left, solve_step
from reflfield.alignment.rotation_steps import copy_matrix
from reflfield.alignment.rotation_steps import scale_vector as shrink
from reflfield.alignment.spline_targets import FAST
from reflfield.field.clustered_model import ClusteredModel
from reflfield.observations.texel_reading import TexelReader
from reflfield.observations.texel_samples import POWERS, transform
from reflfield.sphere.hemisphere import place_directions, softened_cosine_of
from reflfield.util.validation import check_shape

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

STEPS = 3
# Half of the step that the cosine's slope is differenced over: the softened band is 80 wide.
COSINE_STEP = 1e-3


@numba.njit(cache=True, nogil=True)
def _own_function(table: Floats, coefficients: Floats, out: Doubles) -> None:
    """Mean and basis (view nodes, light nodes, (K + 1) * 3) with one texel's coefficients."""
    for v in range(table.shape[0]):
        for m in range(table.shape[1]):
            for c in range(3):
                out[v, m, c] = table[v, m, c]
                for k in range(coefficients.shape[0]):
                    out[v, m, c] += coefficients[k] * table[v, m, 3 * (k + 1) + c]


@numba.njit(cache=True, nogil=True)
def _gains(lights: Doubles, frame: Doubles, power: float, side: int, gains: Doubles) -> None:
    """Softened cosine ** (1 / power) of each light, and its slope by turns about x and y."""
    for j in range(lights.shape[0]):
        gains[j, 0], gains[j, 1], gains[j, 2] = 1.0, 0.0, 0.0
        if side == 1:
            continue
        x, y, z = 0.0, 0.0, 0.0
        for k in range(3):
            x += frame[0, k] * lights[j, k]
            y += frame[1, k] * lights[j, k]
            z += frame[2, k] * lights[j, k]
        upper = softened_cosine_of(z + COSINE_STEP) ** (1.0 / power)
        lower = softened_cosine_of(z - COSINE_STEP) ** (1.0 / power)
        slope = (upper - lower) / (2.0 * COSINE_STEP)
        # Turning by w moves d by w x d: z by w_x y - w_y x.
        gains[j, 0] = softened_cosine_of(z) ** (1.0 / power)
        gains[j, 1], gains[j, 2] = slope * y, -slope * x


@numba.njit(cache=True, nogil=True)
def _at_view(nodes: Doubles, node: int, side: int, s: float, t: float, out: Doubles) -> None:
    """Function of the light nodes at one view: interpolated, and differentiated in s and t."""
    right, up = (1, side) if side > 1 else (0, 0)
    for m in range(nodes.shape[1]):
        for c in range(3):
            p0, p1 = nodes[node, m, c], nodes[node + right, m, c]
            p2, p3 = nodes[node + up, m, c], nodes[node + up + right, m, c]
            low, high = p0 + s * (p1 - p0), p2 + s * (p3 - p2)
            out[0, m, c] = low + t * (high - low)
            out[1, m, c] = (1.0 - t) * (p1 - p0) + t * (p3 - p2)
            out[2, m, c] = high - low


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _add_sample(
    value: float,
    at_view: Doubles,
    corners: tuple[int, int, int, int],
    channel: int,
    view_place: Doubles,
    light_place: Doubles,
    gains: Doubles,
    scale: float,
    jacobian: Doubles,
    normal: Doubles,
) -> None:
    """Add one value to the normal equations of (turn, log gain)."""
    s, t = light_place[0], light_place[1]
    w0, w1, w2, w3 = (1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t
    a, b, c, d = corners
    p0, p1 = at_view[0, a, channel], at_view[0, b, channel]
    p2, p3 = at_view[0, c, channel], at_view[0, d, channel]
    u = w0 * p0 + w1 * p1 + w2 * p2 + w3 * p3
    in_s, in_t = (1 - t) * (p1 - p0) + t * (p3 - p2), (1 - s) * (p2 - p0) + s * (p3 - p1)
    view_s = w0 * at_view[1, a, channel] + w1 * at_view[1, b, channel]
    view_s += w2 * at_view[1, c, channel] + w3 * at_view[1, d, channel]
    view_t = w0 * at_view[2, a, channel] + w1 * at_view[2, b, channel]
    view_t += w2 * at_view[2, c, channel] + w3 * at_view[2, d, channel]
    for k in range(3):
        slope = view_s * view_place[2 + k] + view_t * view_place[5 + k]
        slope += in_s * light_place[2 + k] + in_t * light_place[5 + k]
        jacobian[k] = scale * gains[0] * slope
    jacobian[0] += scale * gains[1] * u
    jacobian[1] += scale * gains[2] * u
    jacobian[3] = scale * gains[0] * u
    jacobian[4] = value - jacobian[3]
    for n in range(5):
        for m in range(n + 1):
            normal[n, m] += jacobian[n] * jacobian[m]
    normal[0, 4] += 1.0


@numba.njit(cache=True, nogil=True)
def _add_texel(
    values: Floats,
    nodes: Doubles,
    counts: tuple[Bools, Bools, Bools],
    taps: tuple[Ints, Ints],
    places: tuple[Doubles, Doubles],
    gains: Doubles,
    sides: tuple[int, int],
    scale: float,
    normal: Doubles,
) -> None:
    """Add one texel's samples: those of seen views, seen lights and photographed pairs.

    NaN was not measured.
    """
    at_view, jacobian = np.zeros((3, nodes.shape[1], 3)), np.zeros(5)
    right, up = (1, sides[1]) if sides[1] > 1 else (0, 0)
    for i in range(values.shape[0]):
        if taps[0][i] < 0 or not counts[0][i]:
            continue
        of_view = places[0][i]
        _at_view(nodes, taps[0][i], sides[0], of_view[0], of_view[1], at_view)
        for j in range(values.shape[1]):
            if taps[1][j] < 0 or not (counts[1][j] and counts[2][i, j]):
                continue
            first = taps[1][j]
            corners = (first, first + right, first + up, first + up + right)
            for c in range(3):
                if np.isnan(values[i, j, c]):
                    continue
                _add_sample(
                    values[i, j, c],
                    at_view,
                    corners,
                    c,
                    of_view,
                    places[1][j],
                    gains[j],
                    scale,
                    jacobian,
                    normal,
                )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _refine_texel(
    values: Floats,
    directions: tuple[Doubles, Doubles],
    counts: tuple[Bools, Bools, Bools],
    nodes: Doubles,
    sides: tuple[int, int],
    power: float,
    spread: float,
    best: Doubles,
) -> None:
    """Turn one frame, `best`, by `STEPS` steps; a step that does not help is shortened."""
    n_views, n_lights = values.shape[0], values.shape[1]
    taps = (np.zeros(n_views, np.int64), np.zeros(n_lights, np.int64))
    places = (np.zeros((n_views, 8)), np.zeros((n_lights, 8)))
    gains, normal, step = np.zeros((n_lights, 3)), np.zeros((5, 5)), np.zeros(4)
    frame, start, turn = best.copy(), best.copy(), np.zeros((3, 3))
    least, strength, scale, factor = np.inf, 0.0, 1.0, 1.0
    for n in range(STEPS + 1):
        normal[:] = 0.0
        place_directions(directions[0], frame, sides[0], taps[0], places[0])
        place_directions(directions[1], frame, sides[1], taps[1], places[1])
        _gains(directions[1], frame, power, sides[1], gains)
        _add_texel(values, nodes, counts, taps, places, gains, sides, scale * factor, normal)
        if n == 0:
            strength = normal[4, 4] / max(normal[0, 4] - 4.0, 1.0) / (spread * spread)
        hold(frame, start, strength, normal)
        cost = normal[4, 4] / max(normal[0, 4], 1.0)
        if cost < least:
            least = cost
            scale *= factor
            copy_matrix(frame, best)
            if not solve_step(normal, step):
                break
        else:
            shrink(step, 4, 0.25)
        rotate_left(best, step, turn, frame)
        factor = np.exp(step[3])


@numba.njit(cache=True, nogil=True)
def _refine(
    values: Floats,
    directions: tuple[Doubles, Doubles],
    seen: tuple[Bools, Bools],
    pairs: Bools,
    table: Floats,
    cluster: NDArray[np.int32],
    coefficients: Floats,
    sides: tuple[int, int],
    power: float,
    spread: float,
    frames: Doubles,
) -> None:
    nodes = np.zeros((table.shape[1], table.shape[2], 3))
    for i in range(values.shape[0]):
        _own_function(table[cluster[i]], coefficients[i], nodes)
        _refine_texel(
            values[i],
            (directions[0][i], directions[1][i]),
            (seen[0][i], seen[1][i], pairs),
            nodes,
            sides,
            power,
            spread,
            frames[i],
        )


def refined_frames(
    reader: TexelReader, model: ClusteredModel, texels: NDArray[np.intp], spread: float
) -> Floats:
    """Rotate frames of texels to where a model explains their samples better.

    Parameters
    ----------
    reader : TexelReader
        Samples, and the frames to begin with.
    model : ClusteredModel
        Fitted in these frames.
    texels : (k,) int
        Texels that have samples.
    spread : float
        Standard deviation of the given frames about the true ones, each axis, radians.

    Returns
    -------
    (k, 3, 3) float32
        `local_from_world` of these texels.

    Raises
    ------
    ShapeError
        If the model has other nodes than the reader's grids.

    Notes
    -----
    The prior weighs against the samples by the texel's own mean squared residual. Samples
    within a degree of the frame's horizon, or below it, are excluded.
    """
    n_nodes = (reader.sides[0] ** 2, reader.sides[1] ** 2)
    check_shape("model.table", model.table, (None, *n_nodes, None))
    measured = reader.measured(texels)
    unit = np.float32(measured.unit)
    samples = measured.pairs.as_product(measured.samples.astype(np.float32) * unit, 0.0)
    frames = reader.local_from_world[texels].astype(np.float64)
    _refine(
        transform(samples, reader.options.domain),
        (measured.views.astype(np.float64), measured.lights.astype(np.float64)),
        (measured.view_seen, measured.light_seen),
        measured.pairs.table,
        model.table,
        model.cluster[texels],
        model.coefficients[texels],
        reader.sides,
        POWERS[reader.options.domain],
        spread,
        frames,
    )
    return frames.astype(np.float32)
