"""Photographs beside what a field predicts for them: relit, read back, measured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from reflfield.capture.capture import Capture
from reflfield.capture.clipping import MEASURED
from reflfield.capture.image_files import read_image
from reflfield.errors import NumericalError
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.metrics.comparison_silhouettes import ComparisonSilhouettes
from reflfield.metrics.image_metrics import Comparison, ImagePair, compare_images
from reflfield.render.relit_photographs import relight_photographs
from reflfield.render.renderer import RenderOptions


@dataclass(frozen=True, eq=False)
class RelitPairs:
    """Photographs with their rendered images on disk; may be iterated any number of times.

    Parameters
    ----------
    capture : Capture
        Photographs.
    folder : Path
        Holds NAME.exr of every photograph.
    silhouettes : ComparisonSilhouettes
        Of the views of the photographs.
    """

    capture: Capture
    folder: Path
    silhouettes: ComparisonSilhouettes

    def __len__(self) -> int:
        return len(self.capture.photographs)

    def __iter__(self) -> Iterator[ImagePair]:
        for i in range(len(self)):
            yield self.read(i)

    def read(self, index: int) -> ImagePair:
        """Photograph `index` with the image rendered for it."""
        photograph = self.capture.photographs[index]
        radiance, kinds = self.capture.read_kinds(index)
        return ImagePair(
            name=photograph.name,
            photograph=radiance,
            relit=read_image(self.folder / f"{photograph.name}.exr"),
            silhouette=self.silhouettes.read(photograph.camera),
            # What is too dark to measure is as good as black; what is too bright is not.
            excluded=np.any((kinds != MEASURED) & (radiance > 0), axis=-1),
            silhouette_from=self.silhouettes.origins[photograph.camera],
        )

    def measured_in(self, comparison: Comparison) -> RelitPairs:
        """Those photographs alone that a comparison of them has measured."""
        names = {image.name for image in comparison.images}
        kept = tuple(p for p in self.capture.photographs if p.name in names)
        return replace(self, capture=replace(self.capture, photographs=kept))


def compare_with_photographs(
    field: ReflectanceField,
    capture: Capture,
    silhouettes: ComparisonSilhouettes,
    folder: Path,
    options: RenderOptions | None = None,
) -> Comparison:
    """Render photographs into a folder and measure the images against them.

    Parameters
    ----------
    field : ReflectanceField
    capture : Capture
        Cameras, lights, photographs.
    silhouettes : ComparisonSilhouettes
        Of the views of the photographs.
    folder : Path
        Gets NAME.exr and NAME.png of every photograph.
    options : RenderOptions, optional

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If there is no photograph, or none that can be measured.
    NumericalError
        If what the field shows is not finite.
    """
    for relit in relight_photographs(field, capture, folder, options):
        if not np.isfinite(relit.rendering.image).all():
            raise NumericalError(
                f"photograph {relit.name!r}: expected finite radiance of the field, received "
                "NaN or infinity: its values are too large; make the field again"
            )
    return compare_images(RelitPairs(capture, folder, silhouettes))


def mean_sample(values: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Mean over observed samples, NaN where there is none.

    Parameters
    ----------
    values : (n, n_photographs, 3) float
        NaN where a channel was not measured.
    observed : (n, n_photographs) bool

    Returns
    -------
    (n, 3) float
    """
    single, counted = values.astype(np.float32), observed.astype(np.float32)[:, None]
    total, weight = (counted @ single)[:, 0], counted.sum(axis=2)
    if np.isnan(total).any():
        measured = ~np.isnan(single)
        weight = (counted @ measured.astype(np.float32))[:, 0]
        total = (counted @ np.where(measured, single, np.float32(0)))[:, 0]
    return np.asarray(total / np.where(weight > 0, weight, np.nan))
