"""What the report shows of the analysis of errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.image_files import read_image
from reflfield.metrics.baselines import BASELINES as BASELINE_NAMES
from reflfield.metrics.baselines import BLACK
from reflfield.metrics.held_out_photographs import RelitPairs
from reflfield.metrics.image_metrics import Comparison
from reflfield.pipeline.error_analysis import (
    BASELINES,
    ERROR_KINDS,
    KIND_FILE,
    SHOWN,
    image_file,
)
from reflfield.report.sections import AnalysedImage, AnalysedImages
from reflfield.util.files import load_arrays

HEADER_BYTES = 4096


@dataclass(frozen=True)
class ImageFiles(Mapping[str, NDArray[np.float32]]):
    """Images by name, each read when it is asked for, and not kept."""

    files: Mapping[str, Path]

    def __getitem__(self, name: str) -> NDArray[np.float32]:
        return read_image(self.files[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self.files)

    def __len__(self) -> int:
        return len(self.files)


def analysed_images(
    title: str,
    compared: Comparison,
    analysed: Mapping[str, Any],
    pairs: RelitPairs,
    folder: Path,
) -> AnalysedImages:
    """A set of photographs as the sections of the report take it.

    Parameters
    ----------
    title : str
    compared : Comparison
        Of the photographs.
    analysed : mapping
        As `error_analysis.analyse` returns it.
    pairs : RelitPairs
        That were measured.
    folder : Path
        As `error_analysis.analyse` has filled it.
    """
    return AnalysedImages(
        title,
        compared,
        analysed[BASELINES],
        analysed[ERROR_KINDS],
        _shown(analysed[SHOWN], pairs, folder),
    )


def _shown(names: list[str], pairs: RelitPairs, folder: Path) -> Iterator[AnalysedImage]:
    """The photographs whose images were kept, one at a time."""
    places = {p.name: i for i, p in enumerate(pairs.capture.photographs)}
    for name in names:
        pair = pairs.read(places[name])
        files = {
            each: image_file(folder, name, each) for each in BASELINE_NAMES if each != BLACK
        }
        stored = load_arrays(
            folder / f"{name}.{KIND_FILE}", pair.silhouette.size + HEADER_BYTES
        )
        yield AnalysedImage(
            pair,
            ImageFiles({each: path for each, path in files.items() if path.is_file()}),
            stored["kinds"],
        )
