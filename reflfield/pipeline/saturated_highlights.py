"""How far a finished field is below the saturated values of the photographs: its highlights."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.clipping import SATURATED
from reflfield.field.clustered_pca import HALF_VECTOR
from reflfield.field.evaluation import evaluate
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.observations.image_projection import samples_of_photograph
from reflfield.pipeline import results
from reflfield.pipeline.cache import WARNINGS
from reflfield.pipeline.clipped_values import TRACE
from reflfield.pipeline.context import Context

# Photographs that are looked into, evenly chosen, and texels of each.
MOST_PHOTOGRAPHS, MOST_TEXELS = 32, 8192
# A bound that the field misses by less is met: half of a step of eight bits near white.
MET = 0.995


def saturation_counts(context: Context, field: ReflectanceField) -> dict[str, Any]:
    """What the record of a stage says of the saturated values that its field was made without.

    Nothing where no value is saturated. With a warning where these are more than a trace.
    """
    record = context.stages.record(context.stage_of("observations"))
    counts = {} if record is None else record.counts
    saturated, measured = (int(counts.get(f"values {k}", 0)) for k in ("saturated", "measured"))
    if not saturated:
        return {}
    ratios = np.concatenate([np.zeros(0), *shortfalls(context, field)])
    below = ratios < MET
    factor = float(np.median(1.0 / ratios[below])) if below.any() else 1.0
    told = saturated > TRACE * (saturated + measured) and below.any()
    return {
        "saturated values": saturated,
        "of them compared with the field": len(ratios),
        "of those the field is darker at": int(below.sum()),
        "bound over the field there, median": factor,
        WARNINGS: [_words(context, saturated, ratios, factor)] if told else [],
    }


def shortfalls(context: Context, field: ReflectanceField) -> Iterator[NDArray[np.float64]]:
    """Field over photograph at saturated values, photograph by photograph.

    The field is held at a thousandth of the photograph from below.
    """
    capture, texels = context.training, results.texels(context)
    visible = results.view_visible(context)
    n = len(capture.photographs)
    for index in np.unique(np.linspace(0, n - 1, min(n, MOST_PHOTOGRAPHS)).astype(int)):
        photograph = capture.photographs[index]
        camera, light = capture.cameras[photograph.camera], capture.lights[photograph.light]
        seen = np.flatnonzero(visible[:, photograph.camera])
        some = seen[:: max(1, len(seen) // MOST_TEXELS)]
        points = texels.position[some]
        bounds, kinds = samples_of_photograph(capture, int(index), points, bounds=True)
        rows = np.flatnonzero((kinds == SATURATED).any(axis=1))
        if not len(rows):
            continue
        views, lights = camera.view_directions(points[rows]), light.directions(points[rows])
        shown = evaluate(field, some[rows], views, lights)
        at = (kinds[rows] == SATURATED) & (bounds[rows] > 0)
        yield np.maximum(shown[at] / bounds[rows][at].astype(np.float64), 1e-3)


def _words(context: Context, saturated: int, ratios: NDArray[np.float64], factor: float) -> str:
    fitted = context.options.compression.model == HALF_VECTOR
    share = np.count_nonzero(ratios < MET) / len(ratios)
    return (
        f"highlights: {saturated} saturated values were "
        f"{'fitted as bounds from below' if fitted else 'left out of the fit'}; the field is "
        f"darker than they are at {share:.0%} of {len(ratios)} looked into, where the "
        f"photographs are at least {factor:.1f} times as bright (median)"
    )
