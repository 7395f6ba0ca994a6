"""The command ``reflfield``: parse, call the library, say what was made."""

from __future__ import annotations

import logging
import sys
from typing import Annotated, NoReturn

import typer

from reflfield import __version__
from reflfield.cli.calibrate_command import calibrate
from reflfield.cli.capture_commands import convert, inspect
from reflfield.cli.check_command import check
from reflfield.cli.field_commands import compare, export, relight, view
from reflfield.cli.lights_command import lights
from reflfield.cli.masks_command import masks
from reflfield.cli.reproduce_command import reproduce
from reflfield.cli.run_commands import demo, run
from reflfield.cli.tradeoff_commands import plan, tradeoff
from reflfield.errors import ReflfieldError
from reflfield.flags import current_flags, with_flags
from reflfield.util.interrupts import ending_on_signals
from reflfield.util.terminal import say, say_error, system_words

# The libraries that do the work take seconds to import: commands import what they need,
# so that --help and wrong arguments answer at once.

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Dome photographs to relightable objects.",
)
# In the order of --help.
for command in (
    *(demo, run, plan, tradeoff, relight, compare, view, export, inspect, convert, check),
    *(lights, masks, calibrate, reproduce),
):
    app.command()(command)
LONGEST_MESSAGE = 1600
LESS_MEMORY = "end other programs, or lower --workers and --max-memory"


def main() -> None:
    """Entry point: input that cannot be used ends with one message and status 2."""
    notes, handler = logging.getLogger("reflfield"), Notes()
    notes.addHandler(handler)
    notes.propagate = False
    try:
        with ending_on_signals():
            app(args=list(current_flags(sys.argv[1:], say_error)))
    except ReflfieldError as error:
        fail(with_flags(str(error)), error)
    except OSError as error:  # a folder that cannot be written, a full disk
        fail(system_words(error), error)
    except MemoryError as error:
        fail(f"memory: expected more than is free ({error or 'none'}); {LESS_MEMORY}", error)
    finally:
        notes.removeHandler(handler)
        notes.propagate = True


class Notes(logging.Handler):
    """Says what the library notes on the way, such as what it does not use of an input."""

    def emit(self, record: logging.LogRecord) -> None:
        """Say one note."""
        say_error(f"reflfield: note: {with_flags(record.getMessage())}")


def fail(message: str, error: Exception) -> NoReturn:
    """Say what is wrong, and what was noted on the error, and end with status 2."""
    notes = getattr(error, "__notes__", ())
    whole = "; ".join([message, *notes])
    if len(whole) > LONGEST_MESSAGE:  # arguments and names are quoted in it
        whole = f"{whole[: LONGEST_MESSAGE // 2]} ... {whole[-LONGEST_MESSAGE // 4 :]}"
    say_error(f"reflfield: error: {whole}")
    sys.exit(2)


@app.callback(invoke_without_command=True)
def version_option(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Dome photographs to relightable objects."""
    if version:
        say(f"reflfield {__version__}")
        raise typer.Exit
