"""The cheap part of the check, which a run makes before it starts."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from reflfield.capture.capture import Capture
from reflfield.capture.inspect import object_centre, spread_evenly
from reflfield.checking.description_findings import directions, unit_finding
from reflfield.checking.findings import ERROR, NOTE, Finding
from reflfield.checking.photograph_statistics import PhotographSet, read_photographs
from reflfield.checking.quality_findings import clipping_findings

# Pixels that are decoded, and photographs.
MOST_PIXELS, FEWEST, MOST = 64 << 20, 8, 64
# A light is dark if what it lights best is so dark, as a share of the median over lights.
DARK = 0.02
# Cosine between view and light from which on the view sees much of what the light lights.
FACING = 0.3
# The object may cover as little as the rest of a photograph.
BRIGHTEST = 0.99


def quick_check(capture: Capture) -> list[Finding]:
    """Errors and warnings that need few photographs.

    Parameters
    ----------
    capture : Capture
        Opened with all that `open_capture` checks.

    Returns
    -------
    list of Finding
        On overexposed photographs, dead lights, and lights in another unit than cameras.
    """
    pixels = max(camera.width * camera.height for camera in capture.cameras)
    most = int(np.clip(MOST_PIXELS // pixels, FEWEST, MOST))
    best_lit = _best_lit(capture)
    indices = sorted(best_lit)
    some = [indices[i] for i in spread_evenly(len(indices), most)]
    photographs = read_photographs(capture, some)
    findings = [
        *unit_finding(capture),
        *clipping_findings(capture, photographs, {}),
        *_dead_lights(capture, photographs, best_lit),
    ]
    return [finding for finding in findings if finding.severity != NOTE]


def _best_lit(capture: Capture) -> dict[int, float]:
    """For each light the photograph of the view that is nearest to it, and their cosine."""
    views, lights = directions(capture, object_centre(capture))
    best: dict[int, tuple[float, int]] = {}
    for index, photograph in enumerate(capture.photographs):
        cosine = float(np.nan_to_num(views[photograph.camera] @ lights[photograph.light]))
        if cosine > best.get(photograph.light, (-2.0, 0))[0]:
            best[photograph.light] = cosine, index
    return {index: cosine for cosine, index in best.values()}


def _dead_lights(
    capture: Capture, photographs: PhotographSet, cosines: dict[int, float]
) -> Iterator[Finding]:
    """Lights under which photographs are dark that should not be: from where they shine."""
    centre = object_centre(capture)[None]
    levels = {}
    for index, statistics in photographs.of.items():
        light = capture.lights[capture.photographs[index].light]
        facing = cosines[index] > FACING
        if facing and light.known and light.kind not in ("environment", "group"):
            strength = float(light.irradiance(centre).mean())
            level = float(np.quantile(statistics.luminance, BRIGHTEST))
            levels[index] = level / max(strength, 1e-300)
    usual = float(np.median(list(levels.values()))) if len(levels) >= 4 else 0.0
    for index, level in levels.items():
        if level < DARK * usual:
            photograph = capture.photographs[index]
            yield Finding(
                "dead light",
                ERROR,
                (capture.lights[photograph.light].id,),
                f"the photograph of the view nearest to it is {100 * level / usual:.2g} % as "
                "bright as that of other lights",
                "take its photographs again, or leave them out",
                file=str(photograph.path),
            )
