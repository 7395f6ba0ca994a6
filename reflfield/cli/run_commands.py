"""The commands that reconstruct a field: ``demo`` and ``run``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from reflfield.cli.limits import GOES_ON, limits, working
from reflfield.cli.messages import say_results
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


def demo(
    out: Out = Path("demo"),
    workers: Workers = 0,
    max_memory: MaxMemory = "4GB",
) -> None:
    """Simulate a small dome of a vase, process it, and compare with held-out photographs."""
    from reflfield.demo import run_demo

    started = time.perf_counter()
    resources = limits(workers, max_memory)
    with working(GOES_ON):
        result = run_demo(out, resources)
    say_results(result, started)


def run(
    capture: CapturePath,
    out: Out,
    config: Config = None,
    set_: Settings = None,
    hold_out: HoldOutWords = "",
    size: Annotated[
        str, typer.Option(metavar="2MB", help="Of the field; the best field of that size.")
    ] = "",
    psnr: Annotated[
        float | None,
        typer.Option(
            metavar="DB",
            help="Of the field; the smallest that is as good. Status 3 if none is.",
        ),
    ] = None,
    preset: Preset = "standard",
    budget: Annotated[
        str,
        typer.Option(
            metavar="5min", help="The best preset that is expected to end in this time."
        ),
    ] = "",
    tradeoff: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Of a tradeoff of the capture: --budget takes from it."
        ),
    ] = None,
    from_: Annotated[
        str | None, typer.Option("--from", metavar="STAGE", help="Compute again from here.")
    ] = None,
    until: Annotated[str, typer.Option(metavar="STAGE", help="Stop after this.")] = "report",
    workers: Workers = 0,
    max_memory: MaxMemory = "4GB",
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Of a dask cluster that computes the blocks."),
    ] = None,
    store: Annotated[
        str | None,
        typer.Option(metavar="URL", help="Folder or fsspec URL for the texels' samples."),
    ] = None,
    format: Format = None,
    follow_links: FollowLinks = False,
    encoding: EncodingOption = None,
    layer: LayerOption = None,
) -> None:
    """Make a relightable field of a capture, with a report.

    Status 0: done. 2: input cannot be used. 3: done, but --psnr is not reached. 130: Ctrl-C.
    """
    from reflfield.api.captures import open_capture
    from reflfield.api.reconstruction import read_options, reconstruct
    from reflfield.options import parse_hold_out, size_settings

    started = time.perf_counter()
    words = [*(set_ or []), *size_settings(size, psnr)]
    options = read_options(config, words, preset)  # what is wrong with them is said at once
    resources = limits(workers, max_memory, scheduler, store)
    held = parse_hold_out(hold_out)
    if scheduler is not None:  # whose workers run in folders of their own
        capture = capture.resolve()
    photographed = open_capture(
        *(capture, format),
        encoding=encoding,
        layer=layer,
        follow_links=follow_links,
        test_split=held.test,
    )
    options = read_options(config, words, preset, photographed)
    asked: dict[str, Any] = {"options": options, "hold_out": held, "resources": resources}
    with working(GOES_ON):
        asked["options"] = _within(budget, tradeoff, photographed, asked)
        result = reconstruct(photographed, out, **asked, from_stage=from_, until=until)
    say_results(result, started)


def _within(budget: str, tradeoff: Path | None, capture: Any, asked: dict[str, Any]) -> Any:
    """Options that end within a time, or those that were asked for without one."""
    from reflfield.api.tradeoffs import options_within
    from reflfield.errors import InputError
    from reflfield.options import parse_seconds

    if not budget:
        if tradeoff is not None:
            raise InputError("tradeoff: expected with a budget, received none; add --budget")
        return asked["options"]
    return options_within(parse_seconds(budget), capture, **asked, measured=tradeoff)
