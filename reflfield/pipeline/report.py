"""Stage "report": all results in one page."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
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
from reflfield.pipeline import (
    comparison,
    error_analysis,
    hold_out,
    model_selection,
    results,
    web_page,
)
from reflfield.pipeline.analysis_report import analysed_images
from reflfield.pipeline.atlas import METHOD
from reflfield.pipeline.cache import plain, versions
from reflfield.pipeline.compared_photographs import compared_photographs
from reflfield.pipeline.context import Context
from reflfield.pipeline.held_out_silhouettes import silhouettes_of
from reflfield.pipeline.hollows import SHARE
from reflfield.pipeline.hull import LEFT_OUT
from reflfield.pipeline.maps import AVERAGES
from reflfield.pipeline.memory import readers_at_once
from reflfield.pipeline.quantisation_search import missed_quality
from reflfield.pipeline.rate_distortion import stored_points
from reflfield.pipeline.sample_bookkeeping import sample_counts
from reflfield.pipeline.truth_comparison import TruthScores, truth_scores
from reflfield.report import sections
from reflfield.report.page import ReportContent, Section, write_report

# Views of hull and surface, and their longest side, pixels.
SURFACE_VIEWS, SURFACE_PX = 3, 720
# Sets of photographs that are compared: title and sentence.
PHOTOGRAPH_TITLES = {
    "heldout": ("Held-out photographs", "Photographs of the capture that were kept apart."),
    "truth": ("Unseen views and lights", "Simulated from cameras and lights off the rig."),
}


def write_report_page(context: Context, folder: Path) -> dict[str, Any]:
    """Write the page of all results."""
    field = open_field(results.field_file(context))
    scores = truth_scores(context, field)
    content = report_content(
        context, field, results.arrays(context, "maps", AVERAGES)["average"], scores
    )
    write_report(folder / "index.html", content)
    scores = scores or TruthScores()
    return {
        "sections": len(content.sections),
        **scores.counts(),
        comparison.PROBLEMS: list(scores.problems),
    }


def report_content(
    context: Context,
    field: ReflectanceField,
    average: NDArray[np.float32],
    scores: TruthScores | None,
) -> ReportContent:
    """All sections of the page, in the order of the stages."""
    compared = {
        name: comparison.comparison_of(context, name) for name in compared_photographs(context)
    }
    main = compared.get("heldout") or compared.get("truth")
    parts = [
        *_photograph_sections(context, compared),
        *_analysis_sections(context, compared),
        *_selection_sections(context),
        *_ablation_sections(context, compared),
        *_rate_sections(context),
        *_surface_sections(context, field, average),
        *_alignment_sections(context),
        *_truth_sections(scores, compared.get("truth")),
        _compression_section(context),
        sections.bookkeeping_section(list(sample_counts(context))),
        sections.stages_section([_stage(record) for record in context.stages.records]),
        sections.run_section(plain(context.options), versions()),
    ]
    counts = context.stages.records[-1] if context.stages.records else None
    size = (results.field_file(context)).stat().st_size
    return ReportContent(
        title=context.capture.name,
        subtitle=_subtitle(context),
        key_numbers=sections.key_numbers(
            main,
            file_bytes=size,
            raw_bytes=results.base_reader(context).store.raw_bytes(),
            seconds=model_selection.total_seconds(context),
        ),
        sections=tuple(parts),
        warnings=tuple(
            dict.fromkeys((*warnings_of(context), *(scores.problems if scores else ())))
        ),
        footer="" if counts is None else f"Stages in {context.stages.root.name}/",
        # From where the two are published.
        object_page=f"../{web_page.FILE}",
    )


def _subtitle(context: Context) -> str:
    training = context.training
    return (
        f"{training.n_views} views, {training.n_lights} lights, {len(training.photographs)} "
        f"photographs, {results.base_reader(context).n_texels} texels. "
        f"Held out: {hold_out.held_out_sentence(context.split)}."
    )


def problems_of(context: Context) -> Iterator[str]:
    """What could not be compared, and why; each once."""
    records = context.stages.records
    problems = (text for r in records for text in r.counts.get(comparison.PROBLEMS, ()))
    yield from dict.fromkeys(problems)


def warnings_of(context: Context) -> Iterator[str]:
    """What a user should look at first."""
    for record in context.stages.records:
        yield from context.stages.warnings(record.name)
    yield from hold_out.left_out_sentences(context.capture, context.split)
    yield from filter(None, [missed_quality(context)])
    yield from problems_of(context)
    n_texels = results.base_reader(context).n_texels
    unseen = n_texels - len(results.measured_texels(context))
    if unseen:
        yield (
            f"{unseen} of {n_texels} texels ({unseen / n_texels:.0%}) have no sample; they "
            "repeat the nearest texel that has."
        )
    pairs = results.observed(context).pairs
    total = pairs.n_views * pairs.n_lights
    if missing := total - len(pairs):
        yield f"{missing} of {total} pairs of view and light have no photograph."


def _surface_sections(
    context: Context, field: ReflectanceField, average: NDArray[np.float32]
) -> Iterator[Section]:
    texels = results.texels(context)
    origin = context.training.silhouette_origin(0)
    hull, hollows, made = map(context.stages.record, ("hull", "hollows", "atlas"))
    yield sections.silhouettes_section(
        _SilhouetteViews(context, RayScene(results.atlas(context).mesh, threads=1)),
        workers=min(context.resources.workers, readers_at_once(context)),
        origin={
            "file": "given with the capture",
            "alpha": "alpha of the photographs",
        }.get(origin, "made from the photographs"),
        left_out=() if hull is None else hull.counts.get(LEFT_OUT, ()),
        carved=0.0 if hollows is None else float(hollows.counts[SHARE]),
    )
    if views := list(surface_views(context)):
        yield sections.surface_section(views)
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
        texels.texel_of_pixel,
        results.view_visible(context).sum(axis=1),
        results.observed(context).lights.sum(axis=1),
    )
    yield sections.normals_section(
        texels.texel_of_pixel, field.local_from_world, texels.local_from_world
    )


def surface_views(context: Context) -> Iterator[sections.SurfaceView]:
    """Some views of hull and surface; none where they are the same."""
    context = context.refined
    base = context.is_plane or results.base_mesh(context) is results.hull_mesh(context)
    if base and not context.on_surface:
        return
    scenes = [RayScene(results.hull_mesh(context)), RayScene(results.atlas(context).mesh)]
    index = context.training.photograph_index
    photographed = np.flatnonzero((index >= 0).any(axis=1))
    at = np.unique(np.linspace(0, len(photographed) - 1, SURFACE_VIEWS + 1).astype(int)[:-1])
    for view in photographed[at]:
        camera = context.training.cameras[view]
        photograph = context.training.read_photograph(int(index[view][index[view] >= 0][0]))
        # As many pixels as a page shows.
        step = -(-max(photograph.shape[:2]) // SURFACE_PX)
        yield sections.SurfaceView(
            camera.id,
            photograph[::step, ::step],
            *(scene.facing(camera, step) for scene in scenes),
        )


@dataclass(frozen=True, eq=False)
class _SilhouetteViews(Sequence[sections.SilhouetteView]):
    """Views of a run beside the hull, each worked out when it is asked for."""

    context: Context
    scene: RayScene

    def __len__(self) -> int:
        return self.context.training.n_views

    def __getitem__(self, view: Any) -> Any:
        camera = self.context.training.cameras[view]
        return sections.SilhouetteView(
            name=camera.id,
            photograph=partial(self._photograph, view),
            silhouette=results.silhouettes(self.context)[view],
            hull_silhouette=self.scene.silhouette(camera),
        )

    def _photograph(self, view: int) -> NDArray[np.float32]:
        """The first of a view; black if there is none."""
        training = self.context.training
        camera, photographs = training.cameras[view], training.photograph_index[view]
        photographed = photographs[photographs >= 0]
        if not len(photographed):
            return np.zeros((camera.height, camera.width, 3), np.float32)
        return training.read_photograph(int(photographed[0]))


def _photograph_sections(
    context: Context, compared: dict[str, Comparison | None]
) -> Iterator[Section]:
    for name, pairs in comparison.relit_pairs(context).items():
        measured = compared[name]
        if measured is not None:
            title, intro = PHOTOGRAPH_TITLES[name]
            yield sections.held_out_section(measured, pairs, title=title, intro=intro)


def _analysis_sections(
    context: Context, compared: dict[str, Comparison | None]
) -> tuple[Section, ...]:
    """Trivial baselines, and where the error lies, if anything was compared."""
    folder, sets = context.stages.root / error_analysis.STAGE, []
    for name, pairs in comparison.relit_pairs(context).items():
        measured, analysed = compared[name], error_analysis.analysis_of(context, name)
        if measured is not None and analysed is not None:
            title = PHOTOGRAPH_TITLES[name][0]
            sets.append(analysed_images(title, measured, analysed, pairs, folder / name))
    return sections.analysis_sections(sets) if sets else ()


def _ablation_sections(
    context: Context, compared: dict[str, Comparison | None]
) -> Iterator[Section]:
    """With alignment against without, if the options ask for it."""
    if not context.options.compares_without_alignment:
        return
    counts = {record.name: record.counts for record in context.stages.records}
    names = {comparison.MAIN: "with alignment", comparison.WITHOUT: "without alignment"}
    variants, pairs = [], []
    for variant, stage in comparison.variants(context).items():
        of_variant = compared
        if variant != comparison.MAIN:
            of_variant = {n: comparison.comparison_of(context, n, variant) for n in compared}
        variants.append(_variant(names[variant], of_variant, counts[stage]))
        pairs.append(next(iter(comparison.relit_pairs(context, variant).values()), ()))
    yield sections.ablation_section(variants, pairs)


def _selection_sections(context: Context) -> Iterator[Section]:
    """What was "auto", if anything was: what was selected, and the candidates."""
    sentences = list(model_selection.sentences(context))
    if not sentences:
        return
    if not model_selection.has_candidates(context):
        yield sections.rules_section(sentences)
        return
    selection = model_selection.selection(context)
    records = model_selection.candidate_records(context)
    candidates, pairs = [], []
    for candidate in selection.candidates:
        folder = context.stages.root / model_selection.STAGE / candidate.name
        measured = comparison.read_comparison(folder / "heldout.json")
        if measured is None:
            return
        relit = RelitPairs(
            context.held_out,
            folder / "heldout",
            silhouettes_of(context, "heldout", context.held_out),
        )
        pairs.append(relit.measured_in(measured))
        candidates.append(
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
    yield sections.candidate_runs_section(candidates, selection.selected.name, sentences, pairs)


def _mean_of(metrics: Path) -> dict[str, float] | None:
    return json.loads(metrics.read_text())["mean"] if metrics.is_file() else None


def _variant(
    name: str, compared: dict[str, Comparison | None], counts: dict[str, Any]
) -> sections.FieldVariant:
    """A field as the sections take it that compare several."""
    return sections.FieldVariant(
        name,
        {PHOTOGRAPH_TITLES[n][0]: c for n, c in compared.items() if c is not None},
        counts["field bytes"],
        counts["relative error of the samples"],
        counts["relative error of their cube roots"],
    )


def _rate_sections(context: Context) -> Iterator[Section]:
    """Quality against size, if the options ask for it."""
    if not context.options.shows_rate_distortion:
        return
    yield sections.rate_distortion_section(
        stored_points(context),
        "The last row has the numbers of the fitted model as half floats, unfactored and not "
        "packed, as the paper stores them.",
    )


def _alignment_sections(context: Context) -> Iterator[Section]:
    if not context.options.aligns:
        return
    stored = results.arrays(context, "alignment", "alignment.npz")
    yield sections.alignment_section(
        stored["history"], stored["margin"][results.measured_texels(context)]
    )


def _truth_sections(
    scores: TruthScores | None, compared: Comparison | None
) -> Iterator[Section]:
    if scores is not None:
        yield sections.truth_section(
            surfaces=scores.surfaces,
            frames=scores.frames,
            base_frames=scores.base_frames,
            completion=scores.completion,
            comparison=compared,
        )


def _compression_section(context: Context) -> Section:
    path = results.field_file(context)
    parts = describe(open_field(path)).stored_bytes
    rest = path.stat().st_size - sum(parts.values())
    raw_bytes = results.base_reader(context).store.raw_bytes()
    return sections.compression_section({**parts, "header, names": rest}, raw_bytes)


def _stage(record: Any) -> sections.StageSummary:
    counts = {k: v for k, v in record.counts.items() if isinstance(v, int)}
    return sections.StageSummary(
        name=record.name,
        seconds=record.seconds,
        peak_bytes=record.peak_bytes,
        counts=counts,
        size_bytes=record.size_bytes,
        reused=record.reused,
    )
