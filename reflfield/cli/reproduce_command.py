"""The command that makes the paper's tables and figures anew."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from reflfield.cli.limits import GOES_ON, n_workers, working
from reflfield.cli.shared_options import Out, Workers
from reflfield.util.terminal import say


def reproduce(
    out: Out,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PART",
            help="table1, table2, figures4-6, figures7-8 or figures9-10; repeatable.",
        ),
    ] = None,
    felt: Annotated[
        Path | None,
        typer.Option(help="Folder ubo2014_felt05: Figures 7 and 8 on measured data, too."),
    ] = None,
    directions: Annotated[
        int, typer.Option(help="Cameras and lamps of Figures 9 and 10; the paper has 151.")
    ] = 32,
    pixels: Annotated[
        int, typer.Option(help="Side of the photographs of Figures 9 and 10.")
    ] = 96,
    workers: Workers = 0,
) -> None:
    """Make the paper's Tables 1 and 2 and Figures 4 to 10 anew, beside the paper's figures."""
    from reflfield.reproduction import reproduce as reproducing

    started = time.perf_counter()
    with working(GOES_ON):
        wanted = reproducing.Reproduction(
            felt=felt,
            n_directions=directions,
            photograph_side=pixels,
            workers=n_workers(workers),
        )
        command = reproducing.command_of(out, wanted)
        page = reproducing.reproduce(out, wanted, only or (), command)
    say(f"done in {time.perf_counter() - started:.0f} s")
    say(str(page))
