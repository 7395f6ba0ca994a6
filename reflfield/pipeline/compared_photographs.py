"""Photographs that fields are compared with: held out, or unseen ones of a simulated truth."""

from __future__ import annotations

from reflfield.capture.capture import Capture
from reflfield.capture.readers import open_capture
from reflfield.errors import InputError
from reflfield.metrics.truth_files import open_truth
from reflfield.pipeline.context import Job


def frame_sets(job: Job) -> dict[str, Capture]:
    """Held-out photographs, and the unseen frames that a simulated capture brings."""
    sets: dict[str, Capture] = {}
    if job.held_frames.photographs:
        sets["heldout"] = job.held_frames
    frames, _ = truth_frames(job)
    if frames is not None:
        sets["truth"] = frames
    return sets


def truth_frames(job: Job) -> tuple[Capture | None, str]:
    """Unseen frames of a simulated capture; if they cannot be used, why not."""
    try:
        truth = open_truth(job.capture.root)
        path = truth.heldout() if truth else None
        return (None if path is None else open_capture(path)), ""
    except InputError as error:
        return None, f"truth: not compared: {error}"


def around(job: Job, name: str) -> Capture:
    """What a set of frames is part of: all photographs of their cameras."""
    return job.capture if name == "heldout" else frame_sets(job)[name]
