"""Sections on images: held-out photographs beside rendered images; alignment scores."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.errors import InputError
from reflfield.metrics.image_errors import PSNR_CAP_DB
from reflfield.metrics.image_metrics import (
    Comparison,
    ImageMetrics,
    ImagePair,
    flip_errors,
    worst_to_best,
)
from reflfield.render.exposure import COVERAGE_OF_OBJECT, encoded_picture
from reflfield.report import pictures, plots
from reflfield.report.page import (
    ColourBar,
    Figure,
    Item,
    Note,
    Panel,
    Picture,
    Section,
    Table,
    encode_picture,
)
from reflfield.util.image_boxes import bounding_box

ROW_PX = 480
# FLIP errors of good results lie near 0; full scale would show black images.
FLIP_SCALES = (0.1, 0.2, 0.3, 0.5, 1.0)
# Fewer are better read from the table.
IMAGES_FOR_PLOTS = 6
FLIP_LABEL = "FLIP error, all rows; 0: indistinguishable"
METRIC_HEADER = ("PSNR LDR, dB", "PSNR HDR, dB", "SSIM", "FLIP")


def held_out_section(
    comparison: Comparison,
    pairs: Iterable[ImagePair],
    *,
    title: str = "Held-out photographs",
    intro: str = "Photographs that the field was not made of, beside images rendered from it.",
    max_rows: int = 8,
) -> Section:
    """Rows photograph | image | error, and the table of metrics per photograph.

    Parameters
    ----------
    comparison : Comparison
        Of the same photographs.
    pairs : iterable of ImagePair
        In the order of the comparison; read once, one at a time.
    title, intro : str
    max_rows : int
        Rows shown, from the worst to the best in even steps.

    Returns
    -------
    Section

    Raises
    ------
    InputError
        If the pairs are not those of the comparison.
    """
    shown = {id(f) for f in _even_choice(worst_to_best(comparison.images), max_rows)}
    rows, measured = [], iter(comparison.images)
    for pair in pairs:
        metrics = next(measured, None)
        if metrics is None or pair.name != metrics.name:
            raise InputError(
                f"pairs: expected {metrics.name if metrics else 'no more'!r} as in the "
                f"comparison, received {pair.name!r}; pass the pairs that were compared, in "
                "the same order"
            )
        if id(metrics) in shown:
            rows.append(compared_row(pair, metrics, comparison.exposure))
        del pair  # before the next one is read
    rows.sort(key=lambda row: (-row.metrics.flip, row.metrics.name))
    high = flip_scale([row.error for row in rows])
    items: list[Item] = [_notes_on(comparison)]
    items += [_row_figure(row, high, has_bar=i == 0) for i, row in enumerate(rows)]
    if len(comparison.images) >= IMAGES_FOR_PLOTS:
        items.append(_distribution(comparison))
    items.append(metrics_table(comparison))
    return Section(title, intro, tuple(items))


@dataclass(frozen=True, eq=False)
class ComparedRow:
    """One row of the page: encoded images, metrics, and block means of FLIP errors."""

    metrics: ImageMetrics
    photograph: Picture
    relit: Picture
    error: NDArray[np.floating]


def compared_row(pair: ImagePair, metrics: ImageMetrics, exposure: float) -> ComparedRow:
    """Crop photograph and image to the object and compute their FLIP errors."""
    box = bounding_box(np.asarray(pair.silhouette) >= COVERAGE_OF_OBJECT, margin=6)
    photograph, relit = (
        encode_picture(pictures.fitted(encoded_picture(image[box], exposure), ROW_PX))
        for image in (np.asarray(pair.photograph), np.asarray(pair.relit))
    )
    errors = np.where(pair.counted, flip_errors(pair, exposure), np.float32(np.nan))[box]
    return ComparedRow(metrics, photograph, relit, pictures.block_means(errors, 2 * ROW_PX))


def flip_scale(errors: Sequence[NDArray[np.floating]]) -> float:
    """End of the colour scale that shows nearly all of the errors."""
    tops = [float(np.nanpercentile(error, 99)) for error in errors]
    top = max(tops, default=1.0)
    return next((scale for scale in FLIP_SCALES if scale >= top), FLIP_SCALES[-1])


def error_panel(row: ComparedRow, high: float) -> Picture:
    """A row's FLIP error in false colours from 0 to `high`."""
    coloured = pictures.false_colour(row.error, 0, high, "magma")
    error = pictures.fitted(pictures.with_alpha(coloured, np.isfinite(row.error)), ROW_PX)
    return encode_picture(error, lossless=True)


def _row_figure(row: ComparedRow, high: float, *, has_bar: bool) -> Figure:
    m = row.metrics
    return Figure(
        (
            Panel(row.photograph, "photograph"),
            Panel(row.relit, "image"),
            Panel(error_panel(row, high), f"FLIP error, 0 to {high:g}"),
        ),
        f"PSNR {m.psnr_ldr:.2f} dB (HDR {m.psnr_hdr:.2f} dB) · SSIM {m.ssim:.3f} · "
        f"FLIP {m.flip:.3f} · {m.n_pixels} object pixels"
        + (f", {m.n_excluded} saturated ones excluded" if m.n_excluded else ""),
        title=m.name,
        colour_bar=ColourBar("magma", 0.0, high, FLIP_LABEL) if has_bar else None,
        min_width=0,
    )


def _notes_on(comparison: Comparison) -> Note:
    ratio = " / ".join("–" if r is None else f"{r:.3f}" for r in comparison.colour_ratio)
    return Note(
        f"All photographs and images are shown at one exposure, {comparison.exposure:.4g}; "
        "none is rescaled. Rows are sorted from the highest to the lowest FLIP error. Look "
        "for missing or smeared highlights, soft or displaced edges of shadows, and double "
        f"contours. Image / photograph, sums over all, R / G / B: {ratio} (1: no bias). "
        f"{measured_words(comparison)}"
    )


# What a silhouette's origin means to a reader.
ORIGIN_WORDS = {
    "given": "given with the photographs",
    "alpha": "the alpha of the photographs of their cameras",
    "photographs": "made from all photographs of their cameras",
    "hull": "the base surface as seen by the cameras (too few photographs of those cameras)",
    "image": "the whole image",
}


def measured_words(comparison: Comparison) -> str:
    """Pixels and silhouettes that the metrics are computed on, in a sentence or two."""
    measured = comparison.measured
    words = "; ".join(
        f"{count} {ORIGIN_WORDS.get(origin, origin)}"
        for origin, count in measured["silhouettes"].items()
    )
    text = f"Measured on {measured['pixels']} pixels of the object. Silhouettes: {words}."
    if n := measured["saturated_pixels_left_out"]:
        text += f" {n} pixels of the object are saturated in the photographs and excluded."
    if names := measured["images_not_measured"]:
        text += f" Not measured, because they show no pixel of the object: {', '.join(names)}."
    return text


def _distribution(comparison: Comparison) -> Figure:
    ranked = {
        "PSNR LDR": sorted(f.psnr_ldr for f in comparison.images),
        "PSNR HDR": sorted(f.psnr_hdr for f in comparison.images),
    }
    curves = {name: (range(1, len(v) + 1), v) for name, v in ranked.items()}
    flips = {"FLIP": [f.flip for f in comparison.images]}
    return Figure(
        (
            Panel(plots.lines(curves, "photographs, worst first", "PSNR, dB"), "PSNR, sorted"),
            Panel(
                plots.histogram(flips, "FLIP", "photographs, %", n_bins=20),
                "distribution of FLIP",
            ),
        ),
        "A few photographs far below the rest usually share a light or a view: see the table.",
        min_width=300,
    )


def metrics_table(comparison: Comparison) -> Table:
    """Metrics of every photograph, and their mean on top.

    Parameters
    ----------
    comparison : Comparison

    Returns
    -------
    Table
    """
    mean = comparison.mean
    rows = [("mean", *metric_cells(mean), mean["n_pixels"])]
    rows += [
        (f.name, *metric_cells(vars(f)), float(f.n_pixels))
        for f in worst_to_best(comparison.images)
    ]
    return Table(
        ("photograph", *METRIC_HEADER, "object pixels"),
        tuple(rows),
        "Metrics per photograph over object pixels, highest FLIP error first. PSNR is capped "
        f"at {PSNR_CAP_DB:g} dB (identical images).",
        emphasised=(0,),
    )


def metric_cells(metrics: Mapping[str, Any]) -> tuple[str, str, str, str]:
    """Metrics in the order of `METRIC_HEADER`, as text."""
    decimals = (("psnr_ldr", 2), ("psnr_hdr", 2), ("ssim", 4), ("flip", 4))
    red, green, blue, last = (f"{metrics[key]:.{places}f}" for key, places in decimals)
    return red, green, blue, last


def _even_choice(images: Sequence[ImageMetrics], count: int) -> list[ImageMetrics]:
    if len(images) <= count:
        return list(images)
    ranks = np.unique(np.linspace(0, len(images) - 1, count).round().astype(int))
    return [images[rank] for rank in ranks]


def alignment_section(history: ArrayLike, margin: ArrayLike) -> Section:
    """Alignment: score by iteration, and margin.

    Parameters
    ----------
    history : (n_iterations,) array_like
        Accumulated correlation after each iteration.
    margin : (n_texels,) array_like
        Score gap to the next distinct peak; near 0: undetermined.

    Returns
    -------
    Section
    """
    scores = np.asarray(history, dtype=np.float64).ravel()
    figure = Figure(
        (
            Panel(
                plots.lines(
                    {"correlation": (np.arange(1, scores.size + 1), scores)},
                    "iteration",
                    "accumulated correlation",
                ),
                "score by iteration",
            ),
            Panel(plots.histogram({"margin": margin}, "margin", "texels, %"), "margin"),
        ),
        "The score must never fall, and should converge. Texels with margin 0 are undetermined "
        "(matte or isotropic materials) and keep the hull's frame.",
        min_width=300,
    )
    intro = (
        "One local frame per texel, estimated by correlating apparent BRDFs over all rotations."
    )
    return Section("Alignment", intro, (figure,))


def comparisons_table(comparisons: Mapping[str, Comparison]) -> Table:
    """Mean metrics of sets of photographs.

    Parameters
    ----------
    comparisons : mapping of name to Comparison

    Returns
    -------
    Table
    """
    return Table(
        ("photographs", *METRIC_HEADER),
        tuple((name, *metric_cells(c.mean)) for name, c in comparisons.items()),
        "Mean over the photographs: higher PSNR and SSIM and lower FLIP are better.",
    )


def measured_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Mean metrics in one line, and on what they were measured in another."""
    mean, n = metrics["mean"], len(metrics["images"])
    measured = metrics["measured"]
    parts = [f"measured on {measured['pixels']} pixels"]
    if left_out := measured["saturated_pixels_left_out"]:
        parts.append(f"{left_out} saturated ones left out")
    if names := measured["images_not_measured"]:
        parts.append(f"without a pixel of the object: {', '.join(names)}")
    origins = ", ".join(f"{name} {n}" for name, n in measured["silhouettes"].items())
    return [
        f"{n} image{'' if n == 1 else 's'}: PSNR {mean['psnr_ldr']:.2f} dB (LDR), "
        f"{mean['psnr_hdr']:.2f} dB (HDR), SSIM {mean['ssim']:.4f}, FLIP {mean['flip']:.4f}",
        "; ".join([*parts, f"silhouettes: {origins}"]),
    ]
