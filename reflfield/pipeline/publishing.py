"""Results in the output folder: copies of what the stages have made, and of nothing else.

A result is copied only if it is as its stage has written it, and all that changed at a time
take their places together. Results of stages that do not follow from those that have run are
moved into a folder of their own before: a new field never stands beside the report of another.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from reflfield.errors import InputError
from reflfield.options import write_toml
from reflfield.pipeline import model_selection
from reflfield.pipeline.cache import StageFolder, plain, read_record, versions
from reflfield.pipeline.context import Context
from reflfield.util.checksums import agrees
from reflfield.util.files import naming, replacing, unfinished_name

log = logging.getLogger(__name__)

# What of a stage's folder goes to which place in the output folder, in the order listed.
RESULTS = {
    "compression": {"field.rfld": "field.rfld"},
    "web_page": {"object.html": "object.html"},
    "hull": {"hull.ply": "hull.ply"},
    "surface": {"surface.ply": "surface.ply"},
    "maps": {name: name for name in ("atlas.glb", "normals.exr", "tangents.exr")},
    "comparison": {"metrics.json": "metrics.json"},
    # The same with the baselines and the errors by kind.
    "error_analysis": {"metrics.json": "metrics.json"},
    "report": {"index.html": "report/index.html"},
}
TIMINGS, OPTIONS = "timings.json", "options.toml"
# Folder of the results that do not follow from the stages that have run.
OUTDATED = "outdated"


def publish(context: Context) -> None:
    """Copy what the stages have made to its place in the output folder, each file whole.

    Called as soon as there is a field, so that no later failure withholds it. What is there
    already is left alone.

    Raises
    ------
    InputError
        If a stage's file was damaged since it was written.
    """
    changed = {
        target: source
        for target, source, recorded in _results(context)
        if not agrees(context.out / target, recorded)
    }
    for target in (target for files in RESULTS.values() for target in files.values()):
        unfinished_name(context.out / target).unlink(
            missing_ok=True
        )  # of a run that was killed
    for target in _outdated(context):
        _move(context.out / target, context.out / OUTDATED / target)
    with naming(context.out), ExitStack() as together:
        # Renamed when the stack is left, the first listed last.
        for target, source in changed.items():
            (context.out / target).parent.mkdir(parents=True, exist_ok=True)
            partial = together.enter_context(replacing(context.out / target))
            shutil.copyfile(source, partial)
            _check_copy(context, partial, source)
    for target in changed:
        (context.out / OUTDATED / target).unlink(missing_ok=True)
    _remove_empty(context.out / OUTDATED)


def _results(context: Context) -> Iterator[tuple[str, Path, Mapping[str, Any]]]:
    """Name, file and checksum of every result of the stages that have run.

    Of stages with a result of the same name, that of the last which has run or follows.
    """
    latest: dict[str, tuple[Path, Mapping[str, Any]]] = {}
    for stage, files in RESULTS.items():
        for source, target in files.items():
            if context.stages.record(stage) is None and not (
                target in latest and key_that_follows(context.stages, stage) is not None
            ):
                continue
            folder = context.stages.root / stage
            latest[target] = folder / source, read_record(folder)["checksums"]["files"][source]
    for target, (path, recorded) in latest.items():
        yield target, path, recorded


def _check_copy(context: Context, copy: Path, source: Path) -> None:
    recorded = read_record(source.parent)["checksums"]["files"][source.name]
    if not agrees(copy, recorded):
        raise InputError(
            f"{source}: expected the file that the stage has written, found it damaged; run "
            "the same command again, which computes it again"
        )


def _outdated(context: Context) -> Iterator[str]:
    """Results in the output folder that do not follow from the stages that have run."""
    for target in dict.fromkeys(target for f in RESULTS.values() for target in f.values()):
        path = context.out / target
        if path.is_file() and not any(
            _is_current(context, stage, source, path)
            for stage, files in RESULTS.items()
            for source, name in files.items()
            if name == target
        ):
            yield target


def _is_current(context: Context, stage: str, source: str, path: Path) -> bool:
    """Whether a file is of a stage that has run, or what it would leave there again."""
    if context.stages.record(stage) is not None:
        return True
    if key_that_follows(context.stages, stage) is None:
        return False
    recorded = read_record(context.stages.root / stage)["checksums"]["files"]
    return agrees(path, recorded.get(source, {}))


def key_that_follows(stages: StageFolder, name: str) -> str | None:
    """Key of a stage that has run, or whose result follows from those that have.

    Parameters
    ----------
    stages : StageFolder
    name : str

    Returns
    -------
    str or None
        None if there is no result, or one of the stages that it was made from is another now.
    """
    record = stages.record(name)
    if record is not None:
        return record.key
    stored = read_record(stages.root / name)
    before = stored.get("after")
    if before is None or any(key_that_follows(stages, n) != key for n, key in before.items()):
        return None
    return str(stored["key"])


def _move(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    source.replace(target)


def _remove_empty(folder: Path) -> None:
    """Remove the folders below one that hold nothing, and it."""
    for each in sorted((folder, *folder.rglob("*")), reverse=True):
        if each.is_dir() and not any(each.iterdir()):
            each.rmdir()


def publish_records(context: Context, last: str, *, whole: bool) -> None:
    """Write how long the stages took, and with which options they ran.

    Parameters
    ----------
    context : Context
    last : str
        The stage that the run ended with.
    whole : bool
        Whether that is the last one there is.
    """
    notes = list(model_selection.sentences(context))
    if not whole:
        notes.append(
            f"Of a run up to the stage {last!r}: later results have options of their own."
        )
    with replacing(context.out / TIMINGS) as partial:
        partial.write_text(json.dumps(timings(context), indent=1) + "\n")
    with replacing(context.out / OPTIONS) as partial:
        write_toml(partial, context.asked_options, notes)
    folder = context.out / OUTDATED
    left = [p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()]
    if left:
        log.warning("%s: made from other stages than now: %s", folder, ", ".join(sorted(left)))


def published(context: Context) -> list[Path]:
    """Results of this run in the output folder; none that an earlier run has left there."""
    names = dict.fromkeys(
        target
        for stage, files in RESULTS.items()
        if context.stages.record(stage) is not None
        for target in files.values()
    )
    return [context.out / name for name in (*names, TIMINGS)]


def timings(context: Context) -> dict[str, Any]:
    """Time, memory, sizes and counts of every stage, with versions."""
    records = [plain(asdict(record)) for record in context.stages.records]
    return {
        "stages": records,
        "seconds": model_selection.total_seconds(context),
        "peak_bytes": max((record["peak_bytes"] for record in records), default=0),
        "workers": context.resources.workers,
        "max_memory": context.resources.max_memory,
        "versions": versions(),
    }
