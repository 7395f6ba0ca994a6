"""The command "compare": a field against any photographs, outside a run."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from reflfield.capture.capture import Capture
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.geometry.mesh import Mesh
from reflfield.metrics.comparison_silhouettes import write_comparison_silhouettes
from reflfield.metrics.held_out_photographs import RelitPairs, compare_with_photographs
from reflfield.metrics.image_metrics import Comparison, metrics_text
from reflfield.pipeline.relight_command import check_kept, image_files
from reflfield.render.renderer import RenderOptions
from reflfield.report import sections
from reflfield.report.page import ReportContent, write_report
from reflfield.util.files import filling


def write_comparison_with(
    field: ReflectanceField, frames: Capture, out: Path, options: RenderOptions
) -> Comparison:
    """Relight frames, measure them, and write images, ``metrics.json`` and a page.

    Parameters
    ----------
    field : ReflectanceField
    frames : Capture
        With photographs. Views without a silhouette get one made from their photographs if
        they are enough, else the field's own surface as the camera sees it.
    out : Path
        Gets ``relit/``, ``metrics.json`` and ``report/index.html``: all, or nothing after an
        error.
    options : RenderOptions

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If no frame can be compared, or a file of the frames would be replaced.
    NumericalError
        If what the field shows is not finite.
    """
    pages = [out / "metrics.json", out / "report" / "index.html"]
    check_kept(frames, [*pages, *image_files(frames, out / "relit")])
    with TemporaryDirectory() as scratch, filling(out) as partial:
        silhouettes = write_comparison_silhouettes(
            frames, frames, Mesh(field.positions, field.faces), Path(scratch), options.workers
        )
        comparison = compare_with_photographs(
            field, frames, silhouettes, partial / "relit", options
        )
        pairs = RelitPairs(frames, partial / "relit", silhouettes).measured_in(comparison)
        (partial / "metrics.json").write_text(metrics_text(comparison.to_dict()))
        write_report(partial / "report" / "index.html", _page(field, comparison, pairs))
    return comparison


def _page(field: ReflectanceField, comparison: Comparison, pairs: RelitPairs) -> ReportContent:
    return ReportContent(
        title=f"{field.metadata.get('capture', 'field')} against {pairs.frames.name}",
        subtitle=f"{len(pairs)} frames",
        key_numbers=sections.key_numbers(comparison),
        sections=(
            sections.held_out_section(
                comparison,
                pairs,
                title="Frames",
                intro="Photographs beside what the field predicts for them.",
            ),
        ),
    )
