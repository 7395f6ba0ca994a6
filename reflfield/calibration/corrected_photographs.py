"""Photographs of a capture with a colour matrix applied, as new files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.capture.clipping import SATURATED
from reflfield.capture.image_files import ImageReading
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.capture.photographs import Exposure
from reflfield.util.progress import track

Float32 = NDArray[np.float32]


def with_colors_corrected(
    capture: Capture, matrix: NDArray[np.float64], folder: Path
) -> Capture:
    """The capture with photographs that a matrix was applied to, written as linear OpenEXR.

    Bracketed exposures are merged, dark frames subtracted, gains applied. A pixel that is
    saturated in one channel counts as saturated in all, since the matrix mixes them; negative
    values become 0. Silhouettes that come of alpha become files.

    Parameters
    ----------
    capture : Capture
    matrix : (3, 3) float64
        For linear values.
    folder : Path
        For the new files.

    Raises
    ------
    CaptureError
        If a photograph cannot be read.
    """
    indices = track(range(len(capture.photographs)), len(capture.photographs), "colours")
    photographs = tuple(
        replace(
            capture.photographs[i],
            exposures=(_corrected(capture, i, matrix, folder),),
            dark=None,  # it is subtracted
            gain=None,  # it is applied
        )
        for i in indices
    )
    silhouettes = tuple(_silhouette(capture, view, folder) for view in range(capture.n_views))
    return replace(capture, photographs=photographs, silhouettes=silhouettes)


def _corrected(
    capture: Capture, index: int, matrix: NDArray[np.float64], folder: Path
) -> Exposure:
    image, kinds = capture.read_kinds(index)
    corrected = np.maximum(image @ matrix.T.astype(np.float32), 0)
    saturated = (kinds == SATURATED).any(axis=2)
    level = None
    if saturated.any():
        level = 1.001 * float(corrected.max())
        corrected[saturated] = level
    path = folder / f"p{index:06d}.exr"
    write_exr(path, corrected.astype(np.float32))
    return Exposure(path, reading=ImageReading(white_level=level))


def _silhouette(capture: Capture, view: int, folder: Path) -> Path | None:
    """File of a silhouette, which is written where it comes of alpha."""
    if capture.silhouettes[view] is not None or capture.silhouette_origin(view) != "alpha":
        return capture.silhouettes[view]
    path = folder / f"v{view:04d}.png"
    write_png(path, np.rint(255 * capture.read_silhouette(view)).astype(np.uint8))
    return path
