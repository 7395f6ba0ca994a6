"""Checked reading of one TOML table: each key once, nothing left over."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import Field, field, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from capture_sim.errors import scene_error
from capture_sim.inputs import check_regular

log = logging.getLogger(__name__)

Table = Mapping[str, Any]
Options = TypeVar("Options")

# Magnitude of a number that has no limit of its own: squares stay finite as singles.
LARGEST_NUMBER = 1e18
MOST_ENTRIES = 1024  # of a list of options


class TableReader:
    """Takes the keys of a table one by one and refuses unknown ones at the end.

    Parameters
    ----------
    what : str
        Name of the table in messages, for example ``"object (vase)"``.
    table : mapping
        Keys and values as TOML gives them.

    Examples
    --------
    >>> reader = TableReader("sphere", {"radius": 0.1, "colour": "red"})
    >>> reader.number("radius", 0.05, low=0.0)
    0.1
    >>> reader.finish()
    Traceback (most recent call last):
    ...
    capture_sim.errors.SceneError: sphere: expected keys radius, received 'colour'; remove \
or correct it
    """

    def __init__(self, what: str, table: Table) -> None:
        if not isinstance(table, Mapping):
            raise scene_error(what, "a table", table, "write key = value pairs")
        self.what = what
        self._left = dict(table)
        self._known: list[str] = []

    def take(self, key: str, default: Any = None) -> Any:
        """Take the raw value of `key`, or `default`."""
        self._known.append(key)
        return self._left.pop(key, default)

    def accept_renamed(self, old: str, new: str) -> None:
        """Read the key `old` as `new`, its present name, with one line of warning.

        A `SceneError` that names both where the table holds both.
        """
        if old not in self._left:
            return
        if new in self._left:
            both = f"{self.name(new)}, {self.name(old)}"
            raise scene_error(both, "one of the two", "both", f"remove {self.name(old)}")
        log.warning(
            "%s is now %s; the old name is accepted until version 0.2",
            *(self.name(old), self.name(new)),
        )
        self._left[new] = self._left.pop(old)

    def require(self, key: str) -> Any:
        """Take the raw value of `key`; a `SceneError` if it is not there."""
        value = self.take(key)
        if value is None:
            raise scene_error(self.name(key), "a value", "nothing", f"add {key} = ...")
        return value

    def name(self, key: str) -> str:
        """Name of `key` in messages."""
        return f"{self.what}.{key}"

    def number(
        self,
        key: str,
        default: float,
        *,
        low: float = -LARGEST_NUMBER,
        high: float = LARGEST_NUMBER,
    ) -> float:
        """Take a finite number in [low, high]."""
        return check_number(self.name(key), self.take(key, default), low=low, high=high)

    def count(self, key: str, default: int, *, low: int = 1, high: int = 2**24) -> int:
        """Take a whole number in [low, high]."""
        value = self.take(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise scene_error(self.name(key), f"a whole number in [{low}, {high}]", value)
        return value

    def flag(self, key: str, default: bool) -> bool:
        """Take true or false."""
        value = self.take(key, default)
        if not isinstance(value, bool):
            raise scene_error(self.name(key), "true or false", value)
        return value

    def choice(self, key: str, default: str, choices: Sequence[str]) -> str:
        """Take one of the words `choices`."""
        value = self.take(key, default)
        if not isinstance(value, str) or value not in choices:
            raise scene_error(self.name(key), "one of " + ", ".join(choices), value)
        return str(value)

    def vector(
        self,
        key: str,
        default: Sequence[float],
        length: int = 3,
        *,
        low: float = -LARGEST_NUMBER,
        high: float = LARGEST_NUMBER,
    ) -> NDArray[np.float64]:
        """Take `length` numbers in [low, high]; a single number stands for equal ones."""
        value = self.take(key, default)
        entries = [value] * length if isinstance(value, int | float) else value
        return check_vector(self.name(key), entries, length, low=low, high=high)

    def numbers(self, key: str, default: Sequence[float]) -> NDArray[np.float64]:
        """Take a list of any length of finite numbers."""
        value = self.take(key, default)
        length = len(value) if isinstance(value, list | tuple) else 0
        return check_vector(self.name(key), value, length)

    def file(self, key: str, folder: Path) -> Path:
        """Take the path of an existing file, relative to the scene's folder."""
        value = self.require(key)
        if not isinstance(value, str):
            raise scene_error(self.name(key), "a path", value)
        path = folder / value
        check_regular(path, self.name(key))
        return path

    def finish(self) -> None:
        """Refuse keys that nobody took."""
        if self._left:
            unknown = ", ".join(repr(key) for key in sorted(self._left))
            known = ", ".join(sorted(self._known)) or "none"
            raise scene_error(self.what, f"keys {known}", unknown, "remove or correct it")


def check_number(
    what: str, value: Any, *, low: float = -LARGEST_NUMBER, high: float = LARGEST_NUMBER
) -> float:
    """`value` as a finite float in [low, high]; a `SceneError` if it is not.

    Examples
    --------
    >>> check_number("albedo", 1, low=0, high=1)
    1.0
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    # Integers of any length are compared before they become floats; NaN is in no range.
    if not is_number or not low <= value <= high:
        raise scene_error(what, f"a number in [{low:g}, {high:g}]", value)
    return float(value)


def check_vector(
    what: str,
    value: Any,
    length: int,
    *,
    low: float = -LARGEST_NUMBER,
    high: float = LARGEST_NUMBER,
) -> NDArray[np.float64]:
    """`value` as `length` floats in [low, high]; a `SceneError` if it is not.

    Examples
    --------
    >>> check_vector("target", [0, 0, 0.1], 3)
    array([0. , 0. , 0.1])
    """
    if not isinstance(value, list | tuple | np.ndarray) or len(value) != length or not length:
        raise scene_error(what, f"a list of {length or 'one or more'} numbers", value)
    return np.array([check_number(what, _plain(v), low=low, high=high) for v in value])


def _plain(entry: Any) -> Any:
    return entry.item() if isinstance(entry, np.generic) else entry


def bounded(default: Any, *, low: float = -LARGEST_NUMBER, high: float = LARGEST_NUMBER) -> Any:
    """Field of an options dataclass: a number, whole number or tuple of numbers in a range.

    Parameters
    ----------
    default : float, int or tuple of float
        Also says which of these it is.
    low, high : float
        Smallest and largest value.
    """
    return field(default=default, metadata={"low": low, "high": high})


def one_of(default: str, *others: str) -> Any:
    """Field of an options dataclass: one of some words, the first by default."""
    return field(default=default, metadata={"choices": (default, *others)})


def read_options(kind: type[Options], reader: TableReader) -> Options:
    """Read a table into a dataclass whose fields have defaults.

    Parameters
    ----------
    kind : type
        Frozen dataclass; ranges of its fields come from `bounded` and `one_of`.
    reader : TableReader

    Returns
    -------
    dataclass

    Raises
    ------
    SceneError
        For unknown keys and values out of range.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Lens:
    ...     f_number: float = bounded(8.0, low=0.5)
    >>> read_options(Lens, TableReader("lens", {"f_number": 2.8}))
    Lens(f_number=2.8)
    """
    values = {one.name: _option(reader, one) for one in fields(kind)}  # type: ignore[arg-type]
    reader.finish()
    return kind(**values)


def _option(reader: TableReader, one: Field[Any]) -> Any:
    default: Any = one.default
    limits = one.metadata
    if "choices" in limits:
        return reader.choice(one.name, default, limits["choices"])
    if isinstance(default, bool):
        return reader.flag(one.name, default)
    low, high = limits["low"], limits["high"]
    if isinstance(default, int):
        return reader.count(one.name, default, low=int(low), high=int(high))
    if isinstance(default, tuple):
        entries = reader.numbers(one.name, default)
        if len(entries) > MOST_ENTRIES:
            raise scene_error(
                reader.name(one.name), f"at most {MOST_ENTRIES} numbers", len(entries)
            )
        return tuple(
            check_number(reader.name(one.name), v, low=low, high=high) for v in entries.tolist()
        )
    return reader.number(one.name, default, low=low, high=high)
