"""Section on quality against size: the field at several quantisation steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from reflfield.errors import InputError
from reflfield.report import plots
from reflfield.report.page import (
    Figure,
    Note,
    Panel,
    Picture,
    Section,
    Table,
    format_bytes,
)


@dataclass(frozen=True)
class RatePoint:
    """One field of a curve.

    Attributes
    ----------
    curve : str
        Such as "with alignment".
    file_bytes : int
    samples_db : float
        LDR PSNR on the samples that the field was made of.
    heldout_db : float or None
        Mean LDR PSNR of the held-out photographs; None without any.
    """

    curve: str
    file_bytes: int
    samples_db: float
    heldout_db: float | None


def rate_distortion_section(points: Sequence[RatePoint], note: str = "") -> Section:
    """PSNR against bytes of all curves, plotted and as a table.

    Parameters
    ----------
    points : sequence of RatePoint
        At least one.
    note : str
        A remark on the curves.

    Returns
    -------
    Section

    Raises
    ------
    InputError
        If there is no point.
    """
    if not points:
        raise InputError("points: expected at least one, received none")
    panels = [Panel(_plot(points, "samples_db", "LDR PSNR of the samples, dB"), "samples")]
    if any(point.heldout_db is not None for point in points):
        plot = _plot(points, "heldout_db", "LDR PSNR of held-out photographs, dB")
        panels.insert(0, Panel(plot, "held-out photographs"))
    figure = Figure(
        tuple(panels),
        "Each curve is one model; the relative quantisation step grows from right to left.",
        min_width=0,
    )
    return Section(
        "Quality against size",
        "The field at several quantisation steps, of which compression.relative_step, "
        "compression.size or compression.psnr selects one.",
        (figure, _table(points), *((Note(note),) if note else ())),
    )


def _plot(points: Sequence[RatePoint], which: str, label: str) -> Picture:
    series: dict[str, tuple[list[float], list[float]]] = {}
    for point in points:
        value = getattr(point, which)
        if value is not None:
            xs, ys = series.setdefault(point.curve, ([], []))
            xs.append(point.file_bytes / 1e6)
            ys.append(value)
    return plots.lines(series, "size of the file, MB", label, log_x=True)


def _table(points: Sequence[RatePoint]) -> Table:
    return Table(
        ("field", "size", "bytes", "samples, dB", "held out, dB"),
        tuple(
            (
                point.curve,
                format_bytes(point.file_bytes),
                point.file_bytes,
                f"{point.samples_db:.2f}",
                "-" if point.heldout_db is None else f"{point.heldout_db:.2f}",
            )
            for point in points
        ),
        "LDR PSNR, as everywhere in this report.",
    )
