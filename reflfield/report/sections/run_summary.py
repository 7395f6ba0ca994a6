"""Head of the page and sections on the run: compression, stages, options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from reflfield.metrics.image_metrics import (
    Comparison,
)
from reflfield.report import plots
from reflfield.report.page import (
    Figure,
    KeyNumber,
    Panel,
    Section,
    Table,
    format_bytes,
    format_number,
    format_seconds,
)


def key_numbers(
    comparison: Comparison | None = None,
    *,
    file_bytes: int | None = None,
    raw_bytes: int | None = None,
    seconds: float | None = None,
) -> tuple[KeyNumber, ...]:
    r"""The numbers for the head of the page; those that are not given are left out.

    Parameters
    ----------
    comparison : Comparison, optional
        Of the held-out photographs.
    file_bytes, raw_bytes : int, optional
        Size of the field file, and of its samples as half floats.
    seconds : float, optional
        Processing time of all stages.

    Returns
    -------
    tuple of KeyNumber

    Examples
    --------
    >>> [(n.label, n.value) for n in key_numbers(file_bytes=10**6, raw_bytes=9 * 10**9)]
    [('field file', '1 MB'), ('compression', '9\u202f000 : 1')]
    """
    numbers: list[KeyNumber] = []
    if comparison is not None:
        mean, count = (
            comparison.mean,
            f"mean of {len(comparison.images)} held-out photographs",
        )
        numbers += [
            KeyNumber("PSNR (LDR)", f"{mean['psnr_ldr']:.2f} dB", count),
            KeyNumber("SSIM", f"{mean['ssim']:.3f}", "1: identical"),
            KeyNumber("FLIP", f"{mean['flip']:.3f}", "0: indistinguishable"),
        ]
    if file_bytes is not None:
        numbers.append(
            KeyNumber("field file", format_bytes(file_bytes), "all that relighting needs")
        )
    if file_bytes and raw_bytes is not None:
        ratio = format_number(float(f"{raw_bytes / file_bytes:.3g}"))
        detail = f"of {format_bytes(raw_bytes)} of half-float samples"
        numbers.append(KeyNumber("compression", f"{ratio} : 1", detail))
    if seconds is not None:
        numbers.append(KeyNumber("wall time", format_seconds(seconds), "all stages"))
    return tuple(numbers)


def compression_section(parts: Mapping[str, int], raw_bytes: int) -> Section:
    """Compression: sizes of the file's parts.

    Parameters
    ----------
    parts : mapping of name to bytes
        Parts of the field file, all of it.
    raw_bytes : int
        Samples of the capture as half floats: ``n_texels * n_photographs * 3 * 2``.

    Returns
    -------
    Section
    """
    total = sum(parts.values())
    ratio = f" It is {raw_bytes / total:.4g} times smaller than the samples." if total else ""
    rows = tuple(
        (name, format_bytes(size), f"{100 * size / max(total, 1):.1f} %")
        for name, size in sorted(parts.items(), key=lambda part: (-part[1], part[0]))
    )
    table = Table(
        ("part", "size", "share"),
        (
            *rows,
            ("field file", format_bytes(total), "100 %"),
            ("samples as half floats", format_bytes(raw_bytes), ""),
        ),
        "Size of each part of the field file.",
        emphasised=(len(rows),),
    )
    intro = f"The field file holds {format_bytes(total)}.{ratio}"
    return Section("Compression", intro, (table,))


@dataclass(frozen=True)
class StageSummary:
    """Resources and counts of one stage.

    Attributes
    ----------
    name : str
    seconds : float
        Wall time.
    peak_bytes : int, optional
        Peak resident memory.
    counts : mapping of name to count
        What went in and what came out, such as ``{"photographs": 1024}``; every item left
        out is counted.
    size_bytes : int, optional
        Of its results on disk.
    reused : bool
        True if the stage was skipped because its result was up to date; the
        time is that of the run that made it.
    """

    name: str
    seconds: float
    peak_bytes: int | None = None
    counts: Mapping[str, int] = field(default_factory=dict)
    size_bytes: int | None = None
    reused: bool = False


def stages_section(stages: Sequence[StageSummary]) -> Section:
    """Stages: time, peak memory, counts, sizes on disk.

    Parameters
    ----------
    stages : sequence of StageSummary
        In the order they run.

    Returns
    -------
    Section
    """
    total = sum(stage.seconds for stage in stages)
    rows = tuple(
        (
            stage.name + (" (reused)" if stage.reused else ""),
            format_seconds(stage.seconds),
            None if stage.peak_bytes is None else format_bytes(stage.peak_bytes),
            _counts(stage.counts),
            None if stage.size_bytes is None else format_bytes(stage.size_bytes),
        )
        for stage in stages
    )
    table = Table(
        ("stage", "wall time", "peak memory", "counts", "on disk"),
        (*rows, ("total", format_seconds(total), None, None, None)),
        "Counts of what went into each stage and came out. Reused stages show the wall time of "
        "the run that computed them.",
        emphasised=(len(rows),),
    )
    plot = plots.bars([s.name for s in stages], [s.seconds for s in stages], "seconds")
    figure = Figure((Panel(plot),), "Wall time of each stage.", min_width=300)
    return Section(
        "Stages", f"Wall time of all stages: {format_seconds(total)}.", (figure, table)
    )


def run_section(options: Mapping[str, Any], versions: Mapping[str, str]) -> Section:
    """Options and versions, so that the run can be repeated.

    Parameters
    ----------
    options : mapping
        Possibly nested; shown as ``stage.option``.
    versions : mapping of package to version

    Returns
    -------
    Section
    """
    return Section(
        "Options and versions",
        "Everything needed to repeat this run.",
        (
            Table(("option", "value"), tuple(_flattened(options)), "Options used."),
            Table(("package", "version"), tuple(versions.items()), "Versions used."),
        ),
    )


def _counts(counts: Mapping[str, int]) -> str | None:
    return ", ".join(f"{format_number(n)} {name}" for name, n in counts.items()) or None


def _flattened(options: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in options.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            rows += _flattened(value, f"{name}.")
        else:
            rows.append((name, str(value)))
    return rows
