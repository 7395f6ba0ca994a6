"""Findings on dark frames: unusable, of another exposure, and how much they take away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.capture.color_spaces import LUMINANCE
from reflfield.capture.consistency import check_dark_frame, first_uses
from reflfield.capture.dark_frames import DarkFrame
from reflfield.checking.findings import ERROR, NOTE, WARNING, Evidence, Finding
from reflfield.checking.photograph_statistics import KEPT_PIXELS, reduced
from reflfield.checking.shown_images import shown
from reflfield.errors import InputError

Float32 = NDArray[np.float32]

KIND = "dark frame"
# A dark frame does not belong to a photograph where it is brighter, by this factor and this
# share of what is bright, in this part of the image.
BRIGHTER, BRIGHTER_SHARE, LARGEST_PART = 1.1, 0.01, 0.02


def dark_frame_findings(capture: Capture) -> tuple[list[Finding], Capture]:
    """Findings on dark frames, and the capture without those that cannot be used.

    Each is compared with one photograph of each camera.
    """
    files = {exposure.path for p in capture.photographs for exposure in p.exposures}
    findings: list[Finding] = []
    shares: list[float] = []
    refused: set[DarkFrame] = set()
    for dark, index in first_uses(capture):
        camera = capture.cameras[capture.photographs[index].camera]
        try:
            check_dark_frame(dark, camera, files)
            lit = _without_dark_frame(capture, index)
            if lit is None:
                continue  # the photograph is at fault, which others tell
            capture.photographs[index].read_kinds()
        except InputError as error:
            findings += [] if dark in refused else [_refused(camera.id, dark, error)]
            refused.add(dark)
            continue
        level = reduced(dark.radiance(), KEPT_PIXELS)
        shares.append(float(level.mean() / max(float(lit.mean()), 1e-30)))
        findings += _brighter(capture, index, dark, lit, level)
    if shares:
        findings.append(_used(capture, refused, shares))
    return findings, _without(capture, refused)


def _without_dark_frame(capture: Capture, index: int) -> Float32 | None:
    """A small photograph as the camera saw it; None if it cannot be read."""
    try:
        radiance = replace(capture.photographs[index], dark=None, gain=None).read()
    except InputError:
        return None
    return reduced(radiance, KEPT_PIXELS)


def _without(capture: Capture, refused: set[DarkFrame]) -> Capture:
    photographs = tuple(
        replace(photograph, dark=None) if photograph.dark in refused else photograph
        for photograph in capture.photographs
    )
    return replace(capture, photographs=photographs) if refused else capture


def _refused(camera: str, dark: DarkFrame, error: InputError) -> Finding:
    words, _, remedy = str(error).rpartition("; ")
    return Finding(
        KIND, ERROR, (camera,), words or remedy, remedy if words else "take it again",
        str(dark.path),
    )  # fmt: skip


def _brighter(
    capture: Capture, index: int, dark: DarkFrame, lit: Float32, level: Float32
) -> list[Finding]:
    """A finding on a dark frame that is brighter than its photograph."""
    photograph = capture.photographs[index]
    bright = lit @ LUMINANCE
    limit = BRIGHTER * bright + BRIGHTER_SHARE * np.quantile(bright, 0.99)
    part = float((level @ LUMINANCE > limit).mean())
    if part <= LARGEST_PART:
        return []
    return [
        Finding(
            "bright dark frame",
            WARNING,
            (capture.cameras[photograph.camera].id,),
            f"it is brighter than {photograph.name} in {100 * part:.0f} % of the image, where "
            "nothing is left of that photograph",
            "check that all lamps were off, and that camera, exposure and room light are those "
            "of the photographs",
            str(dark.path),
            (Evidence(shown(level), dark.path.name),),
        )
    ]


def _used(capture: Capture, refused: set[DarkFrame], shares: list[float]) -> Finding:
    used = [p for p in capture.photographs if p.dark is not None and p.dark not in refused]
    return Finding(
        KIND,
        NOTE,
        (),
        f"{len({p.dark for p in used})} of them are subtracted from {len(used)} of "
        f"{len(capture.photographs)} photographs, of one of each camera "
        f"{100 * float(np.median(shares)):.1f} % of the light (median)",
        "check that this is meant",
    )
