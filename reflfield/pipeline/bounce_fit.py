"""Bounced light beside harmonics: its gain, and the harmonics of what it leaves."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from reflfield.field.indirect_light import IndirectLight
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.observations.shade import Shade
from reflfield.observations.stored_shade import StoredShade
from reflfield.pipeline import results
from reflfield.pipeline.context import Context
from reflfield.pipeline.indirect import fitted_to_shade
from reflfield.render.bounced_light import BouncedLight
from reflfield.render.camera_rays import FieldSurface

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

# Below this gain in every channel the capture shows no such light. Where surfaces do light each
# other it is about 1; where a simulation left that out it was below .1.
LEAST_GAIN = 0.3
# Largest gain: noise and light of the surroundings are not the surface's own.
LARGEST_GAIN = 1.5


def with_bounced_light(
    context: Context, field: ReflectanceField, indirect: IndirectLight | None
) -> IndirectLight | None:
    """Indirect light with what a field's surface sends into its own shadows.

    Parameters
    ----------
    context : Context
        With its stage "indirect" done.
    field : ReflectanceField
        As it was fitted.
    indirect : IndirectLight or None
        By harmonics alone; None where shadows are black or not traced.

    Returns
    -------
    IndirectLight or None
        The same where bounced light is not asked for, or the capture does not show it.
    """
    if indirect is None or not context.options.indirect.bounce:
        return indirect
    shade = results.shade(context)
    if not len(shade.texels):
        return indirect
    field.decode()
    workers = max(context.resources.workers, 1)
    traced = BouncedLight(FieldSurface(field), workers)
    if not traced.shares.nnz:
        return indirect
    bounced = _of_shade(context, traced, shade, workers) ** np.float32(1 / field.inverse_power)
    gain = _gain(shade, bounced)
    if (gain < LEAST_GAIN).all():
        return indirect

    def read(rows: Indices) -> Shade:
        of_harmonics = shade.rows(rows)
        return replace(of_harmonics, values=of_harmonics.values - gain * bounced[rows])

    model, coefficients = fitted_to_shade(context, shade, read)
    return IndirectLight(model.functions(), coefficients, gain=gain)


def _of_shade(
    context: Context, traced: BouncedLight, shade: StoredShade, workers: int
) -> Floats:
    """Bounced light as samples where a shade has its own, (n, n_kept, 3)."""
    lit = results.light_visible(context)
    bounced = np.zeros(shade.values.shape, np.float32)
    lights = context.training.lights
    _ = (traced.shares, traced.albedo)

    def under(number: int) -> tuple[Indices, Indices, Floats]:
        row, place = np.nonzero(shade.light == number)
        if not len(row):
            return row, place, np.zeros((0, 3), np.float32)
        return row, place, traced.under(lights[number], lit[:, number])[shade.texels[row]]

    with ThreadPoolExecutor(workers) as pool:
        for row, place, values in pool.map(under, range(len(lights))):
            bounced[row, place] = values
    return bounced


def _gain(shade: StoredShade, bounced: Floats) -> Floats:
    """Least squares of the shade on bounced light, both transformed, channel by channel."""
    used = shade.weights > 0
    known = np.where(used, bounced, 0.0)
    products = (known * shade.values.astype(np.float32)).sum(axis=(0, 1), dtype=np.float64)
    squares = np.square(known, dtype=np.float64).sum(axis=(0, 1))
    gain = products * shade.unit / np.where(squares > 0, squares, 1.0)
    return np.clip(gain, 0.0, LARGEST_GAIN).astype(np.float32)
