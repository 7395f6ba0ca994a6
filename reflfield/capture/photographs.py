"""A photograph: its files, how they are read, and what is done to their values."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.clipping import kinds_of_bracket
from reflfield.capture.dark_frames import DarkFrame
from reflfield.capture.exposures import merge_exposures
from reflfield.capture.gain_grids import GainGrid
from reflfield.capture.image_files import (
    AS_STATED,
    ImageReading,
    read_alpha,
    read_described,
    read_exposure,
    read_image,
)


@dataclass(frozen=True)
class Exposure:
    """One file of a photograph.

    Parameters
    ----------
    path : Path
    seconds : float
        Exposure time, where exposures are bracketed.
    reading : ImageReading
        Encoding, layer and white level, where the file does not say them.
    """

    path: Path
    seconds: float = 1.0
    reading: ImageReading = AS_STATED


@dataclass(frozen=True)
class Photograph:
    """What one camera saw under one light.

    Parameters
    ----------
    name : str
        File stem; names of relit frames are taken from it.
    camera, light : int
        Indices into the capture's cameras and lights.
    exposures : tuple of Exposure
        One file, or several bracketed ones.
    is_test : bool
        True where the capture's maker keeps the photograph for comparison.
    dark : DarkFrame, optional
        What the camera sees without any lamp: it is subtracted.
    gain : GainGrid, optional
        What the values are then multiplied by.
    """

    name: str
    camera: int
    light: int
    exposures: tuple[Exposure, ...]
    is_test: bool = False
    dark: DarkFrame | None = None
    gain: GainGrid | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that it is read from."""
        dark = () if self.dark is None else (self.dark.path,)
        return (*(exposure.path for exposure in self.exposures), *dark)

    @property
    def path(self) -> Path:
        """The first file."""
        return self.exposures[0].path

    @property
    def is_one_file(self) -> bool:
        """Whether its radiance is that of one file: nothing is merged, taken off or scaled."""
        return len(self.exposures) == 1 and self.dark is None and self.gain is None

    def read(self) -> NDArray[np.float32]:
        """Linear radiance, (h, w, 3) float32; bracketed exposures are merged."""
        if self.is_one_file:
            first = self.exposures[0]
            return read_image(first.path, first.reading) / np.float32(first.seconds)
        return self.read_kinds()[0]

    def read_kinds(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Radiance and which of its values are measurements (`Capture.read_kinds`)."""
        image, kinds = self._read_lit()
        if self.gain is not None:
            image = self.gain.multiply(image, str(self.path))
        return image, kinds

    def _read_lit(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Radiance of the lamp alone, and kinds of its values, before the gain."""
        first = self.exposures[0]
        if len(self.exposures) == 1:
            read = read_described(first.path, first.reading)
            image, kinds = read.image / np.float32(first.seconds), read.kinds
        else:
            image, kinds = self._read_bracket()
        if self.dark is None:
            return image, kinds
        if len(self.exposures) > 1:
            read = read_described(first.path, first.reading)
        return self.dark.subtracted(image, kinds, read)

    def _read_bracket(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        read = [read_exposure(e.path, e.reading) for e in self.exposures]
        images, kinds, encodings = zip(*read, strict=True)
        seconds = [e.seconds for e in self.exposures]
        return merge_exposures(images, seconds, encodings), kinds_of_bracket(kinds, seconds)

    def read_alpha(self) -> NDArray[np.float32] | None:
        """Alpha of the first file, (h, w) float32; None if it has none or is opaque."""
        first = self.exposures[0]
        return read_alpha(first.path, first.reading)
