"""Samples of the half-vector model for use in kernels, many at a time.

A batch holds up to `BATCH` pairs of directions in their texels' frames, one number of all pairs
after the other, and what they come to in the tables. `place_batch` is a loop without branches
or calls (hence `util.single_precision`), which the compiler turns into vector instructions. A
sample at a time, with calls, would take six times as long.

Kernels fill a batch with `put_pair`, call `place_batch`, and read each pair of it. They pass
whole arrays and indices on: a part of an array is an object whose references are counted, which
takes longer than a sample does.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.field.half_vector import (
    HALF_SIDE,
    KNEE,
    LEAST_COSINE,
    N_DIFFERENCE,
    N_LIGHT,
    N_PHASE,
    N_VIEW,
    REACH,
    SKEW_RINGS,
)
from reflfield.sphere.hemisphere import HORIZON_SOFTNESS
from reflfield.util.single_precision import FAST, angle_of, logarithm

Floats = NDArray[np.float32]

BATCH = 64
# Where the numbers of a batch begin: directions to the light and the viewer in the frame; the
# shares of the upper nodes of lobes (along h_x, h_y and the difference angle), of a skew along
# its rings, the cosine of twice the difference azimuth; the shares of the upper nodes of the
# diffuse table (light, view, phase); s and V of the model's formula.
LIGHT, VIEW, LOBE, RING, AZIMUTH, TABLE, COSINE, SPREAD = (
    BATCH * place for place in (0, 3, 6, 9, 10, 11, 14, 15)
)
N_NUMBERS = 16 * BATCH
# Of the first nodes: of lobes, of a skew, of the diffuse table.
LOBE_NODE, SKEW_NODE, TABLE_NODE = 0, BATCH, 2 * BATCH
N_NODES = 3 * BATCH

_ONE, _ZERO, _TWO = np.float32(1.0), np.float32(0.0), np.float32(2.0)
_HALF_SCALE = np.float32(0.5 * (HALF_SIDE - 1))
_DIFFERENCE_SCALE = np.float32((N_DIFFERENCE - 1) / (np.pi / 2))
_SOFTNESS = np.float32(HORIZON_SOFTNESS)
_SOFT_SCALE = np.float32(1 / (4 * HORIZON_SOFTNESS))
# Keeps the square roots and quotients of zero finite.
_TINY = np.float32(1e-12)

# Kernel helpers are typed by numba; to mypy their scalars are Any.


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _cell(position: Any, n_nodes: int) -> Any:
    """Lower node and share of the upper one."""
    lower = min(max(np.int32(position), np.int32(0)), np.int32(n_nodes - 2))
    return lower, min(max(position - np.float32(lower), _ZERO), _ONE)


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _softened_cosine(z: Any) -> Any:
    """`sphere.hemisphere.softened_cosine`, without branches."""
    foot = max(z + _SOFTNESS, _ZERO)
    return z if z > _SOFTNESS else foot * foot * _SOFT_SCALE


@numba.njit(cache=True, nogil=True)
def empty_batch() -> Any:
    """Numbers and first nodes of a batch, all zero."""
    return np.zeros(N_NUMBERS, np.float32), np.zeros(N_NODES, np.int32)


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def put_direction(numbers: Any, at: Any, frames: Any, t: Any, direction: Any) -> None:
    """Write a direction (three numbers) in the frame of texel t from place `at` on."""
    x, y, z = direction
    for c in range(3):
        numbers[at + BATCH * c] = (
            frames[t, c, 0] * x + frames[t, c, 1] * y + frames[t, c, 2] * z
        )


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def put_pairs(
    first: Any, n: Any, texels: Any, frames: Any, views: Any, lights: Any, batch: Any
) -> None:
    """Write pairs `first` to `first + n` of lists of texels and directions into a batch."""
    numbers = batch[0]
    for i in range(n):
        a, t = first + i, max(texels[first + i], 0)
        put_direction(numbers, LIGHT + i, frames, t, (lights[a, 0], lights[a, 1], lights[a, 2]))
        put_direction(numbers, VIEW + i, frames, t, (views[a, 0], views[a, 1], views[a, 2]))


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def place_batch(batch: Any) -> None:
    """Where the pairs of a batch stand in the tables; its directions stay as they are."""
    numbers, nodes = batch
    for i in range(BATCH):
        lx, ly, lz = (
            numbers[LIGHT + i],
            numbers[LIGHT + BATCH + i],
            numbers[LIGHT + 2 * BATCH + i],
        )
        vx, vy, vz = numbers[VIEW + i], numbers[VIEW + BATCH + i], numbers[VIEW + 2 * BATCH + i]
        hx, hy, hz = lx + vx, ly + vy, lz + vz
        scale = _ONE / np.sqrt(hx * hx + hy * hy + hz * hz + _TINY)
        hx, hy, hz = hx * scale, hy * scale, max(hz * scale, _ZERO)
        sine = np.sqrt(hx * hx + hy * hy)
        cos_difference = min(max(lx * hx + ly * hy + lz * hz, _ZERO), _ONE)
        sin_difference = np.sqrt(_ONE - cos_difference * cos_difference)
        difference = angle_of(sin_difference, cos_difference)
        # The arc hyperbolic sine, 1 at 90 degrees.
        t = angle_of(min(sine, _ONE), hz) / KNEE
        radius = logarithm(t + np.sqrt(t * t + _ONE)) / REACH
        across = radius / (sine + _TINY)
        column, fx = _cell((hx * across + _ONE) * _HALF_SCALE, HALF_SIDE)
        row, fy = _cell((hy * across + _ONE) * _HALF_SCALE, HALF_SIDE)
        layer, fd = _cell(difference * _DIFFERENCE_SCALE, N_DIFFERENCE)
        ring, fr = _cell(radius * np.float32(SKEW_RINGS - 1), SKEW_RINGS)
        nodes[LOBE_NODE + i] = (layer * HALF_SIDE + row) * HALF_SIDE + column
        nodes[SKEW_NODE + i] = layer * SKEW_RINGS + ring
        numbers[LOBE + i] = fx
        numbers[LOBE + BATCH + i] = fy
        numbers[LOBE + 2 * BATCH + i] = fd
        numbers[RING + i] = fr
        # l_z - v_z is 2 sin(theta_h) sin(theta_d) cos(phi_d).
        sines = sine * sin_difference
        turn = (lz - vz) * (lz - vz) / (_TWO * sines * sines + _TINY) - _ONE
        numbers[AZIMUTH + i] = min(turn, _ONE)
        cos_light, cos_view = min(max(lz, _ZERO), _ONE), min(max(vz, LEAST_COSINE), _ONE)
        column, fx = _cell(cos_light * np.float32(N_LIGHT - 1), N_LIGHT)
        row, fy = _cell(cos_view * np.float32(N_VIEW - 1), N_VIEW)
        layer, fd = _cell((_ONE - cos_difference) * np.float32(N_PHASE - 1), N_PHASE)
        nodes[TABLE_NODE + i] = (layer * N_VIEW + row) * N_LIGHT + column
        numbers[TABLE + i] = fx
        numbers[TABLE + BATCH + i] = fy
        numbers[TABLE + 2 * BATCH + i] = fd
        raised = max(cos_light, LEAST_COSINE)
        numbers[COSINE + i] = _softened_cosine(lz)
        numbers[SPREAD + i] = _ONE / (raised + cos_view - raised * cos_view)


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def corner_shares(fx: Any, fy: Any, fz: Any) -> Any:
    """Shares of the eight corners of a cell; the first changes fastest."""
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    a, b, c, d = gx * gy, fx * gy, gx * fy, fx * fy
    return a * gz, b * gz, c * gz, d * gz, a * fz, b * fz, c * fz, d * fz


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def diffuse_at(i: Any, batch: Any, table: Any) -> Any:
    """Diffuse table at pair i of a batch, without the light's cosine."""
    numbers, nodes = batch
    at = TABLE + i
    s = corner_shares(numbers[at], numbers[at + BATCH], numbers[at + 2 * BATCH])
    a = np.uint32(nodes[TABLE_NODE + i])
    b = a + np.uint32(N_LIGHT)
    c = a + np.uint32(N_LIGHT * N_VIEW)
    d = c + np.uint32(N_LIGHT)
    one = np.uint32(1)
    near = s[0] * table[a] + s[1] * table[a + one] + s[2] * table[b] + s[3] * table[b + one]
    far = s[4] * table[c] + s[5] * table[c + one] + s[6] * table[d] + s[7] * table[d + one]
    return near + far


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def lobe_place(i: Any, batch: Any) -> Any:
    """First node of pair i of a batch in lobes, and the shares of its eight corners."""
    numbers, nodes = batch
    at = LOBE + i
    shares = corner_shares(numbers[at], numbers[at + BATCH], numbers[at + 2 * BATCH])
    return np.uint32(nodes[LOBE_NODE + i]), shares


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def skew_place(i: Any, batch: Any) -> Any:
    """First node of pair i in skews; shares of its four corners times the azimuth's cosine."""
    numbers, nodes = batch
    fr, fd, turn = numbers[RING + i], numbers[LOBE + 2 * BATCH + i], numbers[AZIMUTH + i]
    gr, gd = _ONE - fr, (_ONE - fd) * turn
    fd = fd * turn
    return np.uint32(nodes[SKEW_NODE + i]), (gr * gd, fr * gd, gr * fd, fr * fd)


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def interpolated(place: Any, lobes: Any, k: Any, c: Any) -> Any:
    """One channel of a lobe (K, nodes, 3) at a place."""
    a, s = place
    b = a + np.uint32(HALF_SIDE)
    x = a + np.uint32(HALF_SIDE * HALF_SIDE)
    y = x + np.uint32(HALF_SIDE)
    one = np.uint32(1)
    near = s[0] * lobes[k, a, c] + s[1] * lobes[k, a + one, c]
    near += s[2] * lobes[k, b, c] + s[3] * lobes[k, b + one, c]
    far = s[4] * lobes[k, x, c] + s[5] * lobes[k, x + one, c]
    return near + far + (s[6] * lobes[k, y, c] + s[7] * lobes[k, y + one, c])


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def skew_at(place: Any, skews: Any, k: Any, c: Any) -> Any:
    """What the difference azimuth makes of one channel of a lobe, as a factor."""
    a, s = place
    b = a + np.uint32(SKEW_RINGS)
    one = np.uint32(1)
    near = s[0] * skews[k, a, c] + s[1] * skews[k, a + one, c]
    return _ONE + near + (s[2] * skews[k, b, c] + s[3] * skews[k, b + one, c])


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def lobe_at(lobe: Any, skew: Any, tables: Any, k: Any, c: Any) -> Any:
    """One channel of a lobe at `lobe_place` and `skew_place`."""
    nodes, skews = tables
    return interpolated(lobe, nodes, k, c) * skew_at(skew, skews, k, c)


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def lobes_into(part: Any, i: Any, batch: Any, tables: Any) -> None:
    """Lobes at pair i of a batch times cosine and spread, into `part` (K, 3)."""
    factor = batch[0][COSINE + i] * batch[0][SPREAD + i]
    lobe, skew = lobe_place(i, batch), skew_place(i, batch)
    for k in range(part.shape[0]):
        for c in range(3):
            part[k, c] = factor * lobe_at(lobe, skew, tables, k, c)


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def sample_at(i: Any, batch: Any, t: Any, coefficients: Any, tables: Any) -> Any:
    """Sample (three numbers) of texel t for pair i of a batch that has been placed."""
    diffuse, weights = coefficients
    lobes, table = tables
    numbers = batch[0]
    cosine = numbers[COSINE + i]
    base, factor = cosine * diffuse_at(i, batch, table), cosine * numbers[SPREAD + i]
    red, green, blue = base * diffuse[t, 0], base * diffuse[t, 1], base * diffuse[t, 2]
    lobe, skew = lobe_place(i, batch), skew_place(i, batch)
    for k in range(weights.shape[1]):
        weight = factor * weights[t, k]
        red += weight * lobe_at(lobe, skew, lobes, k, 0)
        green += weight * lobe_at(lobe, skew, lobes, k, 1)
        blue += weight * lobe_at(lobe, skew, lobes, k, 2)
    return red, green, blue
