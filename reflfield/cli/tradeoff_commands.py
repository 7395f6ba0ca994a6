"""The commands on what accuracy costs: ``plan`` and ``tradeoff``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from reflfield.cli.limits import GOES_ON, limits, working
from reflfield.cli.shared_options import (
    CapturePath,
    Config,
    EncodingOption,
    FollowLinks,
    Format,
    HoldOutWords,
    LayerOption,
    MaxMemory,
    Out,
    Preset,
    Settings,
    Workers,
)
from reflfield.util.terminal import say


def plan(
    capture: CapturePath,
    config: Config = None,
    set_: Settings = None,
    preset: Preset = "standard",
    hold_out: HoldOutWords = "",
    workers: Workers = 0,
    max_memory: MaxMemory = "4GB",
    format: Format = None,
    follow_links: FollowLinks = False,
    encoding: EncodingOption = None,
    layer: LayerOption = None,
) -> None:
    """Say what a run will take of time, memory and disk, without running it."""
    from reflfield.api.reconstruction import read_options
    from reflfield.api.tradeoffs import plan as plan_capture
    from reflfield.options import parse_hold_out

    read_options(config, set_ or [], preset)  # what is wrong with them is said at once
    held, resources = parse_hold_out(hold_out), limits(workers, max_memory)
    photographed = _opened(capture, format, encoding, layer, follow_links, held.test)
    options = read_options(config, set_ or [], preset, photographed)
    with working():
        planned = plan_capture(
            photographed, hold_out=held, options=options, resources=resources
        )
    for line in planned.lines():
        say(line)


def tradeoff(
    capture: CapturePath,
    out: Out,
    budget: Annotated[
        str, typer.Option(metavar="20min", help="Time for all runs; without, all are made.")
    ] = "",
    stages: Annotated[
        str,
        typer.Option(
            metavar="hull,texture,...", help="Whose options are varied; default: all."
        ),
    ] = "",
    config: Config = None,
    set_: Settings = None,
    preset: Preset = "standard",
    hold_out: HoldOutWords = "",
    workers: Workers = 0,
    max_memory: MaxMemory = "4GB",
    format: Format = None,
    follow_links: FollowLinks = False,
    encoding: EncodingOption = None,
    layer: LayerOption = None,
) -> None:
    """Measure what accuracy costs in time on a capture: options varied, with a report.

    Photographs are kept apart twice: to choose settings on, and to report what was chosen.
    """
    from reflfield.api.reconstruction import read_options
    from reflfield.api.tradeoffs import measure_tradeoff
    from reflfield.options import parse_hold_out, parse_seconds

    asked: dict[str, Any] = {
        "budget": parse_seconds(budget) if budget else None,
        "stages": [name.strip() for name in stages.split(",") if name.strip()],
        "options": read_options(config, set_ or [], preset),
        "hold_out": parse_hold_out(hold_out),
        "resources": limits(workers, max_memory),
    }
    test = asked["hold_out"].test
    photographed = _opened(capture, format, encoding, layer, follow_links, test)
    asked["options"] = read_options(config, set_ or [], preset, photographed)
    with working(GOES_ON):
        measure_tradeoff(photographed, out, **asked, tell=say)
    say(str(out / "index.html"))
    say(str(out / "tradeoff.json"))


def _opened(
    capture: Path,
    format: str | None,
    encoding: str | None,
    layer: str | None,
    follow_links: bool,
    test_split: bool,
) -> Any:
    from reflfield.api.captures import open_capture

    return open_capture(
        *(capture, format),
        encoding=encoding,
        layer=layer,
        follow_links=follow_links,
        test_split=test_split,
    )
