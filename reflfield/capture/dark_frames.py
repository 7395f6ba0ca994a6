r"""Dark frames: what a camera sees without any lamp, subtracted from its photographs.

A photograph holds the light of its lamp, that of the room and the level of the sensor. One of
the same view with all lamps off holds the last two. Their difference, of linear values over
their exposure times,

.. math:: L = P / t_P - D / t_D,

is the light of the lamp alone. Samples, silhouettes and comparisons all read this difference.

Where a photograph is no brighter than its dark frame nothing is left to measure: the value is 0
and counts as too dark (`BLACK` of `capture.clipping`), as code 0 does. Where the dark frame is
saturated, nothing is known but that there is no negative light: 0, `SATURATED`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.clipping import BLACK, MEASURED, SATURATED, TRANSPARENT
from reflfield.capture.image_files import (
    AS_STATED,
    ImageReading,
    ReadImage,
    read_described,
)
from reflfield.errors import CaptureError

Float32 = NDArray[np.float32]
Kinds = NDArray[np.uint8]


@dataclass(frozen=True)
class DarkFrame:
    """A photograph of a view without any lamp.

    Parameters
    ----------
    path : Path
    seconds : float
        Exposure time, where the photographs state theirs.
    reading : ImageReading
        Encoding, layer and white level, where the file does not say them.
    """

    path: Path
    seconds: float = 1.0
    reading: ImageReading = AS_STATED

    def subtracted(
        self, image: Float32, kinds: Kinds, photograph: ReadImage
    ) -> tuple[Float32, Kinds]:
        """Radiance of a photograph, and kinds of its values, without what is dark.

        Parameters
        ----------
        image : (h, w, 3) float32
            Radiance over the exposure time.
        kinds : (h, w, 3) uint8
            Of `capture.clipping`.
        photograph : ReadImage
            Its file as decoded, of bracketed exposures the first.

        Raises
        ------
        CaptureError
            If the dark frame cannot be read, or differs from the photograph in size, encoding
            or kind of numbers.
        """
        dark = self._read()
        self._check_like(dark, photograph)
        return _difference(image, kinds, dark, np.float32(self.seconds), photograph)

    def radiance(self) -> Float32:
        """What is subtracted, (h, w, 3) float32."""
        return self._read().image / np.float32(self.seconds)

    def read_as(self, stated: Mapping[str, Any]) -> DarkFrame:
        """The same file, read in another way."""
        return replace(self, reading=replace(self.reading, **stated))

    def _read(self) -> ReadImage:
        try:
            status = self.path.stat()
        except OSError as error:
            raise CaptureError(
                f"{self.path}: dark frame missing; copy it there, or remove it from the "
                "description"
            ) from error
        return _cached(self.path, self.reading, (status.st_mtime_ns, status.st_size))

    def _check_like(self, dark: ReadImage, photograph: ReadImage) -> None:
        """Demand a dark frame that is stored as its photograph is."""
        name, (height, width) = photograph.path.name, photograph.image.shape[:2]
        if dark.image.shape != photograph.image.shape:
            raise CaptureError(
                f"{self.path}: dark frame: expected {width} x {height} pixels as {name} has, "
                f"received {dark.image.shape[1]} x {dark.image.shape[0]}; take it with the "
                "same camera, or crop it alike"
            )
        if not dark.is_stored_like(photograph):
            raise CaptureError(
                f"{self.path}: dark frame: expected {photograph.numbers} as {name} has, "
                f"received {dark.numbers}, whose brightness need not compare; develop it as "
                "the photographs are, or state its 'encoding' if that is wrong"
            )


# Photographs of a view follow each other; views are read by a few threads at a time.
@lru_cache(maxsize=2)
def _cached(path: Path, reading: ImageReading, changed: tuple[int, int]) -> ReadImage:
    """The dark frame as decoded, as long as the file stays as it is."""
    dark = read_described(path, reading, what="dark frame")
    dark.image.setflags(write=False)
    return dark


def _difference(
    image: Float32, kinds: Kinds, dark: ReadImage, seconds: np.float32, photograph: ReadImage
) -> tuple[Float32, Kinds]:
    level = dark.image / seconds
    if photograph.alpha is not None:
        level *= photograph.alpha[..., None]  # the photograph was multiplied by it
    left = image - level
    kinds = np.array(kinds)
    too_dark = left <= 0 if photograph.integer else left < 0
    kinds[too_dark & (kinds == MEASURED)] = BLACK
    kinds[(dark.kinds == SATURATED) & (kinds != TRANSPARENT)] = SATURATED
    left[dark.kinds == SATURATED] = 0
    return np.maximum(left, 0, out=left), kinds
