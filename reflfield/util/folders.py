"""Folders of results: linked, flushed to the disk, removed, and kept for one run at a time."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from reflfield.errors import InputError
from reflfield.util.files import flush_to_disk

try:
    import fcntl
except ModuleNotFoundError:  # not on Windows: there, runs are not kept apart
    fcntl = None  # type: ignore[assignment]

LOCK = ".lock"
# Files that are flushed to the disk at a time: their waits overlap.
FLUSHING_THREADS = 8


def link_folder(source: Path, target: Path, without: Sequence[str] = ()) -> None:
    """A second name for every file below a folder; copies where there are no links.

    Parameters
    ----------
    source : Path
        Its files are never written in place again.
    target : Path
        Must not exist.
    without : sequence of str
        Files and folders in it that are left out.
    """

    def left_out(folder: str, names: list[str]) -> set[str]:
        return set(without) & set(names) if Path(folder) == source else set()

    shutil.copytree(source, target, copy_function=link_file, ignore=left_out)


def link_file(source: Path | str, target: Path | str) -> None:
    """A second name for a file; a copy on another file system, or one without links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def remove(path: Path) -> None:
    """Remove a file or a folder."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def flush_folder(folder: Path, without: str) -> None:
    """Wait until all files below a folder are on the disk, but for one of the folders in it."""
    kept = [entry for entry in folder.iterdir() if entry.name != without]
    paths = [path for entry in kept for path in (entry, *entry.rglob("*"))]
    with ThreadPoolExecutor(FLUSHING_THREADS) as pool:
        list(pool.map(flush_to_disk, [path for path in paths if path.is_file()]))
    for path in (*(path for path in paths if path.is_dir()), folder):
        flush_to_disk(path)


def folder_bytes(folder: Path, without: str) -> int:
    """Size of all files below a folder, one of the folders in it left out."""
    kept = [entry for entry in folder.iterdir() if entry.name != without]
    files = [path for entry in kept for path in (entry, *entry.rglob("*")) if path.is_file()]
    return sum(path.stat().st_size for path in files)


def _opened_lock(path: Path) -> IO[bytes]:
    """A file to be locked, which is created and never written; no link, no pipe waited for."""
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise InputError(
            f"{path}: expected the lock of a run, received something else; remove it"
        )
    return path.open("ab")


@contextmanager
def only_run(root: Path) -> Iterator[None]:
    """Keep other runs out of a folder while the block runs.

    The system releases the lock when the process ends, however it ends.

    Raises
    ------
    InputError
        If another run holds it.
    """
    root.mkdir(parents=True, exist_ok=True)
    with _opened_lock(root / LOCK) as lock:
        if fcntl is not None:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(
                    f"{root}: expected a folder for this run alone, found another run working "
                    "in it; wait for it, or choose another folder"
                ) from None
        yield
