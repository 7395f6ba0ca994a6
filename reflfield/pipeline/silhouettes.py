"""Stage "silhouettes": coverage of every training view, read or made."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from reflfield.capture.capture import Capture
from reflfield.pipeline.context import Context
from reflfield.pipeline.memory import silhouettes_at_once
from reflfield.pipeline.view_store import SILHOUETTES, name_of, store_views

# Views of one block, and pixels of their silhouettes.
VIEWS_AT_ONCE = 8
PIXELS_AT_ONCE = 16 << 20


def write_silhouettes(context: Context, folder: Path) -> dict[str, Any]:
    """Coverage of every training view, read or made, as 8-bit arrays."""
    capture = context.training
    blocks = context.blocks(folder).map(
        "silhouettes",
        silhouettes_block,
        capture,
        silhouette_runs(capture),
        at_once=silhouettes_at_once(context),
    )
    views = (named for arrays in blocks for named in arrays.items())
    store_views(folder / SILHOUETTES, views)
    n_given = sum(path is not None for path in capture.silhouettes)
    return {"views": capture.n_views, "silhouettes given": n_given}


def silhouettes_block(capture: Capture, views: range) -> dict[str, Any]:
    """Coverage of some views, 8 bits."""
    return {
        name_of(i): np.rint(capture.read_silhouette(i) * 255).astype(np.uint8) for i in views
    }


def silhouette_runs(capture: Capture) -> list[range]:
    """Views whose silhouettes are made together: of large images, few."""
    pixels = max(camera.width * camera.height for camera in capture.cameras)
    step = int(np.clip(PIXELS_AT_ONCE // pixels, 1, VIEWS_AT_ONCE))
    n = capture.n_views
    return [range(i, min(i + step, n)) for i in range(0, n, step)]
