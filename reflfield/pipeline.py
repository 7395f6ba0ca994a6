"""From a capture to a reflectance field and its report: the stages in order.

Every stage is a function of its inputs and its frozen options (`reflfield.steps`); it is
skipped when neither has changed, written whole or not at all, and resumed after a kill
(`reflfield.stages`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from reflfield.capture.model import Capture
from reflfield.config import HoldOut, Resources
from reflfield.errors import InputError
from reflfield.stages import only_run
from reflfield.steps import evaluation, outputs, reflectance, surface
from reflfield.steps.job import Job
from reflfield.steps.memory import check_memory
from reflfield.steps.options import PipelineOptions

STAGES = (
    "silhouettes",
    "hull",
    "atlas",
    "visibility",
    "observations",
    "completion",
    "alignment",
    "compression",
    "comparison",
    "report",
)


def run(
    capture: Capture,
    out: Path,
    options: PipelineOptions | None = None,
    *,
    hold_out: HoldOut | None = None,
    resources: Resources | None = None,
    first: str | None = None,
    last: str = STAGES[-1],
) -> Job:
    """Make a reflectance field of a capture, and say how good it is.

    Parameters
    ----------
    capture : Capture
        See `reflfield.capture.readers.open_capture`.
    out : Path
        Folder for all results; created.
    options : PipelineOptions, optional
    hold_out : HoldOut, optional
        Views and lights kept for comparison.
    resources : Resources, optional
    first : str, optional
        This stage and all later ones are computed again even if nothing changed.
    last : str
        Stop after this stage.

    Returns
    -------
    Job
        Folders and records of the stages.

    Raises
    ------
    InputError
        If a stage is unknown, or capture or options cannot be used.
    GeometryError
        If the silhouettes do not determine a surface.
    """
    wanted = STAGES[: _number("--until", last) + 1]
    redo = frozenset(STAGES[_number("--from", first) :]) if first else frozenset()
    if redo and redo.isdisjoint(wanted):
        raise InputError(
            f"--from, --until: expected the first stage not after the last, received {first} "
            f"after {last}"
        )
    options = options or PipelineOptions()
    job = Job(capture, out, options, hold_out or HoldOut(), resources or Resources(), redo)
    check_memory(job)
    training, key = job.training, job.stages.key

    def stage(
        name: str,
        compute: Callable[[Job, Path], Mapping[str, Any]],
        depends: Any = None,
        **inputs: str,
    ) -> None:
        job.stages.run(name, lambda to: compute(job, to), options=depends, inputs=inputs)

    stages: dict[str, Callable[[], None]] = {
        # silhouettes, given or made from the photographs
        "silhouettes": lambda: stage(
            "silhouettes",
            surface.write_silhouettes,
            capture=training.digest(("cameras", "silhouettes")),
        ),
        # silhouettes -> watertight mesh that encloses the object
        "hull": lambda: stage(
            "hull",
            surface.write_hull,
            options.hull,
            silhouettes=key("silhouettes"),
            lights=training.digest(("lights",)),
        ),
        # mesh -> UV charts -> texel table
        "atlas": lambda: stage(
            "atlas", surface.write_atlas, (options.atlas, options.texture), hull=key("hull")
        ),
        # which camera and which light each texel sees
        "visibility": lambda: stage(
            "visibility", surface.write_visibility, options.visibility, atlas=key("atlas")
        ),
        # photographs -> apparent BRDF samples per texel
        "observations": lambda: stage(
            "observations",
            reflectance.write_observations,
            visibility=key("visibility"),
            photographs=training.digest(("photographs",)),
        ),
        # scattered directions -> common grid; missing samples filled
        "completion": lambda: stage(
            "completion",
            reflectance.write_completion,
            (options.completion, options.resampling, options.seed),
            observations=key("observations"),
        ),
        # one local frame per texel
        "alignment": lambda: stage(
            "alignment",
            reflectance.write_alignment,
            (options.alignment, options.seed),
            completion=key("completion"),
        ),
        # raw samples again, in the aligned frames -> clustered local PCA -> field file
        "compression": lambda: stage(
            "compression",
            reflectance.write_compression,
            (options.compression, options.seed, capture.name),
            alignment=key("alignment"),
        ),
        # held-out photographs against the field relit from their cameras
        "comparison": lambda: stage(
            "comparison",
            evaluation.write_comparison,
            options.relighting,
            compression=key("compression"),
            **{name: f.digest() for name, f in evaluation.frame_sets(job).items()},
        ),
        # everything that was found, in one page
        "report": lambda: stage(
            "report", outputs.write_report_page, comparison=key("comparison")
        ),
    }
    with only_run(job.stages.root):
        for name in wanted:
            stages[name]()
        outputs.publish(job)
    return job


def _number(option: str, name: str) -> int:
    if name not in STAGES:
        raise InputError(f"{option}: expected one of {', '.join(STAGES)}, received {name!r}")
    return STAGES.index(name)
