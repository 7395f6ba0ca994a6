"""Stages that skip themselves, are written whole or not at all, and resume after a kill.

Each stage owns one folder. Its key is the SHA-256 of its name, the version of its code, its
options and the keys of the stages it reads, so a folder whose key matches holds what
the stage would compute again. Work goes into ``NAME.partial`` and is renamed when it
is complete; a killed run leaves at most that folder, which the next run removes.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil

from reflfield.errors import InputError

RECORD = "stage.json"
# Packages whose version may change what a stage computes.
NUMERICAL_PACKAGES = ("numpy", "scipy", "numba", "open3d-cpu", "open3d", "xatlas", "zarr")


@dataclass(frozen=True)
class StageRecord:
    """What a stage did.

    Parameters
    ----------
    name, key : str
    seconds : float
        Wall time of the computation; kept when the stage is skipped.
    peak_bytes : int
        Largest resident memory of the process and its children while it ran.
    size_bytes : int
        Size of the folder.
    counts : dict
        What went in and what came out.
    reused : bool
        True if an earlier result was taken.
    """

    name: str
    key: str
    seconds: float
    peak_bytes: int
    size_bytes: int
    counts: dict[str, Any] = field(default_factory=dict)
    reused: bool = False


class MemoryWatch:
    """Largest resident memory of this process and its children while a block runs."""

    def __init__(self, interval: float = 0.05) -> None:
        self.peak_bytes = 0
        self._interval = interval
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> MemoryWatch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()

    def _watch(self) -> None:
        process = psutil.Process()
        while True:
            self.peak_bytes = max(self.peak_bytes, resident_bytes(process))
            if self._stopped.wait(self._interval):
                return


def resident_bytes(process: psutil.Process) -> int:
    """Resident memory of a process and its children."""
    total = 0
    for member in [process, *process.children(recursive=True)]:
        try:
            total += member.memory_info().rss
        except psutil.NoSuchProcess:
            continue
    return total


class StageFolder:
    """Results of the stages of one run, each in a folder of its own.

    Parameters
    ----------
    root : Path
        Folder that holds the stages' folders; created.
    redo : set of str
        Stages to compute again even if their key matches.
    """

    def __init__(self, root: Path, redo: set[str] | None = None) -> None:
        root.mkdir(parents=True, exist_ok=True)
        self.root = root
        self.redo = redo or set()
        self.records: list[StageRecord] = []

    def run(
        self,
        name: str,
        compute: Callable[[Path], Mapping[str, Any]],
        *,
        options: Any = None,
        inputs: Mapping[str, str] | None = None,
        revision: int = 1,
    ) -> Path:
        """Compute a stage, or take its earlier result.

        Parameters
        ----------
        name : str
            Name of the stage and its folder.
        compute : callable
            Writes the results into the folder that it is given; returns counts.
        options : dataclass or plain value
            What the result depends on besides its inputs.
        inputs : mapping of str to str
            Keys of what is read.
        revision : int
            Raised when the code of the stage changes what it computes.

        Returns
        -------
        Path
            Folder with the results.
        """
        key = stage_key(name, options, inputs or {}, revision)
        folder = self.root / name
        earlier = None if name in self.redo else _matching_record(folder, key)
        if earlier is not None:
            self.records.append(earlier)
            return folder
        partial = self.root / f"{name}.partial"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        started = time.perf_counter()
        with MemoryWatch() as watch:
            counts = dict(compute(partial))
        record = StageRecord(
            name=name,
            key=key,
            seconds=time.perf_counter() - started,
            peak_bytes=watch.peak_bytes,
            size_bytes=folder_bytes(partial),
            counts=counts,
        )
        described = {**asdict(record), "options": plain(options), "inputs": dict(inputs or {})}
        (partial / RECORD).write_text(
            json.dumps({**described, "versions": versions()}, indent=1)
        )
        replace_folder(partial, folder)
        self.records.append(record)
        return folder

    def key(self, name: str) -> str:
        """Key of a stage that has run."""
        for record in self.records:
            if record.name == name:
                return record.key
        raise InputError(f"stage {name!r}: expected to have run, but it has not")


def stage_key(name: str, options: Any, inputs: Mapping[str, str], revision: int) -> str:
    """SHA-256 that changes when anything does that a stage's result depends on."""
    described = [name, revision, plain(options), dict(sorted(inputs.items())), versions()]
    text = json.dumps(described, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def versions() -> dict[str, str]:
    """Versions of this package and of what it computes with."""
    found = {"reflfield": version("reflfield"), "python": platform.python_version()}
    for package in NUMERICAL_PACKAGES:
        try:
            found[package] = version(package)
        except ModuleNotFoundError:
            continue
    return found


def plain(value: Any) -> Any:
    """Options as JSON values."""
    if is_dataclass(value) and not isinstance(value, type):
        return {name: plain(item) for name, item in asdict(value).items()}
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def _matching_record(folder: Path, key: str) -> StageRecord | None:
    try:
        found = json.loads((folder / RECORD).read_text())
    except (OSError, ValueError):
        return None
    if found.get("key") != key:
        return None
    return StageRecord(
        name=found["name"],
        key=key,
        seconds=found["seconds"],
        peak_bytes=found["peak_bytes"],
        size_bytes=found["size_bytes"],
        counts=found["counts"],
        reused=True,
    )


def folder_bytes(folder: Path) -> int:
    """Size of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def replace_folder(partial: Path, folder: Path) -> None:
    """Put a finished folder in the place of an earlier one."""
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary name that becomes `path` if the block succeeds, else vanishes."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
