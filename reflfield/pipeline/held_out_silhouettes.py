"""Stage "held_out_silhouettes": silhouettes of the photographs to compare with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from reflfield.capture.capture import Capture
from reflfield.metrics.comparison_silhouettes import (
    ComparisonSilhouettes,
    open_comparison_silhouettes,
    write_comparison_silhouettes,
)
from reflfield.pipeline import results
from reflfield.pipeline.compared_photographs import compared_photographs, with_all_photographs
from reflfield.pipeline.context import Context

STAGE = "held_out_silhouettes"


def write_held_out_silhouettes(context: Context, folder: Path) -> dict[str, Any]:
    """Write the silhouettes of all views that are compared, once for all fields."""
    origins: list[str] = []
    for name, compared in compared_photographs(context).items():
        made = write_comparison_silhouettes(
            compared,
            with_all_photographs(context, name),
            results.hull_mesh(context),
            folder / name,
            context.resources.workers,
        )
        origins += made.origins
    return {"views": len(origins), **{o: origins.count(o) for o in sorted(set(origins))}}


def silhouettes_digests(context: Context) -> dict[str, str]:
    """Digests of what the silhouettes of the photographs are made from."""
    digests = {}
    for name, compared in compared_photographs(context).items():
        whole = with_all_photographs(context, name)
        ids = {camera.id for camera in compared.cameras}
        views = [i for i, camera in enumerate(whole.cameras) if camera.id in ids]
        digests[name] = context.digest_of(whole.subset(views), "cameras", "silhouettes")
    return digests


def silhouettes_of(context: Context, name: str, compared: Capture) -> ComparisonSilhouettes:
    """Silhouettes of a set of photographs, as their stage has made them."""
    return open_comparison_silhouettes(context.stages.root / STAGE / name, compared)
