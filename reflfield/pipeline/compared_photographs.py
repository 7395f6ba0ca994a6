"""Photographs that fields are compared with: held out, or unseen ones of a simulated truth."""

from __future__ import annotations

from reflfield.capture.capture import Capture
from reflfield.capture.readers import open_capture
from reflfield.errors import InputError
from reflfield.metrics.truth_files import open_truth
from reflfield.pipeline.context import Context


def compared_photographs(context: Context) -> dict[str, Capture]:
    """Return the held-out photographs, and the unseen ones that a simulated capture brings."""
    sets: dict[str, Capture] = {}
    if context.held_out.photographs:
        sets["heldout"] = context.held_out
    unseen, _ = unseen_photographs(context)
    if unseen is not None:
        sets["truth"] = unseen
    return sets


def unseen_photographs(context: Context) -> tuple[Capture | None, str]:
    """Return unseen photographs of a simulated capture; if they cannot be used, why not."""
    try:
        truth = open_truth(context.capture.root)
        path = truth.heldout() if truth else None
        return (None if path is None else open_capture(path)), ""
    except InputError as error:
        return None, f"truth: not compared: {error}"


def with_all_photographs(context: Context, name: str) -> Capture:
    """Return the capture that a set of compared photographs is part of."""
    return context.capture if name == "heldout" else compared_photographs(context)[name]
