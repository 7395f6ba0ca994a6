"""Directories of TIFF files: pages and what tells a camera raw file from a photograph."""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

from reflfield.errors import CaptureError

MOST_PAGES = 1000
MOST_TAGS = 4096
MOST_CHANNELS = 1024
# Values of one tag that are read; of longer ones (strip offsets) only that they are there.
MOST_VALUES = 1024

# Tags by name, TIFF 6.0 and DNG 1.7.
SUBFILE, WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC = 254, 256, 257, 258, 259, 262
SAMPLES, TILE_WIDTH, TILE_HEIGHT, FORMAT, SUB_DIRECTORIES = 277, 322, 323, 339, 330
PAGE_NAME, TRANSFER, WHITE, PRIMARIES, ORIENTATION, EXTRA = 285, 301, 318, 319, 274, 338
# Of Exif data: the directory of the camera's settings, the one of interoperability, its index.
EXIF, INTEROPERABILITY, INDEX = 34665, 40965, 1
# Exposure time (seconds), f-number and speed (ISO).
EXPOSURE = (33434, 33437, 34855)
DNG_VERSION = 50706
COLOUR_FILTER_ARRAY, LINEAR_RAW = 32803, 34892
# NEF, ARW, PEF and others compress mosaics in ways of their own.
RAW_COMPRESSIONS = (32767, 32769, 34713, 65000, 65535)

# Of other tags only that they are there is kept.
READ = {
    *(SUBFILE, WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC, SAMPLES, TILE_WIDTH, TILE_HEIGHT),
    *(FORMAT, SUB_DIRECTORIES, PAGE_NAME, WHITE, PRIMARIES, ORIENTATION, EXTRA),
    *(EXIF, INTEROPERABILITY, INDEX, *EXPOSURE),
}

_TYPES = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 6: "b", 7: "B", 8: "h", 9: "i", 10: "ii"}
_TYPES |= {11: "f", 12: "d", 13: "I", 16: "Q", 17: "q", 18: "Q"}
_PLACE = {
    "B": 1,
    "s": 1,
    "b": 1,
    "H": 2,
    "h": 2,
    "I": 4,
    "i": 4,
    "f": 4,
    "Q": 8,
    "q": 8,
    "d": 8,
}

Tags = dict[int, tuple[float, ...]]


@dataclass(frozen=True)
class TiffPage:
    """One page of a TIFF file.

    Parameters
    ----------
    index : int
        Number of the page.
    name : str
        Its page name, or empty.
    width, height : int
    tile_width, tile_height : int
        1 where the page has strips.
    bits : int
        Of each value.
    sample_format : int
        1 unsigned, 2 signed, 3 float.
    photometric : int
        0 white is zero, 1 black is zero, 2 RGB, 3 palette, 6 YCbCr.
    reduced : bool
        Whether it is a smaller copy or a mask of another page.
    transfer : bool
        Whether it has a transfer function of its own.
    alpha : bool
        Whether one of its values is alpha.
    orientation : int
        How a viewer turns the page, 1 to 8; 1 is not at all.
    chromaticities : tuple of 8 float or None
        x and y of red, green, blue and white.
    """

    index: int
    name: str
    width: int
    height: int
    tile_width: int
    tile_height: int
    bits: int
    sample_format: int
    photometric: int
    reduced: bool
    transfer: bool
    alpha: bool
    orientation: int
    chromaticities: tuple[float, ...] | None


def read_tiff_pages(path: Path, file: IO[bytes]) -> tuple[TiffPage, ...]:
    """The pages of a TIFF or BigTIFF file.

    Parameters
    ----------
    path : Path
        Named in messages.
    file : binary file
        Open, anywhere.

    Returns
    -------
    tuple of TiffPage

    Raises
    ------
    CaptureError
        If a directory is damaged or there are more than `MOST_PAGES` pages, or
        `MOST_CHANNELS` values in a pixel.
    """
    pages = tuple(
        _page(path, index, tags) for index, tags in enumerate(_directories(path, file))
    )
    if not pages:
        raise CaptureError(f"{path}: expected a TIFF image, received a file without pages")
    return pages


def raw_evidence(path: Path) -> str:
    """What says that a TIFF is a camera raw file, whose first page is a thumbnail.

    Returns
    -------
    str
        Empty if nothing does.
    """
    with path.open("rb") as file:
        for tags in _directories(path, file):
            children = [*_sub_directories(path, file, tags)]
            for directory in (tags, *children):
                if DNG_VERSION in directory:
                    return "DNG"
                if _first(directory, PHOTOMETRIC, -1) in (COLOUR_FILTER_ARRAY, LINEAR_RAW):
                    return "TIFF with a mosaic of colour filters"
                if _first(directory, COMPRESSION, 1) in RAW_COMPRESSIONS:
                    return "TIFF with compressed sensor data"
            if _first(tags, SUBFILE, 0) & 1 and children:
                return "TIFF that starts with a thumbnail"
    return ""


@dataclass(frozen=True)
class ExifFacts:
    """What Exif data say.

    Parameters
    ----------
    orientation : int
        How a viewer turns the image, 1 to 8; 1 is not at all.
    adobe_rgb : bool
        Whether the camera wrote Adobe RGB (interoperability index R03).
    exposure : (seconds, f-number, ISO) tuple of float
        0 where it is not stated.
    """

    orientation: int = 1
    adobe_rgb: bool = False
    exposure: tuple[float, float, float] = (0.0, 0.0, 0.0)


def exif_facts(path: Path, exif: bytes) -> ExifFacts:
    """What the Exif data (a TIFF) of an image of another format say."""
    if exif[:4] not in (b"II*\0", b"MM\0*"):
        return ExifFacts()
    return tiff_facts(path, io.BytesIO(exif))


def tiff_facts(path: Path, file: IO[bytes]) -> ExifFacts:
    """What the Exif data of an open TIFF file say; nothing where they are garbled."""
    facts = ExifFacts()
    with suppress(CaptureError, struct.error, ValueError, OverflowError):
        inner = next(_directories(path, file), {})
        facts = ExifFacts(_first(inner, ORIENTATION, 1))
        for pointer in (EXIF, INTEROPERABILITY):
            position = _first(inner, pointer, 0)
            inner = next(_directories(path, file, position), {}) if position else {}
            if pointer == EXIF:
                time, stop, speed = (float((*inner.get(t, ()), 0)[0]) for t in EXPOSURE)
                facts = replace(facts, exposure=(time, stop, speed))
        index = bytes(int(n) for n in inner.get(INDEX, ()))
        facts = replace(facts, adobe_rgb=index[:3] == b"R03")
    return facts


def _directories(path: Path, file: IO[bytes], first: int | None = None) -> Iterator[Tags]:
    """Tags of a chain of directories."""
    file.seek(0)
    start = file.read(16)
    order = "<" if start[:2] == b"II" else ">"
    big = start[2:4] in (b"+\0", b"\0+")
    position = first
    if position is None:
        (position,) = struct.unpack_from(order + ("Q" if big else "I"), start, 8 if big else 4)
    seen: set[int] = set()
    while position:
        if position in seen or len(seen) >= MOST_PAGES:
            raise _damaged(path, f"more than {MOST_PAGES} pages, or pages in a circle")
        seen.add(position)
        tags, position = _directory(path, file, position, order, big)
        yield tags


def _sub_directories(path: Path, file: IO[bytes], tags: Tags) -> Iterator[Tags]:
    for position in tags.get(SUB_DIRECTORIES, ()):
        yield from _directories(path, file, int(position))


def _directory(
    path: Path, file: IO[bytes], position: int, order: str, big: bool
) -> tuple[Tags, int]:
    """Tags of one directory, and where the next one is (0: nowhere)."""
    if position >= file.seek(0, os.SEEK_END):
        raise _damaged(path, "a directory beyond the end of the file")
    file.seek(position)
    count_type, entry_type, next_type = ("Q", "HHQ8s", "Q") if big else ("H", "HHI4s", "I")
    (count,) = struct.unpack(order + count_type, file.read(struct.calcsize(order + count_type)))
    if count > MOST_TAGS:
        raise _damaged(path, f"{count:,} tags in a directory")
    size = struct.calcsize(order + entry_type)
    entries = file.read(count * size)
    tail = file.read(struct.calcsize(order + next_type))
    following = struct.unpack(order + next_type, tail)[0] if tail else 0
    tags: Tags = {}
    for tag, kind, length, value in struct.iter_unpack(order + entry_type, entries):
        known = tag in READ and kind in _TYPES and length <= MOST_VALUES
        tags[tag] = _values(file, order, _TYPES[kind], length, value, big) if known else ()
    return tags, following


def _values(
    file: IO[bytes], order: str, kind: str, length: int, value: bytes, big: bool
) -> tuple[float, ...]:
    """Values of a tag: within it if they fit there, else where it points to."""
    n_bytes = length * sum(_PLACE[letter] for letter in kind)
    if n_bytes > len(value):
        (position,) = struct.unpack(order + ("Q" if big else "I"), value)
        file.seek(position)
        value = file.read(n_bytes)
    if kind == "s":
        return tuple(value[:length])
    numbers = struct.unpack(f"{order}{length * kind}", value[:n_bytes])
    if len(kind) == 1:
        return numbers
    return tuple(a / b if b else 0.0 for a, b in zip(numbers[::2], numbers[1::2], strict=True))


def _page(path: Path, index: int, tags: Tags) -> TiffPage:
    samples = int(_first(tags, SAMPLES, 1))
    if samples > MOST_CHANNELS:
        raise _damaged(path, f"{samples:,} values in a pixel")
    chromaticities = (*tags.get(PRIMARIES, ()), *tags.get(WHITE, ()))
    name = bytes(int(n) for n in tags.get(PAGE_NAME, ())).rstrip(b"\0")
    return TiffPage(
        index,
        name.decode("utf-8", errors="replace"),
        width=int(_first(tags, WIDTH, 0)),
        height=int(_first(tags, HEIGHT, 0)),
        tile_width=int(_first(tags, TILE_WIDTH, 1)),
        tile_height=int(_first(tags, TILE_HEIGHT, 1)),
        bits=int(_first(tags, BITS, 1)),
        sample_format=int(_first(tags, FORMAT, 1)),
        photometric=int(_first(tags, PHOTOMETRIC, 1)),
        reduced=bool(int(_first(tags, SUBFILE, 0)) & 5),
        transfer=TRANSFER in tags,
        alpha=any(kind in (1, 2) for kind in tags.get(EXTRA, ())),
        orientation=int(_first(tags, ORIENTATION, 1)),
        chromaticities=chromaticities if len(chromaticities) == 8 else None,
    )


def _first(tags: Tags, tag: int, default: int) -> int:
    values = tags.get(tag) or (default,)
    return int(values[0])


def _damaged(path: Path, what: str) -> CaptureError:
    return CaptureError(
        f"{path}: expected a TIFF image, received a damaged or different file ({what}); copy "
        "or export it again"
    )
