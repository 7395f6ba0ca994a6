"""Bounced light beside harmonics: its gain, and the harmonics of what it leaves."""

from __future__ import annotations

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
from reflfield.util.blas_threads import thread_pool
from reflfield.util.even_order import even_order

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

# Below this gain in every channel the capture shows no such light. Where surfaces do light each
# other it is about 1; where a simulation left that out it was below .1, and about .3 under a
# flash whose stray light fills the shadows.
LEAST_GAIN = 0.4
# Lights under which the gain is looked at first; then under twice as many, and so on.
LIGHTS_TRIED = 16
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
    traced = BouncedLight(FieldSurface(field), context.resources.workers)
    if not traced.shares.nnz:
        return indirect
    bounced, gain = _as_shown(context, field, traced, shade)
    if (gain < LEAST_GAIN).all():
        return indirect

    def read(rows: Indices) -> Shade:
        of_harmonics = shade.rows(rows)
        return replace(of_harmonics, values=of_harmonics.values - gain * bounced[rows])

    model, coefficients = fitted_to_shade(context, shade, read)
    return IndirectLight(model.functions(), coefficients, gain=gain)


def gain_counts(field: ReflectanceField) -> dict[str, list[float]]:
    """Gain of each channel of bounced light, for the record of a stage; empty without any."""
    if not field.indirect.is_traced:
        return {}
    return {"gain of bounced light": field.indirect.gain.astype(float).round(3).tolist()}


def _as_shown(
    context: Context, field: ReflectanceField, traced: BouncedLight, shade: StoredShade
) -> tuple[Floats, Floats]:
    """Bounced light where a shade has samples, (n, n_kept, 3), and its gain.

    More and more lights are looked at, until their gain is too small, or all are done.
    """
    lights = np.unique(shade.light[shade.weights.any(axis=2)])
    lights = lights[even_order(len(lights))]
    bounced, gain = np.zeros(shade.values.shape, np.float32), np.zeros(3, np.float32)
    transformed, n_done, n_next = bounced, 0, LIGHTS_TRIED
    while n_done < len(lights):
        _add_bounced(context, traced, shade, lights[n_done:n_next], bounced)
        n_done, n_next = n_next, 2 * n_next
        transformed = bounced ** np.float32(1 / field.inverse_power)
        gain = _gain(shade, transformed, lights[:n_done])
        if (gain < LEAST_GAIN).all():
            break
    return transformed, gain


def _add_bounced(
    context: Context,
    traced: BouncedLight,
    shade: StoredShade,
    numbers: Indices,
    bounced: Floats,
) -> None:
    """Add what some lights bring to the bounced light (n, n_kept, 3) of a shade."""
    lit, lights = results.light_visible(context), context.training.lights
    _ = (traced.shares, traced.albedo)

    def under(number: int) -> tuple[Indices, Indices, Floats]:
        row, place = np.nonzero(shade.light == number)
        return row, place, traced.under(lights[number], lit[:, number])[shade.texels[row]]

    with thread_pool(traced.workers) as pool:
        for row, place, values in pool.map(under, numbers.tolist()):
            bounced[row, place] = values


def _gain(shade: StoredShade, bounced: Floats, lights: Indices) -> Floats:
    """Slope of the shade over bounced light, both transformed, channel by channel.

    Samples under some of the lights count.

    What a light brings to all shadows alike, as stray light does, says nothing: only how much
    brighter one texel is than others under it.
    """
    gain, of_lights = np.zeros(3, np.float32), np.isin(shade.light, lights)
    for c in range(3):
        used = shade.weights[..., c] & of_lights
        light = shade.light[used]
        x, y = (a[..., c][used].astype(np.float64) for a in (bounced, shade.values))
        count = np.maximum(np.bincount(light), 1)
        mean = np.bincount(light, x) / count
        squares = np.vdot(x, x) - np.vdot(count, mean**2)
        products = np.vdot(x, y) - np.vdot(mean, np.bincount(light, y))
        if squares > 0:
            gain[c] = np.clip(products * shade.unit / squares, 0.0, LARGEST_GAIN)
    return gain
