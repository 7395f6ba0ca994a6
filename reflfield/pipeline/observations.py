"""Stage "observations": photographs to apparent BRDF samples of every texel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from reflfield.errors import InputError
from reflfield.observations.image_projection import (
    VALUE_KINDS,
    LookedInto,
    Projection,
    project_photographs,
)
from reflfield.observations.intensity_agreement import other_intensities
from reflfield.observations.light_agreement import looks_at, other_light_axes
from reflfield.observations.store import Location, open_samples, place_of
from reflfield.pipeline import results
from reflfield.pipeline.cache import WARNINGS, key_of
from reflfield.pipeline.clipped_values import check_measured, clipping_lines, write_measured
from reflfield.pipeline.context import Context
from reflfield.pipeline.memory import writers_at_once
from reflfield.pipeline.results import ELSEWHERE, SAMPLES
from reflfield.util.files import naming


def write_observations(context: Context, folder: Path) -> dict[str, Any]:
    """Write apparent BRDF samples of all texels; warn of what was not measured."""
    location = new_samples_location(context, folder)
    projection = Projection(
        context.training,
        results.texels(context).position,
        results.view_visible(context),
        location,
        context.resources.block_bytes,
    )
    blocks = context.blocks(folder)
    with naming(str(location)):  # the disk of a store may be full, and not that of the results
        projected = project_photographs(projection, blocks, writers_at_once(context))
    check_measured(context.training, projected)
    write_measured(folder, projected.measured)
    n_samples = len(results.texels(context)) * len(context.training.photographs)
    return {
        "photographs": projected.photographs,
        "samples": n_samples,
        "raw bytes": n_samples * 6,
        **{f"values {kind}": projected.count(kind) for kind in VALUE_KINDS},
        WARNINGS: [
            # Once, not again of the same photographs on another surface.
            *(() if context.on_surface else clipping_lines(context.training, projected)),
            *misread_lights(context, projected.looked_into),
        ],
    }


def new_samples_location(context: Context, folder: Path) -> Location:
    """Return where the stage that is computed into a folder puts the samples.

    In a store, in a place of its own for each key, which is noted in the folder.
    """
    if context.resources.store is None:
        return folder / SAMPLES
    location = place_of(context.resources.store, key_of(folder))
    (folder / ELSEWHERE).write_text(location)
    return location


def misread_lights(context: Context, samples: LookedInto) -> list[str]:
    """Return warnings where lights are plainly in other axes, or of other intensities."""
    if context.is_plane:  # all its points face one way
        return []
    looks = list(
        looks_at(
            context.training,
            samples.photograph,
            results.texels(context).position[samples.texel],
            results.texels(context).normal[samples.texel],
            samples.brightness(),
        )
    )
    return [words for words in (other_light_axes(looks), other_intensities(looks)) if words]


def lost_observations(context: Context, folder: Path) -> str:
    """Return what is wrong with the samples in a store elsewhere; empty if nothing is.

    Its chunks are verified as they are read.
    """
    if not (folder / ELSEWHERE).is_file():
        return ""
    try:
        open_samples((folder / ELSEWHERE).read_text(), "r")
    except InputError as error:
        return str(error).partition("; ")[0]
    return ""
