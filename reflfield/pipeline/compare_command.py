"""The command "compare": a field against any photographs, outside a run."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from reflfield.capture.capture import Capture
from reflfield.errors import InputError
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.geometry.mesh import Mesh
from reflfield.metrics.baselines import Baselines, albedo_of_field
from reflfield.metrics.comparison_silhouettes import write_comparison_silhouettes
from reflfield.metrics.error_kinds import KindFinder
from reflfield.metrics.held_out_photographs import RelitPairs, compare_with_photographs
from reflfield.metrics.image_metrics import metrics_text
from reflfield.pipeline.analysis_report import analysed_images
from reflfield.pipeline.error_analysis import Analyser, analyse, metrics_of
from reflfield.pipeline.relight_command import check_kept, image_files
from reflfield.render.camera_rays import FieldSurface
from reflfield.render.nearest_photographs import NearestPhotographs
from reflfield.render.renderer import RenderOptions
from reflfield.report import sections
from reflfield.report.page import ReportContent, write_report
from reflfield.report.sections import AnalysedImages
from reflfield.util.files import filling

# Title of the set of photographs.
TITLE = "Photographs"


def write_comparison_with(
    field: ReflectanceField,
    capture: Capture,
    out: Path,
    options: RenderOptions,
    photographs: Capture | None = None,
) -> dict[str, Any]:
    """Relight photographs, measure them, and write images, ``metrics.json`` and a page.

    Parameters
    ----------
    field : ReflectanceField
    capture : Capture
        With photographs. Views without a silhouette get one made from their photographs if
        they are enough, else the field's own surface as the camera sees it.
    out : Path
        Gets ``relit/``, ``metrics.json`` and ``report/index.html``: all, or nothing after an
        error.
    options : RenderOptions
    photographs : Capture, optional
        That made the field, for the nearest one of each photograph; `capture` where they
        are of the field's own capture.

    Returns
    -------
    dict
        `Comparison.to_dict`, with the baselines and the errors by kind.

    Raises
    ------
    InputError
        If no photograph can be compared, or a file of the capture or the results of a run
        would be replaced.
    NumericalError
        If what the field shows is not finite.
    """
    if (out / "stages").is_dir():
        raise InputError(
            f"out: expected a folder of its own, received {out}, where metrics and report are "
            "those of a run; choose another"
        )
    pages = [out / "metrics.json", out / "report" / "index.html"]
    check_kept(capture, [*pages, *image_files(capture, out / "relit")])
    with TemporaryDirectory() as scratch, filling(out) as partial:
        silhouettes = write_comparison_silhouettes(
            capture, capture, Mesh(field.positions, field.faces), Path(scratch), options.workers
        )
        comparison = compare_with_photographs(
            field, capture, silhouettes, partial / "relit", options
        )
        pairs = RelitPairs(capture, partial / "relit", silhouettes).measured_in(comparison)
        analyser = _analyser(field, capture, photographs, options)
        analysed = analyse(analyser, pairs, comparison, Path(scratch))
        analysis = metrics_of(analysed)
        (partial / "metrics.json").write_text(metrics_text(comparison.to_dict(), **analysis))
        images = analysed_images(TITLE, comparison, analysed, pairs, Path(scratch))
        write_report(partial / "report" / "index.html", _page(field, pairs, images))
    return {**comparison.to_dict(), **analysis}


def _analyser(
    field: ReflectanceField,
    capture: Capture,
    photographs: Capture | None,
    options: RenderOptions,
) -> Analyser:
    """Baselines of a field without its run: the mean texture is the field's own."""
    surface = FieldSurface(field, options.workers, options.ray_offset)
    albedo = albedo_of_field(field, surface)
    nearest = _nearest(field, surface, capture, photographs)
    return Analyser(
        Baselines(field, surface, albedo, nearest, options), KindFinder(surface, albedo)
    )


def _nearest(
    field: ReflectanceField,
    surface: FieldSurface,
    capture: Capture,
    photographs: Capture | None,
) -> NearestPhotographs | str:
    """Photographs that made the field, or why there are none."""
    if photographs is None and not is_capture_of(field, capture):
        return (
            "the photographs that made the field are not at hand; name their capture with "
            "`field_photographs`"
        )
    try:
        return NearestPhotographs(surface, photographs or capture)
    except InputError as error:
        return str(error)


def is_capture_of(field: ReflectanceField, capture: Capture) -> bool:
    """Whether a capture has the name of the one that made a field, and views and lights enough.

    Parameters
    ----------
    field : ReflectanceField
    capture : Capture

    Returns
    -------
    bool
    """
    views, lights = (field.metadata.get(name) for name in ("views", "lights"))
    return bool(
        field.metadata.get("capture") == capture.name
        and (isinstance(views, int) and capture.n_views >= views)
        and (isinstance(lights, int) and capture.n_lights >= lights)
    )


def _page(field: ReflectanceField, pairs: RelitPairs, images: AnalysedImages) -> ReportContent:
    return ReportContent(
        title=f"{field.metadata.get('capture', 'field')} against {pairs.capture.name}",
        subtitle=f"{len(pairs)} photographs",
        key_numbers=sections.key_numbers(images.comparison),
        sections=(
            sections.held_out_section(
                images.comparison,
                pairs,
                title=TITLE,
                intro="Photographs beside what the field predicts for them.",
            ),
            *sections.analysis_sections([images]),
        ),
    )
