"""The folder that a capture goes to: one process at a time, whole or not at all, nobody else's.

Work is done in a hidden folder beside the target, or inside it where it exists already (it
may be the current folder or a file system of its own). What was interrupted stays there, each
file of it whole, and the same command goes on from it. In the end the files go to their
places, `capture.json` last: a folder with that file holds a whole capture.

A capture lists its files in `files.json`. Only these are ever replaced or deleted, and only
while they have the sizes that they were written with.
"""

from __future__ import annotations

import json
import os
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any

from capture_sim.errors import SceneError, scene_error
from capture_sim.files import flush_to_disk, write_json, write_text, write_whole
from capture_sim.inputs import read_bytes
from capture_sim.record import EFFECTS_FILE

try:
    import fcntl
except ImportError:  # Windows; runs in one folder are not kept apart there
    fcntl = None  # type: ignore[assignment]

CAPTURE_FILE = "capture.json"
LIST_FILE = "files.json"
FINGERPRINT_FILE = "scene.sha256"
LOCK_FILE = ".lock"
# While files go to their places: which they are, and which an earlier capture has there.
MOVING_FILE = ".moving.json"
INSIDE = ".incomplete"
_OF_THE_WORK = (LIST_FILE, FINGERPRINT_FILE, LOCK_FILE, MOVING_FILE)
LARGEST_LIST = 1 << 30


def work_folder(folder: Path) -> Path:
    """The hidden folder in which a capture for `folder` is made."""
    if folder.is_dir():
        return folder / INSIDE
    return folder.parent / f".{folder.name}.incomplete"


@contextmanager
def reserved(folder: Path) -> Iterator[Path]:
    """Keep other processes from writing to a folder while the block runs.

    The system releases the lock when the process ends, however it ends.

    Parameters
    ----------
    folder : Path
        Absolute.

    Yields
    ------
    Path
        The hidden folder; removed again if nothing was begun in it.

    Raises
    ------
    SceneError
        If another process has it.
    """
    part = work_folder(folder)
    part.mkdir(parents=True, exist_ok=True)
    born = part.stat()
    with (part / LOCK_FILE).open("w") as lock:
        if fcntl is not None:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise scene_error(
                    str(folder),
                    "a folder for this command alone",
                    "another capture-sim working on it",
                    "wait for it, or choose another folder",
                ) from None
        try:
            yield part
        finally:
            if _is_still(part, born) and not (part / FINGERPRINT_FILE).exists():
                shutil.rmtree(part, ignore_errors=True)


def _is_still(path: Path, status: os.stat_result) -> bool:
    """Tell whether a path is the same folder as before, not another one of that name."""
    return path.exists() and os.path.samestat(path.stat(), status)


def begin(part: Path, mark: str) -> None:
    """Keep what an interrupted call for the same scene left; clear away what another left.

    Parameters
    ----------
    part : Path
        The hidden folder, reserved.
    mark : str
        Fingerprint of the scene.
    """
    if begun_for(part) == mark:
        return
    _clear(part)
    write_whole(part / FINGERPRINT_FILE, write_text, mark)


def _clear(part: Path) -> None:
    """Remove what is in a hidden folder, but for the lock."""
    for entry in sorted(part.iterdir(), key=lambda entry: entry.name == MOVING_FILE):
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        elif entry.name != LOCK_FILE:
            entry.unlink()


def begun_for(part: Path) -> str | None:
    """Fingerprint of the scene that a hidden folder was begun for, if any."""
    try:
        return read_bytes(part / FINGERPRINT_FILE, 1 << 10).decode("ascii", errors="replace")
    except SceneError:
        return None


def check_target(folder: Path, *, overwrite: bool) -> None:
    """Refuse a folder that may not be written.

    Parameters
    ----------
    folder : Path
        Where a capture is to go.
    overwrite : bool
        True if an earlier capture may be replaced.

    Raises
    ------
    SceneError
        If there is a file, a folder that holds anything but a capture that this program
        wrote, or such a capture that may not be replaced.
    """
    if not folder.is_dir():
        if folder.exists() or folder.is_symlink():
            kind = "a file" if folder.exists() else "a link to nothing"
            raise scene_error(str(folder), "a folder or nothing", kind, "choose another place")
        return
    if not any(entry.name != INSIDE for entry in folder.iterdir()):
        return
    if (folder / CAPTURE_FILE).is_file() and not overwrite:
        raise scene_error(
            str(folder), "no capture there yet", "one", "pass --overwrite to replace it"
        )
    if others := foreign_files(folder):
        shown = ", ".join(repr(name) for name in others[:3])
        more = " and more" if len(others) > 3 else ""
        raise scene_error(
            str(folder),
            "an empty folder or an earlier capture of capture-sim with nothing else in it",
            f"{shown}{more}, which it did not write or which changed since",
            "choose another place, or move that away; nothing is deleted",
        )
    if not overwrite:
        raise scene_error(
            str(folder), "nothing there", "part of a capture", "pass --overwrite to replace it"
        )


def foreign_files(folder: Path, most: int = 4) -> list[str]:
    """Files in a folder that are not those of a capture as this program wrote them.

    Parameters
    ----------
    folder : Path
    most : int
        No more are looked for.

    Returns
    -------
    list of str
        Relative paths; links, pipes and the like count, too.
    """
    listed = _listed(folder)
    own = _OF_THE_WORK if listed else ()
    others = (
        name
        for name, status in _entries(folder)
        if name not in own
        and not (
            stat.S_ISREG(status.st_mode)
            and name in listed
            and listed[name] in (None, status.st_size)
        )
    )
    return list(islice(others, most))


def _entries(folder: Path) -> Iterator[tuple[str, os.stat_result]]:
    """Everything below a folder but folders, by relative path; not the hidden folder inside."""
    for root, folders, files in os.walk(folder):
        if Path(root) == folder and INSIDE in folders:
            folders.remove(INSIDE)
        folders.sort()
        links = [name for name in folders if (Path(root) / name).is_symlink()]
        for name in sorted([*files, *links]):
            path = Path(root) / name
            if os.path.lexists(path):
                yield path.relative_to(folder).as_posix(), path.lstat()


def _listed(folder: Path) -> dict[str, int | None]:
    """Sizes of the files that the list of a capture names; empty if there is no such list."""
    try:
        content = json.loads(read_bytes(folder / LIST_FILE, LARGEST_LIST))
        files = content["files"] if content["generator"] == "capture_sim" else {}
        return {str(name): size for name, size in files.items()}
    except (SceneError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {}


def publish(part: Path, folder: Path, *, overwrite: bool) -> None:
    """Bring a capture from the hidden folder to its place.

    Parameters
    ----------
    part : Path
        Holds all files of the capture, on the disk.
    folder : Path
        Absolute.
    overwrite : bool
        True if an earlier capture may be replaced.

    Raises
    ------
    SceneError
        If somebody has put something else there meanwhile.
    """
    check_target(folder, overwrite=overwrite)
    files = {
        # The times in the record have other lengths each time: equal scenes, equal bytes.
        name: None if name == EFFECTS_FILE else status.st_size
        for name, status in sorted(_entries(part))
        if not PurePosixPath(name).name.startswith(".") and name not in _OF_THE_WORK
    }
    content = {"generator": "capture_sim", "files": files}
    write_whole(part / LIST_FILE, write_json, content)
    for root, _, _ in os.walk(part):
        flush_to_disk(Path(root))
    if not folder.exists():
        part.rename(folder)
        flush_to_disk(folder.parent)
        for name in (FINGERPRINT_FILE, LOCK_FILE):
            (folder / name).unlink(missing_ok=True)
        return
    moving = {"new": [*files, LIST_FILE], "old": [name for name, _ in _entries(folder)]}
    write_whole(part / MOVING_FILE, write_json, moving)
    finish(part, folder)


def finish(part: Path, folder: Path) -> bool:
    """Go on bringing files to their places, if that has been begun.

    Parameters
    ----------
    part, folder : Path

    Returns
    -------
    bool
        True if that was so; the capture is whole now.
    """
    if not (part / MOVING_FILE).is_file():
        return False
    moving: dict[str, Any] = json.loads(read_bytes(part / MOVING_FILE, LARGEST_LIST))
    if (part / CAPTURE_FILE).exists():  # that of an earlier capture, which is not whole now
        (folder / CAPTURE_FILE).unlink(missing_ok=True)
    last = [LIST_FILE, CAPTURE_FILE]
    for name in [*(n for n in moving["new"] if n not in last), *last]:
        if (part / name).exists():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (part / name).replace(folder / name)
    _remove(folder, set(moving["old"]) - set(moving["new"]))
    flush_to_disk(folder)
    _clear(part)
    return True


def _remove(folder: Path, names: Iterable[str]) -> None:
    """Remove files, and folders that become empty by that."""
    for name in names:
        (folder / name).unlink(missing_ok=True)
    parents = {parent for name in names for parent in PurePosixPath(name).parents}
    for parent in sorted(parents - {PurePosixPath(".")}, reverse=True):
        try:
            (folder / parent).rmdir()
        except OSError:  # not empty, or gone
            continue
