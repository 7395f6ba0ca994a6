"""Nested tables of options: one over another, and names of earlier versions."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

log = logging.getLogger(__name__)


def merged(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Tables of `first`, overridden option by option by `second`.

    Examples
    --------
    >>> merged({"hull": {"blur": 1.0}, "seed": 1}, {"hull": {"tolerance": 2}})
    {'hull': {'blur': 1.0, 'tolerance': 2}, 'seed': 1}
    """
    result = dict(first)
    for name, value in second.items():
        earlier = result.get(name)
        both = isinstance(value, Mapping) and isinstance(earlier, Mapping)
        result[name] = merged(earlier, value) if both else value  # type: ignore[arg-type]
    return result


def with_current_names(tables: Mapping[str, Any], renamed: Mapping[str, str]) -> dict[str, Any]:
    """Return tables in which options that were renamed have their new names.

    Parameters
    ----------
    tables : mapping
        By name; nested. What has the new name already wins.
    renamed : mapping of str to str
        New names by old ones, ``table.option``.

    Examples
    --------
    >>> logging.disable()
    >>> with_current_names({"hull": {"side": 64}}, {"hull.side": "hull.resolution"})
    {'hull': {'resolution': 64}}
    >>> logging.disable(logging.NOTSET)
    """
    result = dict(tables)
    for old, new in renamed.items():
        holder, name = _holder_of(result, old)
        if name in holder:
            log.warning(
                "option %r is now %r; the old name is accepted until version 0.2",
                *(old, new),
            )
            value = holder[name]
            result = _without(result, old.split("."))
            for part in reversed(new.split(".")):
                value = {part: value}
            result = merged(value, result)
    return result


def without_removed(tables: Mapping[str, Any], removed: Mapping[str, str]) -> dict[str, Any]:
    """Return tables without options that are gone, saying so and why.

    Parameters
    ----------
    tables : mapping
        By name; nested.
    removed : mapping of str to str
        Reasons by names, ``table.option``.

    Examples
    --------
    >>> logging.disable()
    >>> without_removed({"hull": {"side": 64}, "seed": 1}, {"hull.side": "it is derived"})
    {'hull': {}, 'seed': 1}
    >>> logging.disable(logging.NOTSET)
    """
    result = dict(tables)
    for gone, reason in removed.items():
        holder, name = _holder_of(result, gone)
        if name in holder:
            log.warning(
                "option %r is gone: %s; it is ignored until version 0.2, remove it",
                *(gone, reason),
            )
            result = _without(result, gone.split("."))
    return result


def _holder_of(tables: Mapping[str, Any], option: str) -> tuple[Mapping[str, Any], str]:
    """Table that an option would stand in, empty if there is none, and its name there."""
    *above, name = option.split(".")
    holder: Any = tables
    for part in above:
        holder = holder.get(part) if isinstance(holder, Mapping) else None
    return (holder if isinstance(holder, Mapping) else {}), name


def _without(tables: Mapping[str, Any], path: Sequence[str]) -> dict[str, Any]:
    """Return nested tables without the value at a path."""
    name, *below = path
    if below:
        return {**tables, name: _without(tables[name], below)}
    return {key: value for key, value in tables.items() if key != name}
