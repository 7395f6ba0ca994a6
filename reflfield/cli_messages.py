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
    """Mean metrics in one line, and on what they were measured in another."""
    mean, n = metrics["mean"], len(metrics["frames"])
    if not mean:
        return
    say(
        f"{n} frame{'' if n == 1 else 's'}: PSNR {mean['psnr_ldr']:.2f} dB (LDR), "
        f"{mean['psnr_hdr']:.2f} dB (HDR), SSIM {mean['ssim']:.4f}, FLIP {mean['flip']:.4f}"
    )
    measured = metrics["measured"]
    parts = [f"measured on {measured['pixels']} pixels"]
    if left_out := measured["saturated_pixels_left_out"]:
        parts.append(f"{left_out} saturated ones left out")
    if names := measured["frames_not_measured"]:
        parts.append(f"without a pixel of the object: {', '.join(names)}")
    origins = ", ".join(f"{name} {n}" for name, n in measured["silhouettes"].items())
    say("; ".join([*parts, f"silhouettes: {origins}"]))
    from reflfield.report.sections import analysis_lines

    for line in analysis_lines(metrics):
        say(with_flags(line))
