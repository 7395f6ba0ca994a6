"""Section on model selection: every candidate run, and which was selected."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from reflfield.errors import InputError
from reflfield.metrics.image_metrics import ImagePair
from reflfield.report.page import (
    Item,
    Note,
    Section,
    Table,
    format_bytes,
    format_seconds,
)
from reflfield.report.sections.alignment_gain import FieldVariant, median_photograph
from reflfield.report.sections.held_out_images import METRIC_HEADER, metric_cells

TITLE = "Model selection"


@dataclass(frozen=True)
class CandidateRun:
    """One of the fields to select from.

    Attributes
    ----------
    field : FieldVariant
        Compared on the held-out photographs that decide.
    seconds : float
        Of all its stages, shared ones included.
    unseen : mapping of str to float, optional
        Mean metrics of photographs that had no part in the selection.
    """

    field: FieldVariant
    seconds: float
    unseen: Mapping[str, float] | None = None


def rules_section(words: Sequence[str]) -> Section:
    """Options that were selected without a candidate run.

    Parameters
    ----------
    words : sequence of str
        A sentence for each option.

    Returns
    -------
    Section

    Examples
    --------
    >>> rules_section(["No shadow could be traced."]).items[0].text
    'No shadow could be traced.'
    """
    notes = tuple(Note(text) for text in words)
    return Section(TITLE, "Options on auto that were selected without a candidate run.", notes)


def candidate_runs_section(
    runs: Sequence[CandidateRun],
    selected: str,
    words: Sequence[str],
    pairs: Sequence[Iterable[ImagePair]],
) -> Section:
    """All candidate runs on the photographs that decided, and which was selected.

    Parameters
    ----------
    runs : sequence of CandidateRun
        First the one that is selected in doubt.
    selected : str
        Name of the field that was selected.
    words : sequence of str
        A sentence for each option that was selected.
    pairs : sequence of iterable of ImagePair
        Of each field, the photographs of its comparison in that order.

    Returns
    -------
    Section

    Raises
    ------
    InputError
        If there are not two fields at least, or the one selected is not among them.
    """
    names = [one.field.name for one in runs]
    if len(runs) < 2 or selected not in names:
        raise InputError(
            f"runs: expected two fields at least and {selected!r} among them, received {names}"
        )
    items: list[Item] = [Note(text) for text in words]
    items.append(_compared(runs, names.index(selected)))
    if all(one.unseen is not None for one in runs):
        items.append(_unseen(runs, names.index(selected)))
    # The field that was selected against the next best.
    order = np.argsort([name != selected for name in names], kind="stable")
    order[1:] = sorted(order[1:], key=lambda i: -_psnr(runs[i]))
    items.append(
        median_photograph(
            [runs[i].field for i in order],
            [pairs[i] for i in order],
            "Look at the edges of shadows and at highlights. The selected field is the first.",
        )
    )
    intro = (
        "Options on auto were selected on held-out photographs, with a candidate run for each "
        "combination. Down the table, a field replaced the one selected so far if its mean LDR "
        "PSNR on the held-out photographs was significantly higher: by more than the standard "
        "error of the difference, and by more than 1 dB over the square root of their number. "
        "Since these photographs were used for the selection, their metrics are slightly "
        "optimistic for the selected field."
    )
    return Section(TITLE, intro, tuple(items))


def _psnr(one: CandidateRun) -> float:
    return next(iter(one.field.comparisons.values())).mean["psnr_ldr"]


def _compared(runs: Sequence[CandidateRun], selected: int) -> Table:
    compared = [next(iter(one.field.comparisons.values())) for one in runs]
    psnr = np.array([[image.psnr_ldr for image in c.images] for c in compared])
    wins = (psnr == psnr.max(axis=0)).sum(axis=1)
    rows = tuple(
        (
            one.field.name,
            f"{comparison.mean['psnr_ldr']:.2f}",
            f"{comparison.mean['ssim']:.4f}",
            f"{comparison.mean['flip']:.4f}",
            f"{best} of {psnr.shape[1]}",
            f"{100 * one.field.sample_error:.2f}",
            format_bytes(one.field.file_bytes),
            format_seconds(one.seconds),
        )
        for one, comparison, best in zip(runs, compared, wins, strict=True)
    )
    return Table(
        (
            "field",
            "PSNR LDR, dB",
            "SSIM",
            "FLIP",
            "best in",
            "relative error, %",
            "size",
            "wall time",
        ),
        rows,
        "Mean over the held-out photographs used for the selection; the selected field is in "
        "bold. Best in: photographs on which it has the highest PSNR. The relative error is on "
        "the samples that the field was made of; shadowed ones count only where shadows are "
        "kept. Wall time: of all its stages, including those that candidate runs "
        "share.",
        emphasised=(selected,),
    )


def _unseen(runs: Sequence[CandidateRun], selected: int) -> Table:
    return Table(
        ("field", *METRIC_HEADER),
        tuple((one.field.name, *metric_cells(one.unseen or {})) for one in runs),
        "Mean over unseen views and lights, which had no part in the selection.",
        emphasised=(selected,),
    )
