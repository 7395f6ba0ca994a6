"""From a fitted half-vector model to a field: cube roots in steps, delta-coded colours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.field.array_schemas import check_arrays
from reflfield.field.build import (
    FINEST_SHARE,
    FINEST_TURN,
    BaseSurface,
    Quantisation,
    indirect_arrays,
    surface_arrays,
)
from reflfield.field.half_vector import SKEW_STEP, HalfVectorModel
from reflfield.field.indirect_light import IndirectLight
from reflfield.field.quantisation import check_finite, codes_from_rotations, smallest_codes
from reflfield.field.reflectance_field import Domain, HalfVectorField, Visibility, check_options

# Step of the frames where numbers are quantised at all, radians.
COARSE_TURN = 0.006
# Lobes are shared by all texels: their steps are a share of that of a texel's numbers.
LOBE_STEP_SHARE = 0.25
# Quantile of a lobe over its nodes, whose root turns a step of a sample into one of weights.
PEAK_QUANTILE = 0.999


def build_half_vector_field(
    surface: BaseSurface,
    model: HalfVectorModel,
    indirect: IndirectLight | None = None,
    *,
    domain: Domain = "cube_root",
    visibility: Visibility = "kept",
    metadata: Mapping[str, Any] | None = None,
    quantisation: Quantisation | None = None,
) -> HalfVectorField:
    """Quantise a half-vector model on a surface into a field.

    Parameters
    ----------
    surface : BaseSurface
    model : HalfVectorModel
        In 1/sr.
    indirect : IndirectLight, optional
        What texels show in traced shadows.
    domain : {"cube_root", "square_root", "linear"}
        Of the indirect light.
    visibility : {"kept", "factored"}
    metadata : mapping, optional
        Plain JSON values.
    quantisation : Quantisation, optional
        Its step is that of cube roots of samples.

    Returns
    -------
    HalfVectorField

    Raises
    ------
    InputError
        If a number is not finite or a frame is no rotation.
    """
    for name in ("diffuse", "weights", "lobes", "skews", "diffuse_table"):
        check_finite(name, getattr(model, name))
    bits = quantisation or Quantisation()
    arrays = surface_arrays(surface) | _model_arrays(model, bits)
    arrays |= indirect_arrays(indirect, model.n_texels, bits.step)
    check_arrays(
        {name: (a.dtype.name, a.shape) for name, a in arrays.items()}, HalfVectorField.model
    )
    built = HalfVectorField(
        arrays=arrays,
        domain=domain,
        visibility=visibility,
        light_model="known",
        metadata=dict(metadata or {}),
    )
    check_options(built.domain, built.visibility, built.light_model, built.model)
    for name in ("positions", "uv", "faces", "texel_of_pixel", "half_vector"):
        getattr(built, name)
    return built


def _model_arrays(model: HalfVectorModel, bits: Quantisation) -> dict[str, NDArray[Any]]:
    color = np.cbrt(model.diffuse.astype(np.float64))
    lobes = np.moveaxis(np.cbrt(model.lobes.astype(np.float64)), 0, 1)
    size = max(float(color.max(initial=0.0)), float(lobes.max(initial=0.0)))
    step = bits.step or FINEST_SHARE * size or 1.0
    peak = np.quantile(lobes.max(axis=2), PEAK_QUANTILE, axis=0)
    weights = np.cbrt(model.weights.astype(np.float64))
    weight_step = np.maximum(step / np.where(peak > 0, peak, 1.0), FINEST_SHARE)
    lobe_step = np.full(model.n_lobes, max(LOBE_STEP_SHARE * step, FINEST_SHARE * size))
    red, green, blue = np.rint(color / np.float32(step)).T
    turn = np.deg2rad(bits.turn_deg) or (COARSE_TURN if bits.step else FINEST_TURN)
    return {
        "turns": codes_from_rotations(model.frames, turn),
        "turn_step": np.array([turn], np.float32),
        "diffuse": _codes(np.stack([green, red - green, blue - green], axis=1)),
        "diffuse_scale": np.array([step], np.float32),
        "lobe_weights": _codes(np.rint(weights / weight_step.astype(np.float32))),
        "lobe_weight_scale": weight_step.astype(np.float32),
        "lobes": _codes(np.rint(lobes / lobe_step.astype(np.float32)[:, None])),
        "lobe_scale": lobe_step.astype(np.float32),
        "lobe_skews": np.rint(model.skews / SKEW_STEP).astype(np.int8),
        "diffuse_table": np.ascontiguousarray(model.diffuse_table, np.float32),
    }


def _codes(rounded: NDArray[np.float64]) -> NDArray[Any]:
    return smallest_codes(rounded.astype(np.int32))
