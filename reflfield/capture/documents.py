"""Description files: bounded reading, text in the encodings that occur, finite numbers."""

from __future__ import annotations

import codecs
import csv
import json
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import CaptureError
from reflfield.util.files import read_bytes
from reflfield.util.quoting import quoted

# 151 x 151 frames of transforms.json with all its keys, indented, are about 45 MB.
MAX_DOCUMENT_BYTES = 80 * 2**20
# JSON values and objects of a description: such a file has 1.1 million values in 23,000
# objects. Counted before parsing, they bound the memory at about half a gigabyte.
MAX_VALUES = 4_000_000
MAX_OBJECTS = 500_000

# Photographs of a description, its cameras or its lights, and pairs of camera and light.
MAX_PHOTOGRAPHS = 100_000
MAX_ENTRIES = 20_000
MAX_PAIRS = 50_000_000

# Largest coordinate (in the capture's unit) and pixel coordinate: their squares and
# quotients stay within single precision's exponents.
LARGEST_COORDINATE = 1e12

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # before UTF-16's, which it begins with
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
# What no text holds, but every binary file.
_BINARY = re.compile("[\x00-\x08\x0e-\x1f\x7f]")


def read_text(path: Path) -> str:
    """Text of a description file in UTF-8, UTF-16 or Windows-1252.

    Parameters
    ----------
    path : Path
        A byte order mark is honoured. Without one, UTF-16 is told by its zero bytes, and
        what is no UTF-8 is Windows-1252, as editors on Windows save it.

    Returns
    -------
    str
        Without a byte order mark.

    Raises
    ------
    CaptureError
        If the file is missing, no regular one, larger than `MAX_DOCUMENT_BYTES`, or not
        text. The message names it.
    """
    content = read_bytes(path, MAX_DOCUMENT_BYTES, CaptureError)
    for encoding in _encodings(content):
        try:
            text = content.decode(encoding).removeprefix("\ufeff")
        except UnicodeDecodeError:
            continue
        if not _BINARY.search(text):
            return text
    raise CaptureError(
        f"{path}: expected a text file (UTF-8), received {_binary_kind(content)}"
    )


def csv_rows(path: Path, lines: Iterable[str], delimiter: str = ",") -> list[list[str]]:
    """Words of the lines of a table, without spaces around them.

    Raises
    ------
    CaptureError
        If a word is longer than a table's can be, as behind a quotation mark without another.
    """
    try:
        return [
            [word.strip() for word in words] for words in csv.reader(lines, delimiter=delimiter)
        ]
    except csv.Error as error:
        raise CaptureError(
            f"{path}: expected a table of values with {quoted(delimiter)} between them, "
            f"received a line that is none ({error}); is a quotation mark left open?"
        ) from error


def read_json(path: Path) -> dict[str, Any]:
    """Read the object in a JSON file.

    Parameters
    ----------
    path : Path
        At most `MAX_DOCUMENT_BYTES` with `MAX_VALUES` values in `MAX_OBJECTS` objects.

    Returns
    -------
    dict

    Raises
    ------
    CaptureError
        If the file cannot be read, is not JSON, not an object or too large, holds NaN,
        infinities or numbers beyond double precision, or gives a key two values.
    """
    text = read_text(path)
    n_objects, n_values = text.count("{"), text.count(",") + text.count("[") + text.count(":")
    if n_objects > MAX_OBJECTS or n_values > MAX_VALUES:
        raise CaptureError(
            f"{path}: expected a description of at most {MAX_VALUES:,} values in "
            f"{MAX_OBJECTS:,} objects, received about {n_values:,} in {n_objects:,}; "
            "split the capture"
        )
    try:
        document = json.loads(
            text,
            parse_constant=_refuse_constant,
            parse_float=_finite_float,
            parse_int=_finite_int,
            object_pairs_hook=_object,
        )
    except (ValueError, RecursionError) as error:
        raise CaptureError(f"{path}: expected JSON, received {error}") from error
    if not isinstance(document, dict):
        raise CaptureError(
            f"{path}: expected a JSON object, received {type(document).__name__}"
        )
    return document


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Object of its pairs; one key with two values is refused."""
    content = dict(pairs)
    if len(content) != len(pairs):
        for name, value in pairs:
            if content[name] != value:
                raise ValueError(f"two values of the key {quoted(name)} in one object")
    return content


def parse_number(text: str) -> float | None:
    """Finite number written with a decimal point or a decimal comma; None for other text.

    Examples
    --------
    >>> parse_number("0.5"), parse_number("-,5e1"), parse_number("1_0"), parse_number("nan")
    (0.5, -5.0, None, None)
    """
    pointed = text.replace(",", ".")
    if not _NUMBER.fullmatch(pointed):
        return None
    value = float(pointed)
    return value if math.isfinite(value) else None


def parse_count(text: str) -> int | None:
    """Whole number of up to nine ASCII digits; None for other text."""
    return int(text) if re.fullmatch("[0-9]{1,9}", text) else None


def number(value: Any, what: str) -> float:
    """A number of a JSON document as float.

    Raises
    ------
    CaptureError
        If it is text, a boolean, a list or nothing.
    """
    if type(value) not in (int, float) or not math.isfinite(value):
        raise CaptureError(f"{what}: expected a number, received {quoted(value)}")
    return float(value)


def number_array(
    value: Any, shapes: Sequence[tuple[int | None, ...]], what: str
) -> NDArray[np.float64]:
    """Numbers of a JSON document as an array.

    Parameters
    ----------
    value : object
        A number, a list or a list of lists.
    shapes : sequence of tuple
        Shapes that are allowed; None stands for any length above 0.
    what : str
        Named in messages.

    Returns
    -------
    float64 array of one of the shapes

    Raises
    ------
    CaptureError
        If the shape differs, a value is no number (text and booleans are none), or its
        absolute value exceeds `LARGEST_COORDINATE`.

    Examples
    --------
    >>> number_array([1, 2, 3.5], [(3,)], "up")
    array([1. , 2. , 3.5])
    """
    rows = value if isinstance(value, list) else [value]
    leaves = [leaf for row in rows for leaf in (row if isinstance(row, list) else [row])]
    try:
        numeric = all(type(leaf) in (int, float) for leaf in leaves)
        array = np.array(value if numeric else math.nan, dtype=np.float64)
    except ValueError:  # rows of different lengths
        array = np.array(math.nan)
    if not any(_fits(array.shape, shape) for shape in shapes) or np.isnan(array).any():
        wanted = " or ".join(_words(shape) for shape in shapes)
        raise CaptureError(f"{what}: expected {wanted}, received {quoted(value)}")
    if not (np.abs(array) <= LARGEST_COORDINATE).all():
        raise CaptureError(
            f"{what}: expected numbers of at most {LARGEST_COORDINATE:g}, received "
            f"{quoted(value)}"
        )
    return array


def check_counts(what: str, n_cameras: int, n_lights: int, n_photographs: int) -> None:
    """Refuse captures of more than `MAX_PHOTOGRAPHS`, `MAX_ENTRIES` or `MAX_PAIRS`.

    Raises
    ------
    CaptureError
        Naming the description and what there is too much of.
    """
    counts = {
        "cameras": (n_cameras, MAX_ENTRIES),
        "lights": (n_lights, MAX_ENTRIES),
        "photographs": (n_photographs, MAX_PHOTOGRAPHS),
    }
    for name, (count, most) in counts.items():
        if count > most:
            raise CaptureError(
                f"{what}: expected at most {most:,} {name}, received {count:,}; "
                "split the capture"
            )
    if n_cameras * n_lights > MAX_PAIRS:
        raise CaptureError(
            f"{what}: expected at most {MAX_PAIRS:,} pairs of camera and light, received "
            f"{n_cameras:,} x {n_lights:,}; split the capture"
        )


def _fits(received: tuple[int, ...], shape: tuple[int | None, ...]) -> bool:
    return len(received) == len(shape) and all(
        length == wanted or (wanted is None and length > 0)
        for length, wanted in zip(received, shape, strict=True)
    )


def _words(shape: tuple[int | None, ...]) -> str:
    """What a shape asks for, in words."""
    if not shape:
        return "a number"
    if len(shape) == 1:
        return f"{shape[0]} numbers"
    return f"{shape[0] or 'rows'} {'x' if shape[0] else 'of'} {shape[1]} numbers"


def _encodings(content: bytes) -> list[str]:
    """Encodings to try, in order."""
    for mark, encoding in _BYTE_ORDER_MARKS:
        if content.startswith(mark):
            return [encoding]
    # Names and numbers are mostly ASCII: every other byte of their UTF-16 is zero.
    even, odd = content[:4096:2].count(0), content[1:4096:2].count(0)
    if max(even, odd) > len(content[:4096]) // 5 and len(content) % 2 == 0:
        return ["utf-16-le" if odd > even else "utf-16-be"]
    return ["utf-8", "cp1252"]


def _refuse_constant(text: str) -> NoReturn:
    raise ValueError(f"the number {text}, which is not finite")


def _finite_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {quoted(text)}, which is not finite")
    return value


def _finite_int(text: str) -> int:
    if len(text) > 300:
        raise ValueError(f"a number of {len(text)} digits, which is beyond double precision")
    return int(text)


def _binary_kind(content: bytes) -> str:
    if content[:2] == b"PK":
        return "a zip archive; unpack it first"
    return "a binary file, or text in another encoding; save it as UTF-8"
