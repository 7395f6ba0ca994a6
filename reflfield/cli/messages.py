"""What the commands say of a run: its stages, its metrics and its files."""

from __future__ import annotations

import time
from typing import Any

import typer

from reflfield.flags import with_flags
from reflfield.util.terminal import say, say_error

MISSED = 3  # status where the quality that was asked for is not reached


def say_results(result: Any, started: float) -> None:
    """Time per stage, metrics, and where everything is."""
    for record in result.stages:
        state = "unchanged" if record.reused else f"{record.seconds:.1f} s"
        say(f"{record.name:<22}{state:>10}  {record.peak_bytes / 2**30:5.2f} GB")
    for note in result.notes:
        say(note)
    if result.metrics:
        say_metrics(result.metrics)
    say(f"total             {time.perf_counter() - started:8.1f} s")
    for path in result.files:
        say(str(path))
    if result.missed_quality:
        say_error(f"reflfield: {result.missed_quality}")
        raise typer.Exit(MISSED)


def say_metrics(metrics: dict[str, Any]) -> None:
    """Mean metrics, what they were measured on, and what they are compared with."""
    from reflfield.report.sections import analysis_lines, measured_lines

    if metrics["mean"]:
        for line in (*measured_lines(metrics), *analysis_lines(metrics)):
            say(with_flags(line))
