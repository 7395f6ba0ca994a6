"""Stages that skip themselves, are written whole or not at all, and resume after a kill.

Each stage owns one folder. Its key is the SHA-256 of its name, the version of its code, its
options and the keys of the stages it reads, so a folder whose key matches holds what
the stage would compute again. Work goes into ``NAME.partial`` and is renamed when it
is complete. What a stage that failed or was killed has finished of its blocks
(`reflfield.util.blocks`) is taken up by the next run with the same key; all else of it is
removed.

Beside the record stand checksums of all its files, which are compared before a result is used
again: what was damaged meanwhile is computed again, saying so.

A stage that is missing here and complete with the same key in another folder is taken over
from there, by hard links: files of a complete stage are never written again in place, only
replaced.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import platform
import shutil
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil

from reflfield.errors import InputError
from reflfield.util.blocks import Blocks, Scheduler, Tally
from reflfield.util.checksums import checksums, first_damaged, is_stamped, stamped
from reflfield.util.files import flush_to_disk, naming, read_bytes, replacing
from reflfield.util.folders import flush_folder, folder_bytes, link_file, link_folder, remove

log = logging.getLogger(__name__)
# Among a stage's counts: what a user must know of its result, in sentences. It is said each
# time that the result is used, and at the head of the report.
WARNINGS = "warnings"
RECORD = "stage.json"
LARGEST_RECORD = 256 << 20
KEY = "key"
# Folders inside a stage's: results of blocks, removed when it is complete, and stores that
# are written chunk by chunk and stay.
BLOCKS = "blocks"
RESTARTABLE = ("samples",)
# Packages whose version may change what a stage computes.
NUMERICAL_PACKAGES = (
    *("numpy", "scipy", "numba", "open3d-cpu", "open3d", "xatlas", "zarr", "trimesh"),
    *("opencv-contrib-python-headless", "scikit-image", "flip-evaluator", "OpenEXR"),
    *("OpenImageIO", "rawpy"),
)


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
    cpu_seconds : float
        CPU time of all threads of this process together, which other programs on a
        busy machine change little.
    blocks_computed, blocks_resumed : int
        Blocks of work that this run has done, and that it found done by one that was
        interrupted.
    blocks_repeated : int
        Times that one of those done was begun again, because a cluster's worker had died at
        it or failed.
    work : dict of str to float
        CPU seconds of each work by blocks; of work inside another, both.
    """

    name: str
    key: str
    seconds: float
    peak_bytes: int
    size_bytes: int
    counts: dict[str, Any] = field(default_factory=dict)
    reused: bool = False
    cpu_seconds: float = 0.0
    blocks_computed: int = 0
    blocks_resumed: int = 0
    blocks_repeated: int = 0
    work: dict[str, float] = field(default_factory=dict)


# Times that resident memory is read for each time that children are looked for.
POLLS_PER_LISTING = 10


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
        members, polls = [psutil.Process()], 0
        while True:
            # To find children all processes of the machine are looked through.
            if polls % POLLS_PER_LISTING == 0:
                members = [members[0], *members[0].children(recursive=True)]
            polls += 1
            self.peak_bytes = max(self.peak_bytes, resident_bytes(members))
            if self._stopped.wait(self._interval):
                return


def resident_bytes(processes: Iterable[psutil.Process]) -> int:
    """Resident memory of those of some processes that still run."""
    total = 0
    for member in processes:
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
    redo : collection of str
        Stages to compute again even if their key matches.
    others : sequence of StageFolder
        Where complete stages are taken over from; of those to compute again, only what has
        been run there meanwhile.
    """

    def __init__(
        self,
        root: Path,
        redo: Collection[str] = (),
        others: Sequence[StageFolder] = (),
    ) -> None:
        self.root = root
        self.redo = frozenset(redo)
        self.others = tuple(others)
        self.records: list[StageRecord] = []
        self.tally = Tally()

    def take_over_from(self, others: Iterable[StageFolder]) -> None:
        """Take complete stages over from these folders from now on."""
        self.others = tuple(others)

    def run(
        self,
        name: str,
        compute: Callable[[Path], Mapping[str, Any]],
        *,
        options: Any = None,
        inputs: Mapping[str, str] | None = None,
        after: Mapping[str, str] | None = None,
        code: str = "",
        intact: Callable[[Path], str] = lambda folder: "",
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
            Digests of what is read besides the results of other stages.
        after : mapping of str to str
            Keys of the stages whose results are read.
        code : str
            Digest of the code that computes the stage.
        intact : callable
            Says what is wrong with what the stage has left outside of its folder; an empty
            text if nothing is.

        Returns
        -------
        Path
            Folder with the results.
        """
        inputs, after = dict(inputs or {}), dict(after or {})
        key = stage_key(name, options, {**inputs, **after}, code)
        self.root.mkdir(parents=True, exist_ok=True)
        folder = self.root / name
        earlier = None if name in self.redo else _usable_record(folder, key, intact)
        if earlier is not None:
            forget_blocks(folder)
            self.records.append(earlier)
            return folder
        partial = folder.with_name(f"{name}.partial")
        record = None if name in self.redo else _usable_record(partial, key, intact)
        record = record or self._taken_over(name, key, partial, intact)
        with naming(partial):
            if record is None:
                prepare_partial(partial, key, fresh=name in self.redo)
                described = {"options": plain(options), "inputs": inputs, "after": after}
                record = self._computed(name, key, partial, compute, described)
            take_place(partial, folder)
        self.records.append(record)
        return folder

    def _taken_over(
        self, name: str, key: str, partial: Path, intact: Callable[[Path], str]
    ) -> StageRecord | None:
        """The stage as another folder has it, linked into the unfinished one."""
        for other in self.others:
            run = other.record(name)
            if name in self.redo and not run:
                continue
            record = _usable_record(other.root / name, key, intact)
            if record is not None:
                link_stage(other.root / name, partial)
                return replace(record, reused=run is None or run.reused)
        return None

    def _computed(
        self,
        name: str,
        key: str,
        partial: Path,
        compute: Callable[[Path], Mapping[str, Any]],
        described: dict[str, Any],
    ) -> StageRecord:
        """Compute a stage into its unfinished folder, its record last."""
        started, spent = time.perf_counter(), time.process_time()
        self.tally = Tally()
        try:
            with MemoryWatch() as watch:
                counts = dict(compute(partial))
            forget_unfinished(partial)
        except BaseException:
            if not has_blocks(partial):
                shutil.rmtree(partial, ignore_errors=True)
            raise
        record = StageRecord(
            name=name,
            key=key,
            seconds=time.perf_counter() - started,
            peak_bytes=watch.peak_bytes,
            size_bytes=folder_bytes(partial, without=BLOCKS),
            counts=counts,
            cpu_seconds=time.process_time() - spent,
            blocks_computed=self.tally.computed,
            blocks_resumed=self.tally.resumed,
            blocks_repeated=self.tally.repeated,
            work=self.tally.cpu_seconds,
        )
        sums = checksums(partial, stores=RESTARTABLE, without=(KEY, BLOCKS, RECORD))
        flush_folder(partial, without=BLOCKS)
        text = {**asdict(record), **described, "versions": versions(), "checksums": sums}
        with replacing(partial / RECORD) as unfinished:
            unfinished.write_text(json.dumps(stamped(text), indent=1))
        return record

    def blocks(self, scheduler: Scheduler, folder: Path) -> Blocks:
        """Work by blocks of the stage that is being computed into `folder`."""
        return Blocks(scheduler, folder / BLOCKS, self.tally)

    def record(self, name: str) -> StageRecord | None:
        """Record of a stage that has run; None of one that has not."""
        return next((record for record in self.records if record.name == name), None)

    def warnings(self, name: str) -> list[str]:
        """What a user must know of the result of a stage; nothing of one that has not run."""
        record = self.record(name)
        return [] if record is None else [str(text) for text in record.counts.get(WARNINGS, ())]

    def key(self, name: str) -> str:
        """Key of a stage that has run."""
        record = self.record(name)
        if record is None:
            raise InputError(f"stage {name!r}: expected to have run, but it has not")
        return record.key


def stage_key(name: str, options: Any, inputs: Mapping[str, str], code: str) -> str:
    """SHA-256 that changes when anything does that a stage's result depends on."""
    described = [name, code, plain(options), dict(sorted(inputs.items())), versions()]
    text = json.dumps(described, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def versions() -> dict[str, str]:
    """Versions of this package and of what it computes with."""
    return dict(_installed_versions())


@cache
def _installed_versions() -> dict[str, str]:
    """Look them up once: each stage asks, and each lookup reads a package's description."""
    installed = {"reflfield": version("reflfield"), "python": platform.python_version()}
    for package in NUMERICAL_PACKAGES:
        try:
            installed[package] = version(package)
        except ModuleNotFoundError:
            continue
    return installed


def plain(value: Any) -> Any:
    """Options as JSON values."""
    if is_dataclass(value) and not isinstance(value, type):
        return {name: plain(item) for name, item in asdict(value).items()}
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def read_record(folder: Path) -> dict[str, Any]:
    """What a stage's folder says of itself; empty if it does not, or is damaged."""
    if not os.path.lexists(folder / RECORD):
        return {}
    try:
        record = json.loads(read_bytes(folder / RECORD, LARGEST_RECORD))
    except (InputError, ValueError, RecursionError):
        record = None
    if isinstance(record, dict) and is_stamped(record):
        return record
    log.warning("%s: damaged; the stage is not used", folder / RECORD)
    return {}


def _usable_record(folder: Path, key: str, intact: Callable[[Path], str]) -> StageRecord | None:
    """Record of a complete stage with this key whose files are all as they were written."""
    stored = read_record(folder)
    if stored.get("key") != key:
        return None
    kept = {
        entry.name: stored[entry.name] for entry in fields(StageRecord) if entry.name in stored
    }
    try:
        damaged = first_damaged(folder, stored["checksums"])
        record = StageRecord(**{**kept, "reused": True})
    except (TypeError, KeyError, AttributeError):
        return None
    wrong = f"{folder / damaged}: damaged or gone" if damaged else intact(folder)
    if wrong:
        log.warning("%s; the stage %r is computed again", wrong, folder.stem)
        return None
    return record


def prepare_partial(partial: Path, key: str, *, fresh: bool) -> None:
    """Make the folder that a stage is computed in, with the blocks of a killed run of it.

    Only what is restartable by block is kept, and only of the same stage with the same key.
    """
    try:
        same = (partial / KEY).read_text() == key
    except OSError:
        same = False
    if fresh or not same:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        with replacing(partial / KEY) as unfinished:
            unfinished.write_text(key)
    for entry in partial.iterdir():
        if entry.name not in (KEY, BLOCKS, *RESTARTABLE):
            remove(entry)
    forget_unfinished(partial)


def forget_unfinished(partial: Path) -> None:
    """Remove what a process that was killed, this run's or a worker's, left of a chunk.

    A worker that an earlier command had left at work may be writing one still: it is
    renamed meanwhile, or written once more by whoever needs it.
    """
    for name in RESTARTABLE:
        for unfinished in (partial / name).rglob("*.partial"):
            unfinished.unlink(missing_ok=True)


def key_of(partial: Path) -> str:
    """Key of the stage that is being computed into a folder."""
    return (partial / KEY).read_text()


def has_blocks(partial: Path) -> bool:
    """Whether anything in a stage's unfinished folder is worth keeping."""
    return (partial / BLOCKS).is_dir() or (partial / RECORD).is_file()


def take_place(partial: Path, folder: Path) -> None:
    """Put a complete stage in the place of an earlier one.

    The earlier folder loses its record before its files: killed in between, it is not taken
    for complete, and the finished one beside it takes its place in the next run.
    """
    if os.path.lexists(folder / RECORD):
        remove(folder / RECORD)
    if os.path.lexists(folder):
        remove(folder)
    partial.rename(folder)
    flush_to_disk(folder.parent)
    forget_blocks(folder)


def link_stage(complete: Path, partial: Path) -> None:
    """Take a complete stage over into the unfinished folder of another root.

    The record comes last: killed before, the folder is not taken for complete.
    """
    shutil.rmtree(partial, ignore_errors=True)
    link_folder(complete, partial, without=(RECORD, KEY, BLOCKS))
    link_file(complete / RECORD, partial / RECORD)


def forget_blocks(folder: Path) -> None:
    """Remove what a complete stage was put together from."""
    shutil.rmtree(folder / BLOCKS, ignore_errors=True)
    (folder / KEY).unlink(missing_ok=True)
