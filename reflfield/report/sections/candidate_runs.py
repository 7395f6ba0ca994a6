"""Section on what was left open: every field that was tried, and which was taken."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from reflfield.errors import InputError
from reflfield.metrics.image_metrics import FramePair
from reflfield.report.page import (
    Item,
    Note,
    Section,
    Table,
    format_bytes,
    format_seconds,
)
from reflfield.report.sections.alignment_gain import FieldVariant, middle_frame
from reflfield.report.sections.held_out_images import METRIC_HEADER, metric_cells

TITLE = "Choices"


@dataclass(frozen=True)
class TriedField:
    """One way to settle what was open.

    Attributes
    ----------
    field : FieldVariant
        Compared on the frames that decide.
    seconds : float
        Of all its stages, shared ones included.
    unseen : mapping of str to float, optional
        Mean metrics of frames that had no part in the decision.
    """

    field: FieldVariant
    seconds: float
    unseen: Mapping[str, float] | None = None


def rules_section(words: Sequence[str]) -> Section:
    """What was left open and settled without a trial.

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
    return Section(TITLE, "What the options left open was settled without a trial.", notes)


def choices_section(
    tried: Sequence[TriedField],
    taken: str,
    words: Sequence[str],
    pairs: Sequence[Iterable[FramePair]],
) -> Section:
    """Fields of all trials on the frames that decided, and which was taken.

    Parameters
    ----------
    tried : sequence of TriedField
        First the one that is taken in doubt.
    taken : str
        Name of the field that was taken.
    words : sequence of str
        A sentence for each option that was open.
    pairs : sequence of iterable of FramePair
        Of each field, the frames of its comparison in that order.

    Returns
    -------
    Section

    Raises
    ------
    InputError
        If there are not two fields at least, or the one taken is not among them.
    """
    names = [one.field.name for one in tried]
    if len(tried) < 2 or taken not in names:
        raise InputError(
            f"tried: expected two fields at least and {taken!r} among them, received {names}"
        )
    items: list[Item] = [Note(text) for text in words]
    items.append(_compared(tried, names.index(taken)))
    if all(one.unseen is not None for one in tried):
        items.append(_unseen(tried, names.index(taken)))
    # The field that was taken against the next best.
    order = np.argsort([name != taken for name in names], kind="stable")
    order[1:] = sorted(order[1:], key=lambda i: -_psnr(tried[i]))
    items.append(
        middle_frame(
            [tried[i].field for i in order],
            [pairs[i] for i in order],
            "Look at the edges of shadows and at highlights. The field taken is the first.",
        )
    )
    intro = (
        "What the options left open was settled by making every field. Down the table, a field "
        "took the place of the one taken so far if its LDR PSNR, in the mean of the held-out "
        "frames, was higher by more than chance: the standard error of the lead, and 1 dB over "
        "the root of the number of frames. These frames have decided, and so speak a little "
        "too well of the field taken."
    )
    return Section(TITLE, intro, tuple(items))


def _psnr(one: TriedField) -> float:
    return next(iter(one.field.comparisons.values())).mean["psnr_ldr"]


def _compared(tried: Sequence[TriedField], taken: int) -> Table:
    compared = [next(iter(one.field.comparisons.values())) for one in tried]
    psnr = np.array([[frame.psnr_ldr for frame in c.frames] for c in compared])
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
        for one, comparison, best in zip(tried, compared, wins, strict=True)
    )
    return Table(
        ("field", "PSNR LDR, dB", "SSIM", "FLIP", "best in", "error, %", "size", "time"),
        rows,
        "Mean over the held-out frames, which decided; the field taken stands out. Best in: "
        "frames in which it has the highest PSNR. The error is on the samples that the field "
        "was made of, shadowed ones only where shadows are kept. Time is of all its stages: "
        "what several trials share was computed once.",
        emphasised=(taken,),
    )


def _unseen(tried: Sequence[TriedField], taken: int) -> Table:
    return Table(
        ("field", *METRIC_HEADER),
        tuple((one.field.name, *metric_cells(one.unseen or {})) for one in tried),
        "Mean over unseen views and lights, which had no part in the decision.",
        emphasised=(taken,),
    )
