"""A sweep as a web page, as JSON, and as unit costs for further plans."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from reflfield.report import plots
from reflfield.report.page import (
    Cell,
    Figure,
    KeyNumber,
    Note,
    Panel,
    ReportContent,
    Section,
    Table,
    format_bytes,
    format_seconds,
    write_report,
)
from reflfield.report.plots import Mark
from reflfield.tradeoff.cost_fit import CostFit
from reflfield.tradeoff.measured_run import write_json
from reflfield.tradeoff.sweep_results import Measured, SweepResult, front_of, gain, picks
from reflfield.tradeoff.swept_options import LIGHTS, VIEWS, Configuration, shown, value_of
from reflfield.util.quoting import printable

PAGE, DOCUMENT, COSTS = "index.html", "tradeoff.json", "unit_costs.json"
FORMAT, VERSION = "reflfield-tradeoff", 1
TIME, PSNR = "CPU time, s", "PSNR, dB"
# Runs that curves and tables call by the part of the sweep that they are of.
PARTS = {
    "default": "default",
    "alone": "one option changed",
    "halving": "fewer photographs",
    "together": "combination",
}


def write_tradeoff(out: Path, result: SweepResult, fit: CostFit) -> Path:
    """Write page, document and unit costs of a sweep; return the page's path."""
    write_json(out / DOCUMENT, document(result, fit))
    write_json(out / COSTS, fit.costs.document())
    write_report(out / PAGE, content(result, fit))
    return out / PAGE


def document(result: SweepResult, fit: CostFit) -> dict[str, Any]:
    """What `tradeoff.json` holds."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "capture": result.context.capture.name,
        "photographs": result.groups.sentence(),
        "model": result.counts.model,
        "seconds": round(result.seconds, 1),
        "configurations": [_entry(m, result.default) for m in result.measured],
        "not run": [configuration.name for configuration in result.left],
        "picks": {name: m.configuration.name for name, m in picks(result).items()},
        "cost model": fit.summary(),
    }


def _entry(measured: Measured, default: Measured) -> dict[str, Any]:
    configuration = measured.configuration
    entry: dict[str, Any] = {
        "name": configuration.name,
        "settings": dict(configuration.settings),
        VIEWS: configuration.views,
        LIGHTS: configuration.lights,
        "part": measured.stage_of_sweep,
    }
    if not measured.measures:
        return {**entry, "failed": measured.failed or "no photograph could be measured"}
    gained, error = gain(measured, default)
    return {
        **entry,
        "CPU seconds": round(measured.cpu_seconds, 2),
        "wall seconds": round(measured.seconds, 2),
        "repeats": measured.repeats,
        "peak bytes": measured.peak_bytes,
        "field bytes": measured.field_bytes,
        "PSNR": measured.psnr,
        "gain": gained,
        "error of the gain": error,
        **{name: measured.outcome.get(name, {}) for name in ("reported", "unseen", "truth")},
    }


# --- the page --------------------------------------------------------------------------------


def content(result: SweepResult, fit: CostFit) -> ReportContent:
    """What the page shows."""
    default, chosen = result.default, picks(result)
    best = chosen["best"]
    numbers = (
        KeyNumber("default", f"{default.psnr:.1f} dB", _time(default)),
        KeyNumber("best", f"{best.psnr:.1f} dB", _time(best)),
        KeyNumber("fast", f"{chosen['fast'].psnr:.1f} dB", _time(chosen["fast"])),
        KeyNumber("runs", str(len(result.measured)), format_seconds(result.seconds)),
    )
    parts = (
        picks_section(result),
        front_section(result),
        *options_sections(result),
        *photographs_sections(result),
        configurations_section(result),
        *truth_sections(result),
        costs_section(fit),
        *left_sections(result),
    )
    return ReportContent(
        title=f"What accuracy costs: {printable(result.context.capture.name)}",
        subtitle=f"{result.groups.sentence()}. Model: {result.counts.model}.",
        key_numbers=numbers,
        sections=parts,
    )


def _time(measured: Measured) -> str:
    return f"{format_seconds(measured.cpu_seconds)} CPU"


def picks_section(result: SweepResult) -> Section:
    """Three configurations of the front, and the default."""
    rows = []
    for name, measured in {"default": result.default, **picks(result)}.items():
        gained, error = gain(measured, result.default)
        rows.append(
            (
                name,
                f"{measured.psnr:.2f}",
                f"{gained:+.2f} ± {error:.2f}",
                _mean(measured, "reported"),
                _mean(measured, "unseen"),
                format_seconds(measured.cpu_seconds),
                format_bytes(measured.field_bytes),
            )
        )
    header = (
        *("pick", "chosen on, dB", "gain, dB", "reported, dB", "unseen, dB"),
        *("CPU", "field"),
    )
    table = Table(
        header,
        tuple(rows),
        "Chosen by the photographs of the first PSNR; those that are reported have not been "
        "chosen by.",
        emphasised=(0,),
    )
    commands = [
        Note(f"{name}: reflfield run CAPTURE -o OUT {command_words(measured.configuration)}")
        for name, measured in picks(result).items()
    ]
    return Section(
        "Three configurations of the front",
        "The least time at most 3 dB below the best (fast), at most 0.5 dB (balanced) and "
        "0.05 dB (best). Times are those of all stages up to the comparison.",
        (table, *commands),
    )


def command_words(configuration: Configuration) -> str:
    """Settings as arguments of ``reflfield run``.

    Examples
    --------
    >>> command_words(Configuration((("hull.resolution", 96),)))
    '--set hull.resolution=96'
    """
    words = [f"--set {name}={shown(value)}" for name, value in configuration.settings]
    return " ".join(words) or "(the default)"


def _mean(measured: Measured, images: str) -> str | None:
    mean = measured.outcome.get(images, {}).get("mean")
    return f"{mean['psnr_ldr']:.2f}" if mean else None


def front_section(result: SweepResult) -> Section:
    """All configurations of all photographs, and those that none beats."""
    whole = result.whole
    front = [whole[i] for i in front_of([(m.cpu_seconds, m.psnr) for m in whole])]
    others = [m for m in whole if m not in front]
    series = {
        "front": [_mark(m, result.default, "") for m in front],
        "others": [_mark(m, result.default, "") for m in others],
    }
    plot = plots.marked_curves(
        {name: marks for name, marks in series.items() if marks},
        *(TIME, PSNR),
        log_x=True,
        joined=("front",),
    )
    rows = tuple(
        (m.configuration.short_name, f"{m.psnr:.2f}", f"{m.cpu_seconds:.1f}", *_scatter(m))
        for m in front
    )
    header = ("configuration", PSNR, TIME, "runs", "least", "most")
    table = Table(header, rows, "CPU time: median of the runs, with the least and the most.")
    figure = Figure((Panel(plot),), "The default is ringed; bars: standard error of the gain.")
    return Section(
        "Pareto front",
        "Configurations that no other beats in both time and error, on the photographs that "
        "settings are chosen on.",
        (figure, table),
    )


def _scatter(measured: Measured) -> tuple[Cell, Cell, Cell]:
    """Number of runs of a configuration, and its least and largest CPU time."""
    times = measured.cpu_times
    return len(times), f"{min(times):.1f}", f"{max(times):.1f}"


def _mark(measured: Measured, default: Measured, label: str) -> Mark:
    error = 0.0 if measured is default else gain(measured, default)[1]
    is_default = measured is default
    return Mark(measured.cpu_seconds, measured.psnr, label, error, is_ringed=is_default)


def curves_of(result: SweepResult) -> dict[str, list[tuple[Any, Measured]]]:
    """Values and runs of each option that was varied alone, the default among them."""
    curves: dict[str, list[tuple[Any, Measured]]] = {}
    for measured in result.measured:
        if measured.changed and measured.measures:
            name, value = measured.changed
            usual = value_of(result.context.options, name)
            curves.setdefault(name, [(usual, result.default)]).append((value, measured))
    return {
        name: sorted(curve, key=lambda point: (str(type(point[0])), point[0]))
        for name, curve in curves.items()
    }


def options_sections(result: SweepResult) -> Iterator[Section]:
    """A curve for each option: error against time, the default ringed."""
    curves = {n: c for n, c in curves_of(result).items() if n not in (VIEWS, LIGHTS)}
    if not curves:
        return
    panels = []
    for name, curve in curves.items():
        marks = [_mark(m, result.default, shown(value)) for value, m in curve]
        plot = plots.marked_curves({name: marks}, TIME, PSNR, log_x=True, joined=(name,))
        panels.append(Panel(plot, name))
    figure = Figure(
        tuple(panels),
        "Each point is a run with this value and the default of all other options; the default "
        "is ringed. Bars: standard error of the gain over the default.",
        min_width=320,
    )
    yield Section(
        "Options, one at a time",
        "Error on the photographs that settings are chosen on, against the CPU time of all "
        "stages up to the comparison.",
        (figure,),
    )


def photographs_sections(result: SweepResult) -> Iterator[Section]:
    """Error against the number of lights and of views."""
    curves = {n: c for n, c in curves_of(result).items() if n in (VIEWS, LIGHTS)}
    if not curves:
        return
    groups, panels, notes = result.groups, [], []
    for name, curve in curves.items():
        total = len(groups.training_views if name == VIEWS else groups.training_lights)
        counts = [max(1, round(share * total)) for share, _ in curve]
        marks = [
            Mark(
                *(float(n), m.psnr, str(n)),
                y_error=0.0 if m is result.default else gain(m, result.default)[1],
                is_ringed=m is result.default,
            )
            for n, (_, m) in zip(counts, curve, strict=True)
        ]
        plot = plots.marked_curves({name: marks}, f"number of {name}", PSNR, joined=(name,))
        panels.append(Panel(plot, name))
        notes.append(Note(verdict(name, counts, [m.psnr for _, m in curve])))
    figure = Figure(
        tuple(panels),
        "Fields of fewer of the views or lights, spread evenly, on the same photographs.",
        min_width=320,
    )
    yield Section(
        "Is it worth more lights?",
        "A curve that still rises at its end says that more photographs of this kind would "
        "help; a flat one that they would not.",
        (figure, *notes),
    )


def verdict(name: str, counts: list[int], psnr: list[float]) -> str:
    """What the end of a curve says of more views or lights.

    Examples
    --------
    >>> verdict("lights", [6, 12, 24], [24.0, 26.0, 26.1])
    'From 12 to 24 lights: +0.1 dB, +0.1 for a doubling: more lights would gain little.'
    """
    gained = psnr[-1] - psnr[-2]
    of_doubling = gained / max(math.log2(counts[-1] / counts[-2]), 1e-3)
    more = "would help" if of_doubling > 0.5 else "would gain little"
    return (
        f"From {counts[-2]} to {counts[-1]} {name}: {gained:+.1f} dB, {of_doubling:+.1f} for a "
        f"doubling: more {name} {more}."
    )


def configurations_section(result: SweepResult) -> Section:
    """All runs in a table."""
    rows = [_row(m, result.default) for m in result.measured if m.measures]
    header = (
        *("configuration", "part", PSNR, "gain, dB", "±", "unseen, dB", "SSIM", TIME),
        *("wall time, s", "memory", "field"),
    )
    table = Table(header, tuple(rows), "All runs", emphasised=(0,))
    return Section(
        "All configurations",
        "In the order in which they were run. Stages that several share were computed once; "
        "times are those of all stages, as if each had computed its own.",
        (table,),
    )


def _row(measured: Measured, default: Measured) -> tuple[Cell, ...]:
    gained, error = gain(measured, default)
    return (
        measured.configuration.short_name,
        PARTS[measured.stage_of_sweep],
        f"{measured.psnr:.2f}",
        f"{gained:+.2f}".replace("-", "−"),
        f"{error:.2f}",
        _mean(measured, "unseen"),
        f"{measured.outcome['chosen on']['mean']['ssim']:.4f}",
        f"{measured.cpu_seconds:.1f}",
        f"{measured.seconds:.1f}",
        format_bytes(measured.peak_bytes),
        format_bytes(measured.field_bytes),
    )


def truth_sections(result: SweepResult) -> Iterator[Section]:
    """Errors against the truth, where the capture brings it."""
    some = [m for m in result.measured if m.measures and m.outcome["truth"]]
    if not some:
        return
    names = sorted({name for m in some for name in m.outcome["truth"]})
    rows = tuple(
        (m.configuration.short_name, *(_number(m.outcome["truth"].get(name)) for name in names))
        for m in some
    )
    yield Section(
        "Against the truth",
        "What the simulator knows of surface and frames; nothing was chosen by it.",
        (Table(("configuration", *names), rows, "Errors against the truth"),),
    )


def _number(value: float | None) -> str | None:
    return None if value is None else f"{value:.3g}"


def costs_section(fit: CostFit) -> Section:
    """What the model of costs predicts of these runs, before its fit to them and after."""
    plot = plots.marked_curves(
        {
            "as it comes": [Mark(m, p) for m, p in zip(fit.measured, fit.before, strict=True)],
            "fitted": [Mark(m, p) for m, p in zip(fit.measured, fit.after, strict=True)],
        },
        "CPU time of the run, s",
        "predicted, s",
        log_x=True,
    )
    return Section(
        "The model of costs",
        fit.sentence(),
        (
            Figure((Panel(plot),), "Each run of the sweep, as predicted from its counts."),
            Note(
                f"{COSTS} has the fitted model; reflfield run --budget TIME --tradeoff DIR "
                "takes from this sweep the best configuration that it expects to end in time."
            ),
        ),
    )


def left_sections(result: SweepResult) -> Iterator[Section]:
    """What was not run, or could not be used."""
    failed = [m for m in result.measured if m.failed]
    names: Iterable[tuple[str, str]] = (
        *((m.configuration.name, m.failed) for m in failed),
        *((c.name, "the budget did not suffice") for c in result.left),
    )
    rows = tuple(names)
    if rows:
        table = Table(("configuration", "why"), rows, f"{len(rows)} configurations")
        yield Section("Not measured", "Configurations without a result.", (table,))
