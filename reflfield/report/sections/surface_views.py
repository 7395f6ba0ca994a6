"""Section of the surface beside the hull: both in the light of a lamp at the camera."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.render.exposure import ExposureMeter, encoded_picture
from reflfield.report import pictures
from reflfield.report.page import Figure, Panel, Section, encode_picture
from reflfield.util.image_boxes import bounding_box

SHEET_PX = 360


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """One view for `surface_section`.

    Attributes
    ----------
    name : str
    photograph : (h, w, 3) float
        Linear radiance; any light.
    hull, surface : (h, w) float
        Cosine between normal and ray; NaN beside the object.
    """

    name: str
    photograph: NDArray[Any]
    hull: NDArray[Any]
    surface: NDArray[Any]


def surface_section(views: Iterable[SurfaceView]) -> Section:
    """Photographs, and what hull and surface look like from there, of one grey.

    Parameters
    ----------
    views : iterable of SurfaceView

    Returns
    -------
    Section
    """
    panels = tuple(panel for view in views for panel in _panels(view))
    figure = Figure(
        panels,
        "Left a photograph, then the visual hull and the surface of the field, as grey bodies "
        "lit from the camera. What is hollow in the photograph should be hollow in the "
        "surface; smooth parts should be smooth, and thin parts whole.",
        min_width=240,
    )
    intro = "The surface that the field lies on, beside the hull that the silhouettes make."
    return Section("Surface and hull", intro, (figure,))


def _panels(view: SurfaceView) -> tuple[Panel, ...]:
    box = bounding_box(np.isfinite(view.hull), margin=4)
    photograph, shown = np.asarray(view.photograph)[box], np.isfinite(view.hull)[box]
    meter = ExposureMeter()
    meter.add(photograph, shown)
    images = (
        (encoded_picture(photograph, meter.exposure_or_one), view.name),
        (_grey(view.hull[box]), "hull"),
        (_grey(view.surface[box]), "surface"),
    )
    factor = max(1, SHEET_PX // max(shown.shape))
    return tuple(
        Panel(
            encode_picture(pictures.fitted(pictures.enlarged(image, factor), SHEET_PX)), label
        )
        for image, label in images
    )


def _grey(cosines: NDArray[Any]) -> NDArray[np.uint8]:
    """Grey bodies over black."""
    shade = np.nan_to_num(np.asarray(cosines, np.float64))
    return encoded_picture(np.repeat(0.7 * shade[..., None], 3, axis=2), 1.0)
