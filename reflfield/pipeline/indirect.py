"""Stage "indirect": what texels show where no light reaches them directly."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from reflfield.field.indirect_fit import IndirectModel, fit_to_shade
from reflfield.observations.shade import Shade
from reflfield.observations.stored_shade import StoredShade
from reflfield.observations.texel_reading import TexelReader
from reflfield.pipeline import results
from reflfield.pipeline.atlas import pixel_width
from reflfield.pipeline.context import Context
from reflfield.util.even_order import even_order

# Texels so near to one that the light reaches, in texel spacings and not less than a pixel, are
# at the edge of a shadow: their pixels mix both.
EDGE_SPACINGS = 1.5
# Lights of each texel that are kept where each is that of a few photographs: those with samples
# in its shadow, and others spread evenly, under which no texel may come out brighter.
MOST_LIGHTS = 48


def write_indirect(context: Context, folder: Path) -> dict[str, Any]:
    """Write the indirect light of all texels that a camera sees."""
    reader = results.base_reader(context)
    in_view = results.texels_in_view(context)
    parts = context.blocks(folder).map(
        "light in the shadows",
        shade_block,
        (reader, texels_at_edge(context)),
        reader.blocks_of(in_view),
    )
    n_samples, n_used = (
        sum(float(part[name]) for part in parts) for name in ("samples", "used")
    )
    kept = {name: parts.joined(name) for name in ("values", "weights", "light")}
    shade = StoredShade(
        in_view,
        **kept,
        unit=reader.domain_unit,
        lights=context.training.lights,
        positions=results.texels(context).position,
    )
    shade = shade.only(np.flatnonzero(shade.weights.any(axis=(1, 2))))
    model, coefficients = fitted_to_shade(context, shade, shade.rows)
    np.savez(folder / "indirect.npz", functions=model.functions(), coefficients=coefficients)
    np.savez(
        folder / results.SHADE,
        **{name: getattr(shade, name) for name in ("texels", *kept)},
        unit=np.array(shade.unit),
    )
    return {
        "samples in shadow": int(n_samples),
        "samples at edges of shadows": int(n_samples - n_used),
        "texels that show shadow": len(shade.texels),
        "components": len(model.variances),
        "residual of the transformed samples": float(np.sqrt(model.noise)),
    }


def texels_at_edge(context: Context) -> NDArray[np.bool_]:
    """(n_texels, n_lights) True where the light reaches the texel or its surroundings."""
    texels = results.texels(context)
    pixel = pixel_width(context.training, results.hull_mesh(context))
    radius = max(EDGE_SPACINGS * texels.spacing, pixel)
    return neighbourhood_reached(texels.position, results.light_visible(context), radius)


def fitted_to_shade(
    context: Context, shade: StoredShade, read: Callable[[NDArray[np.intp]], Shade]
) -> tuple[IndirectModel, NDArray[np.float32]]:
    """Model of indirect light, and coefficients (n_texels, K) of all texels.

    Parameters
    ----------
    context : Context
    shade : StoredShade
        Of the texels that have any.
    read : callable
        Shade of some rows of that.
    """
    options = context.options.indirect
    model, of_shade = fit_to_shade(
        read,
        np.arange(len(shade.texels)),
        context.training.n_lights,
        options.n_components,
        most=options.training_texels,
        seed=context.options.seed,
        workers=context.resources.workers,
    )
    # Of the others nothing but the mean is known.
    coefficients = np.zeros((len(shade.positions), of_shade.shape[1]), np.float32)
    coefficients[shade.texels] = of_shade
    return model, coefficients


def shade_block(
    shared: tuple[TexelReader, NDArray[np.bool_]], texels: NDArray[np.intp]
) -> dict[str, Any]:
    """Return the shade of some texels, one sample for each light.

    Parameters
    ----------
    shared : (TexelReader, (n_texels, n_lights) bool)
        Reader of the base frames, and True where the light reaches the texel's surroundings.
    texels : (n,) int
    """
    reader, at_edge = shared
    shade = reader.shade(texels)
    # Views agree but for noise, the model errs more: one sample, however many there are.
    inside = ~at_edge[texels]
    used = (shade.weights > 0) & inside[..., None]
    # Of views that have measured any channel.
    n_views = shade.weights.max(axis=2)
    n_kept = used.shape[1] if reader.store.observed.pairs.is_product else MOST_LIGHTS
    kept = np.arange(len(texels))[:, None], lights_kept(np.asarray(used.any(axis=2)), n_kept)
    return {
        "values": (shade.values[kept] / np.float32(reader.domain_unit)).astype(np.float16),
        "weights": used[kept],
        "light": kept[1].astype(np.int32),
        "samples": np.array(n_views.sum(dtype=np.float64)),
        "used": np.array((n_views * inside).sum(dtype=np.float64)),
    }


def lights_kept(used: NDArray[np.bool_], most: int = MOST_LIGHTS) -> NDArray[np.intp]:
    """Lights (n, most) of each texel, ascending: used ones before others, spread evenly.

    Parameters
    ----------
    used : (n, n_lights) bool
        Lights with samples.
    most : int

    Examples
    --------
    >>> lights_kept(np.array([[False, False, False, True, False, False]]), 3)
    array([[0, 3, 5]])
    """
    n_lights = used.shape[1]
    rank = np.argsort(even_order(n_lights))
    order = np.argsort(np.where(used, rank - n_lights, rank), axis=1)
    return np.sort(order[:, :most], axis=1)


def neighbourhood_reached(
    positions: NDArray[np.floating], reached: NDArray[np.bool_], radius: float
) -> NDArray[np.bool_]:
    """(n, n_lights) bool: whether a light reaches any point within a radius.

    Examples
    --------
    >>> line = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    >>> neighbourhood_reached(line, np.array([[True], [False], [False]]), 2.0).ravel()
    array([ True,  True, False])
    """
    pairs = cKDTree(positions).query_pairs(radius, output_type="ndarray")
    both = np.concatenate([pairs, pairs[:, ::-1]])
    ones = np.ones(len(both), np.int32)
    near = csr_array((ones, (both[:, 0], both[:, 1])), shape=(len(positions),) * 2)
    return np.asarray(near @ reached.astype(np.int32) + reached > 0)
