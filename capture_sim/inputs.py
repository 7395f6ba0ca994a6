"""Input files and memory, looked at before they are used.

Files are not trusted: only regular ones are opened (a named pipe would wait for ever, a
device never end), and sizes are compared with limits before memory is taken. What a scene
holds in memory is compared with the ceiling of `memory_limit` before it is made.
"""

from __future__ import annotations

import math
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import psutil

from capture_sim.errors import scene_error

# What a file that is no regular one is called in messages.
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)
_ceiling: ContextVar[int | None] = ContextVar("ceiling", default=None)


def check_regular(path: Path, what: str | None = None) -> int:
    """Demand a regular file, before it is opened; return its size in bytes.

    Parameters
    ----------
    path : Path
        Symbolic links are followed.
    what : str, optional
        Key that names it in the scene; the path itself if not given.

    Raises
    ------
    SceneError
        If the file is missing or a folder, pipe, device or socket.
    """
    name, received = what or str(path), "" if what is None else f": {path}"
    remedy = "check the path" if what is None else "paths are relative to the scene"
    try:
        status = path.stat()
    except (OSError, ValueError) as failure:
        reason = getattr(failure, "strerror", None) or str(failure)
        raise scene_error(
            name, "an existing file", f"{reason.lower()}{received}", remedy
        ) from failure
    if not stat.S_ISREG(status.st_mode):
        kind = next((name for test, name in _KINDS if test(status.st_mode)), "something else")
        raise scene_error(name, "a file", f"{kind}{received}", "name the file itself")
    return status.st_size


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """Bytes of a regular file of a bounded size.

    Parameters
    ----------
    path : Path
    most_bytes : int
        A larger file is refused unread.

    Raises
    ------
    SceneError
        Naming the file.
    """
    size = check_regular(path)
    if size <= most_bytes:
        try:
            with path.open("rb") as file:
                content = file.read(most_bytes + 1)
        except OSError as failure:
            raise scene_error(str(path), "a readable file", str(failure.strerror)) from failure
        size = len(content)
    if size > most_bytes:
        raise scene_error(
            str(path), f"at most {most_bytes:,} bytes", f"{size:,}", "is this the right file?"
        )
    return content


@contextmanager
def memory_limit(max_memory: int | None) -> Iterator[None]:
    """Let `check_memory` refuse what would bring this process above a ceiling.

    Parameters
    ----------
    max_memory : int, optional
        Bytes of resident memory.
    """
    token = _ceiling.set(max_memory)
    try:
        yield
    finally:
        _ceiling.reset(token)


def check_memory(what: str, n_bytes: float) -> None:
    """Demand that so much more memory stays below the ceiling of `memory_limit`.

    Parameters
    ----------
    what : str
        Key or file that needs it.
    n_bytes : float
        About to be taken.

    Raises
    ------
    SceneError
        Says which ceiling would suffice.
    """
    ceiling = _ceiling.get()
    if ceiling is None:
        return
    least = psutil.Process().memory_info().rss + n_bytes
    if least > ceiling:
        raise scene_error(
            "--max-memory",
            f"at least {megabytes(least)} for {what}",
            megabytes(ceiling),
            "raise it, or make that smaller",
        )


def megabytes(size: float) -> str:
    """A size in bytes as text, rounded up.

    Examples
    --------
    >>> megabytes(3_000_000)
    '3 MB'
    """
    return f"{math.ceil(size / (1 << 20))} MB"
