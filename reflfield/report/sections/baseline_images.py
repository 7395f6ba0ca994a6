"""Sections on what the metrics mean: trivial baselines, and where the error lies."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from reflfield.metrics.baselines import BASELINES, BLACK, MEAN, NEAREST
from reflfield.metrics.error_kinds import KINDS, NO_KIND
from reflfield.metrics.image_errors import strips
from reflfield.metrics.image_metrics import Comparison, ImagePair, without_backdrop
from reflfield.render.exposure import COVERAGE_OF_OBJECT, display, encoded_picture
from reflfield.report import pictures
from reflfield.report.page import (
    Figure,
    Item,
    Note,
    Panel,
    Picture,
    Section,
    Table,
    encode_picture,
)
from reflfield.report.sections.held_out_images import METRIC_HEADER, ROW_PX, metric_cells
from reflfield.util.image_boxes import bounding_box

BASELINE_NAMES: Mapping[str, str] = {
    NEAREST: "nearest photograph",
    MEAN: "mean texture",
    BLACK: "black",
}
# Of each kind, by place: told apart by colour-blind readers (Okabe and Ito's palette).
KIND_COLOURS = (
    "#e69f00",
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#5a5a5a",
    "#d0d0d0",
)
# End of the colour scale of LDR differences.
LARGEST_DIFFERENCE = 0.2


@dataclass(frozen=True, eq=False)
class AnalysedImage:
    """A photograph with the images that are compared with it.

    Parameters
    ----------
    pair : ImagePair
        Photograph and image of the field.
    baselines : mapping of str to (h, w, 3) float
        Linear radiance by the names of `reflfield.metrics.baselines`.
    kinds : (h, w) uint8
        Places in `reflfield.metrics.error_kinds.KINDS`.
    """

    pair: ImagePair
    baselines: Mapping[str, NDArray[Any]]
    kinds: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class AnalysedImages:
    """One set of photographs, its metrics, and what the analysis found.

    Parameters
    ----------
    title : str
        Of the set.
    comparison : Comparison
        Of the field.
    baselines, kinds : mapping
        As ``metrics.json`` holds them: metrics of each baseline, shares of each kind.
    shown : iterable of AnalysedImage
        Read once, one at a time.
    """

    title: str
    comparison: Comparison
    baselines: Mapping[str, Any]
    kinds: Mapping[str, Any]
    shown: Iterable[AnalysedImage]


def analysis_sections(sets: Iterable[AnalysedImages]) -> tuple[Section, Section]:
    """What trivial methods get on the same photographs, and where the field's error lies.

    Parameters
    ----------
    sets : iterable of AnalysedImages

    Returns
    -------
    baselines, kinds : Section
    """
    beside: list[Item] = []
    where: list[Item] = []
    for images in sets:
        beside += [baselines_table(images), *_notes(images.baselines)]
        if not where:
            where.append(_definitions(images.kinds["definitions"]))
        where.append(kinds_table(images))
        for number, image in enumerate(images.shown):
            if number == 0:  # one is enough to see what the baselines are
                beside.append(_baselines_figure(images, image))
            where.append(_kinds_figure(images, image))
    return (
        Section(
            "Trivial baselines",
            "What methods without a model of reflectance get on the same photographs, on the "
            "same pixels and at the same exposure.",
            tuple(beside),
        ),
        Section(
            "Where the error lies",
            "Pixels of the object by kind, and the share of the squared error in each.",
            tuple(where),
        ),
    )


def baselines_table(images: AnalysedImages) -> Table:
    """Mean metrics of the field and of the baselines."""
    rows = [("field", *metric_cells(images.comparison.mean))]
    rows += [
        (BASELINE_NAMES[name], *metric_cells(images.baselines[name]["mean"]))
        for name in BASELINE_NAMES
        if name in images.baselines
    ]
    return Table(
        ("image", *METRIC_HEADER),
        tuple(rows),
        f"{images.title}: mean over {len(images.comparison.images)} photographs.",
        emphasised=(0,),
    )


def _notes(baselines: Mapping[str, Any]) -> Iterator[Note]:
    if NEAREST in baselines:
        yield Note(
            f"Nearest photograph: {nearest_words(baselines)}. It is carried over the surface; "
            "its shading, shadows and highlights come along. Mean texture: matt, with the "
            "surface and the shadows of the field."
        )
    for name, reason in baselines["missing"].items():
        yield Note(f"No {BASELINE_NAMES[name]}: {reason}.")


def nearest_words(baselines: Mapping[str, Any]) -> str:
    """How far the nearest photographs are, in a few words.

    Examples
    --------
    >>> nearest = [{"view_degrees": 10, "light_degrees": 0}]
    >>> nearest_words({"nearest_photograph": {"nearest": nearest}})
    'on average 10 degrees off in view and 0 in light'
    """
    nearest = baselines[NEAREST]["nearest"]
    view, light = (
        float(np.mean([each[key] for each in nearest]))
        for key in ("view_degrees", "light_degrees")
    )
    return f"on average {view:.0f} degrees off in view and {light:.0f} in light"


def _baselines_figure(images: AnalysedImages, image: AnalysedImage) -> Figure:
    """Photograph, image of the field, and the baselines but black."""
    name, exposure = image.pair.name, images.comparison.exposure
    box = _box(image.pair)
    psnrs = {
        baseline: _psnr_of(images.baselines[baseline]["images"], name)
        for baseline in BASELINES
        if baseline in images.baselines
    }
    of_field = next(f.psnr_ldr for f in images.comparison.images if f.name == name)
    panels = [
        Panel(_picture(image.pair.photograph, box, exposure), "photograph"),
        Panel(_picture(image.pair.relit, box, exposure), f"field, {of_field:.2f} dB"),
    ]
    panels += [
        Panel(
            _picture(image.baselines[baseline], box, exposure),
            f"{text}, {psnrs[baseline]:.2f} dB",
        )
        for baseline, text in BASELINE_NAMES.items()
        if baseline in image.baselines and baseline in psnrs
    ]
    return Figure(
        tuple(panels),
        f"The photograph of middling FLIP error. Black, not shown, gets {psnrs[BLACK]:.2f} dB.",
        title=name,
        min_width=0,
    )


def _psnr_of(images: Iterable[Mapping[str, Any]], name: str) -> float:
    return next(float(image["psnr_ldr"]) for image in images if image["name"] == name)


def kinds_table(images: AnalysedImages) -> Table:
    """Share of pixels and of squared error, and PSNR, of each kind."""
    rows = [
        (
            name,
            f"{100 * kind['share_of_pixels']:.1f} %",
            f"{100 * kind['share_of_squared_error']:.1f} %",
            "" if kind["psnr_ldr"] is None else f"{kind['psnr_ldr']:.2f}",
        )
        for name, kind in images.kinds["kinds"].items()
    ]
    return Table(
        ("kind", "pixels", "squared error", "PSNR LDR, dB"),
        tuple(rows),
        f"{images.title}: of {len(images.comparison.images)} photographs together.",
    )


def _definitions(definitions: Mapping[str, str]) -> Note:
    explained = "; ".join(f"{kind}: {definitions[kind]}" for kind in KINDS)
    return Note(f"A pixel is of the first kind of these that applies: {explained}.")


def _kinds_figure(images: AnalysedImages, image: AnalysedImage) -> Figure:
    exposure, box = images.comparison.exposure, _box(image.pair)
    counted = image.kinds[box] != NO_KIND
    # Made small before it is coloured: colours take ten times the memory.
    errors = pictures.block_means(
        np.where(counted, ldr_difference(image.pair, exposure)[box], np.float32(np.nan)),
        2 * ROW_PX,
    )
    difference = pictures.false_colour(errors, 0.0, LARGEST_DIFFERENCE, "magma")
    return Figure(
        (
            Panel(_picture(image.pair.photograph, box, exposure), "photograph"),
            Panel(_picture(image.pair.relit, box, exposure), "image"),
            Panel(
                _flat(difference, np.isfinite(errors)),
                f"LDR difference, 0 to {LARGEST_DIFFERENCE:g}",
            ),
            Panel(_flat(kinds_coloured(image.kinds)[box], counted), "kinds"),
        ),
        "Difference: root mean square over the channels.",
        title=image.pair.name,
        legend=tuple(zip(KIND_COLOURS, KINDS, strict=True)),
        min_width=0,
    )


def ldr_difference(pair: ImagePair, exposure: float) -> NDArray[np.float32]:
    """Root mean square over the channels of the difference of LDR images, (h, w) float32."""
    height, width = np.shape(pair.silhouette)
    difference = np.zeros((height, width), np.float32)
    for own, _, _ in strips(height, width):
        first, second = (display(x, exposure) for x in without_backdrop(pair, own))
        difference[own] = np.sqrt(np.mean((second - first) ** 2, axis=-1))
    return difference


def kinds_coloured(kinds: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Kinds as colours, (h, w, 3) uint8; black where there is none.

    Examples
    --------
    >>> kinds_coloured(np.array([[0, 255]], np.uint8))[0].tolist()
    [[230, 159, 0], [0, 0, 0]]
    """
    palette = np.zeros((256, 3), np.uint8)
    colours = [matplotlib.colors.to_rgb(colour) for colour in KIND_COLOURS]
    palette[: len(colours)] = np.rint(np.array(colours) * 255)
    return palette[kinds]


def _box(pair: ImagePair) -> tuple[slice, slice]:
    return bounding_box(np.asarray(pair.silhouette) >= COVERAGE_OF_OBJECT, margin=6)


def _picture(image: NDArray[Any], box: tuple[slice, slice], exposure: float) -> Picture:
    shown = encoded_picture(np.asarray(image)[box], exposure)
    return encode_picture(pictures.fitted(shown, ROW_PX))


def _flat(coloured: NDArray[np.uint8], counted: NDArray[np.bool_]) -> Picture:
    """Colours that mean something, transparent where nothing is measured."""
    shown = pictures.fitted(pictures.with_alpha(coloured, counted), ROW_PX)
    return encode_picture(shown, lossless=True)


def analysis_lines(metrics: Mapping[str, Any]) -> Iterator[str]:
    """What trivial methods get, a line each, and in which kinds of pixels most error lies."""
    baselines = metrics.get("baselines", {"missing": {}})
    for name, text in BASELINE_NAMES.items():
        if name in baselines:
            mean = baselines[name]["mean"]
            more = f"; {nearest_words(baselines)}" if "nearest" in baselines[name] else ""
            yield (
                f"baseline {text}: PSNR {mean['psnr_ldr']:.2f} dB (LDR), SSIM "
                f"{mean['ssim']:.4f}, FLIP {mean['flip']:.4f}{more}"
            )
    for name, reason in baselines["missing"].items():
        yield f"baseline {BASELINE_NAMES[name]}: none; {reason}"
    kinds = metrics.get("error_kinds", {"kinds": {}})["kinds"]
    ranked = sorted(kinds.items(), key=lambda kind: -kind[1]["share_of_squared_error"])[:3]
    if ranked:
        shares = (
            f"{name} {kind['share_of_squared_error']:.0%} on {kind['share_of_pixels']:.0%} of "
            "the pixels"
            for name, kind in ranked
        )
        yield f"squared error: {', '.join(shares)}"
