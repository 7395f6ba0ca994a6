"""Bookkeeping of samples: what became of every photograph, sample and texel of a run."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from reflfield.pipeline import comparison, results
from reflfield.pipeline.compared_photographs import compared_photographs
from reflfield.pipeline.context import Context
from reflfield.report.sections import CountedItems


def sample_counts(context: Context) -> Iterator[CountedItems]:
    """Count what went into each stage of a finished run, and what became of it.

    Totals come from the capture and the texel table, parts from what the stages have
    recorded or left: a stage that loses something does not add up.

    Parameters
    ----------
    context : Context
        With its stages done up to the comparison.

    Yields
    ------
    CountedItems
    """
    counts = {record.name: record.counts for record in context.stages.records}
    # Of the surface that the field is on.
    context = context.refined
    projected = counts[context.stage_of("observations")]
    yield _photographs(context, projected)
    yield _values(context, projected)
    yield _samples(context, counts)
    yield from _texels(context, counts)
    yield _frames(context)


def _photographs(context: Context, projected: dict[str, Any]) -> CountedItems:
    """Photographs of the capture: projected, held out and compared, or neither."""
    return CountedItems(
        "observations",
        "photographs",
        len(context.capture.photographs),
        {
            "projected onto the surface": projected["photographs"],
            "held out and compared": len(context.held_out.photographs),
            "of a held-out view or light, used for neither": len(context.split.aside),
            "redundant, under lights that are not needed": len(context.split.redundant),
        },
    )


def _samples(context: Context, counts: dict[str, dict[str, Any]]) -> CountedItems:
    """One sample for each texel and photograph: fitted, unseen, shadowed, below the horizon."""
    observed = results.observed(context)
    n_seen, n_observed = observed.count_seen(), observed.count()
    shadowed = n_seen - n_observed
    unseen = len(observed.views) * len(observed.pairs) - n_seen
    # As the completion counted them, where there is one.
    handed_on = counts.get("completion", {}).get("samples observed", n_observed)
    used = counts["compression"]["samples fitted"]
    unmeasured = counts["compression"]["samples not measured"]
    none = {"samples in shadow": 0, "samples at edges of shadows": 0}
    shade = counts.get(context.stage_of("indirect"), none)
    mixed = shade["samples at edges of shadows"]
    shown = shade["samples in shadow"] - mixed
    return CountedItems(
        "compression",
        "samples",
        len(results.texels(context)) * len(context.training.photographs),
        {
            "fitted": used,
            "texel not seen by the camera": unseen,
            "in shadow: fitted as indirect light": shown,
            "in shadow: at its edge": mixed,
            "in shadow: nothing made of them": shadowed - shown - mixed,
            "not measured in any channel": unmeasured,
            "below the horizon of the texel's frame, or outside the light's cone": (
                handed_on - used - unmeasured
            ),
        },
    )


def _values(context: Context, projected: dict[str, Any]) -> CountedItems:
    """Three values for each photograph and texel that its camera sees: measured or not."""
    of_views = results.observed(context).pairs.table.sum(axis=1)
    names = {
        "measured": "measured",
        "saturated": "saturated: at least as bright, left out of the samples",
        "black": "at code 0: counted as too dark for the file",
        "transparent": "under alpha 0: left out",
        "dark": "of a colour that the light has not: left out",
        "unlit": "the light gives nothing there",
    }
    return CountedItems(
        "observations",
        "values",
        3 * int(results.view_visible(context).sum(axis=0) @ of_views),
        {name: projected[f"values {kind}"] for kind, name in names.items()},
    )


def _texels(context: Context, counts: dict[str, dict[str, Any]]) -> Iterator[CountedItems]:
    """Texels of the atlas through completion and alignment, if any, and compression."""
    n = len(results.texels(context))
    if context.options.aligns:
        unseen = n - len(results.measured_texels(context))
        yield from _aligned_texels(counts, n, unseen)
    fitted = counts["compression"]
    yield CountedItems(
        "compression",
        "texels",
        n,
        {
            "fitted to their samples": fitted["texels fitted"],
            "repeat the nearest that is": fitted["texels that repeat another"],
        },
    )


def _aligned_texels(
    counts: dict[str, dict[str, Any]], n: int, unseen: int
) -> Iterator[CountedItems]:
    """Texels through completion, if any, and alignment."""
    aligned = counts["alignment"]
    if "completion" in counts:  # of one view there is none
        completed = counts["completion"]
        yield CountedItems(
            "completion",
            "texels",
            n,
            {
                "completed": completed["texels completed"],
                "without samples": completed["texels without samples"],
            },
        )
    yield CountedItems(
        "alignment",
        "texels",
        n,
        {
            "frame found": aligned["texels aligned"],
            "keep the base frame": aligned["texels that keep the base frame"],
            "without samples": unseen,
        },
    )


def _frames(context: Context) -> CountedItems:
    """Photographs that are compared, from the metrics that were written."""
    names = {"heldout": "held out", "truth": "unseen and simulated"}
    sets, parts = compared_photographs(context), {}
    for name, frames in sets.items():
        measured = comparison.comparison_of(context, name)
        if measured is None:
            parts[f"{names[name]}, not compared"] = len(frames.photographs)
            continue
        parts[f"{names[name]}, measured"] = len(measured.images)
        if measured.not_measured:
            parts[f"{names[name]}, without an object pixel"] = len(measured.not_measured)
    total = sum(len(frames.photographs) for frames in sets.values())
    return CountedItems("comparison", "photographs", total, parts)
