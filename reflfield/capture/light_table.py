"""Lights of a capture whose description says nothing of them: ``lights.csv`` beside it.

The first line names the columns: ``name``, then ``x,y,z`` (position of a lamp in the
coordinates of the cameras) or ``dx,dy,dz`` (direction to a distant light), and optionally
``intensity`` or ``r,g,b``, and ``view``.

Without ``view`` each row is a lamp. It belongs to a photograph if its name is, in this order,

1. the end of the photograph's path (``v03/l17.tif``),
2. its file name, 3. its file name without suffix,
4. a folder that it lies in (``lamp17`` of ``images/lamp17/v03.tif``), or
5. a word of its file name (``l17`` of ``v03_l17.tif``; words end at ``_ - .`` and spaces).

The first of these by which some row fits counts; then one row must fit, or the file is refused.
By 4 and 5 a lamp's name may be replaced by another lamp's: where that names a file that the
description lacks, it is a further photograph of the same camera.

With ``view`` each row is a photograph: ``name`` its file, ``view`` a photograph of the
description, named by 1, 2 or 3, that has the same camera. Photographs without a row are not
used.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from reflfield.capture.capture import Capture
from reflfield.capture.described_items import described_light
from reflfield.capture.documents import (
    MAX_PHOTOGRAPHS,
    check_counts,
    csv_rows,
    parse_number,
    read_text,
)
from reflfield.capture.fixed_view import notes_on_lengths
from reflfield.capture.lights import Light
from reflfield.capture.names import IMAGE_SUFFIXES, frame_name, unique_names
from reflfield.capture.paths import NamedFiles
from reflfield.capture.photographs import Exposure, Photograph
from reflfield.capture.unique_items import UniqueItems, leading_digits, numbered
from reflfield.errors import CaptureError
from reflfield.util.quoting import listed, quoted

FILE_NAME = "lights.csv"
_COLUMNS = "name,x,y,z or name,dx,dy,dz, then intensity or r,g,b, and view, where wanted"
_KINDS = {"point": ("x", "y", "z"), "directional": ("dx", "dy", "dz")}
_WORD_ENDS = re.compile(r"[_\-. ]+")


@dataclass(frozen=True)
class _Row:
    """One line of the table."""

    name: str
    view: str
    light: Light
    place: tuple[float, ...]  # as it stands there


def light_table_of(capture: Capture) -> Path | None:
    """The ``lights.csv`` of a capture; None where there is none.

    Raises
    ------
    CaptureError
        If there are two, beside the description and in the capture's folder.
    """
    folders = {capture.root.resolve(): capture.root}
    if capture.description is not None:
        folders.setdefault(capture.description.parent.resolve(), capture.description.parent)
    tables = [
        folder / FILE_NAME for folder in folders.values() if (folder / FILE_NAME).exists()
    ]
    if len(tables) > 1:
        raise CaptureError(
            f"{tables[0]}: expected one table of lights, received {tables[1]} too"
        )
    return tables[0] if tables else None


def with_lights(capture: Capture, table: Path, *, follow_links: bool = False) -> Capture:
    """The capture with the lights of a table.

    Parameters
    ----------
    capture : Capture
        Its lights are unknown.
    table : Path
        ``lights.csv``; see the module for what it holds.
    follow_links : bool
        Whether symbolic links may lead out of the capture's folder.

    Returns
    -------
    Capture
        With further photographs, where the table names some.

    Raises
    ------
    CaptureError
        If the capture has lights of its own, the table is malformed, or a photograph fits no
        row or several.
    """
    if any(light.known for light in capture.lights):
        raise CaptureError(
            f"{table}: expected a capture whose lights are unknown, received one whose lights "
            f"stand in {capture.description}; remove or rename one of the two"
        )
    rows, by_view = _rows(table)
    files = NamedFiles(table, follow_links=follow_links, root=capture.root)
    if by_view:
        pairs = [_photograph_of_row(row, capture, files, table) for row in rows]
        further, unused = len(pairs), ""
    else:
        own = [(p, *_row_of(p, rows, capture, table)) for p in capture.photographs]
        more = list(_siblings(own, rows, capture, files))
        pairs = [(photograph, row) for photograph, row, _ in own] + more
        further, unused = len(more), _unused(rows, [row for _, row in pairs])
    details = f"{len(rows)} rows of {table}" + (
        f", which name {further} photographs" if further else ""
    )
    notes = [f"{table}: no photograph for {unused}"] if unused else []
    if rows[0].light.kind == "directional":
        notes += notes_on_lengths([row.place for row in rows], table)
    return _lit(capture, pairs, details, notes)


def _lit(
    capture: Capture,
    pairs: Sequence[tuple[Photograph, _Row]],
    details: str,
    notes: Sequence[str],
) -> Capture:
    """The capture of some photographs, each with the light of its row."""
    lights = UniqueItems()
    paths = [photograph.path for photograph, _ in pairs]
    names = unique_names(paths, capture.root)
    photographs = []
    for name, (photograph, row) in zip(names, pairs, strict=True):
        numbers = (row.light.position, row.light.direction, row.light.intensity)
        key = (row.light.kind, *(leading_digits(np.asarray(n)) for n in numbers))
        photographs.append(replace(photograph, name=name, light=lights.add(key, row.light)))
    check_counts(
        str(capture.description), len(capture.cameras), len(lights.items), len(photographs)
    )
    return replace(
        capture,
        lights=numbered(lights.items, "l"),
        photographs=tuple(photographs),
        details=(*capture.details, f"lights: {details}"),
        notes=(*capture.notes, *notes),
    )


def _unused(rows: Sequence[_Row], used: Sequence[_Row]) -> str:
    names = {row.name for row in used}
    return listed([row.name for row in rows if row.name not in names])


# --- which row belongs to a photograph ----------------------------------------------------


def _keys(path: Path, root: Path) -> list[set[str]]:
    """Names by which a row fits a photograph, in the order in which they are tried."""
    relative = path.relative_to(root)
    parts = [part.casefold() for part in relative.parts]
    ends = {"/".join(parts[i:]) for i in range(len(parts) - 1)}
    stem = frame_name(relative).casefold()
    words = {word for word in _WORD_ENDS.split(stem) if word}
    return [ends, {parts[-1]}, {stem}, set(parts[:-1]), words]


def _row_of(
    photograph: Photograph, rows: Sequence[_Row], capture: Capture, table: Path
) -> tuple[_Row, int]:
    """The row that fits a photograph, and by which kind of name (0 to 4)."""
    for kind, keys in enumerate(_keys(photograph.path, capture.root)):
        fitting = [row for row in rows if row.name.casefold() in keys]
        if len(fitting) == 1:
            return fitting[0], kind
        if fitting:
            raise CaptureError(
                f"{table}: photograph {photograph.path}: expected one row whose name belongs "
                f"to it, received {listed([row.name for row in fitting])}; name the rows as "
                "the files"
            )
    raise CaptureError(
        f"{table}: photograph {photograph.path}: expected a row whose name is its file, its "
        f"folder or a word of its file name, received none of {len(rows)} "
        f"({listed([row.name for row in rows])}); add one, or use the column 'view'"
    )


def _siblings(
    own: Sequence[tuple[Photograph, _Row, int]],
    rows: Sequence[_Row],
    capture: Capture,
    files: NamedFiles,
) -> Iterator[tuple[Photograph, _Row]]:
    """Photographs of the same cameras under other lamps, by the lamps' names."""
    seen = {photograph.path for photograph, _, _ in own}
    for photograph, row, kind in own:
        for other in rows:
            name = _renamed(
                photograph.path.relative_to(capture.root), row.name, other.name, kind
            )
            path = None if name is None else files.path(name)
            if path is None or path in seen or not path.is_file():
                continue
            seen.add(path)
            reading = photograph.exposures[0].reading
            yield replace(photograph, exposures=(Exposure(path, reading=reading),)), other


def _renamed(path: Path, name: str, other: str, kind: int) -> str | None:
    """A path with one lamp's name in the place of another's; None where it has none."""
    if kind < 3 or name == other or "/" in other or "\\" in other:
        return None
    folders, stem = list(path.parts[:-1]), frame_name(path)
    suffix = path.name[len(stem) :]
    if kind == 3:
        folders = [other if part.casefold() == name.casefold() else part for part in folders]
    else:
        words = re.split(f"({_WORD_ENDS.pattern})", stem)
        stem = "".join(other if word.casefold() == name.casefold() else word for word in words)
    return "/".join([*folders, stem + suffix])


def _photograph_of_row(
    row: _Row, capture: Capture, files: NamedFiles, table: Path
) -> tuple[Photograph, _Row]:
    """The photograph that a row names, with the camera of its view."""
    if not row.view:
        raise CaptureError(
            f"{table}: row {quoted(row.name)}: expected a view as the other rows have, "
            "received none"
        )
    shown = _named(row.view, capture)
    if not shown or len({photograph.camera for photograph in shown}) > 1:
        raise CaptureError(
            f"{table}: row {quoted(row.name)}: expected the view to name photographs of one "
            f"camera in {capture.description}, received {quoted(row.view)}, which names "
            f"{len(shown)}"
        )
    own = [p for p in _named(row.name, capture) if p.camera == shown[0].camera]
    if len(own) == 1:
        return own[0], row
    folder = shown[0].path.parent.relative_to(capture.root).as_posix()
    names = [row.name] if folder == "." else [f"{folder}/{row.name}", row.name]
    paths = [files.path(name, IMAGE_SUFFIXES) for name in names]
    path = next((path for path in paths if path.is_file()), paths[0])
    reading = shown[0].exposures[0].reading
    return replace(shown[0], exposures=(Exposure(path, reading=reading),)), row


def _named(name: str, capture: Capture) -> list[Photograph]:
    """Photographs whose path ends so, or whose file is called so."""
    for kind in range(3):
        named = [
            photograph
            for photograph in capture.photographs
            if name.casefold() in _keys(photograph.path, capture.root)[kind]
        ]
        if named:
            return named
    return []


# --- the table ----------------------------------------------------------------------------


def _rows(table: Path) -> tuple[list[_Row], bool]:
    """Rows of the table, and whether they have a column ``view``."""
    lines = [line for line in read_text(table).splitlines() if line.strip()]
    lines = [line for line in lines if not line.startswith("#")]
    first = lines[0] if lines else ""
    delimiter = next((mark for mark in ",;\t" if mark in first), ",")
    parsed = csv_rows(table, lines, delimiter)
    columns, kind = _columns(parsed[0] if parsed else [], table)
    if not 1 <= len(parsed) - 1 <= MAX_PHOTOGRAPHS:
        raise CaptureError(
            f"{table}: expected 1 to {MAX_PHOTOGRAPHS:,} rows below the names of the columns, "
            f"received {len(parsed) - 1}"
        )
    rows = [_row(words, columns, kind, table) for words in parsed[1:]]
    seen: set[tuple[str, str]] = set()
    for row in rows:
        key = (row.name.casefold(), row.view.casefold())
        if key in seen:
            raise CaptureError(
                f"{table}: expected each name once, received {quoted(row.name)} twice"
            )
        seen.add(key)
    return rows, "view" in columns


def _columns(words: Sequence[str], table: Path) -> tuple[list[str], str]:
    """Names of the columns, and the kind of light that they describe."""
    columns = [word.lower() for word in words]
    present = set(columns)
    kinds = [kind for kind, names in _KINDS.items() if set(names) & present]
    known = {"name", "view", *(_KINDS[kinds[0]] if kinds else ())}
    powers = [p for p in (("intensity",), ("r", "g", "b")) if set(p) & present]
    known |= set(powers[0]) if powers else set()
    complete = len(kinds) == 1 and len(powers) < 2 and present <= known
    needed = {"name", *(_KINDS[kinds[0]] if kinds else ()), *(powers[0] if powers else ())}
    if not complete or not needed <= present or len(columns) != len(present):
        raise CaptureError(
            f"{table}: expected a first line that names the columns {_COLUMNS}, received "
            f"{quoted(','.join(words))}"
        )
    return columns, kinds[0]


def _row(words: Sequence[str], columns: Sequence[str], kind: str, table: Path) -> _Row:
    line = quoted(",".join(words))
    if len(words) != len(columns):
        raise CaptureError(
            f"{table}: expected {len(columns)} values in a row, received {len(words)}: {line}"
        )
    values = dict(zip(columns, words, strict=True))
    power = ("r", "g", "b") if "r" in values else ("intensity",) * 3
    place = [parse_number(values[name]) for name in _KINDS[kind]]
    intensity = [parse_number(values.get(name, "1")) for name in power]
    if not values["name"] or None in place or None in intensity:
        raise CaptureError(
            f"{table}: expected a name and finite numbers in a row, received {line}"
        )
    where = {"position" if kind == "point" else "direction": np.array(place, np.float64)}
    light = described_light(
        f"{table}: row {quoted(values['name'])}",
        kind,
        intensity=np.array(intensity, np.float64),
        **where,
    )
    name, view = (values.get(key, "").replace("\\", "/") for key in ("name", "view"))
    return _Row(name, view, light, tuple(where.popitem()[1].tolist()))
