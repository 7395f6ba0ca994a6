"""Options of all stages: one frozen dataclass each, from TOML and from ``--set``."""

from __future__ import annotations

import dataclasses
import tomllib
import types
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import tomli_w

from reflfield.errors import InputError

Options = TypeVar("Options")
# A configuration file is written by hand: anything larger is another file.
LARGEST_FILE = 1 << 20


def read_toml(path: Path) -> dict[str, Any]:
    """Tables of a TOML file.

    Raises
    ------
    InputError
        If the file cannot be read or is not TOML; the message names it.
    """
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f"{path}: expected options in TOML, received more than 1 MB")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected TOML, received something else: {error}") from error


def write_toml(path: Path, options: Any) -> None:
    """Write nested option dataclasses; what is None is left out."""
    path.write_text(tomli_w.dumps(_without_none(dataclasses.asdict(options))), encoding="utf-8")


def parse_settings(settings: Iterable[str]) -> dict[str, Any]:
    """Tables of ``stage.option=value`` words; values are TOML, bare words are text.

    Raises
    ------
    InputError
        If a word has another form.

    Examples
    --------
    >>> parse_settings(["hull.resolution=128", "resampling.visibility=kept"])
    {'hull': {'resolution': 128}, 'resampling': {'visibility': 'kept'}}
    """
    tables: dict[str, Any] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        stage, dot, option = name.strip().partition(".")
        if not (equals and dot and stage and option):
            raise InputError(f"--set: expected stage.option=value, received {setting!r}")
        tables.setdefault(stage, {})[option] = _toml_value(text.strip())
    return tables


def _toml_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def merged(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Tables of `first`, overridden option by option by `second`."""
    result = {stage: dict(table) for stage, table in first.items()}
    for stage, table in second.items():
        result.setdefault(stage, {}).update(table)
    return result


def with_tables(options: Options, tables: Mapping[str, Any], where: str = "") -> Options:
    """Options with the values of nested tables in place of the defaults.

    Parameters
    ----------
    options : dataclass
        Frozen; fields are options or further dataclasses.
    tables : mapping
        By field name; nested for dataclass fields.
    where : str
        Prefix for messages.

    Returns
    -------
    dataclass
        Same type.

    Raises
    ------
    InputError
        If a name is unknown (near names are suggested) or a value has the wrong type.
    """
    hints = get_type_hints(type(options))
    known = {f.name for f in fields(options)}  # type: ignore[arg-type]
    changes: dict[str, Any] = {}
    for name, value in tables.items():
        label = f"{where}{name}"
        if name not in known:
            raise InputError(
                f"option {label!r}: expected one of {sorted(known)}, which this is not"
            )
        current = getattr(options, name)
        if is_dataclass(current):
            if not isinstance(value, Mapping):
                raise InputError(f"option {label!r}: expected a table, received {value!r}")
            changes[name] = with_tables(current, value, f"{label}.")
        else:
            changes[name] = _converted(label, value, hints[name])
    try:
        return replace(options, **changes)  # type: ignore[type-var]
    except InputError as error:
        raise InputError(f"{where}{error}") from error


def _converted(label: str, value: Any, expected: Any) -> Any:
    """Value as the annotated type, or an error that names both."""
    origin = get_origin(expected)
    if origin in (Union, types.UnionType):
        return _first_that_fits(label, value, get_args(expected), expected)
    if origin is tuple and isinstance(value, (list, tuple)):
        return tuple(tuple(item) if isinstance(item, list) else item for item in value)
    if origin is not None and origin is not tuple:
        return value  # Literal: the dataclass checks its own words
    if expected is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    plain = expected if isinstance(expected, type) else object
    if isinstance(value, bool) and plain in (int, float):
        raise InputError(f"option {label!r}: expected {plain.__name__}, received {value!r}")
    if not isinstance(value, plain):
        wanted = getattr(expected, "__name__", str(expected))
        raise InputError(f"option {label!r}: expected {wanted}, received {value!r}")
    return value


def _first_that_fits(label: str, value: Any, choices: tuple[Any, ...], expected: Any) -> Any:
    if value in (None, "none") and type(None) in choices:
        return None
    for choice in choices:
        try:
            return _converted(label, value, choice)
        except InputError:
            continue
    raise InputError(f"option {label!r}: expected {expected}, received {value!r}")


def _without_none(table: dict[str, Any]) -> dict[str, Any]:
    kept = {name: value for name, value in table.items() if value is not None}
    return {n: _without_none(v) if isinstance(v, dict) else v for n, v in kept.items()}


@dataclass(frozen=True)
class Resources:
    """What a run may use; nothing of it changes the result.

    Parameters
    ----------
    workers : int
        Threads.
    max_memory : int
        Bytes of resident memory that the blocks are sized for.
    """

    workers: int = 2
    max_memory: int = 4 << 30

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise InputError(f"--workers: expected at least 1, received {self.workers}")
        if self.max_memory < 1 << 30:
            raise InputError(
                f"--max-memory: expected at least 1GB, received {self.max_memory} bytes: "
                "the libraries alone take half of that"
            )

    @property
    def block_bytes(self) -> int:
        """Working memory for one block of texels."""
        return min(self.max_memory // 16, 256 << 20)


_UNITS = {"": 1, "B": 1, "KB": 1 << 10, "MB": 1 << 20, "GB": 1 << 30, "TB": 1 << 40}


def parse_bytes(text: str) -> int:
    """Bytes of a size such as ``4GB`` or ``512MB`` (powers of 1024).

    Raises
    ------
    InputError
        If the text has another form.

    Examples
    --------
    >>> parse_bytes("1.5GB")
    1610612736
    """
    upper = text.strip().upper().replace("IB", "B")
    digits = upper.rstrip("KMGTB")
    try:
        return int(float(digits) * _UNITS[upper[len(digits) :]])
    except (ValueError, KeyError, OverflowError):
        raise InputError(f"size: expected a number with MB or GB, received {text!r}") from None


@dataclass(frozen=True)
class HoldOut:
    """How many views and lights a run keeps for comparison.

    Parameters
    ----------
    views, lights : int
        Spread evenly over the capture; their photographs are not used for the field.
    """

    views: int = 0
    lights: int = 0

    def __post_init__(self) -> None:
        for name in ("views", "lights"):
            if getattr(self, name) < 0:
                raise InputError(f"--hold-out {name}: expected >= 0, got {getattr(self, name)}")


def parse_hold_out(text: str) -> HoldOut:
    """Counts of ``views=2,lights=3``.

    Raises
    ------
    InputError
        If the text has another form.

    Examples
    --------
    >>> parse_hold_out("lights=3")
    HoldOut(views=0, lights=3)
    """
    counts: dict[str, int] = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, equals, number = part.partition("=")
        if name not in ("views", "lights") or not equals or not number.isdigit():
            raise InputError(f"--hold-out: expected views=K,lights=K, received {text!r}")
        counts[name] = int(number)
    return HoldOut(**counts)


__all__ = [
    "HoldOut",
    "Resources",
    "field",
    "merged",
    "parse_bytes",
    "parse_hold_out",
    "parse_settings",
    "read_toml",
    "with_tables",
    "write_toml",
]
