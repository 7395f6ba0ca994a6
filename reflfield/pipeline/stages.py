"""From a capture to a reflectance field and its report: the stages in order.

Every stage is a function of its inputs and its frozen options (`reflfield.pipeline`); it is
skipped when neither has changed, written whole or not at all, and resumed after a kill
(`reflfield.pipeline.cache`).
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from reflfield.capture.capture import Capture
from reflfield.capture.consistency import check_single_lights
from reflfield.errors import InputError
from reflfield.observations.store import check_place
from reflfield.options import HoldOut, Resources
from reflfield.pipeline import (
    alignment,
    atlas,
    comparison,
    completion,
    compression,
    held_out_silhouettes,
    hull,
    indirect,
    maps,
    model_selection,
    observations,
    publishing,
    rate_distortion,
    report,
    resampling,
    silhouettes,
    surface,
    visibility,
    without_alignment,
)
from reflfield.pipeline.cache import plain
from reflfield.pipeline.code_digests import code_digest
from reflfield.pipeline.compared_photographs import frame_sets
from reflfield.pipeline.context import Job
from reflfield.pipeline.hold_out import held_out_counts
from reflfield.pipeline.memory import check_memory
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.quantisation_search import held_out
from reflfield.util import progress
from reflfield.util.file_digests import FileDigests
from reflfield.util.folders import only_run

log = logging.getLogger(__name__)
# In the folder of the stages: digests of the files that were read.
FILES_INDEX = "files.json"
# Of the options of rendering, what no picture depends on.
RENDERING_RESOURCES = ("workers", "block_pixels")
# In the folder of a simulated capture.
TRUTH = "truth"


@dataclass(frozen=True)
class Stage:
    """One stage: what computes it, and everything that its result depends on.

    Parameters
    ----------
    name : str
    compute : callable
        Writes the results into a folder and returns counts.
    after : tuple of str
        Stages whose results it reads (and through them those before), where they are wanted.
    options : callable
        What of the job's options matters.
    reads : callable
        Digests of what it reads besides.
    wanted : callable
        Whether the job asks for it.
    intact : callable
        Says what is wrong with what it has left outside of its folder, if anything.
    """

    name: str
    compute: Callable[[Job, Path], Mapping[str, Any]]
    after: tuple[str, ...] = ()
    options: Callable[[PipelineOptions], Any] = lambda options: None
    reads: Callable[[Job], Mapping[str, str]] = lambda job: {}
    wanted: Callable[[Job], bool] = lambda job: True
    intact: Callable[[Job, Path], str] = lambda job, folder: ""

    def run(self, job: Job) -> None:
        """Compute the stage, or take its earlier result."""
        before = [name for name in self.after if BY_NAME[name].wanted(job)]
        job.stages.run(
            self.name,
            lambda folder: self.compute(job, folder),
            options=self.options(job.options),
            inputs=self.reads(job),
            after={name: job.stages.key(name) for name in before},
            code=code_digest(self.compute.__module__),
            intact=lambda folder: self.intact(job, folder),
        )


def field_metadata_digest(job: Job) -> dict[str, str]:
    """What the metadata of a field say besides its options."""
    return {"name": job.capture.name, "held_out": json.dumps(held_out(job))}


def frames_digests(job: Job) -> dict[str, str]:
    """Digests of the frames that fields are compared on."""
    sets = frame_sets(job)
    return {name: job.digest_of(frames) for name, frames in sets.items()}


def truth_digest(job: Job) -> dict[str, str]:
    """Digest of all files of the truth that a simulated capture brings."""
    total, files = hashlib.sha256(), sorted((job.capture.root / TRUTH).rglob("*"))
    for path in files:
        if path.is_file():
            total.update(path.relative_to(job.capture.root).as_posix().encode())
            total.update(job.digests.digest(path))
    job.digests.save()
    return {TRUTH: total.hexdigest()} if files else {}


def relit_with(options: PipelineOptions) -> dict[str, Any]:
    """Options of rendering that a picture depends on."""
    said = asdict(options.relighting)
    return {name: value for name, value in said.items() if name not in RENDERING_RESOURCES}


def shown(options: PipelineOptions) -> dict[str, Any]:
    """Options as the report lists them."""
    return {**plain(options), "relighting": relit_with(options)}


def read_by_report(job: Job) -> dict[str, str]:
    """What the report shows besides the results of the stages."""
    words = {f"choice {i}": text for i, text in enumerate(model_selection.words_of(job))}
    return {**field_metadata_digest(job), **truth_digest(job), **words}


def try_candidates(job: Job, folder: Path) -> Mapping[str, Any]:
    """Run with every way to settle what is open, up to the comparison; take the best."""
    found = model_selection.candidates(job)
    tried: list[tuple[model_selection.Candidate, Job]] = []
    for i, candidate in enumerate(found):
        progress.report(f"trial of {candidate.name}", i, len(found))
        folders = [job.stages, *(trial.stages for _, trial in tried)]
        trial = model_selection.trial_of(job, candidate, folders)
        for stage in ORDER[: STAGES.index("comparison") + 1]:
            if stage.wanted(trial) and stage.name != "maps":
                stage.run(trial)
        model_selection.keep_comparison(trial, candidate, folder)
        tried.append((candidate, trial))
    job.stages.also = tuple(trial.stages for _, trial in tried)
    return model_selection.conclude(folder, tried)


ORDER = (
    # silhouettes, given or made from the photographs
    Stage(
        "silhouettes",
        silhouettes.write_silhouettes,
        reads=lambda job: {"capture": job.digest_of(job.training, "cameras", "silhouettes")},
    ),
    # silhouettes -> watertight mesh that encloses the object
    Stage(
        "hull",
        hull.write_hull,
        after=("silhouettes",),
        options=lambda options: options.hull,
        reads=lambda job: {"lights": job.digest_of(job.training, "lights")},
    ),
    # mesh -> UV charts -> texel table
    Stage(
        "atlas",
        atlas.write_atlas,
        after=("hull",),
        options=lambda options: (options.atlas, options.texture),
    ),
    # which camera and which light each texel sees
    Stage(
        "visibility",
        visibility.write_visibility,
        after=("atlas",),
        options=lambda options: options.visibility,
    ),
    # photographs -> apparent BRDF samples per texel
    Stage(
        "observations",
        observations.write_observations,
        after=("visibility",),
        reads=lambda job: {"photographs": job.digest_of(job.training, "photographs")},
        intact=observations.lost_observations,
    ),
    # silhouettes of the frames that fields are compared on, all photographs considered
    Stage(
        held_out_silhouettes.SILHOUETTES,
        held_out_silhouettes.write_silhouettes_of_frames,
        after=("hull",),
        reads=held_out_silhouettes.silhouettes_digests,
    ),
    # what is open is settled by trials on the held-out frames
    Stage(
        model_selection.STAGE,
        try_candidates,
        after=("observations", held_out_silhouettes.SILHOUETTES),
        options=lambda options: (
            options.indirect,
            options.completion,
            options.resampling,
            options.alignment,
            options.compression,
            relit_with(options),
            options.seed,
        ),
        reads=lambda job: {"name": job.capture.name, **frames_digests(job)},
        wanted=model_selection.is_open,
    ),
    # samples in shadow -> what the object shines into itself
    Stage(
        "indirect",
        indirect.write_indirect,
        after=("observations",),
        options=lambda options: (options.indirect, options.resampling, options.seed),
        wanted=lambda job: job.finds_indirect_light,
    ),
    # fit on the hull; the hull moved to the normals that were fitted
    Stage(
        "surface",
        surface.write_surface,
        after=("observations", "indirect"),
        options=lambda options: (options.compression, options.resampling, options.seed),
        wanted=lambda job: job.options.refines_surface,
    ),
    # which camera and which light each texel of the new surface sees
    Stage(
        "surface_visibility",
        surface.write_surface_visibility,
        after=("surface",),
        options=lambda options: options.visibility,
        wanted=lambda job: job.options.refines_surface,
    ),
    # photographs -> samples of the new surface
    Stage(
        "surface_observations",
        surface.write_surface_observations,
        after=("surface_visibility",),
        reads=lambda job: {"photographs": job.digest_of(job.training, "photographs")},
        wanted=lambda job: job.options.refines_surface,
        intact=surface.lost_surface_observations,
    ),
    # samples in shadow -> indirect light on the new surface
    Stage(
        "surface_indirect",
        surface.write_surface_indirect,
        after=("surface_observations",),
        options=lambda options: (options.indirect, options.resampling, options.seed),
        wanted=lambda job: job.options.refines_surface and job.finds_indirect_light,
    ),
    # scattered directions -> common grid; missing samples filled
    Stage(
        "completion",
        completion.write_completion,
        after=("observations",),
        options=lambda options: (options.completion, options.resampling, options.seed),
        wanted=lambda job: job.options.aligns,
    ),
    # one local frame per texel
    Stage(
        "alignment",
        alignment.write_alignment,
        after=("completion",),
        options=lambda options: (options.alignment, options.seed),
        wanted=lambda job: job.options.aligns,
    ),
    # raw samples again, in the aligned frames, on the grid; missing samples filled
    Stage(
        "resampling",
        resampling.write_resampling,
        after=("alignment",),
        options=lambda options: (
            options.compression.rank,
            options.compression.training_texels,
            options.seed,
        ),
        wanted=lambda job: job.options.aligns,
    ),
    # model fitted to the raw samples, and to the photographs -> field file
    Stage(
        "compression",
        compression.write_compression,
        after=(
            *("observations", "resampling", "indirect"),
            *("surface_observations", "surface_indirect"),
        ),
        options=lambda options: (options.compression, options.resampling, options.seed),
        reads=field_metadata_digest,
    ),
    # the field's frames as pictures, the mesh with its mean texture
    Stage("maps", maps.write_maps, after=("compression",)),
    # the same in the base frames, to compare with
    Stage(
        "without_alignment",
        without_alignment.write_without_alignment,
        after=("compression",),
        options=lambda options: (options.compression, options.resampling, options.seed),
        reads=field_metadata_digest,
        wanted=lambda job: job.options.compares_without_alignment,
    ),
    # held-out photographs against the fields relit from their cameras
    Stage(
        "comparison",
        comparison.write_comparison,
        after=("compression", "without_alignment", held_out_silhouettes.SILHOUETTES),
        options=relit_with,
        reads=lambda job: {
            **frames_digests(job),
            "held_out": json.dumps(held_out_counts(job.split)),
        },
    ),
    # what bits bring: the models quantised more and more coarsely
    Stage(
        "rate_distortion",
        rate_distortion.write_rate_distortion,
        after=("compression", "without_alignment", held_out_silhouettes.SILHOUETTES),
        options=relit_with,
        reads=frames_digests,
        wanted=lambda job: job.options.shows_rate_distortion,
    ),
    # everything that was found, in one page
    Stage(
        "report",
        report.write_report_page,
        after=("choices", "maps", "comparison", "rate_distortion"),
        options=shown,
        reads=read_by_report,
    ),
)
STAGES = tuple(stage.name for stage in ORDER)
BY_NAME = {stage.name: stage for stage in ORDER}


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
        What is kept for comparison.
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
    wanted = STAGES[: _number("until", last) + 1]
    redo = frozenset(STAGES[_number("from_stage", first) :]) if first else frozenset()
    if redo and redo.isdisjoint(wanted):
        raise InputError(
            f"from_stage, until: expected the first stage not after the last, received {first} "
            f"after {last}"
        )
    job = Job(
        capture,
        out,
        options or PipelineOptions(),
        hold_out or HoldOut(),
        resources or Resources(),
        redo,
        digests=FileDigests(out / "stages" / FILES_INDEX),
    )
    if job.resources.store is not None:
        check_place(job.resources.store, capture=capture.root, out=out)
    check_single_lights(capture)
    check_memory(job)
    model_selection.check_choices(job)
    with only_run(job.stages.root), telling_where_the_field_is(job):
        for stage in ORDER[: len(wanted)]:
            if stage.name == model_selection.STAGE:
                affected = model_selection.first_affected(job)
                if last == model_selection.STAGE or affected in wanted:
                    job = settled(job)
            elif stage.wanted(job):
                stage.run(job)
                say_warnings(job, stage.name)
                if job.stages.record("compression") is not None:
                    publishing.publish(job)
        publishing.publish(job)
        publishing.publish_records(job, last, whole=last == STAGES[-1])
    return job


def say_warnings(job: Job, stage: str) -> None:
    """Tell what a user must know of the result of a stage, computed now or before."""
    for text in job.stages.warnings(stage):
        log.warning("%s: %s", stage, text)


@contextmanager
def telling_where_the_field_is(job: Job) -> Iterator[None]:
    """Note on an error that comes after the field is finished that it is there."""
    try:
        yield
    except Exception as error:
        if job.stages.record("compression") is not None:
            error.add_note(f"the field is finished: {job.out / 'field.rfld'}")
        raise


def settled(job: Job) -> Job:
    """The job with nothing left open, by trials where there is something to try."""
    if model_selection.is_open(job):
        BY_NAME[model_selection.STAGE].run(job)
    return model_selection.decided(job)


def _number(argument: str, name: str) -> int:
    if name not in STAGES:
        raise InputError(f"{argument}: expected one of {', '.join(STAGES)}, received {name!r}")
    return STAGES.index(name)
