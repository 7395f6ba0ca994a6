"""Digests of files that are read: by content, once for each state of a file.

Size, times and inode tell whether a file may have changed since it was hashed; what its content
was is kept in an index for the next run.
"""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from reflfield.errors import InputError
from reflfield.util.checksums import is_stamped, stamped
from reflfield.util.files import check_regular, read_bytes, replacing

# A file that was changed so shortly before it was hashed may change again within the same tick
# of the file system's clock; it is hashed again by the next run.
TICK_NS = 2_000_000_000
# An index of more files than any capture has.
LARGEST_INDEX = 256 << 20


def file_digest(path: Path, error: type[InputError] = InputError) -> bytes:
    """SHA-256 of a regular file; the bytes are streamed.

    Parameters
    ----------
    path : Path
    error : type, optional
        What to raise.

    Raises
    ------
    InputError
        Of the type asked for, naming the file.
    """
    check_regular(path, error)
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").digest()
    except OSError as failure:
        raise error(f"{path}: cannot be read ({failure.strerror or failure})") from failure


@dataclass(eq=False)
class FileDigests:
    """Digests of files, each hashed only if it may have changed.

    Parameters
    ----------
    index : Path, optional
        Keeps them for the next run; one that is damaged counts as none.

    Attributes
    ----------
    hashed : list of Path
        Files whose content was read.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "photograph"
    >>> _ = path.write_bytes(b"first")
    >>> digests = FileDigests()
    >>> first, again = digests.digest(path), digests.digest(path)
    >>> first == again, len(digests.hashed)
    (True, 1)
    """

    index: Path | None = None
    hashed: list[Path] = field(default_factory=list)
    _known: dict[str, Any] = field(default_factory=dict, init=False, repr=False)
    _new: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        self._known = _read_index(self.index) if self.index is not None else {}

    def digest(self, path: Path, error: type[InputError] = InputError) -> bytes:
        """SHA-256 of a file; see `file_digest`."""
        check_regular(path, error)
        name, state = str(path.absolute()), _state(path)
        entry = self._known.get(name)
        if entry is not None and entry["state"] == state:
            return bytes.fromhex(entry["sha256"])
        content = file_digest(path, error)
        self.hashed.append(path)
        self._known[name] = {"state": state, "sha256": content.hex(), "at": time.time_ns()}
        self._new = True
        return content

    def save(self) -> None:
        """Write the index, if there is one and anything new in it."""
        if self.index is None or not self._new:
            return
        unchanging = {
            name: entry
            for name, entry in self._known.items()
            if entry["at"] - max(entry["state"][1:3]) > TICK_NS
        }
        self.index.parent.mkdir(parents=True, exist_ok=True)
        with replacing(self.index) as partial:
            partial.write_text(json.dumps(stamped({"files": unchanging})))
        self._new = False


def _state(path: Path) -> list[int]:
    """Size, times of content and of inode, inode."""
    status = path.stat()
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]


def _read_index(index: Path) -> dict[str, Any]:
    try:
        document = json.loads(read_bytes(index, LARGEST_INDEX))
    except (InputError, ValueError, RecursionError):
        return {}
    if not isinstance(document, dict) or not is_stamped(document):
        return {}
    return dict(document.get("files", {}))
