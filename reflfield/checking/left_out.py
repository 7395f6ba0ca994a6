"""Notes on what lights and photographs are not checked for, and why."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from reflfield.capture.capture import Capture
from reflfield.capture.lights import ENVIRONMENT, GROUP
from reflfield.checking.findings import NOTE, Finding
from reflfield.checking.photograph_findings import LEAST_LIT, PhotographFits
from reflfield.checking.silhouette_findings import FEWEST_VIEWS, Shape

KIND = "not checked"


def without_surface(capture: Capture, shape: Shape) -> str:
    """Why the shading of a hull says nothing of lights and photographs; empty if it does."""
    if not capture.lights_known:
        return "where the lights stand is not known"
    if any(light.kind in (ENVIRONMENT, GROUP) for light in capture.lights):
        return "they are lit by more than one lamp each"
    if shape.mesh is None and len(shape.views) < FEWEST_VIEWS:
        return f"fewer than {FEWEST_VIEWS} views have a silhouette"
    return "the silhouettes bound no hull" if shape.mesh is None else ""


def all_left_out(why: str) -> Finding:
    """The note that no shading is compared."""
    return Finding(
        KIND,
        NOTE,
        (),
        f"places and strengths of lights, and photographs in wrong places: {why}",
        "look at the photographs by yourself",
    )


def left_out_findings(by_fit: PhotographFits) -> Iterator[Finding]:
    """Notes on views and photographs of which shading says nothing."""
    capture = by_fit.capture
    indices = [int(i) for i in by_fit.shading.photographs]
    compared = {capture.photographs[i].camera for i in indices}
    views = sorted({capture.photographs[i].camera for i in by_fit.photographs.of} - compared)
    if views:
        yield Finding(
            KIND,
            NOTE,
            tuple(capture.cameras[view].id for view in views),
            "the shading of their photographs: where they see a point is not known",
            "correct what is found on these views, and check again",
        )
    unlit = [indices[int(row)] for row in np.flatnonzero(~by_fit.lit())]
    if unlit:
        yield Finding(
            KIND,
            NOTE,
            tuple(capture.photographs[i].name for i in unlit),
            f"whether these {len(unlit)} of {len(indices)} photographs are in their places: "
            f"light shines on less than {100 * LEAST_LIT:.0f} % of what each shows",
            "look at them by yourself",
        )
