"""The command `capture-sim`."""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from capture_sim.dome import rig_presets
from capture_sim.effects.effect_registry import read_choice
from capture_sim.errors import SceneError, scene_error, shown
from capture_sim.inputs import memory_limit
from capture_sim.materials import material_presets
from capture_sim.memory import parse_bytes
from capture_sim.objects import object_presets
from capture_sim.open3d_library import load_open3d
from capture_sim.plan import plan as make_plan
from capture_sim.record import table_lines
from capture_sim.scene import Scene, load_scene, shipped_scenes
from capture_sim.transforms import FOLDER, described
from capture_sim.write import MOST_WORKERS, write_capture

app = typer.Typer(
    help="Simulate photographs of an object in a dome of cameras and lights.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

SceneArgument = Annotated[
    str, typer.Argument(metavar="SCENE", help="A TOML file, or the name of a shipped scene.")
]

EffectsOption = Annotated[
    str | None,
    typer.Option(
        "--effects", metavar="CHOICE", help="auto, all, none or names with commas between."
    ),
]


MemoryOption = Annotated[
    str, typer.Option(metavar="SIZE", help="Ceiling of resident memory, such as 800MB.")
]


def _loaded(scene: str, effects: str | None) -> Scene:
    """Scene with the choice of effects of the command line, if there is one."""
    loaded = load_scene(scene)
    if effects is None:
        return loaded
    word = effects if effects in ("auto", "all", "none") else effects.split(",")
    choice = replace(loaded.effects, simulate=read_choice("--effects", word), forced={})
    return replace(loaded, effects=choice)


@app.command()
def render(
    scene: SceneArgument,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the capture.")],
    workers: Annotated[
        int, typer.Option(min=1, max=MOST_WORKERS, help="Views rendered at the same time.")
    ] = min(os.cpu_count() or 1, 8),
    max_memory: MemoryOption = "4GB",
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier capture in the folder.")
    ] = False,
    effects: EffectsOption = None,
    contributions: Annotated[
        int,
        typer.Option(
            min=0, max=4096, help="Photographs to write each effect's contribution for."
        ),
    ] = 0,
    as_: Annotated[
        str | None,
        typer.Option(
            "--as",
            metavar="transforms",
            help="Add the splits that radiance-field software reads.",
        ),
    ] = None,
) -> None:
    """Simulate a capture: photographs, silhouettes, calibration and truth."""
    if as_ not in (None, FOLDER):
        raise scene_error("--as", FOLDER, as_, "leave it out for the native format alone")
    ceiling = parse_bytes(max_memory)
    with _interruptible("the same command goes on from here"), memory_limit(ceiling):
        loaded = _loaded(scene, effects)
        for note in loaded.mesh.notes:
            print(f"capture-sim: repaired {shown(note)}", file=sys.stderr)
        with _progress_bar() as bar:
            write_capture(
                loaded,
                output,
                workers=workers,
                max_memory=ceiling,
                overwrite=overwrite,
                n_contributions=contributions,
                as_transforms=as_ is not None,
                progress=_shown_by(bar),
            )
    splits = described(output) if as_ else ()
    for line in [*table_lines(output), f"Wrote {output}", *splits]:
        _console().print(line, highlight=False, soft_wrap=True, markup=False)


@app.command()
def plan(
    scene: SceneArgument, max_memory: MemoryOption = "4GB", effects: EffectsOption = None
) -> None:
    """Show what would be simulated, why, and its cost, without doing it."""
    ceiling = parse_bytes(max_memory)
    with _interruptible("nothing was written"), memory_limit(ceiling):
        lines = make_plan(_loaded(scene, effects), max_memory=ceiling).lines()
    for line in lines:
        _console().print(line, highlight=False, soft_wrap=True, markup=False)


@app.command()
def presets() -> None:
    """List the rigs, objects, materials and scenes that scene files can name."""
    for title, entries in (
        ("scenes", shipped_scenes()),
        ("objects", object_presets()),
        ("materials", material_presets()),
        ("rigs", rig_presets()),
    ):
        _console().print(_preset_table(title, entries))


def _preset_table(title: str, entries: Mapping[str, Any]) -> Table:
    table = Table(title=title, title_justify="left", show_header=False, box=None)
    for name, entry in entries.items():
        table.add_row(name, entry if isinstance(entry, str) else _one_line(entry))
    return table


def _one_line(preset: Mapping[str, Any]) -> str:
    """The plain settings of a preset; nested tables by their keys."""
    return ", ".join(
        f"{key} = ..." if isinstance(value, dict) else f"{key} = {value}"
        for key, value in preset.items()
        if not (isinstance(value, list) and value and isinstance(value[0], dict))
    )


def _progress_bar() -> Progress:
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


def _shown_by(bar: Progress) -> Callable[[int, int], None]:
    """Report that begins where an earlier call stopped, so that the time left is right."""
    tasks: list[TaskID] = []

    def report(done: int, total: int) -> None:
        if tasks:
            bar.update(tasks[0], completed=done)
        else:
            tasks.append(bar.add_task("photographs", completed=done, total=total))

    return report


def _console() -> Console:
    return Console()


def main() -> None:
    """Run the command; scenes and files that cannot be used end with status 2."""
    notes, handler = logging.getLogger("capture_sim"), Notes()
    notes.addHandler(handler)
    notes.propagate = False
    try:
        app()
    except SceneError as error:
        _fail(str(error))
    except OSError as error:  # a folder that cannot be written, a full disk
        _fail(f"{error.filename or 'system'}: {error.strerror or error}")
    except MemoryError:
        _fail("system: expected more memory, received none; lower --max-memory or --workers")
    finally:
        notes.removeHandler(handler)
        notes.propagate = True


class Notes(logging.Handler):
    """Says what the simulator notes on the way, such as an old name in a scene."""

    def emit(self, record: logging.LogRecord) -> None:
        """Say one note on one line."""
        print(f"capture-sim: note: {shown(record.getMessage())}", file=sys.stderr)


def _fail(message: str) -> NoReturn:
    """Say what is wrong on one line and end with status 2."""
    print(f"capture-sim: {shown(message)}", file=sys.stderr)
    sys.exit(2)


@contextmanager
def _interruptible(left: str) -> Iterator[None]:
    """End with status 130 and one line after Ctrl-C, once what was begun is in order."""
    load_open3d()  # before: libraries that are being imported may turn what is raised into more
    before = signal.getsignal(signal.SIGINT)
    try:
        if before is not signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        yield
    except KeyboardInterrupt:
        print(f"capture-sim: interrupted; {left}", file=sys.stderr)
        sys.exit(130)
    finally:
        signal.signal(signal.SIGINT, before)
