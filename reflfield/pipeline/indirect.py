"""Stage that finds what texels show where no light reaches them directly."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from reflfield.field.indirect_fit import fit_indirect
from reflfield.observations.texel_reading import Shade, TexelReader
from reflfield.pipeline.atlas import pixel_width
from reflfield.pipeline.context import Job

# Texels so near to one that the light reaches, in texel spacings and not less than a pixel, are
# at the edge of a shadow: their pixels mix both.
EDGE_SPACINGS = 1.5


@dataclass(frozen=True, eq=False)
class Shading:
    """What all blocks share whose shade is read.

    Parameters
    ----------
    reader : TexelReader
    at_edge : (n_texels, n_lights) bool
        True where the light reaches the texel's surroundings.
    """

    reader: TexelReader
    at_edge: NDArray[np.bool_]


def shade_block(context: Shading, texels: NDArray[np.intp]) -> dict[str, Any]:
    """Shade of some texels, one sample for each light."""
    found = context.reader.shade(texels)
    # Views agree but for noise, the model errs more: one sample, however many there are.
    inside = ~context.at_edge[texels]
    used = (found.weights > 0) & inside[..., None]
    # Of views that have measured any channel.
    n_views = found.weights.max(axis=2)
    return {
        "values": (found.values / np.float32(context.reader.domain_unit)).astype(np.float16),
        "weights": used.astype(np.float32),
        "lights": found.lights,
        "samples": np.array(n_views.sum(dtype=np.float64)),
        "used": np.array((n_views * inside).sum(dtype=np.float64)),
    }


def write_indirect(job: Job, folder: Path) -> dict[str, Any]:
    """Indirect light of all texels that a camera sees."""
    options, reader, seen = job.options.indirect, job.base_reader, job.texels_in_view
    radius = max(EDGE_SPACINGS * job.texels.spacing, pixel_width(job.training, job.hull_mesh))
    at_edge = neighbourhood_reached(job.texels.position, job.light_seen, radius)
    parts = job.blocks(folder).map(
        "light in the shadows", shade_block, Shading(reader, at_edge), reader.blocks_of(seen)
    )
    shade = Shade(*(parts.joined(name) for name in ("values", "weights", "lights")))
    n_samples, n_used = (
        sum(float(part[name]) for part in parts) for name in ("samples", "used")
    )
    in_shade = np.flatnonzero(shade.weights.any(axis=(1, 2)))
    rng = np.random.default_rng(job.options.seed)
    n = min(len(in_shade), options.training_texels)
    chosen = np.sort(rng.choice(in_shade, n, replace=False))

    def read(texels: NDArray[np.intp]) -> Shade:
        values = shade.values[texels].astype(np.float32) * np.float32(reader.domain_unit)
        arrays = (values, shade.weights[texels], shade.lights[texels])
        return replace(shade, **dict(zip(("values", "weights", "lights"), arrays, strict=True)))

    model = fit_indirect(read, chosen, job.training.n_lights, options.n_components)
    coefficients = np.zeros((reader.n_texels, len(model.variances)), np.float32)
    for some in np.array_split(np.arange(len(seen)), max(1, len(seen) // 1024)):
        coefficients[seen[some]] = model.coefficients(read(some))
    np.savez(folder / "indirect.npz", functions=model.functions(), coefficients=coefficients)
    return {
        "samples in shadow": int(n_samples),
        "samples at edges of shadows": int(n_samples - n_used),
        "texels that show shadow": len(in_shade),
        "components": len(model.variances),
        "residual in the domain": float(np.sqrt(model.noise)),
    }


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
