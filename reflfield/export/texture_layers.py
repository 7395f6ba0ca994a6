"""Frames and coefficients of a field as layers of one OpenEXR image in texture space.

======================  =====================================================================
channels                what
======================  =====================================================================
``R G B``               sample for view and light along the normal, 1/sr, linear
``A``                   1 where there is a texel, 0 between charts
``normal.X .Y .Z``      unit normal of the texel's frame, world
``tangent.X .Y .Z``     unit tangent of the texel's frame, world
``position.X .Y .Z``    point of the surface, world, the unit of the capture
``diffuse.R .G .B``     half-vector fields: diffuse colour, 1/sr
``weight.1``, ...       half-vector fields: weights of the lobes
``cluster.Y``           clustered fields: number of the cluster
``coefficient.1``, ...  clustered fields: coefficients in the field's domain
======================  =====================================================================
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.image_writing import write_exr
from reflfield.field.evaluation import evaluate
from reflfield.field.reflectance_field import (
    ClusteredField,
    HalfVectorField,
    ReflectanceField,
)
from reflfield.render.camera_rays import FieldSurface

Floats = NDArray[np.floating]


def texture_layers(field: ReflectanceField) -> dict[str, Floats]:
    """Values of every texel, by channel."""
    frames, texels = field.local_from_world, np.arange(field.n_texels)
    normals = np.ascontiguousarray(frames[:, 2])
    samples = evaluate(field, texels, normals, normals)
    positions, _ = FieldSurface(field).texel_points
    layers = dict(zip("RGB", samples.T, strict=True))
    layers["A"] = np.ones(field.n_texels, np.float32)
    for name, vectors in (
        ("normal", normals),
        ("tangent", frames[:, 0]),
        ("position", positions),
    ):
        layers |= {f"{name}.{axis}": v for axis, v in zip("XYZ", vectors.T, strict=True)}
    return layers | _coefficients(field)


def _coefficients(field: ReflectanceField) -> dict[str, Floats]:
    if isinstance(field, HalfVectorField):
        model = field.half_vector
        colours = zip("RGB", model.diffuse.T, strict=True)
        layers: dict[str, Floats] = {f"diffuse.{name}": value for name, value in colours}
        return layers | {f"weight.{k}": w for k, w in enumerate(model.weights.T, 1)}
    if isinstance(field, ClusteredField):
        clusters = {"cluster.Y": field.cluster.astype(np.float32)}
        return clusters | {f"coefficient.{k}": c for k, c in enumerate(field.coefficients.T, 1)}
    return {}


def write_texture_layers(path: Path, field: ReflectanceField) -> list[str]:
    """Write the image; returns a line with its channels."""
    layers = texture_layers(field)
    values = np.stack(list(layers.values()), axis=1).astype(np.float32)
    texels = field.texel_of_pixel
    image = np.where(texels[..., None] >= 0, values[np.maximum(texels, 0)], np.float32(0.0))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, image, list(layers))
    return [f"channels: {' '.join(layers)}"]
