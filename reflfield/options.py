"""Options of all stages: one frozen dataclass each, from TOML and from ``--set``."""

from __future__ import annotations

import dataclasses
import os
import re
import sys
import tomllib
import types
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import tomli_w

from reflfield.errors import InputError
from reflfield.util.dask_cluster import check_installed
from reflfield.util.files import read_bytes
from reflfield.util.nested_tables import merged, with_current_names, without_removed

Options = TypeVar("Options")
# Options that were renamed, by their whole names, old -> new. Old names are accepted, with one
# line of warning, until the next minor version.
RENAMED_OPTIONS = {
    "compression.coarseness": "compression.relative_step",
    "compression.samples.fineness": "compression.samples.grid_refinement",
}
# Options that are gone, with what holds instead. They are ignored, with one line of warning,
# until the next minor version: the `options.toml` of an earlier run lists every option.
REMOVED_OPTIONS = {
    "visibility.shadow_band": "no stage of a run has used it",
}
# A configuration file is written by hand: anything larger is another file.
LARGEST_FILE = 1 << 20
# Keys of very many parts take time and memory that grow with the square of their number.
LONGEST_LINE = 4096
# Whole numbers that fit 63 bits, and what else is said of values in messages.
LARGEST_WHOLE = (1 << 63) - 1
LONGEST_SHOWN = 100
# Of an option's name: stage, group, option.
MOST_PARTS = 8
# Libraries and code take 0.4 GB before the first photograph is read.
LEAST_MEMORY = 1 << 30
# Threads beyond any machine's cores: a number above is a slip.
MOST_WORKERS = 1024


def read_toml(path: Path) -> dict[str, Any]:
    """Tables of a TOML file.

    Raises
    ------
    InputError
        If the file cannot be read, is no regular one, or is not TOML; the message names it.
    """
    content = read_bytes(path, LARGEST_FILE)
    if max(map(len, content.splitlines()), default=0) > LONGEST_LINE:
        raise InputError(
            f"{path}: expected options in TOML, received a line of more "
            f"than {LONGEST_LINE} bytes"
        )
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # ValueError also of numbers without end
        raise InputError(f"{path}: expected TOML, received something else: {error}") from error


def write_toml(path: Path, options: Any, notes: Iterable[str] = ()) -> None:
    """Write nested option dataclasses, below notes; what is None is left out."""
    comments = "".join(f"# {note}\n" for note in notes)
    tables = tomli_w.dumps(_without_none(dataclasses.asdict(options)))
    path.write_text(comments + tables, encoding="utf-8")


def parse_settings(settings: Iterable[str]) -> dict[str, Any]:
    """Tables of ``stage.option=value`` words; values are TOML, bare words are text.

    Raises
    ------
    InputError
        If a word has another form.

    Examples
    --------
    >>> parse_settings(["hull.resolution=128", "resampling.visibility=kept", "seed=3"])
    {'hull': {'resolution': 128}, 'resampling': {'visibility': 'kept'}, 'seed': 3}
    """
    tables: dict[str, Any] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        path = [part.strip() for part in name.split(".")]
        if not (equals and all(path)):
            raise InputError(
                f"settings: expected stage.option=value, received {_shown(setting)}"
            )
        if len(path) > MOST_PARTS:
            raise InputError(
                f"settings: expected stage.option=value, received a name of {len(path)} parts"
            )
        table: Any = _toml_value(text.strip())
        for part in reversed(path):
            table = {part: table}
        tables = merged(tables, table)
    return tables


def _toml_value(text: str) -> Any:
    if len(text) > LONGEST_LINE:
        return text
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):  # ValueError also of numbers without end
        return text


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
    if not where:
        tables = with_current_names(tables, RENAMED_OPTIONS)
        tables = without_removed(tables, REMOVED_OPTIONS)
    hints = get_type_hints(type(options))
    known = [f.name for f in fields(options)]  # type: ignore[arg-type]
    changes: dict[str, Any] = {}
    for name, value in tables.items():
        label = f"{where}{name}"
        if name not in known:
            raise InputError(_unknown(label, name, known))
        current = getattr(options, name)
        if is_dataclass(current):
            if not isinstance(value, Mapping):
                raise InputError(
                    f"option {label!r}: expected a table, received {_shown(value)}"
                )
            changes[name] = with_tables(current, value, f"{label}.")
        else:
            changes[name] = _converted(label, value, hints[name])
    try:
        return replace(options, **changes)  # type: ignore[type-var]
    except InputError as error:
        raise InputError(f"option {where}{error}") from error


def _unknown(label: str, name: str, known: list[str]) -> str:
    near = get_close_matches(name, known, n=1)
    remedy = f"; did you mean {near[0]!r}?" if near else ""
    return f"option {_shown(label)}: unknown; expected one of {', '.join(known)}{remedy}"


def _converted(label: str, value: Any, expected: Any) -> Any:
    """Value as the annotated type, or an error that names both."""
    origin = get_origin(expected)
    if origin in (Union, types.UnionType):
        return _first_that_fits(label, value, expected)
    if origin is tuple:
        return _converted_tuple(label, value, expected)
    if origin is Literal:
        fits = value in get_args(expected)
    elif expected is float and _is_number(value):
        fits = abs(value) <= sys.float_info.max  # nor is NaN
        value = float(value) if fits else value
    else:
        # True is an int to Python, and not to those who write options.
        fits = isinstance(value, expected) and isinstance(value, bool) == (expected is bool)
        fits = fits and not (expected is int and abs(value) > LARGEST_WHOLE)
    if not fits:
        raise _another_value(label, value, expected)
    return value


def _another_value(label: str, value: Any, expected: Any) -> InputError:
    received = _shown(value)
    return InputError(f"option {label!r}: expected {_words(expected)}, received {received}")


def _shown(value: Any) -> str:
    """A value for messages, which a file may have made of any size."""
    if isinstance(value, int) and abs(value) > LARGEST_WHOLE:
        return f"one of {value.bit_length()} bits"
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # thousands of digits or of levels
        return f"a {type(value).__name__} of numbers or levels without end"
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]} ..."


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _converted_tuple(label: str, value: Any, expected: Any) -> tuple[Any, ...]:
    kinds = get_args(expected)
    is_sequence = isinstance(value, (list, tuple))
    if is_sequence and len(kinds) == 2 and kinds[1] is Ellipsis:
        kinds = kinds[:1] * len(value)
    if not is_sequence or len(value) != len(kinds):
        raise _another_value(label, value, expected)
    return tuple(_converted(label, v, kind) for v, kind in zip(value, kinds, strict=True))


def _first_that_fits(label: str, value: Any, expected: Any) -> Any:
    choices = get_args(expected)
    if value in (None, "none") and type(None) in choices:
        return None
    for choice in choices:
        if choice is type(None):
            continue
        try:
            return _converted(label, value, choice)
        except InputError:
            continue
    raise _another_value(label, value, expected)


def _words(expected: Any) -> str:
    """What a type asks for, as someone would say it who writes options."""
    origin, inner = get_origin(expected), get_args(expected)
    if origin is Literal:
        return " or ".join(map(repr, inner))
    if origin in (Union, types.UnionType):
        return " or ".join(map(_words, inner))
    if origin is tuple:
        return f"a list of {', '.join('...' if i is ... else _words(i) for i in inner)}"
    names = {bool: "true or false", int: "a whole number", float: "a finite number"}
    return names.get(expected, {str: "text", type(None): "'none'"}.get(expected, str(expected)))


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
    scheduler : str, optional
        Address of a `dask.distributed` scheduler, whose workers compute the blocks. They
        open the capture and the store by the names that this process has for them.
    store : str, optional
        Folder, or URL for fsspec, that holds the samples of all texels.
    """

    workers: int = 2
    max_memory: int = 4 << 30
    scheduler: str | None = None
    store: str | None = None

    def __post_init__(self) -> None:
        if self.scheduler is not None:
            check_installed()
        if not 1 <= self.workers <= MOST_WORKERS:
            raise InputError(f"workers: expected 1 to {MOST_WORKERS}, received {self.workers}")
        if self.max_memory < LEAST_MEMORY:
            raise InputError(
                f"max_memory: expected at least {gigabytes(LEAST_MEMORY)}, received "
                f"{gigabytes(self.max_memory)}: the libraries alone take half of that"
            )

    @property
    def block_bytes(self) -> int:
        """Working memory for one block of texels; each thread has one."""
        return min(self.max_memory // (8 * self.workers), 256 << 20)


def available_cores() -> int:
    """Processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def gigabytes(size: float) -> str:
    """Bytes for messages.

    Examples
    --------
    >>> gigabytes(1610612736)
    '1.5 GB'
    """
    return f"{size / 2**30:.1f} GB"


_UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}


def parse_bytes(text: str, name: str = "max_memory") -> int:
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
    upper = text.strip().upper().removesuffix("B").removesuffix("I")
    digits = upper.rstrip("KMGT")
    try:
        return int(float(digits) * _UNITS[upper[len(digits) :]])
    except (ValueError, KeyError, OverflowError):
        raise InputError(
            f"{name}: expected a number with MB or GB, such as 4GB, received {_shown(text)}"
        ) from None


_SECONDS = {"": 1, "s": 1, "min": 60, "h": 3600}


def parse_seconds(text: str, name: str = "budget") -> float:
    """Seconds of a duration such as ``90s``, ``20min`` or ``1.5h``.

    Raises
    ------
    InputError
        If the text has another form, or is not above zero.

    Examples
    --------
    >>> parse_seconds("20min"), parse_seconds("90")
    (1200.0, 90.0)
    """
    match = re.fullmatch(r"([0-9]{1,9}(?:\.[0-9]{1,6})?) ?(s|min|h|)", text.strip())
    seconds = float(match[1]) * _SECONDS[match[2]] if match else 0.0
    if not seconds > 0:
        raise InputError(
            f"{name}: expected a time above 0 such as 90s, 20min or 1.5h, "
            f"received {_shown(text)}"
        )
    return seconds


HOLD_OUT_FORMS = "views=K,lights=K, or photographs=K, or test, or views=K,light-cone=DEGREESdeg"


@dataclass(frozen=True)
class HoldOut:
    """What a run keeps apart from the field's making, and compares the field with.

    Parameters
    ----------
    views, lights : int
        Spread evenly over those that have photographs; none of their photographs makes the
        field.
    photographs : int
        Spread evenly over views and lights; these alone are kept apart. Not together with
        `views` and `lights`.
    test : bool
        The photographs that the capture itself sets apart as its test split. Alone.
    light_cone : float
        All lights within this angle, degrees, of the middle one of the list, as seen from the
        object: how well the field extrapolates, which single lights do not show. Instead of
        `lights`.

    Raises
    ------
    InputError
        If a count is negative or no whole number, the angle is not 0 to 90, or two ways to
        choose are mixed.

    Examples
    --------
    >>> HoldOut(views=2, lights=3).lights
    3
    >>> HoldOut(views=2, photographs=3)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    reflfield.errors.InputError: hold_out: expected ... received views=2,photographs=3
    """

    views: int = 0
    lights: int = 0
    photographs: int = 0
    test: bool = False
    light_cone: float = 0.0

    def __post_init__(self) -> None:
        for name in ("views", "lights", "photographs"):
            count = getattr(self, name)
            whole = isinstance(count, Integral) and not isinstance(count, bool)
            if not whole or count < 0:
                raise InputError(f"hold_out: {name}: expected a number >= 0, received {count}")
        cone: Any = self.light_cone
        number = isinstance(cone, Real) and not isinstance(cone, bool)
        if not number or not 0 <= cone <= 90:
            raise InputError(
                f"hold_out: light_cone: expected 0 to 90 degrees, received {self.light_cone}"
            )
        by_pairs = self.views > 0 or self.lights > 0 or self.light_cone > 0
        two_kinds_of_lights = self.lights > 0 and self.light_cone > 0
        if by_pairs + (self.photographs > 0) + self.test > 1 or two_kinds_of_lights:
            raise InputError(f"hold_out: expected {HOLD_OUT_FORMS}, received {self}")

    def __str__(self) -> str:
        """As `parse_hold_out` reads it."""
        counts = {name: getattr(self, name) for name in ("views", "lights", "photographs")}
        parts = [f"{name}={count}" for name, count in counts.items() if count]
        if self.light_cone:
            parts.append(f"light-cone={self.light_cone:g}deg")
        return ",".join(parts + ["test"] * self.test)


def parse_hold_out(text: str) -> HoldOut:
    """Parts of ``views=2,lights=3``, ``light-cone=25deg``, ``photographs=4`` or ``test``.

    Raises
    ------
    InputError
        If the text has another form.

    Examples
    --------
    >>> parse_hold_out("lights=3").lights, parse_hold_out("light-cone=25deg").light_cone
    (3, 25.0)
    """
    values: dict[str, Any] = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, value = _hold_out_part(part)
        if value is None or name in values:
            raise InputError(f"hold_out: expected {HOLD_OUT_FORMS}, received {_shown(text)}")
        values[name] = value
    return HoldOut(**values)


def _hold_out_part(part: str) -> tuple[str, Any]:
    """Name of an argument of `HoldOut` and its value; None where the part has no such form."""
    name, _, number = part.partition("=")
    if part == "test":
        return "test", True
    if name == "light-cone" and re.fullmatch(r"[0-9]{1,3}(\.[0-9]{1,6})?(deg)?", number):
        return "light_cone", float(number.removesuffix("deg"))
    if name in ("views", "lights", "photographs") and re.fullmatch("[0-9]{1,9}", number):
        return name, int(number)
    return name, None


def size_settings(size: str, psnr: float | None) -> list[str]:
    """Settings of the size or quality that was asked for; neither asks for nothing.

    Raises
    ------
    InputError
        If one of them is not more than zero.

    Examples
    --------
    >>> size_settings("500KB", None)
    ['compression.size=512000']
    """
    settings = []
    if size:
        settings.append(f"compression.size={parse_bytes(size, 'size')}")
        if settings[0].endswith("=0") or "-" in size:
            raise InputError(f"size: expected more than no bytes, received {size!r}")
    if psnr is not None:
        if not 0 < psnr < float("inf"):
            raise InputError(f"psnr: expected a number of dB above 0, received {psnr}")
        settings.append(f"compression.psnr={psnr}")
    return settings
