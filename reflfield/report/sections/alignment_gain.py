"""Section on the gain of alignment: two fields of one size on the same photographs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from reflfield.errors import InputError
from reflfield.metrics.image_metrics import Comparison, ImagePair
from reflfield.report.page import (
    ColourBar,
    Figure,
    Item,
    Note,
    Panel,
    Section,
    Table,
    format_bytes,
)
from reflfield.report.sections.held_out_images import (
    METRIC_HEADER,
    ComparedRow,
    compared_row,
    error_panel,
    flip_scale,
    metric_cells,
)

# Fields whose files differ by less than this share count as equal in size.
EQUAL_SIZE = 0.02
# Width of an image where the fields are too many for one row.
WRAPPED_WIDTH = 260


@dataclass(frozen=True)
class FieldVariant:
    """One of the fields that are compared.

    Attributes
    ----------
    name : str
        Such as "with alignment".
    comparisons : mapping of set of photographs to Comparison
        The same sets and photographs for all variants.
    file_bytes : int
    sample_error, cube_root_error : float
        Relative error of the field on the samples that it was made of, and of their
        cube roots.
    """

    name: str
    comparisons: Mapping[str, Comparison]
    file_bytes: int
    sample_error: float
    cube_root_error: float


def ablation_section(
    variants: Sequence[FieldVariant], pairs: Sequence[Iterable[ImagePair]]
) -> Section:
    """What alignment brings: errors of fields with and without it, and one image of each.

    Parameters
    ----------
    variants : sequence of FieldVariant
        The field itself first.
    pairs : sequence of iterable of ImagePair
        Of each variant, the photographs of its first comparison in that order. May be empty.

    Returns
    -------
    Section

    Raises
    ------
    InputError
        If there are not two variants at least.
    """
    if len(variants) < 2:
        raise InputError(f"variants: expected two at least, received {len(variants)}")
    items: list[Item] = [_errors_table(variants)]
    if variants[0].comparisons:
        advice = "Look at the highlights and at fine relief: without alignment they smear."
        items += [_metrics_table(variants), median_photograph(variants, pairs, advice)]
    sizes = [variant.file_bytes for variant in variants]
    if max(sizes) > (1 + EQUAL_SIZE) * min(sizes):
        words = "; ".join(f"{v.name} {format_bytes(v.file_bytes)}" for v in variants)
        items.append(Note(f"The files are not of one size: {words}.", is_warning=True))
    intro = (
        "The same samples, compressed twice with the same number of clusters, components and "
        "bits: in the aligned local frames, and in the frames of the hull."
    )
    return Section("With alignment and without", intro, tuple(items))


def _errors_table(variants: Sequence[FieldVariant]) -> Table:
    return Table(
        (
            "field",
            "size",
            "bytes",
            "relative error of the samples, %",
            "relative error of their cube roots, %",
        ),
        tuple(
            (
                v.name,
                format_bytes(v.file_bytes),
                v.file_bytes,
                f"{100 * v.sample_error:.2f}",
                f"{100 * v.cube_root_error:.2f}",
            )
            for v in variants
        ),
        "Relative error: root mean square of field minus sample, over that of the samples of "
        "the photographs that the field was made of. The cube root weighs dark samples more.",
    )


def _metrics_table(variants: Sequence[FieldVariant]) -> Table:
    return Table(
        ("photographs", "field", *METRIC_HEADER),
        tuple(
            (name, variant.name, *metric_cells(variant.comparisons[name].mean))
            for name in variants[0].comparisons
            for variant in variants
        ),
        "Mean over photographs that neither field was made of: higher PSNR and SSIM and lower "
        "FLIP are better.",
    )


def median_photograph(
    variants: Sequence[FieldVariant], pairs: Sequence[Iterable[ImagePair]], advice: str
) -> Figure:
    """The photograph whose gain in FLIP, first over second, is the median, with all variants.

    Parameters
    ----------
    variants : sequence of FieldVariant
        Two at least, with comparisons.
    pairs : sequence of iterable of ImagePair
        Of each variant, the photographs of its first comparison in that order.
    advice : str
        What to look at.
    """
    compared = [next(iter(variant.comparisons.values())) for variant in variants]
    flips = np.array([[image.flip for image in c.images] for c in compared])
    gains = flips[1] - flips[0]
    chosen = int(np.argsort(gains, kind="stable")[len(gains) // 2])
    rows = [
        _row_of(chosen, own_pairs, comparison)
        for own_pairs, comparison in zip(pairs, compared, strict=True)
    ]
    high = flip_scale([row.error for row in rows])
    named = list(zip([v.name for v in variants], rows, strict=True))
    metrics = "; ".join(
        f"{name}: PSNR {row.metrics.psnr_ldr:.2f} dB, SSIM {row.metrics.ssim:.3f}, FLIP "
        f"{row.metrics.flip:.3f}"
        for name, row in named
    )
    return Figure(
        (
            Panel(rows[0].photograph, "photograph"),
            *(Panel(row.relit, name) for name, row in named),
            *(Panel(error_panel(row, high), f"FLIP error {name}") for name, row in named),
        ),
        f"The held-out photograph with the median gain in FLIP. {metrics}. {advice}",
        title=rows[0].metrics.name,
        colour_bar=ColourBar("magma", 0.0, high, "FLIP error; 0: indistinguishable"),
        min_width=0 if len(variants) == 2 else WRAPPED_WIDTH,
    )


def _row_of(chosen: int, own_pairs: Iterable[ImagePair], comparison: Comparison) -> ComparedRow:
    pair = next(pair for i, pair in enumerate(own_pairs) if i == chosen)
    return compared_row(pair, comparison.images[chosen], comparison.exposure)
