"""How close rendered images are to photographs, in the units of the literature.

All measures are taken over the *object pixels* of `reflfield.render.exposure`, at the common
exposure of the photographs; nothing is rescaled per image or per channel.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.errors import InputError, ShapeError
from reflfield.metrics.image_errors import (
    HALO_PX,
    PIXELS_PER_DEGREE,
    PSNR_CAP_DB,
    flip_map,
    psnr_of_mean_square,
    ssim_map,
    strips,
)
from reflfield.render.exposure import (
    COVERAGE_OF_OBJECT,
    ExposureMeter,
    display,
    object_pixels,
)
from reflfield.util.image_boxes import bounding_box

Image = NDArray[np.float64]

# What is said of a photograph, in the order of ``metrics.json``.
METRIC_KEYS = ("name", "psnr_ldr", "psnr_hdr", "ssim", "flip", "n_pixels", "n_excluded",
              "silhouette_from")  # fmt: skip

DEFINITIONS: Mapping[str, str] = {
    "object_pixels": "silhouette coverage >= 0.5, eroded by a disk of radius 2 pixels",
    "exposure": "1 / 99.5th percentile of the photographs' luminance over all object pixels",
    "psnr_ldr": "on sRGB(clip(exposure * x, 0, 1)), peak 1, dB, capped",
    "psnr_hdr": "on exposure * x, peak 1, dB, capped",
    "ssim": "scikit-image, uniform 7 x 7 window, on the LDR images, map averaged",
    "flip": "LDR-FLIP, map averaged; 0 is equal, 1 is the worst",
    "backdrop": "black in both images where coverage < 0.5, so windows do not see it",
    "excluded": "pixels where the photograph is saturated; equal in both images, not counted",
    "colour_ratio": "sum of relit / sum of photograph over object pixels, per channel",
}


class NothingToMeasure(InputError):
    """No photograph shows a pixel of the object that could be measured."""


@dataclass(frozen=True, eq=False)
class ImagePair:
    """A photograph and the image rendered for the same camera and light.

    Attributes
    ----------
    name : str
        Name of the photograph, quoted in results and errors.
    photograph, relit : (h, w, 3) float
        Linear radiance.
    silhouette : (h, w) float
        Coverage by the object, 0 to 1.
    excluded : (h, w) bool, optional
        True where the photograph is no measurement, such as saturated pixels.
    silhouette_from : str
        Where the silhouette comes from.
    """

    name: str
    photograph: NDArray[Any]
    relit: NDArray[Any]
    silhouette: NDArray[Any]
    excluded: NDArray[np.bool_] | None = None
    silhouette_from: str = "given"

    @property
    def counted(self) -> NDArray[np.bool_]:
        """(h, w) True where the pixel is measured: on the object, and a measurement."""
        inside = object_pixels(self.silhouette)
        return inside if self.excluded is None else inside & ~self.excluded


@dataclass(frozen=True)
class ImageMetrics:
    """Measures of one photograph; see `DEFINITIONS`.

    Attributes
    ----------
    psnr_ldr, psnr_hdr : float
        dB, at most `PSNR_CAP_DB`.
    ssim, flip : float
    n_pixels : int
        Object pixels measured.
    colour_sums : (2, 3) tuple of float
        Sums of the photograph and of the relit image over the measured pixels, per channel.
    n_excluded : int
        Object pixels left out because the photograph is saturated there.
    silhouette_from : str
        Where the silhouette comes from.
    """

    name: str
    psnr_ldr: float
    psnr_hdr: float
    ssim: float
    flip: float
    n_pixels: int
    colour_sums: tuple[tuple[float, ...], ...]
    n_excluded: int = 0
    silhouette_from: str = "given"

    @property
    def colour_ratio(self) -> tuple[float | None, ...]:
        """Relit over photograph per channel; None where the photograph is black."""
        return _colour_ratio(*np.asarray(self.colour_sums))

    def to_dict(self) -> dict[str, Any]:
        """What ``metrics.json`` says of the photograph; see `Comparison.from_dict`."""
        return {key: getattr(self, key) for key in METRIC_KEYS}


@dataclass(frozen=True)
class Comparison:
    """Measures of all photographs, their mean, and how they were taken.

    Attributes
    ----------
    images : tuple of ImageMetrics
    exposure : float
        The factor e that all images were multiplied with.
    warnings : tuple of str
        What a reader of the numbers should know.
    not_measured : tuple of str
        Photographs that show no pixel of the object that could be measured.
    """

    images: tuple[ImageMetrics, ...]
    exposure: float
    warnings: tuple[str, ...] = ()
    not_measured: tuple[str, ...] = ()

    @property
    def mean(self) -> dict[str, float]:
        """Plain mean over photographs of every measure."""
        keys = ("psnr_ldr", "psnr_hdr", "ssim", "flip", "n_pixels")
        return {k: float(np.mean([getattr(f, k) for f in self.images])) for k in keys}

    @property
    def colour_ratio(self) -> tuple[float | None, ...]:
        """Relit over photograph per channel, of the sums over all photographs.

        A mean of ratios would be that of the darkest photographs.
        """
        return _colour_ratio(*np.sum([image.colour_sums for image in self.images], axis=0))

    def to_dict(self) -> dict[str, Any]:
        """The content of ``metrics.json``; see `to_json`."""
        return {
            "images": [image.to_dict() for image in self.images],
            "mean": self.mean,
            "measured": self.measured,
            "extra": {
                "exposure": self.exposure,
                "pixels_per_degree": PIXELS_PER_DEGREE,
                "psnr_cap_db": PSNR_CAP_DB,
                "colour_ratio": list(self.colour_ratio),
                "images": [
                    {
                        "name": f.name,
                        "colour_ratio": list(f.colour_ratio),
                        "colour_sums": [list(sums) for sums in f.colour_sums],
                    }
                    for f in self.images
                ],
                "definitions": dict(DEFINITIONS),
                "warnings": list(self.warnings),
            },
        }

    @property
    def measured(self) -> dict[str, Any]:
        """On what the measures were taken: counts over all photographs."""
        origins = [image.silhouette_from for image in self.images]
        return {
            "images": len(self.images),
            "pixels": sum(image.n_pixels for image in self.images),
            "saturated_pixels_left_out": sum(image.n_excluded for image in self.images),
            "silhouettes": {origin: origins.count(origin) for origin in sorted(set(origins))},
            "images_not_measured": list(self.not_measured),
        }

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Comparison:
        """The comparison that `to_dict` has told the content of."""
        extra = content["extra"]
        sums = {more["name"]: more["colour_sums"] for more in extra["images"]}
        images = tuple(
            ImageMetrics(**image, colour_sums=tuple(map(tuple, sums[image["name"]])))
            for image in content["images"]
        )
        return Comparison(
            images,
            extra["exposure"],
            tuple(extra["warnings"]),
            tuple(content["measured"]["images_not_measured"]),
        )

    def to_json(self) -> str:
        """``metrics.json``: photographs, mean, and under "extra" what else was found."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"


def metrics_text(compared: Mapping[str, Any] | None, **more: Any) -> str:
    """Text of ``metrics.json``: every photograph, the mean, what was measured, and more."""
    nothing: dict[str, Any] = {"images": [], "mean": {}, "measured": {}}
    kept = nothing if compared is None else {name: compared[name] for name in nothing}
    return json.dumps({**kept, **more}, indent=2, allow_nan=False) + "\n"


def common_exposure(photographs: Iterable[tuple[ArrayLike, ArrayLike]]) -> float:
    """Exposure e of a whole comparison; one pass over the photographs.

    Parameters
    ----------
    photographs : iterable of ((h, w, 3), (h, w))
        Photograph (linear) and its silhouette; or, instead of the silhouette,
        True for the pixels that count.

    Returns
    -------
    float
        Exposure; ``nan`` if the percentile is not positive (photographs are
        black), because then no exposure is defined.

    Raises
    ------
    InputError
        If no photograph has an object pixel.

    Examples
    --------
    >>> grey = np.full((9, 9, 3), 0.25)
    >>> round(common_exposure([(grey, np.ones((9, 9)))]), 6)
    4.0
    """
    meter, n_pairs = ExposureMeter(), 0
    for photograph, silhouette in photographs:
        n_pairs += 1
        meter.add(photograph, silhouette)
        del photograph, silhouette  # before the next ones are read
    if meter.is_empty:
        raise NothingToMeasure(
            "pairs: expected at least one object pixel to set the exposure from, received "
            f"none in {n_pairs} photographs; check the silhouettes"
        )
    return meter.exposure


def compare_images(pairs: Iterable[ImagePair], exposure: float | None = None) -> Comparison:
    """Measure rendered images against photographs, all at one exposure.

    Parameters
    ----------
    pairs : iterable of ImagePair
        Read twice (exposure, then measures). A one-shot iterator is kept in
        memory; pass an object that can be iterated again, or `exposure`, to
        hold one photograph at a time.
    exposure : float, optional
        Exposure from `common_exposure`, if known already.

    Returns
    -------
    Comparison

        Photographs without a pixel that counts are left out and named.

    Raises
    ------
    InputError
        If there is no photograph, or none with a pixel that counts, or a value under one is
        not finite. The message names the photograph.
    ShapeError
        If photograph, rendered image and silhouette differ in size.

    Examples
    --------
    White photographs, relit 10 % too dark: HDR error 0.1, so 20 dB.

    >>> white = np.ones((16, 16, 3))
    >>> result = compare_images([ImagePair("a", white, 0.9 * white, np.ones((16, 16)))])
    >>> round(result.mean["psnr_hdr"], 9), result.images[0].n_pixels
    (20.0, 144)
    """
    pairs = list(pairs) if isinstance(pairs, Iterator) else pairs
    if exposure is None:
        exposure = common_exposure(_checked(pairs))
    notes: tuple[str, ...] = ()
    if math.isnan(exposure):
        exposure = 1.0
        notes = ("The photographs are black over the object; exposure 1 was used.",)
    measured, left_out = [], []
    for pair in pairs:
        if pair.counted.any():
            measured.append(measure_image(pair, exposure))
        else:
            left_out.append(pair.name)
        del pair  # before the next one is read
    if not measured:
        raise NothingToMeasure(
            "pairs: expected at least one photograph with object pixels to compare, "
            "received none"
            + (f" ({', '.join(left_out)} have none); check the silhouettes" if left_out else "")
        )
    return Comparison(tuple(measured), exposure, notes, tuple(left_out))


def measure_image(pair: ImagePair, exposure: float) -> ImageMetrics:
    """Measures of one photograph at a given exposure.

    Parameters
    ----------
    pair : ImagePair
    exposure : float
        From `common_exposure`.

    Returns
    -------
    ImageMetrics

    Raises
    ------
    InputError
        If the photograph has no object pixel or a value under one is not finite.
    ShapeError
        If the images differ in size.
    """
    check_pair(pair)
    counted = pair.counted
    if not counted.any():
        raise InputError(
            f"photograph {pair.name!r}: expected object pixels (silhouette coverage >= 0.5, "
            "eroded by 2 pixels), received none; leave the photograph out or check its "
            "silhouette"
        )
    sums = _sums(pair, counted, exposure)
    n = int(counted.sum())
    return ImageMetrics(
        name=pair.name,
        psnr_ldr=psnr_of_mean_square(sums["ldr"] / (3 * n)),
        psnr_hdr=psnr_of_mean_square(sums["hdr"] / (3 * n)),
        ssim=sums["ssim"] / n,
        flip=sums["flip"] / n,
        n_pixels=n,
        colour_sums=tuple(map(tuple, sums["colours"].tolist())),
        n_excluded=int((object_pixels(pair.silhouette) & ~counted).sum()),
        silhouette_from=pair.silhouette_from,
    )


def _sums(pair: ImagePair, counted: NDArray[np.bool_], exposure: float) -> dict[str, Any]:
    """Sums over the pixels that count: squared errors, SSIM, FLIP, and both images."""
    sums: dict[str, Any] = dict.fromkeys(("ldr", "hdr", "ssim", "flip"), 0.0)
    sums["colours"] = np.zeros((2, 3))
    box = bounding_box(counted, HALO_PX)
    pair, counted = _part_of(pair, box), counted[box]
    for own, wide, inner in strips(*counted.shape):
        here = counted[own]
        if not here.any():
            continue
        images = without_backdrop(pair, wide)
        shown = [display(image, exposure) for image in images]
        radiance = [image[inner][here] for image in images]
        first, second = (image[inner][here] for image in shown)
        sums["ldr"] += float(np.sum((second - first) ** 2))
        first, second = (exposure * values for values in radiance)
        sums["hdr"] += float(np.sum((second - first) ** 2))
        sums["ssim"] += float(ssim_map(*shown)[inner][here].sum())
        sums["flip"] += float(flip_map(*shown)[inner][here].sum(dtype=np.float64))
        sums["colours"] += [values.sum(axis=0) for values in radiance]
    return sums


def flip_errors(pair: ImagePair, exposure: float) -> NDArray[np.float32]:
    """FLIP error of each pixel, (h, w) float32; 0 where the object is not near."""
    covered = np.asarray(pair.silhouette) >= COVERAGE_OF_OBJECT
    errors = np.zeros(covered.shape, np.float32)
    box = bounding_box(covered, HALO_PX)
    pair, of_box = _part_of(pair, box), errors[box]
    for own, wide, inner in strips(*of_box.shape):
        shown = [display(image, exposure) for image in without_backdrop(pair, wide)]
        of_box[own] = flip_map(*shown)[inner]
    return errors


def _part_of(pair: ImagePair, box: tuple[slice, slice]) -> ImagePair:
    """Some rows and columns of a pair; what is measured does not look beyond `HALO_PX`."""
    images: dict[str, Any] = {
        name: np.asarray(getattr(pair, name))[box]
        for name in ("photograph", "relit", "silhouette")
    }
    excluded = None if pair.excluded is None else pair.excluded[box]
    return replace(pair, excluded=excluded, **images)


def check_pair(pair: ImagePair) -> None:
    """Demand equal sizes and finite values.

    Raises
    ------
    ShapeError
        If photograph, rendered image and silhouette differ in size.
    InputError
        If a value where coverage >= 0.5 is not finite. Values elsewhere are never
        read and may be anything.
    """
    size = np.shape(pair.silhouette)
    for what, image in (("photograph", pair.photograph), ("relit", pair.relit)):
        if len(size) != 2 or np.shape(image) != (*size, 3):
            raise ShapeError(
                f"photograph {pair.name!r}, {what}: expected shape (h, w, 3) with the size "
                f"of the silhouette, received {np.shape(image)} and silhouette {size}"
            )
    covered = np.asarray(pair.silhouette) >= COVERAGE_OF_OBJECT
    for what, image in (("photograph", pair.photograph), ("relit", pair.relit)):
        _check_finite(pair.name, what, image, covered)


def without_backdrop(pair: ImagePair, rows: slice = slice(None)) -> tuple[Image, Image]:
    """Photograph and rendered image (some rows) as float64, black where coverage < 0.5.

    SSIM and FLIP look at neighbourhoods; a backdrop that the field cannot know
    must not enter them from outside the silhouette. Nor must a saturated highlight: where
    pixels are excluded, the rendered image is equal to the photograph.
    """
    covered = (np.asarray(pair.silhouette)[rows] >= COVERAGE_OF_OBJECT)[..., None]
    photograph, relit = (
        np.where(covered, np.asarray(np.asarray(image)[rows], dtype=np.float64), 0.0)
        for image in (pair.photograph, pair.relit)
    )
    if pair.excluded is not None:
        relit = np.where(pair.excluded[rows][..., None], photograph, relit)
    return photograph, relit


def _checked(pairs: Iterable[ImagePair]) -> Iterator[tuple[ArrayLike, NDArray[np.bool_]]]:
    """Photographs and their pixels that count, one at a time in memory."""
    for pair in pairs:
        check_pair(pair)
        yield pair.photograph, pair.counted
        del pair  # before the next one is read


def _check_finite(
    name: str, what: str, image: NDArray[Any], covered: NDArray[np.bool_]
) -> None:
    bad = covered & ~np.isfinite(image).all(axis=-1)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise InputError(
            f"photograph {name!r}, {what}: expected finite radiance on the object, received "
            f"{np.asarray(image)[row, column].tolist()} at row {row}, column {column} "
            f"({int(bad.sum())} such pixels); repair the image or leave the photograph out"
        )


def _colour_ratio(
    photograph: NDArray[np.float64], relit: NDArray[np.float64]
) -> tuple[float | None, float | None, float | None]:
    """Of the sums (3,) of both images."""
    red, green, blue = (
        float(image / measured) if measured > 0.0 else None
        for measured, image in zip(photograph, relit, strict=True)
    )
    return red, green, blue


def worst_to_best(images: Sequence[ImageMetrics]) -> list[ImageMetrics]:
    """Photographs by falling FLIP error, ties by name.

    Examples
    --------
    >>> make = lambda name, flip: ImageMetrics(name, 30, 30, 0.9, flip, 9, (1, 1, 1))
    >>> [f.name for f in worst_to_best([make("a", 0.1), make("b", 0.3)])]
    ['b', 'a']
    """
    return sorted(images, key=lambda f: (-f.flip, f.name))
