"""Stage "report": all results in one page."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.field.description import describe
from reflfield.field.file import open_field
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.geometry.ray_scene import RayScene
from reflfield.metrics.held_out_photographs import RelitPairs
from reflfield.metrics.image_metrics import Comparison
from reflfield.pipeline import comparison, hold_out, model_selection
from reflfield.pipeline.atlas import METHOD
from reflfield.pipeline.cache import plain, versions
from reflfield.pipeline.compared_photographs import frame_sets
from reflfield.pipeline.context import Job
from reflfield.pipeline.held_out_silhouettes import silhouettes_of_frames
from reflfield.pipeline.hull import LEFT_OUT
from reflfield.pipeline.maps import AVERAGES
from reflfield.pipeline.quantisation_search import missed_quality
from reflfield.pipeline.rate_distortion import stored_points
from reflfield.pipeline.sample_bookkeeping import accounts_of
from reflfield.pipeline.truth_comparison import TruthScores, truth_scores
from reflfield.report import sections
from reflfield.report.page import ReportContent, Section, write_report

# Sets of frames that are compared: title and sentence.
FRAME_TITLES = {
    "heldout": ("Held-out photographs", "Photographs of the capture that were kept apart."),
    "truth": ("Unseen views and lights", "Simulated from cameras and lights off the rig."),
}


def write_report_page(job: Job, folder: Path) -> dict[str, Any]:
    """The page: everything that was found."""
    field = open_field(job.stages.root / "compression" / "field.rfld")
    scores = truth_scores(job, field)
    content = report_content(job, field, job.result("maps", AVERAGES)["average"], scores)
    write_report(folder / "index.html", content)
    problems = scores.problems if scores is not None else ()
    return {"sections": len(content.sections), comparison.PROBLEMS: list(problems)}


def report_content(
    job: Job,
    field: ReflectanceField,
    average: NDArray[np.float32],
    scores: TruthScores | None,
) -> ReportContent:
    """All sections of the page, in the order of the stages."""
    compared = {name: comparison.comparison_of(job, name) for name in frame_sets(job)}
    main = compared.get("heldout") or compared.get("truth")
    parts = [
        *_frames_sections(job, compared),
        *_choices_sections(job),
        *_ablation_sections(job, compared),
        *_rate_sections(job),
        *_surface_sections(job, field, average),
        *_alignment_sections(job),
        *_truth_sections(scores, compared.get("truth")),
        _compression_section(job),
        sections.bookkeeping_section(list(accounts_of(job))),
        sections.stages_section([_stage(record) for record in job.stages.records]),
        sections.run_section(plain(job.options), versions()),
    ]
    counts = job.stages.records[-1] if job.stages.records else None
    size = (job.stages.root / "compression" / "field.rfld").stat().st_size
    return ReportContent(
        title=job.capture.name,
        subtitle=_subtitle(job),
        key_numbers=sections.key_numbers(
            main,
            file_bytes=size,
            raw_bytes=raw_bytes(job),
            seconds=model_selection.total_seconds(job),
        ),
        sections=tuple(parts),
        warnings=tuple(
            dict.fromkeys((*warnings_of(job), *(scores.problems if scores else ())))
        ),
        footer="" if counts is None else f"Stages in {job.stages.root.name}/",
    )


def _subtitle(job: Job) -> str:
    training = job.training
    return (
        f"{training.n_views} views, {training.n_lights} lights, {len(training.photographs)} "
        f"photographs, {job.base_reader.n_texels} texels. "
        f"Held out: {hold_out.held_out_words(job.split)}."
    )


def raw_bytes(job: Job) -> int:
    """Samples of the capture as half floats, unobserved ones included."""
    return int(np.prod(job.observed.views.shape)) * job.training.n_lights * 3 * 2


def problems_of(job: Job) -> Iterator[str]:
    """What could not be compared, and why; each once."""
    records = job.stages.records
    found = (text for r in records for text in r.counts.get(comparison.PROBLEMS, ()))
    yield from dict.fromkeys(found)


def warnings_of(job: Job) -> Iterator[str]:
    """What a user should look at first."""
    for record in job.stages.records:
        yield from job.stages.warnings(record.name)
    yield from hold_out.left_out_words(job.capture, job.split)
    yield from filter(None, [missed_quality(job)])
    yield from problems_of(job)
    unseen = job.base_reader.n_texels - len(job.seen_texels)
    if unseen:
        share = unseen / job.base_reader.n_texels
        yield (
            f"{unseen} of {job.base_reader.n_texels} texels ({share:.0%}) have no sample; they "
            "repeat the nearest texel that has."
        )
    missing = int((~job.observed.pairs).sum())
    if missing:
        total = job.observed.pairs.size
        yield f"{missing} of {total} pairs of view and light have no photograph."


def _surface_sections(
    job: Job, field: ReflectanceField, average: NDArray[np.float32]
) -> Iterator[Section]:
    texels = job.texels
    origin = job.training.silhouette_origin(0)
    hull, made = job.stages.record("hull"), job.stages.record("atlas")
    yield sections.silhouettes_section(
        _silhouette_views(job),
        origin={
            "file": "given with the capture",
            "alpha": "alpha of the photographs",
        }.get(origin, "made from the photographs"),
        left_out=() if hull is None else hull.counts.get(LEFT_OUT, ()),
    )
    yield sections.atlas_section(
        texels.texel_of_pixel,
        texels.chart,
        average,
        {
            "charts": int(texels.chart.max()) + 1,
            METHOD: "" if made is None else str(made.counts.get(METHOD, "")),
            "texels": len(texels),
        },
    )
    yield sections.coverage_section(
        texels.texel_of_pixel, job.view_seen.sum(axis=1), job.observed.lights.sum(axis=1)
    )
    yield sections.normals_section(
        texels.texel_of_pixel, field.local_from_world, texels.local_from_world
    )


def _silhouette_views(job: Job) -> Iterator[sections.SilhouetteView]:
    scene = RayScene(job.surface_atlas.mesh, threads=job.resources.workers)
    for i, camera in enumerate(job.training.cameras):
        photographs = job.training.photograph_index[i]
        photographed = photographs[photographs >= 0]
        yield sections.SilhouetteView(
            name=camera.id,
            photograph=(
                job.training.read_photograph(int(photographed[0]))
                if len(photographed)
                else np.zeros((camera.height, camera.width, 3), np.float32)
            ),
            silhouette=job.view_silhouettes[i],
            hull_silhouette=scene.silhouette(camera),
        )


def _frames_sections(job: Job, compared: dict[str, Comparison | None]) -> Iterator[Section]:
    for name, pairs in comparison.relit_pairs(job).items():
        measured = compared[name]
        if measured is not None:
            title, intro = FRAME_TITLES[name]
            yield sections.held_out_section(measured, pairs, title=title, intro=intro)


def _ablation_sections(job: Job, compared: dict[str, Comparison | None]) -> Iterator[Section]:
    """With alignment against without, if the options ask for it."""
    if not job.options.compares_without_alignment:
        return
    counts = {record.name: record.counts for record in job.stages.records}
    names = {comparison.MAIN: "with alignment", comparison.WITHOUT: "without alignment"}
    variants, pairs = [], []
    for variant, stage in comparison.variants(job).items():
        found = compared
        if variant != comparison.MAIN:
            found = {n: comparison.comparison_of(job, n, variant) for n in compared}
        variants.append(_variant(names[variant], found, counts[stage]))
        pairs.append(next(iter(comparison.relit_pairs(job, variant).values()), ()))
    yield sections.ablation_section(variants, pairs)


def _choices_sections(job: Job) -> Iterator[Section]:
    """What was "auto", if anything was: what it has come to, and what was tried."""
    words = list(model_selection.words_of(job))
    if not words:
        return
    if not model_selection.is_open(job):
        yield sections.rules_section(words)
        return
    found, records = model_selection.outcome(job), model_selection.trial_records(job)
    tried, pairs = [], []
    for candidate in found.tried:
        folder = job.stages.root / model_selection.STAGE / candidate.name
        measured = comparison.read_comparison(folder / "heldout.json")
        if measured is None:
            return
        relit = RelitPairs(
            job.held_frames,
            folder / "heldout",
            silhouettes_of_frames(job, "heldout", job.held_frames),
        )
        pairs.append(relit.measured_in(measured))
        tried.append(
            sections.CandidateRun(
                _variant(
                    candidate.name,
                    {"heldout": measured},
                    json.loads((folder / "field.json").read_text()),
                ),
                seconds=sum(r["seconds"] for r in records[candidate.name]),
                unseen=_mean_of(folder / "truth.json"),
            )
        )
    yield sections.candidate_runs_section(tried, found.taken.name, words, pairs)


def _mean_of(metrics: Path) -> dict[str, float] | None:
    return json.loads(metrics.read_text())["mean"] if metrics.is_file() else None


def _variant(
    name: str, compared: dict[str, Comparison | None], counts: dict[str, Any]
) -> sections.FieldVariant:
    """A field as the sections take it that compare several."""
    return sections.FieldVariant(
        name,
        {FRAME_TITLES[n][0]: c for n, c in compared.items() if c is not None},
        counts["field bytes"],
        counts["relative error of the samples"],
        counts["relative error of their cube roots"],
    )


def _rate_sections(job: Job) -> Iterator[Section]:
    """Quality against size, if the options ask for it."""
    if not job.options.shows_rate_distortion:
        return
    yield sections.rate_distortion_section(
        stored_points(job),
        "The last row has the numbers of the fitted model as half floats, unfactored and not "
        "packed, as the paper stores them.",
    )


def _alignment_sections(job: Job) -> Iterator[Section]:
    if not job.options.aligns:
        return
    stored = job.result("alignment", "alignment.npz")
    yield sections.alignment_section(stored["history"], stored["margin"][job.seen_texels])


def _truth_sections(
    scores: TruthScores | None, compared: Comparison | None
) -> Iterator[Section]:
    if scores is not None:
        yield sections.truth_section(
            hull=scores.hull,
            frames=scores.frames,
            base_frames=scores.base_frames,
            completion=scores.completion,
            comparison=compared,
        )


def _compression_section(job: Job) -> Section:
    path = job.stages.root / "compression" / "field.rfld"
    parts = describe(open_field(path)).stored_bytes
    rest = path.stat().st_size - sum(parts.values())
    return sections.compression_section({**parts, "header, names": rest}, raw_bytes(job))


def _stage(record: Any) -> sections.StageRecord:
    counts = {k: v for k, v in record.counts.items() if isinstance(v, int)}
    return sections.StageRecord(
        name=record.name,
        seconds=record.seconds,
        peak_bytes=record.peak_bytes,
        outputs=counts,
        size_bytes=record.size_bytes,
        reused=record.reused,
    )
