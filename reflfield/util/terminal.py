"""What commands say: results, errors, and the progress of work with the time left."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from reflfield.util.interrupts import Stopped, leaving_work_in_order
from reflfield.util.progress import ProgressLines, listening
from reflfield.util.quoting import printable

errors = Console(stderr=True, highlight=False)


@contextmanager
def showing_progress(if_interrupted: str = "nothing half-written is left") -> Iterator[None]:
    """Show the progress of all work inside the block, with the time left.

    On a terminal as bars, else as a line now and then. Ctrl-C ends with status 130, a request
    to terminate with 143.
    """
    try:
        shown = bars() if errors.is_terminal else listening(ProgressLines(say_error))
        with leaving_work_in_order(), shown:
            yield
    except Stopped as signal:
        say_error(f"reflfield: {signal.word}; {if_interrupted}")
        raise typer.Exit(signal.status) from None


@contextmanager
def bars() -> Iterator[None]:
    """Progress bars on the terminal."""
    columns = (
        TextColumn("{task.description:<38}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=errors) as shown:
        tasks: dict[str, TaskID] = {}

        def listen(description: str, done: int, total: int) -> None:
            if done == 0 or description not in tasks:
                if description in tasks:
                    shown.remove_task(tasks[description])
                tasks[description] = shown.add_task(description, total=total)
            shown.update(tasks[description], completed=done, total=total)

        with listening(listen):
            yield


def say_error(line: str) -> None:
    """One line on standard error, with what cannot be printed escaped."""
    errors.print(printable(line), markup=False, soft_wrap=True)


def say(line: str) -> None:
    """One line of result on standard output, with what cannot be printed escaped."""
    try:
        print(printable(line), flush=True)
    except BrokenPipeError:  # the reader has what it wanted
        raise
    except OSError as error:
        error.filename = "standard output"
        raise


def system_words(error: OSError) -> str:
    """What the system says, and of which file; where it names none, of the working folder."""
    named = str(error.filename or Path.cwd())
    if error.filename2:
        named = f"{named}, {error.filename2}"
    return f"{named}: {error.strerror or error}"
