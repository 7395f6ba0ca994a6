"""Stage "web_page": the field as one web page, with held-out photographs to compare with."""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from reflfield.capture.capture import Capture
from reflfield.errors import InputError
from reflfield.field.file import open_field
from reflfield.metrics.image_metrics import Comparison
from reflfield.pipeline import comparison, results, stage_inputs
from reflfield.pipeline.context import Context
from reflfield.render.exposure import encoded_picture
from reflfield.viewer.object_page import (
    Bookmark,
    can_be_shown,
    page_digest,
    too_large_page,
    write_object_page,
)

log = logging.getLogger(__name__)

FILE = "object.html"
# Photographs of each set, evenly chosen, and the largest side that they are shown at, pixels.
MOST_PHOTOGRAPHS, LARGEST_SIDE = 6, 640
JPEG_QUALITY = 88
NOTES = {
    "heldout": "Held out: the field was not made of this photograph.",
    "truth": "A view and a light off the rig, simulated.",
}


def write_web_page(context: Context, folder: Path) -> dict[str, Any]:
    """Write the page; where it would be too large, one that says so."""
    field = open_field(results.field_file(context))
    bookmarks = [
        bookmark
        for name, pairs in comparison.relit_pairs(context).items()
        for bookmark in _bookmarks(name, pairs.capture, comparison.comparison_of(context, name))
    ]
    try:
        moved = distances_to_hull(context)
        write_object_page(folder / FILE, field, context.capture.name, bookmarks, moved)
    except InputError as error:
        log.warning("%s: %s", FILE, error)
        (folder / FILE).write_text(too_large_page(context.capture.name), encoding="utf-8")
    return {"photographs": len(bookmarks)}


def distances_to_hull(context: Context) -> NDArray[np.floating] | None:
    """How far each vertex was moved out of the hull; None where the hull stays."""
    if not context.options.refines_surface:
        return None
    hull, surface = results.atlas(context), results.atlas(context.refined)
    return np.einsum("nd,nd->n", surface.positions - hull.positions, hull.normals)


def page_digests(context: Context) -> dict[str, str]:
    """What the page depends on besides the stages: its script, the name, the photographs."""
    return {
        "page": page_digest(),
        **stage_inputs.field_metadata_digest(context),
        **stage_inputs.compared_digests(context),
    }


def _bookmarks(name: str, compared: Capture, measured: Comparison | None) -> Iterator[Bookmark]:
    """Some photographs of a set, at the exposure that it was compared at."""
    if measured is None:
        return
    shown = [
        i
        for i, photograph in enumerate(compared.photographs)
        if can_be_shown(compared.cameras[photograph.camera], compared.lights[photograph.light])
    ]
    n_chosen = min(MOST_PHOTOGRAPHS, len(shown))
    for i in np.unique(np.linspace(0, len(shown) - 1, n_chosen).astype(int)) if shown else ():
        photograph = compared.photographs[shown[i]]
        yield Bookmark(
            name=photograph.name,
            note=NOTES[name],
            camera=compared.cameras[photograph.camera],
            lights=compared.lights[photograph.light].sources,
            exposure=measured.exposure,
            picture=_jpeg(
                encoded_picture(compared.read_photograph(shown[i]), measured.exposure)
            ),
        )


def _jpeg(pixels: NDArray[np.uint8]) -> bytes:
    picture, stream = Image.fromarray(pixels), io.BytesIO()
    picture.thumbnail((LARGEST_SIDE, LARGEST_SIDE))
    picture.save(stream, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return stream.getvalue()
