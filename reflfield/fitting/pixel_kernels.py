"""Kernels of the fit to photographs: derivatives of samples, and sums over pixels and lights.

All lights of a texel or a pixel lie one after the other, channels last, so that the loops over
them are vector instructions. A product with the normal matrix goes from texels to what they
show under each light, to pixels, back to texels, and from there to their unknowns: what a
texel shows is computed once, however many pixels it lies under.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from reflfield.field.half_vector_batches import (
    BATCH,
    COSINE,
    LIGHT,
    SPREAD,
    VIEW,
    diffuse_at,
    empty_batch,
    lobe_at,
    lobe_place,
    place_batch,
    put_direction,
    sample_at,
    skew_place,
)
from reflfield.fitting.robust_weights import HUBER, is_evidence, squared_weight
from reflfield.util.single_precision import FAST

# Half of the step by which rotations are differenced, radians: highlights are a few degrees
# wide, and the tables bilinear between nodes a degree apart.
HALF_ANGLE = np.float32(0.008)
# Rotations about the texel's own axes: two tilts and the turn about the normal.
N_ROTATIONS = 3

_ZERO = np.float32(0.0)
_PER_STEP = np.float32(1 / (2 * float(HALF_ANGLE)))


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _is_known(values: Any, pixel: Any, j: Any) -> Any:
    """Whether any channel is measured."""
    red, green, blue = values[pixel, j, 0], values[pixel, j, 1], values[pixel, j, 2]
    return not (np.isnan(red) and np.isnan(green) and np.isnan(blue))


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def mark_used(geometry: Any, values: Any, used: Any) -> None:
    """Mark the texels and lights (m, n_lights) that some value needs."""
    first, entry, _ = geometry
    for pixel in range(values.shape[0]):
        for j in range(values.shape[1]):
            if _is_known(values, pixel, j):
                for e in range(first[pixel], first[pixel + 1]):
                    used[entry[e], j] = True


# --- derivatives ------------------------------------------------------------------------------


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _turn(own: Any, axis: int, angle: Any, numbers: Any) -> None:
    """Directions of a batch in frames rotated about one of their own axes."""
    c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    i, j = BATCH * ((axis + 1) % 3), BATCH * ((axis + 2) % 3)
    for start in (LIGHT, VIEW):
        for n in range(start, start + BATCH):
            x, y = own[n + i], own[n + j]
            numbers[n + BATCH * axis] = own[n + BATCH * axis]
            numbers[n + i] = c * x - s * y
            numbers[n + j] = s * x + c * y


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _by_coefficients(n: int, batch: Any, pairs: Any, tables: Any, out: Any) -> None:
    """Derivatives by colours and weights of the pairs of a batch."""
    lobes, table = tables
    by_diffuse, others = out
    numbers = batch[0]
    for i in range(n):
        row, j = pairs[0, i], pairs[1, i]
        by_diffuse[row, j] = numbers[COSINE + i] * diffuse_at(i, batch, table)
        factor = numbers[COSINE + i] * numbers[SPREAD + i]
        lobe, skew = lobe_place(i, batch), skew_place(i, batch)
        for k in range(lobes[0].shape[0]):
            for c in range(3):
                others[row, k, j, c] = factor * lobe_at(lobe, skew, lobes, k, c)


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _add_samples(
    n: int, batch: Any, pairs: Any, texels: Any, model: Any, scale: Any, axis: int, others: Any
) -> None:
    """Add samples of a batch in turned frames, times a scale, to derivatives by a rotation."""
    coefficients, tables = model
    place_batch(batch)
    for i in range(n):
        row, j = pairs[0, i], pairs[1, i]
        u = others.shape[1] - N_ROTATIONS + axis
        red, green, blue = sample_at(i, batch, texels[row], coefficients, tables)
        others[row, u, j, 0] += scale * red
        others[row, u, j, 1] += scale * green
        others[row, u, j, 2] += scale * blue


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _derive_batch(
    n: int, own: Any, batch: Any, pairs: Any, texels: Any, model: Any, out: Any
) -> None:
    """All derivatives of the pairs of a batch, whose directions are `own`."""
    numbers = batch[0]
    numbers[: len(own)] = own
    place_batch(batch)
    _by_coefficients(n, batch, pairs, model[1], out)
    for axis in range(N_ROTATIONS):
        _turn(own, axis, HALF_ANGLE, numbers)
        _add_samples(n, batch, pairs, texels, model, _PER_STEP, axis, out[1])
        _turn(own, axis, -HALF_ANGLE, numbers)
        _add_samples(n, batch, pairs, texels, model, -_PER_STEP, axis, out[1])


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def derive(texels: Any, views: Any, lights: Any, used: Any, model: Any, out: Any) -> None:
    """Derivatives of samples by colours, and by weights and rotations (zero before)."""
    frames, diffuse, weights, lobes, table = model
    shared = ((diffuse, weights), (lobes, table))
    batch, pairs, n = empty_batch(), np.zeros((2, BATCH), np.int64), 0
    own = np.zeros(6 * BATCH, np.float32)
    for row in range(len(texels)):
        t = texels[row]
        view = (views[row, 0], views[row, 1], views[row, 2])
        for j in range(lights.shape[1]):
            if not used[row, j]:
                continue
            light = (lights[row, j, 0], lights[row, j, 1], lights[row, j, 2])
            put_direction(own, LIGHT + n, frames, t, light)
            put_direction(own, VIEW + n, frames, t, view)
            pairs[0, n], pairs[1, n] = row, j
            n += 1
            if n == BATCH:
                _derive_batch(n, own, batch, pairs, texels, shared, out)
                n = 0
    _derive_batch(n, own, batch, pairs, texels, shared, out)


# --- products ---------------------------------------------------------------------------------


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def texels_shown(x: Any, by_diffuse: Any, others: Any, shown: Any) -> None:
    """What changes x (m, 3 + U) of the unknowns show, into `shown` (m, n_lights * 3).

    `others` are the derivatives by all unknowns but the colours, (m, U, n_lights * 3).
    """
    n_lights = by_diffuse.shape[1]
    for row in range(shown.shape[0]):
        red, green, blue = x[row, 0], x[row, 1], x[row, 2]
        for j in range(n_lights):
            shown[row, 3 * j] = red * by_diffuse[row, j]
            shown[row, 3 * j + 1] = green * by_diffuse[row, j]
            shown[row, 3 * j + 2] = blue * by_diffuse[row, j]
        for u in range(others.shape[1]):
            change = x[row, 3 + u]
            for i in range(3 * n_lights):
                shown[row, i] += change * others[row, u, i]


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def add_to_unknowns(shown: Any, by_diffuse: Any, others: Any, power: int, y: Any) -> None:
    """Adjoint of `texels_shown`: add what (m, n_lights * 3) weighs of the unknowns to y.

    Derivatives count as they are at a power of 1, with their squares at 2.
    """
    n_lights = by_diffuse.shape[1]
    for row in range(shown.shape[0]):
        red, green, blue = _ZERO, _ZERO, _ZERO
        for j in range(n_lights):
            factor = by_diffuse[row, j]
            if power == 2:
                factor *= factor
            red += shown[row, 3 * j] * factor
            green += shown[row, 3 * j + 1] * factor
            blue += shown[row, 3 * j + 2] * factor
        y[row, 0] += red
        y[row, 1] += green
        y[row, 2] += blue
        for u in range(others.shape[1]):
            total = _ZERO
            for i in range(3 * n_lights):
                factor = others[row, u, i]
                if power == 2:
                    factor *= factor
                total += shown[row, i] * factor
            y[row, 3 + u] += total


@numba.njit(cache=True, nogil=True)
def add_rows(rows: Any, part: Any, total: Any) -> None:
    """Add rows (m, U) of single precision to some rows of a total in double precision."""
    for i in range(len(rows)):
        for u in range(part.shape[1]):
            total[rows[i], u] += part[i, u]


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _pixel_shown(pixel: Any, geometry: Any, shown: Any, out: Any) -> None:
    """What the texels under a pixel show, by their shares, into `out` (n_lights * 3)."""
    first, entry, share = geometry
    out[:] = _ZERO
    for e in range(first[pixel], first[pixel + 1]):
        row, part = entry[e], share[e]
        for i in range(len(out)):
            out[i] += part * shown[row, i]


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _add_to_texels(pixel: Any, geometry: Any, values: Any, power: int, out: Any) -> None:
    """Add values of a pixel to the texels under it, times their shares or their squares."""
    first, entry, share = geometry
    for e in range(first[pixel], first[pixel + 1]):
        row, part = entry[e], share[e]
        if power == 2:
            part *= part
        for i in range(len(values)):
            out[row, i] += part * values[i]


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def weigh_through_pixels(geometry: Any, weight: Any, shown: Any, out: Any) -> None:
    """Add to texels what pixels show of them times the weights (n_pixels, n_lights * 3)."""
    of_pixel = np.zeros(shown.shape[1], np.float32)
    for pixel in range(weight.shape[0]):
        _pixel_shown(pixel, geometry, shown, of_pixel)
        for i in range(len(of_pixel)):
            of_pixel[i] *= weight[pixel, i]
        _add_to_texels(pixel, geometry, of_pixel, 1, out)


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _weigh_pixel(pixel: Any, observed: Any, shown: Any, weight: Any) -> Any:
    """Weights of a pixel; `shown` becomes the weighted residual; its square, and the count."""
    values, at_least = observed
    error, count = _ZERO, np.int32(0)
    for i in range(len(shown)):
        value, predicted = values[pixel, i], shown[i]
        counts = is_evidence(value, at_least[pixel, i], predicted)
        # No branches: a value that does not count may be NaN, and so may what follows of it.
        w = squared_weight(value, predicted, HUBER)
        weight[pixel, i] = w if counts else _ZERO
        shown[i] = w * (value - predicted) if counts else _ZERO
        error += shown[i] * (value - predicted) if counts else _ZERO
        count += np.int32(counts)
    return error, count


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def start_step(geometry: Any, observed: Any, shown: Any, weight: Any, sums: Any) -> Any:
    """Weights (zero before) of pixels from what their texels show; sums for the texels.

    `sums` are the weighted residuals by shares, and the weights by squared shares, both
    (m, n_lights * 3). Returns the sum of weighted squares, and how many values count.
    """
    residuals, squares = sums
    of_pixel, own_weight = np.zeros(shown.shape[1], np.float32), np.zeros_like(shown[0])
    error, count = 0.0, 0
    for pixel in range(weight.shape[0]):
        _pixel_shown(pixel, geometry, shown, of_pixel)
        of_value = _weigh_pixel(pixel, observed, of_pixel, weight)
        error += of_value[0]
        count += of_value[1]
        _add_to_texels(pixel, geometry, of_pixel, 1, residuals)
        own_weight[:] = weight[pixel]
        _add_to_texels(pixel, geometry, own_weight, 2, squares)
    return error, count
