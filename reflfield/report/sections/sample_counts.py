"""Section on sample bookkeeping: what became of every photograph, sample and texel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from reflfield.report.page import Cell, Item, Note, Section, Table


@dataclass(frozen=True)
class CountedItems:
    """What went into a stage, and what became of it.

    Attributes
    ----------
    stage, things : str
        Such as "observations", "samples".
    total : int
        That went in.
    parts : mapping of str to int
        What became of them; counted apart from the total.
    """

    stage: str
    things: str
    total: int
    parts: Mapping[str, int]

    @property
    def missing(self) -> int:
        """Items that no part holds; negative where some are counted twice.

        A part of less than none holds nothing: what makes up for it is counted twice.

        Examples
        --------
        >>> CountedItems("capture", "photographs", 9, {"used": 6, "held out": 2}).missing
        1
        >>> CountedItems("capture", "photographs", 9, {"used": 11, "rest": -2}).missing
        -2
        """
        return self.total - sum(max(count, 0) for count in self.parts.values())


def bookkeeping_section(entries: Sequence[CountedItems]) -> Section:
    """Table of all counts, with a warning for each that does not add up.

    Parameters
    ----------
    entries : sequence of CountedItems
        In the order of the stages.

    Returns
    -------
    Section
    """
    rows: list[tuple[Cell, ...]] = []
    for entry in entries:
        rows.append((entry.stage, entry.things, "in", entry.total))
        rows += [("", "", name, count) for name, count in entry.parts.items() if count]
        if entry.missing:
            rows.append(("", "", "unaccounted", entry.missing))
    items: list[Item] = [
        Note(
            f"{entry.stage}: {entry.missing} of {entry.total} {entry.things} are "
            "unaccounted for.",
            is_warning=True,
        )
        for entry in entries
        if entry.missing
    ]
    table = Table(
        ("stage", "items", "outcome", "count"),
        tuple(rows),
        "Each count marked in is the sum of the counts below it.",
    )
    intro = "What became of every photograph, sample and texel."
    return Section("Sample bookkeeping", intro, (*items, table))
