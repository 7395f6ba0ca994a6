"""What of the photographs is no measurement: told, counted, and which texels it leaves out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.errors import InputError
from reflfield.observations.image_projection import VALUE_KINDS, Projected

Bools = NDArray[np.bool_]

# In the folder of the observations: under which lights each texel was measured at all.
MEASURED = "measured.npz"
# Less than this share of the values that cameras see is a trace.
TRACE = 1e-3
# Noise about a black that was subtracted goes below 0, but not by this share of the brightest.
NEGATIVE = 0.1
# A backdrop, or a lamp in view, is brighter than the object, but not by this factor.
ABSURD = 1e9
# What is told of, and the remedy. Not of black: an object has sides that no light reaches.
TOLD = {
    "saturated": "saturated, known only to be at least as bright; expose shorter, or bracket",
    "transparent": "under alpha 0 and left out; check silhouettes and cameras",
}


def check_measured(capture: Capture, projected: Projected) -> None:
    """Refuse photographs that say nothing of the object.

    Raises
    ------
    InputError
        If no value was measured, or all are 0.
    """
    if not projected.values.sum():
        return
    if projected.count("measured") or projected.count("black"):
        if projected.brightest <= 0.0:
            raise InputError(
                f"{capture.name}: photographs: everything is dark: expected values above 0 "
                "where cameras see the object, received "
                f"{int(projected.values.sum())} that are all 0; "
                "expose longer, and check lights, encoding and silhouettes"
            )
        return
    if not any(light.intensity.any() for light in capture.lights):
        raise InputError(
            f"{capture.name}: lights: expected one with an intensity above 0, received "
            f"{capture.n_lights} that are all 0; nothing can be learned from what dark lights "
            "show"
        )
    parts = ", ".join(
        f"{projected.count(k)} {k}" for k in VALUE_KINDS[1:] if projected.count(k)
    )
    raise InputError(
        f"{capture.name}: photographs: expected measured values where cameras see the object, "
        f"received none of {int(projected.values.sum())} ({parts}); expose shorter, and check "
        "lights, alpha channels and silhouettes"
    )


def clipping_lines(capture: Capture, projected: Projected) -> Iterator[str]:
    """Say of what is more than a trace how much there is, and which camera has most.

    And of values so far below 0 that they are no radiance.
    """
    if projected.darkest < -NEGATIVE * projected.brightest:
        yield (
            "photographs: values on the object are negative, down to "
            f"{projected.darkest / projected.brightest:.0%} of the brightest; check that the "
            "files, or their layers, are photographs, and what was subtracted from them"
        )
    yield from absurd_lines(capture, projected)
    seen = np.maximum(projected.values.sum(axis=1), 1)
    for kind, text in TOLD.items():
        counts = projected.values[:, VALUE_KINDS.index(kind)]
        if counts.sum() > TRACE * seen.sum():
            worst = int(np.argmax(counts / seen))
            yield (
                f"photographs: {counts.sum() / seen.sum():.2%} of the values on the object are "
                f"{text} (most, {counts[worst] / seen[worst]:.1%}, of camera "
                f"{capture.cameras[worst].id!r})"
            )


def absurd_lines(capture: Capture, projected: Projected) -> Iterator[str]:
    """Say of pixels so bright that the file must be damaged, and in which photograph."""
    if not (projected.peaks > 0).any():
        return
    usual = float(np.quantile(projected.peaks[projected.peaks > 0], 0.5, method="lower"))
    view, light = np.unravel_index(np.argmax(projected.peaks), projected.peaks.shape)
    peak = float(projected.peaks[view, light])
    if peak > ABSURD * usual:
        name = capture.photographs[int(capture.photograph_index[view, light])].name
        yield (
            f"photographs: {name!r} has values up to {peak:.3g}, {peak / usual:.0e} times the "
            "brightest of other photographs; is the file damaged? Off the object they are not "
            "used"
        )


def write_measured(folder: Path, measured: Bools) -> None:
    """Store (n_texels, n_lights) where some camera measured a value under a light."""
    np.savez_compressed(
        folder / MEASURED,
        measured=np.packbits(measured, axis=1),
        n_lights=np.array(measured.shape[1]),
    )


def stored_measured(arrays: dict[str, NDArray[np.generic]]) -> Bools:
    """Read what `write_measured` stored."""
    bits = np.asarray(arrays["measured"], np.uint8)
    return np.unpackbits(bits, axis=1, count=int(arrays["n_lights"])).astype(np.bool_)
