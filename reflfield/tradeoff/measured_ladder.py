"""Configurations of a finished sweep, from which a run within a time is chosen."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reflfield.errors import InputError
from reflfield.tradeoff.presets import Settings
from reflfield.tradeoff.stage_costs import UnitCosts, read_costs
from reflfield.tradeoff.sweep_results import front_of
from reflfield.tradeoff.swept_options import DEFAULT_NAME, SHOWING, SWEPT, Value
from reflfield.tradeoff.tradeoff_report import COSTS, DOCUMENT, FORMAT, VERSION
from reflfield.util.files import read_bytes

LARGEST_DOCUMENT = 16 << 20
KNOWN = {option.name for option in SWEPT}


def measured_ladder(folder: Path) -> tuple[Mapping[str, Settings], UnitCosts]:
    """Front of a finished sweep by rising quality, and the unit costs fitted to its runs.

    Parameters
    ----------
    folder : Path
        Of the sweep.

    Returns
    -------
    ladder : mapping of str to mapping
        Settings by the names of the configurations.
    costs : UnitCosts

    Raises
    ------
    InputError
        If there is no finished sweep in the folder.
    """
    path = folder / DOCUMENT
    content = read_bytes(path, LARGEST_DOCUMENT)
    try:
        stored = json.loads(content)
        entries = [entry for entry in stored["configurations"] if _counts(entry)]
        points = [(float(entry["CPU seconds"]), float(entry["PSNR"])) for entry in entries]
        front = [entries[i] for i in front_of(points)]
        ladder = {str(entry["name"]): _settings(entry) for entry in front}
        usable = stored["format"] == FORMAT and stored["version"] == VERSION and ladder
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        usable = False
    if not usable:
        raise InputError(
            f"{path}: expected the document of a finished `reflfield tradeoff`, received "
            "something else; run the sweep again"
        )
    return ladder, read_costs(folder / COSTS)


def _counts(entry: dict[str, Any]) -> bool:
    """Whether a configuration is one of a run of all photographs."""
    whole = entry["views"] == entry["lights"] == 1.0
    return whole and "PSNR" in entry and not set(entry["settings"]) & set(SHOWING)


def _settings(entry: dict[str, Any]) -> dict[str, Value]:
    """Settings of a configuration, if they are of options that are swept."""
    settings = dict(entry["settings"])
    if not set(settings) <= KNOWN or (entry["name"] == DEFAULT_NAME and settings):
        raise ValueError("unknown options")
    return settings
