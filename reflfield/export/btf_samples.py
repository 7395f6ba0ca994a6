"""A field as a ``.btf`` container: apparent BRDFs of all texels in their own frames.

The directions are those of the dome of the University of Bonn, 151 for views and for lights.
Means over some texels give the components, by a singular value decomposition; coefficients of
all texels are fitted to some pairs of directions. Of a half-vector field, whose samples are
sums of a few tables, nothing is lost but components below 1e-4 of the largest.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.btf import Btf, read_btf
from reflfield.errors import InputError
from reflfield.export.btf_container import (
    BtfContainer,
    angles_of,
    directions_of,
    write_btf,
)
from reflfield.field.evaluation import evaluate
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.render.camera_rays import FieldSurface

Doubles = NDArray[np.float64]

# Bonn's first dome: inclinations, how many azimuths each has, and the first of these, degrees.
_RINGS = (
    *((0.0, 1, 0.0), (11.0, 6, 15.0), (23.5, 12, 0.0), (30.0, 12, 15.0), (37.5, 12, 0.0)),
    *((45.0, 18, 0.0), (52.5, 18, 7.5), (60.0, 24, 0.0), (67.5, 24, 7.5), (75.0, 24, 0.0)),
)
_SEED, _SOME_TEXELS, _SOME_PAIRS = 7, 384, 1024
MOST_COMPONENTS, _LEAST_SHARE = 32, 1e-4
_TEXELS_AT_ONCE = 1024


def dome_directions() -> Doubles:
    """Directions of the dome in a texel's frame, (151, 3).

    Examples
    --------
    >>> len(dome_directions()), dome_directions()[0].tolist()
    (151, [0.0, 0.0, 1.0])
    """
    angles = [
        (np.radians(theta), np.radians(first + 360.0 / n * i))
        for theta, n, first in _RINGS
        for i in range(n)
    ]
    directions: Doubles = directions_of(np.array(angles))
    return directions


def write_btf_field(path: Path, field: ReflectanceField) -> list[str]:
    """Write the container.

    Parameters
    ----------
    path : Path
        Such as ``object.btf``.
    field : ReflectanceField
        Of a known light.

    Returns
    -------
    list of str
        What to know of the result.

    Raises
    ------
    InputError
        If the field's light is unknown.
    """
    if field.light_model == "unknown":
        raise InputError(
            "field: expected one of known lights, received one that was photographed in an "
            "unknown light: it has no samples by light"
        )
    # Rounded as they are stored, so that what is read is where the samples are.
    directions = directions_of(angles_of(dome_directions()))
    rng = np.random.default_rng(_SEED)
    values, u = _components(field, directions, rng)
    pairs = rng.choice(len(directions) ** 2, _SOME_PAIRS, replace=False)
    coefficients = _coefficients(field, directions, u, pairs)
    columns = field.texel_of_pixel.ravel()
    covered = columns >= 0
    sv = np.where(covered[:, None], coefficients[np.maximum(columns, 0)], 0.0)
    angles = angles_of(directions)
    container = BtfContainer(
        field.texel_of_pixel.shape[1],
        field.texel_of_pixel.shape[0],
        *(angles, angles, values.astype("f4"), u.astype("f4"), sv.astype("f4")),
        rotations=FieldSurface(field).local_from_texture[np.maximum(columns, 0)].astype("f4"),
        setup="reflfield",
    )
    write_btf(path, container)
    # Of what is read from the file: whatever went wrong on the way there shows.
    error = _error(field, directions, read_btf(path), rng)
    return [
        f"{len(values)} components, {len(directions)} views x {len(directions)} lights; error "
        f"{100.0 * error:.2g} % of the field's samples"
    ]


def _samples(
    field: ReflectanceField,
    texels: NDArray[np.integer],
    directions: Doubles,
    pairs: NDArray[np.integer],
) -> Doubles:
    """Samples of texels for pairs ``view * n + light``, (n_texels, n_pairs * 3)."""
    world = directions.astype(np.float32) @ field.local_from_world[texels]
    view, light = np.divmod(pairs, len(directions))
    repeated = np.repeat(texels, len(pairs))
    samples = evaluate(
        field, repeated, world[:, view].reshape(-1, 3), world[:, light].reshape(-1, 3)
    )
    return samples.reshape(len(texels), -1).astype(np.float64)


def _components(
    field: ReflectanceField, directions: Doubles, rng: np.random.Generator
) -> tuple[Doubles, Doubles]:
    """Singular values, and components of all pairs (rows, K), from some texels."""
    some = rng.choice(field.n_texels, min(_SOME_TEXELS, field.n_texels), replace=False)
    pairs = np.arange(len(directions) ** 2)
    blocks = np.array_split(some, -(-len(some) // 32))
    matrix = np.concatenate([_samples(field, block, directions, pairs) for block in blocks])
    squares, left = np.linalg.eigh(matrix @ matrix.T)
    order = np.argsort(squares)[::-1][:MOST_COMPONENTS]
    values = np.sqrt(np.maximum(squares[order], 0.0))
    kept = values > _LEAST_SHARE * max(values[0], 1e-300)
    kept[0] = True
    values, left = values[kept], left[:, order[kept]]
    return values, matrix.T @ left / np.maximum(values, 1e-300)


def _coefficients(
    field: ReflectanceField, directions: Doubles, u: Doubles, pairs: NDArray[np.integer]
) -> Doubles:
    """Least squares of all texels over some pairs, (n_texels, K)."""
    inverse = np.linalg.pinv(u[_rows(pairs)])
    texels = np.arange(field.n_texels)
    blocks = np.array_split(texels, -(-len(texels) // _TEXELS_AT_ONCE))
    parts = [_samples(field, block, directions, pairs) @ inverse.T for block in blocks]
    return np.concatenate(parts)


def _rows(pairs: NDArray[np.integer]) -> NDArray[np.integer]:
    return (3 * pairs[:, None] + np.arange(3)).ravel()


def _error(
    field: ReflectanceField,
    directions: Doubles,
    container: Btf,
    rng: np.random.Generator,
) -> float:
    """Relative difference of the container from the field at other pairs and texels."""
    pairs = rng.choice(len(directions) ** 2, _SOME_PAIRS, replace=False)
    places = np.flatnonzero(field.texel_of_pixel.ravel() >= 0)
    places = rng.choice(places, min(_SOME_TEXELS, len(places)), replace=False)
    wanted = _samples(field, field.texel_of_pixel.ravel()[places], directions, pairs)
    ((u, v),) = container.factors
    shown = v[places] @ np.asarray(u)[_rows(pairs)].T
    off, size = np.linalg.norm(shown - wanted), np.linalg.norm(wanted)
    return float(off / max(float(size), 1e-300))
