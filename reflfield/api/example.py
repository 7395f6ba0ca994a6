"""A field of known reflectance, to try things on without a capture."""

from __future__ import annotations

import numpy as np

from reflfield.api.fields import Field
from reflfield.field.build import BaseSurface, FittedReflectance, build_field
from reflfield.sphere.hemisphere import HemisphereGrid

# Nodes along a side of the grids of views and of lights; texels along a side of the square.
NODES, TEXELS = 9, 8


def example_field() -> Field:
    """Return the field of a white, diffuse square.

    It is one metre wide, lies in the plane z = 0 around the origin, faces +z, has 64 texels,
    and reflects 1 / pi of the irradiance in every direction.

    Returns
    -------
    Field

    Examples
    --------
    >>> example_field().evaluate([0], [0, 0, 1], [0, 0, 1]).round(2)
    array([[0.32, 0.32, 0.32]], dtype=float32)
    """
    n_texels, n_nodes = TEXELS**2, len(HemisphereGrid(NODES).directions)
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    surface = BaseSurface(
        positions=np.concatenate([uv - 0.5, np.zeros((4, 1))], axis=1),
        faces=np.array([[0, 1, 2], [0, 2, 3]]),
        uv=uv,
        texel_of_pixel=np.arange(n_texels).reshape(TEXELS, TEXELS),
    )
    reflectance = FittedReflectance(
        local_from_world=np.tile(np.eye(3), (n_texels, 1, 1)),
        cluster=np.zeros(n_texels, int),
        coefficients=np.zeros((n_texels, 0)),
        mean=np.full((1, n_nodes, n_nodes, 3), np.cbrt(1 / np.pi)),
        basis=np.zeros((1, 0, n_nodes, n_nodes, 3)),
    )
    return Field(build_field(surface, reflectance))
