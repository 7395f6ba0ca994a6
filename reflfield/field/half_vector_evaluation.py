"""Samples and radiance of half-vector fields."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.field.half_vector_batches import (
    BATCH,
    LIGHT,
    VIEW,
    Floats,
    empty_batch,
    place_batch,
    put_direction,
    put_pairs,
    sample_at,
)
from reflfield.util.single_precision import FAST


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def evaluate_half_vector(
    frames: Floats,
    diffuse: Floats,
    weights: Floats,
    lobes: tuple[Floats, Floats],
    table: Floats,
    texels: NDArray[np.int32],
    views: Floats,
    lights: Floats,
    out: Floats,
) -> None:
    """Samples of texels, each for a pair of directions, added to `out` (n, 3)."""
    batch = empty_batch()
    for first in range(0, len(texels), BATCH):
        n = min(BATCH, len(texels) - first)
        put_pairs(first, n, texels, frames, views, lights, batch)
        place_batch(batch)
        for i in range(n):
            a, t = first + i, texels[first + i]
            if t >= 0:
                red, green, blue = sample_at(i, batch, t, (diffuse, weights), (lobes, table))
                out[a, 0] += red
                out[a, 1] += green
                out[a, 2] += blue


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _add_batch(n: int, batch: Any, pairs: Any, texels: Any, model: Any, of_lights: Any) -> None:
    """Radiance of the pairs of a batch, row and light of each in `pairs` (2, BATCH)."""
    coefficients, tables = model
    irradiances, out = of_lights
    place_batch(batch)
    for i in range(n):
        a, j = pairs[0, i], pairs[1, i]
        red, green, blue = sample_at(i, batch, texels[a], coefficients, tables)
        out[a, 0] += irradiances[j, 0] * red
        out[a, 1] += irradiances[j, 1] * green
        out[a, 2] += irradiances[j, 2] * blue


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def sum_half_vector_lights(
    frames: Floats,
    diffuse: Floats,
    weights: Floats,
    lobes: tuple[Floats, Floats],
    table: Floats,
    texels: NDArray[np.int32],
    views: Floats,
    lights: Floats,
    irradiances: Floats,
    lit: NDArray[np.bool_],
    out: Floats,
) -> None:
    """Radiance of texels under lights that all share, added to `out` (n, 3)."""
    batch, pairs, n = empty_batch(), np.zeros((2, BATCH), np.int64), 0
    model, of_lights = ((diffuse, weights), (lobes, table)), (irradiances, out)
    numbers = batch[0]
    for a in range(len(texels)):
        t = texels[a]
        if t < 0:
            continue
        view = (views[a, 0], views[a, 1], views[a, 2])
        for j in range(len(lights)):
            if not lit[a % len(lit), j]:
                continue
            light = (lights[j, 0], lights[j, 1], lights[j, 2])
            put_direction(numbers, LIGHT + n, frames, t, light)
            put_direction(numbers, VIEW + n, frames, t, view)
            pairs[0, n], pairs[1, n] = a, j
            n += 1
            if n == BATCH:
                _add_batch(n, batch, pairs, texels, model, of_lights)
                n = 0
    _add_batch(n, batch, pairs, texels, model, of_lights)
