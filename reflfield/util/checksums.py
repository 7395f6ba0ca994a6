"""Checksums of the files in a folder, to find what was damaged after it was complete.

Files are told by their size and their CRC-32C. Stores of many chunks are told by the number and
size of their files, and each chunk ends with a CRC-32C of its own (`observations.store`), which
is compared for those that were written after the store was complete; the others are verified
when they are read.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import google_crc32c

BLOCK_BYTES = 1 << 20
# A chunk's own checksum, at its end, lowest byte first.
CRC_BYTES = 4
# In the folder of a zarr array: what holds the chunks.
CHUNKS = "c"
# In a JSON document: the checksum of the rest.
STAMP = "crc32c"


def crc32c(path: Path) -> str:
    """CRC-32C of a file as eight hexadecimal digits; the bytes are streamed."""
    value = 0
    with path.open("rb") as file:
        while block := file.read(BLOCK_BYTES):
            value = google_crc32c.extend(value, block)
    return f"{value:08x}"


def described(path: Path) -> dict[str, Any]:
    """Size and checksum of a file."""
    return {"bytes": path.stat().st_size, "crc32c": crc32c(path)}


def stamped(document: Mapping[str, Any]) -> dict[str, Any]:
    """A JSON document with a checksum of what it says.

    Examples
    --------
    >>> is_stamped(stamped({"a": 1})), is_stamped({**stamped({"a": 1}), "a": 2})
    (True, False)
    """
    return {**document, STAMP: _digest_of(document)}


def is_stamped(document: Mapping[str, Any]) -> bool:
    """Whether a JSON document still says what it did when it was stamped."""
    said = {name: value for name, value in document.items() if name != STAMP}
    return document.get(STAMP) == _digest_of(said)


def _digest_of(document: Mapping[str, Any]) -> str:
    return f"{google_crc32c.value(json.dumps(document, sort_keys=True).encode()):08x}"


def agrees(path: Path, recorded: Mapping[str, Any]) -> bool:
    """Whether a file is there and has the size and checksum that were recorded.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "file"
    >>> _ = path.write_bytes(b"123456789")
    >>> recorded = described(path)
    >>> recorded["crc32c"], agrees(path, recorded)
    ('e3069283', True)
    >>> _ = path.write_bytes(b"123456798")
    >>> agrees(path, recorded)
    False
    """
    try:
        status = path.stat()
        same = stat.S_ISREG(status.st_mode) and status.st_size == recorded["bytes"]
        return same and crc32c(path) == recorded["crc32c"]
    except PermissionError:
        raise
    except OSError:  # gone, or a folder, or links in a circle
        return False


def checksums(folder: Path, stores: Sequence[str] = (), without: Sequence[str] = ()) -> Any:
    """What tells the files below a folder, as JSON values.

    Parameters
    ----------
    folder : Path
    stores : sequence of str
        Folders in it that are zarr arrays.
    without : sequence of str
        Files and folders in it that are left out.

    Returns
    -------
    dict
        ``files``: size and checksum by name; ``stores``: number and size of the chunks by name,
        and when the last one was written.
    """
    chunks = {name: list(_files(folder / name / CHUNKS)) for name in stores}
    apart = {path for paths in chunks.values() for path in paths}
    files = [
        path
        for entry in sorted(folder.iterdir())
        if entry.name not in without
        for path in (_files(entry) if entry.is_dir() else (entry,))
        if path not in apart
    ]
    return {
        "files": {path.relative_to(folder).as_posix(): described(path) for path in files},
        "stores": {name: _store(paths) for name, paths in chunks.items() if paths},
    }


def first_damaged(folder: Path, recorded: Mapping[str, Any]) -> str | None:
    """Name of a file that is not as it was recorded; None if all are.

    Parameters
    ----------
    folder : Path
    recorded : mapping
        Of `checksums`.
    """
    for name, entry in recorded["files"].items():
        if not agrees(folder / name, entry):
            return str(name)
    for name, entry in recorded["stores"].items():
        damaged = _damaged_chunk(folder / name / CHUNKS, entry)
        if damaged is not None:
            return damaged.relative_to(folder).as_posix()
    return None


def _store(chunks: Sequence[Path]) -> dict[str, int]:
    states = [path.stat() for path in chunks]
    return {
        "files": len(states),
        "bytes": sum(status.st_size for status in states),
        "newest": max(status.st_mtime_ns for status in states),
    }


def _damaged_chunk(store: Path, recorded: Mapping[str, int]) -> Path | None:
    """What of a store is damaged: a chunk, or their number or size."""
    chunks = list(_files(store))
    for chunk in chunks:
        if not chunk.is_file():  # a pipe, or a link to nothing
            return chunk
        if chunk.stat().st_mtime_ns > recorded["newest"] and not _is_whole(chunk):
            return chunk
    sizes = [chunk.stat().st_size for chunk in chunks]
    whole = (len(sizes), sum(sizes)) == (recorded["files"], recorded["bytes"])
    return None if whole else store


def _is_whole(chunk: Path) -> bool:
    content = chunk.read_bytes()
    own = int.from_bytes(content[-CRC_BYTES:], "little")
    return len(content) > CRC_BYTES and google_crc32c.value(content[:-CRC_BYTES]) == own


def _files(folder: Path) -> Iterator[Path]:
    """All files below a folder, in the order of their names; none if it is not there."""
    for where, folders, names in os.walk(folder):
        folders.sort()
        yield from (Path(where) / name for name in sorted(names))
