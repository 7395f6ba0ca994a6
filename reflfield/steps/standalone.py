"""Comparison of a field with any frames, outside a run."""

from __future__ import annotations

from pathlib import Path

from reflfield.capture.model import Capture
from reflfield.comparison import sections
from reflfield.comparison.heldout import compare_with_photographs
from reflfield.comparison.metrics import Comparison, metrics_text
from reflfield.comparison.report import ReportContent, write_report
from reflfield.field.model import ReflectanceField
from reflfield.files import replacing
from reflfield.relighting.renderer import RenderOptions


def write_standalone_comparison(
    field: ReflectanceField, frames: Capture, out: Path, options: RenderOptions
) -> Comparison:
    """Relight frames, measure them, and write pictures, ``metrics.json`` and a page.

    Parameters
    ----------
    field : ReflectanceField
    frames : Capture
        With photographs.
    out : Path
        Gets ``relit/``, ``metrics.json`` and ``report/index.html``.
    options : RenderOptions

    Returns
    -------
    Comparison
    """
    comparison, pairs = compare_with_photographs(field, frames, out / "relit", options)
    with replacing(out / "metrics.json") as partial:
        partial.write_text(metrics_text(comparison.to_dict()))
    (out / "report").mkdir(exist_ok=True)
    content = ReportContent(
        title=f"{field.metadata.get('capture', 'field')} against {frames.name}",
        subtitle=f"{len(pairs)} frames",
        key_numbers=sections.key_numbers(comparison),
        sections=(
            sections.frames_section(
                comparison,
                pairs,
                title="Frames",
                intro="Photographs beside what the field predicts for them.",
            ),
        ),
    )
    write_report(out / "report" / "index.html", content)
    return comparison
