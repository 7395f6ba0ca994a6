"""Photographs beside what a field predicts for them: relit, read back, measured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reflfield.capture.image_files import read_image
from reflfield.capture.model import Capture
from reflfield.comparison.metrics import Comparison, FramePair, compare_frames
from reflfield.field.model import ReflectanceField
from reflfield.progress import track
from reflfield.relighting.frames import relight_frames
from reflfield.relighting.renderer import RenderOptions


@dataclass(frozen=True, eq=False)
class RelitPairs:
    """Frames with their relit pictures on disk; may be iterated any number of times.

    Parameters
    ----------
    frames : Capture
        Photographs and silhouettes.
    folder : Path
        Holds NAME.exr of every frame.
    """

    frames: Capture
    folder: Path

    def __len__(self) -> int:
        return len(self.frames.photographs)

    def __iter__(self) -> Iterator[FramePair]:
        for i, photograph in enumerate(self.frames.photographs):
            yield FramePair(
                name=photograph.name,
                photograph=self.frames.read_photograph(i),
                relit=read_image(self.folder / f"{photograph.name}.exr"),
                silhouette=self.frames.read_silhouette(photograph.camera),
            )


def compare_with_photographs(
    field: ReflectanceField,
    frames: Capture,
    folder: Path,
    options: RenderOptions | None = None,
) -> tuple[Comparison, RelitPairs]:
    """Relight frames into a folder and measure them against their photographs.

    Parameters
    ----------
    field : ReflectanceField
    frames : Capture
        Cameras, lights, photographs, silhouettes.
    folder : Path
        Gets NAME.exr and NAME.png of every frame.
    options : RenderOptions, optional

    Returns
    -------
    comparison : Comparison
    pairs : RelitPairs
        For the report.

    Raises
    ------
    InputError
        If there is no frame or a frame cannot be compared.
    """
    for _ in relight_frames(field, frames, folder, options):
        pass
    pairs = RelitPairs(frames, folder)
    return compare_frames(track_pairs(pairs)), pairs


def track_pairs(pairs: RelitPairs) -> list[FramePair]:
    """All pairs, with progress."""
    return list(track(pairs, len(pairs), "reading frames"))


def mean_sample(values: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Mean over observed samples, NaN where there is none.

    Parameters
    ----------
    values : (n, n_views, n_lights, 3) float
        NaN where a channel was not measured.
    observed : (n, n_views, n_lights) bool

    Returns
    -------
    (n, 3) float
    """
    measured = ~np.isnan(values)
    counted = observed.astype(np.float32)
    weight = np.einsum("nvlc,nvl->nc", measured.astype(np.float32), counted)
    total = np.einsum("nvlc,nvl->nc", np.where(measured, values, 0).astype(np.float32), counted)
    return total / np.where(weight > 0, weight, np.nan)
