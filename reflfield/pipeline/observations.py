"""Stage "observations": photographs to apparent BRDF samples of every texel."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from reflfield.errors import InputError
from reflfield.observations.image_projection import (
    VALUE_KINDS,
    LookedInto,
    Projection,
    project_photographs,
)
from reflfield.observations.light_agreement import looks_at, other_light_axes
from reflfield.observations.store import open_samples
from reflfield.pipeline.cache import WARNINGS
from reflfield.pipeline.clipped_values import check_measured, clipping_lines, write_measured
from reflfield.pipeline.context import ELSEWHERE, Job
from reflfield.pipeline.memory import writers_at_once

logger = logging.getLogger(__name__)


def write_observations(job: Job, folder: Path) -> dict[str, Any]:
    """Apparent BRDF samples of all texels, on disk; what of them was not measured is told."""
    location = job.new_samples_location(folder)
    projection = Projection(
        job.training, job.texels.position, job.view_seen, location, job.resources.block_bytes
    )
    found = project_photographs(projection, job.blocks(folder), writers_at_once(job))
    check_measured(job.training, found)
    write_measured(folder, found.measured)
    for line in clipping_lines(job.training, found):
        logger.warning("%s", line)
    n_samples = job.view_seen.size * job.training.n_lights
    return {
        "photographs": found.photographs,
        "samples": n_samples,
        "raw bytes": n_samples * 6,
        **{f"values {kind}": found.count(kind) for kind in VALUE_KINDS},
        WARNINGS: misread_lights(job, found.looked_into),
    }


def misread_lights(job: Job, samples: LookedInto) -> list[str]:
    """A warning where the lights are plainly in other axes than the cameras."""
    if job.is_plane:  # all its points face one way
        return []
    looks = looks_at(
        job.training,
        samples.photograph,
        job.texels.position[samples.texel],
        job.texels.normal[samples.texel],
        samples.brightness(),
    )
    words = other_light_axes(list(looks))
    return [words] if words else []


def lost_observations(job: Job, folder: Path) -> str:
    """What is wrong with the samples in a store elsewhere; empty if nothing is.

    Its chunks are verified as they are read.
    """
    if not (folder / ELSEWHERE).is_file():
        return ""
    try:
        open_samples((folder / ELSEWHERE).read_text(), "r")
    except InputError as error:
        return str(error).partition("; ")[0]
    return ""
