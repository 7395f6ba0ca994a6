"""Light in shadows by harmonics alone, for pages, which trace no bounced light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from reflfield.field.indirect_fit import fit_to_shade
from reflfield.field.indirect_light import IndirectLight
from reflfield.field.observed_sphere import fibonacci_directions
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.observations.shade import Shade
from reflfield.render.bounced_light import BouncedLight
from reflfield.render.camera_rays import FieldSurface

# Directions of light that the harmonics are fitted to where the capture states none, and at
# most; functions beside their mean; texels that shape them.
MOST_LIGHTS, N_COMPONENTS, TRAINING_TEXELS = 64, 8, 4096


def baked_indirect(field: ReflectanceField, workers: int = 1) -> IndirectLight:
    """Indirect light of a field whose bounced light is a part of the harmonics.

    Parameters
    ----------
    field : ReflectanceField
    workers : int
        Threads; the result does not depend on their number.

    Returns
    -------
    IndirectLight
        The field's own where it traces no bounced light.
    """
    if not field.indirect.is_traced:
        return field.indirect
    shade = _shown_in_shadows(field, workers)
    rows = np.flatnonzero(shade.weights.any(axis=(1, 2)))

    def read(texels: NDArray[np.intp]) -> Shade:
        return Shade(*(a[texels] for a in (shade.values, shade.weights, shade.lights)))

    n_lights = shade.lights.shape[1]
    model, of_rows = fit_to_shade(
        read, rows, n_lights, N_COMPONENTS, most=TRAINING_TEXELS, workers=workers
    )
    coefficients = np.zeros((field.n_texels, of_rows.shape[1]), np.float32)
    coefficients[rows] = of_rows
    return IndirectLight(model.functions(), coefficients, field.observed_lights)


def _shown_in_shadows(field: ReflectanceField, workers: int) -> Shade:
    """What texels show, transformed, under lights that do not reach them."""
    field.decode()
    surface = FieldSurface(field, max(workers, 1))
    traced, texels = BouncedLight(surface, workers), np.arange(field.n_texels, dtype=np.int32)
    lights = _directions(field)
    positions, normals = surface.texel_points
    lit = np.stack(
        [
            surface.reached_by_light(positions, normals, np.tile(light, (len(texels), 1)))
            for light in lights
        ],
        axis=1,
    )
    bounced = traced.of_distant(lights.astype(np.float32), lit)
    power = field.inverse_power
    shown = field.indirect.under(texels, lights, power, bounced) ** np.float32(1 / power)
    weights = np.repeat(~lit[..., None], 3, axis=2).astype(np.float32)
    everywhere = np.broadcast_to(lights.astype(np.float32), (len(texels), *lights.shape))
    return Shade(shown.astype(np.float32), weights, everywhere)


def _directions(field: ReflectanceField) -> NDArray[np.float64]:
    """Unit directions of lights (m, 3): those of the capture, thinned out, or of a sphere."""
    observed = field.observed_lights
    if observed is None or not len(observed):
        return fibonacci_directions(MOST_LIGHTS)
    places = np.linspace(0, len(observed) - 1, min(len(observed), MOST_LIGHTS))
    return observed[places.astype(np.intp)]
