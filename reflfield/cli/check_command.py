"""The command that checks a capture."""

from __future__ import annotations

import time

import typer

from reflfield.cli.limits import NOTHING_LEFT
from reflfield.cli.shared_options import (
    CapturePath,
    EncodingOption,
    FollowLinks,
    Format,
    LayerOption,
    Out,
)
from reflfield.util.terminal import say, showing_progress

# Exit status by the severity of the gravest finding.
STATUS = {"": 0, "note": 0, "warning": 1, "error": 2}
# Findings of one kind that are said one by one; the report has all.
MOST_SAID = 5


def check(
    capture: CapturePath,
    out: Out,
    format: Format = None,
    follow_links: FollowLinks = False,
    encoding: EncodingOption = None,
    layer: LayerOption = None,
) -> None:
    """Say what is wrong with a capture, before anything is made of it, with a report.

    Status 0: nothing, or notes alone. 1: warnings. 2: errors, or input that cannot be used.
    """
    from reflfield.api.checks import check as check_path
    from reflfield.geometry.open3d_library import load_open3d

    started = time.perf_counter()
    load_open3d()
    with showing_progress(NOTHING_LEFT):
        findings = check_path(
            capture,
            out,
            format=format,
            encoding=encoding,
            layer=layer,
            follow_links=follow_links,
        )
    said: dict[str, int] = {}
    for finding in findings.all:
        said[finding.kind] = said.get(finding.kind, 0) + 1
        if said[finding.kind] <= MOST_SAID:
            say(finding.line())
    for kind, count in said.items():
        if count > MOST_SAID:
            say(f"{kind}: {count - MOST_SAID} more")
    counts = ", ".join(f"{s}s: {findings.count(s)}" for s in ("error", "warning", "note"))
    say(f"{counts} in {time.perf_counter() - started:.1f} s")
    say(str(out / "index.html"))
    say(str(out / "check.json"))
    raise typer.Exit(STATUS[findings.worst])
