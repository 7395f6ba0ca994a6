"""Section that accounts for every photograph, sample and texel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from reflfield.report.page import Cell, Item, Note, Section, Table


@dataclass(frozen=True)
class Account:
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
        """Things that no part accounts for; negative where some are counted twice.

        Examples
        --------
        >>> Account("capture", "photographs", 9, {"used": 6, "held out": 2}).missing
        1
        """
        return self.total - sum(self.parts.values())


def accounts_section(accounts: Sequence[Account]) -> Section:
    """Table of all accounts, with a warning for each that does not add up.

    Parameters
    ----------
    accounts : sequence of Account
        In the order of the stages.

    Returns
    -------
    Section
    """
    rows: list[tuple[Cell, ...]] = []
    for account in accounts:
        rows.append((account.stage, account.things, "in", account.total))
        rows += [("", "", name, count) for name, count in account.parts.items() if count]
        if account.missing:
            rows.append(("", "", "not accounted for", account.missing))
    items: list[Item] = [
        Note(
            f"{account.stage}: {account.missing} of {account.total} {account.things} are not "
            "accounted for.",
            is_warning=True,
        )
        for account in accounts
        if account.missing
    ]
    table = Table(
        ("stage", "what", "what became of it", "count"),
        tuple(rows),
        "Each count in is the sum of the counts below it.",
    )
    intro = "Nothing is dropped silently: every count in is accounted for."
    return Section("Accounts", intro, (*items, table))
