"""From a capture to a reflectance field and its report: the stages in order, and `run`.

Every stage is a function of its inputs and its frozen options (`reflfield.pipeline.stage`); it
is skipped when neither has changed, written whole or not at all, and resumed after a kill
(`reflfield.pipeline.cache`). Each is computed in the module of its name.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
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
    error_analysis,
    held_out_silhouettes,
    hollows,
    hull,
    indirect,
    left_out_views,
    maps,
    model_selection,
    observations,
    publishing,
    rate_distortion,
    report,
    resampling,
    silhouettes,
    stage_inputs,
    surface,
    visibility,
    web_page,
    without_alignment,
)
from reflfield.pipeline.cache import StageFolder
from reflfield.pipeline.context import Context
from reflfield.pipeline.memory import check_memory
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.stage import Stage
from reflfield.util import progress
from reflfield.util.file_digests import FileDigests
from reflfield.util.folders import only_run

log = logging.getLogger(__name__)
# In the folder of the stages: digests of the files that were read.
FILES_INDEX = "files.json"


def run_candidates(context: Context, folder: Path) -> Mapping[str, Any]:
    """Run with every candidate's options up to the comparison, and select the best."""
    candidates = model_selection.candidates(context)
    finished: list[tuple[model_selection.Candidate, StageFolder]] = []
    for i, candidate in enumerate(candidates):
        progress.report(f"candidate run {candidate.name}", i, len(candidates))
        earlier = [context.stages, *(stages for _, stages in finished)]
        candidate_run = model_selection.candidate_context(context, candidate, earlier)
        for stage in CANDIDATE_STAGES:
            if stage.wanted(candidate_run):
                stage.run(candidate_run)
        model_selection.keep_comparison(candidate_run, candidate, folder)
        finished.append((candidate, candidate_run.stages))
    context.stages.take_over_from(stages for _, stages in finished)
    return model_selection.select(folder, finished)


# silhouettes, given or made from the photographs
SILHOUETTES = Stage(
    "silhouettes",
    silhouettes.write_silhouettes,
    reads=stage_inputs.silhouettes_digest,
)
# silhouettes -> watertight mesh that encloses the object
HULL = Stage(
    "hull",
    hull.write_hull,
    after=(SILHOUETTES,),
    options=lambda options: options.hull,
    reads=stage_inputs.lights_digest,
)
# photographs that contradict the hull -> the hull without its hollows
HOLLOWS = Stage(
    "hollows",
    hollows.write_hollows,
    after=(HULL,),
    options=lambda options: options.hull,
    reads=stage_inputs.photographs_digest,
    wanted=hollows.is_searched,
)
# mesh -> UV charts -> texel table
ATLAS = Stage(
    "atlas",
    atlas.write_atlas,
    after=(HULL, HOLLOWS),
    options=lambda options: (options.atlas, options.texture),
)
# which camera and which light each texel sees
VISIBILITY = Stage(
    "visibility",
    visibility.write_visibility,
    after=(ATLAS,),
    options=lambda options: options.visibility,
)
# photographs -> apparent BRDF samples per texel
OBSERVATIONS = Stage(
    "observations",
    observations.write_observations,
    after=(VISIBILITY,),
    reads=stage_inputs.photographs_digest,
    intact=observations.lost_observations,
)
# silhouettes of the photographs that fields are compared with
HELD_OUT_SILHOUETTES = Stage(
    held_out_silhouettes.STAGE,
    held_out_silhouettes.write_held_out_silhouettes,
    after=(HULL,),
    reads=held_out_silhouettes.silhouettes_digests,
)
# some texels fitted without some views -> number of lobes; whether the model suits the object
LEFT_OUT_VIEWS = Stage(
    "left_out_views",
    left_out_views.write_left_out_views,
    after=(OBSERVATIONS,),
    options=lambda options: (options.compression.half_vector.smoothness, options.seed),
    wanted=left_out_views.leaves_views_out,
)
# what is "auto" in the options -> selected on held-out photographs, by candidate runs
MODEL_SELECTION = Stage(
    model_selection.STAGE,
    run_candidates,
    after=(OBSERVATIONS, HELD_OUT_SILHOUETTES, LEFT_OUT_VIEWS),
    options=lambda options: (
        options.indirect,
        options.completion,
        options.resampling,
        options.alignment,
        options.compression,
        stage_inputs.rendering_options(options),
        options.seed,
    ),
    reads=stage_inputs.selection_digests,
    wanted=model_selection.has_candidates,
)
# samples in shadow -> interreflection and other indirect light, where the hull stays as it is
INDIRECT = Stage(
    "indirect",
    indirect.write_indirect,
    after=(OBSERVATIONS,),
    options=lambda options: (options.indirect, options.resampling, options.seed),
    wanted=lambda context: context.fits_indirect_light and not context.options.refines_surface,
)
# fit on the hull; the hull moved to the normals that were fitted
SURFACE = Stage(
    "surface",
    surface.write_surface,
    after=(OBSERVATIONS, LEFT_OUT_VIEWS),
    options=lambda options: (options.compression, options.resampling, options.seed),
    wanted=lambda context: context.options.refines_surface,
)
# which camera and which light each texel of the new surface sees
SURFACE_VISIBILITY = Stage(
    "surface_visibility",
    surface.write_surface_visibility,
    after=(SURFACE,),
    options=lambda options: options.visibility,
    wanted=lambda context: context.options.refines_surface,
)
# photographs -> samples of the new surface
SURFACE_OBSERVATIONS = Stage(
    "surface_observations",
    surface.write_surface_observations,
    after=(SURFACE_VISIBILITY,),
    reads=stage_inputs.photographs_digest,
    wanted=lambda context: context.options.refines_surface,
    intact=surface.lost_surface_observations,
)
# samples in shadow -> indirect light on the new surface
SURFACE_INDIRECT = Stage(
    "surface_indirect",
    surface.write_surface_indirect,
    after=(SURFACE_OBSERVATIONS,),
    options=lambda options: (options.indirect, options.resampling, options.seed),
    wanted=lambda context: context.options.refines_surface and context.fits_indirect_light,
)
# scattered directions -> common grid; missing samples filled
COMPLETION = Stage(
    "completion",
    completion.write_completion,
    after=(OBSERVATIONS,),
    options=lambda options: (options.completion, options.resampling, options.seed),
    wanted=lambda context: context.options.aligns and not context.photometric,
    large_products=True,
)
# one local frame per texel
ALIGNMENT = Stage(
    "alignment",
    alignment.write_alignment,
    after=(OBSERVATIONS, COMPLETION),
    options=lambda options: (options.alignment, options.resampling, options.seed),
    wanted=lambda context: context.options.aligns,
    large_products=True,
)
# raw samples again, in the aligned frames, on the grid; missing samples filled
RESAMPLING = Stage(
    "resampling",
    resampling.write_resampling,
    after=(ALIGNMENT,),
    options=lambda options: (
        options.resampling,
        options.compression.rank,
        options.compression.training_texels,
        options.seed,
    ),
    reads=resampling.texels_read,
    wanted=lambda context: context.options.aligns,
    large_products=True,
)
# model fitted to the raw samples, and to the photographs -> field file
COMPRESSION = Stage(
    "compression",
    compression.write_compression,
    after=(
        *(OBSERVATIONS, LEFT_OUT_VIEWS, RESAMPLING, INDIRECT),
        *(SURFACE_OBSERVATIONS, SURFACE_INDIRECT),
    ),
    options=stage_inputs.field_options,
    reads=stage_inputs.field_metadata_digest,
    large_products=True,
)
# the field's frames as images, the mesh with its mean texture
MAPS = Stage("maps", maps.write_maps, after=(COMPRESSION,))
# the same field in the base frames, to compare with
WITHOUT_ALIGNMENT = Stage(
    "without_alignment",
    without_alignment.write_without_alignment,
    after=(COMPRESSION,),
    options=stage_inputs.field_options,
    reads=stage_inputs.field_metadata_digest,
    wanted=lambda context: context.options.compares_without_alignment,
    large_products=True,
)
# held-out photographs against the fields relit from their cameras
COMPARISON = Stage(
    "comparison",
    comparison.write_comparison,
    after=(COMPRESSION, WITHOUT_ALIGNMENT, HELD_OUT_SILHOUETTES),
    options=stage_inputs.rendering_options,
    reads=stage_inputs.comparison_digests,
)
# trivial baselines beside the field; errors by kind of pixel
ERROR_ANALYSIS = Stage(
    error_analysis.STAGE,
    error_analysis.write_error_analysis,
    after=(MAPS, COMPARISON),
    options=stage_inputs.rendering_options,
    reads=stage_inputs.error_analysis_digests,
)
# quality against size: the models quantised more and more coarsely
RATE_DISTORTION = Stage(
    "rate_distortion",
    rate_distortion.write_rate_distortion,
    after=(COMPRESSION, WITHOUT_ALIGNMENT, HELD_OUT_SILHOUETTES),
    options=stage_inputs.rendering_options,
    reads=stage_inputs.compared_digests,
    wanted=lambda context: context.options.shows_rate_distortion,
)
# the field as a web page, with photographs to compare with
WEB_PAGE = Stage(
    "web_page",
    web_page.write_web_page,
    after=(COMPRESSION, COMPARISON),
    reads=web_page.page_digests,
)
# all results in one page
REPORT = Stage(
    "report",
    report.write_report_page,
    after=(MODEL_SELECTION, MAPS, COMPARISON, ERROR_ANALYSIS, RATE_DISTORTION),
    options=stage_inputs.report_options,
    reads=stage_inputs.report_digests,
)

ORDER = (
    SILHOUETTES,
    HULL,
    HOLLOWS,
    ATLAS,
    VISIBILITY,
    OBSERVATIONS,
    HELD_OUT_SILHOUETTES,
    LEFT_OUT_VIEWS,
    MODEL_SELECTION,
    INDIRECT,
    SURFACE,
    SURFACE_VISIBILITY,
    SURFACE_OBSERVATIONS,
    SURFACE_INDIRECT,
    COMPLETION,
    ALIGNMENT,
    RESAMPLING,
    COMPRESSION,
    MAPS,
    WITHOUT_ALIGNMENT,
    COMPARISON,
    ERROR_ANALYSIS,
    RATE_DISTORTION,
    WEB_PAGE,
    REPORT,
)
STAGES = tuple(stage.name for stage in ORDER)
# What a candidate run computes: all that the comparison needs.
CANDIDATE_STAGES = tuple(
    stage
    for stage in ORDER[: ORDER.index(COMPARISON) + 1]
    if stage not in (MODEL_SELECTION, MAPS)
)
# Earlier names of stages, which are still accepted.
RENAMED = {"choices": MODEL_SELECTION.name, "frame_silhouettes": HELD_OUT_SILHOUETTES.name}


def run(
    capture: Capture,
    out: Path,
    options: PipelineOptions | None = None,
    *,
    hold_out: HoldOut | None = None,
    resources: Resources | None = None,
    from_stage: str | None = None,
    until: str = STAGES[-1],
    reuse: Sequence[Path] = (),
) -> Context:
    """Make a reflectance field of a capture, and measure how good it is.

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
    from_stage : str, optional
        This stage and all later ones are computed again even if nothing changed.
    until : str
        Stop after this stage.
    reuse : sequence of Path
        Folders of results of other runs: stages that are complete there with the same inputs
        and options are taken over.

    Returns
    -------
    Context
        Folders and records of the stages.

    Raises
    ------
    InputError
        If a stage is unknown, or capture or options cannot be used.
    GeometryError
        If the silhouettes do not determine a surface.
    """
    wanted, redo = stages_between(from_stage, until)
    context = Context(
        capture,
        out,
        options or PipelineOptions(),
        hold_out or HoldOut(),
        resources or Resources(),
        StageFolder(out / "stages", redo, [StageFolder(folder / "stages") for folder in reuse]),
        digests=FileDigests(out / "stages" / FILES_INDEX),
    )
    check(context)
    with only_run(context.stages.root), noting_the_field(context):
        for stage in wanted:
            if stage.name == MODEL_SELECTION.name:
                context = with_selected_options(context, wanted)
            elif stage.wanted(context):
                stage.run(context)
                log_warnings(context, stage.name)
                if context.stages.record(COMPRESSION.name) is not None:
                    publishing.publish(context)
        publishing.publish(context)
        publishing.publish_records(context, wanted[-1].name, whole=wanted == ORDER)
    return context


def stages_between(from_stage: str | None, until: str) -> tuple[tuple[Stage, ...], set[str]]:
    """Return the stages up to the last one, and the names of those to compute again.

    Raises
    ------
    InputError
        If a name is unknown, or the first stage comes after the last.
    """
    wanted = ORDER[: _number("until", until) + 1]
    redo = set(STAGES[_number("from_stage", from_stage) :]) if from_stage else set()
    if redo and redo.isdisjoint(stage.name for stage in wanted):
        raise InputError(
            f"from_stage, until: expected the first stage not after the last, received "
            f"{from_stage} after {until}"
        )
    return wanted, redo


def _number(argument: str, name: str) -> int:
    if name in RENAMED:
        log.warning("%s: stage %r is deprecated, use %r", argument, name, RENAMED[name])
    try:
        return STAGES.index(RENAMED.get(name, name))
    except ValueError:
        raise InputError(
            f"{argument}: expected one of {', '.join(STAGES)}, received {name!r}"
        ) from None


def check(context: Context) -> None:
    """Refuse what cannot be used, before anything is computed.

    Raises
    ------
    InputError
        Naming the argument or the option.
    """
    if context.resources.store is not None:
        check_place(context.resources.store, capture=context.capture.root, out=context.out)
    check_single_lights(context.capture)
    check_memory(context)
    model_selection.check_selectable(context)


def with_selected_options(context: Context, wanted: tuple[Stage, ...]) -> Context:
    """Return the context without "auto" in its options, where a wanted stage depends on them.

    Candidates are run where there are several.
    """
    names = [stage.name for stage in wanted]
    affected = model_selection.first_affected(context)
    if names[-1] != MODEL_SELECTION.name and affected not in names:
        return context
    if model_selection.has_candidates(context):
        MODEL_SELECTION.run(context)
    return model_selection.with_selection(context)


def log_warnings(context: Context, stage: str) -> None:
    """Log what a user must know of the result of a stage, computed now or before."""
    for text in context.stages.warnings(stage):
        log.warning("%s: %s", stage, text)


@contextmanager
def noting_the_field(context: Context) -> Iterator[None]:
    """Note on an error that comes after the field is finished that it is there."""
    try:
        yield
    except Exception as error:
        if context.stages.record(COMPRESSION.name) is not None:
            error.add_note(f"the field is finished: {context.out / 'field.rfld'}")
        raise
