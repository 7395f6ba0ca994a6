"""The command that corrects the calibration of a capture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from reflfield.cli.limits import working
from reflfield.cli.shared_options import EncodingOption, FollowLinks, Format, LayerOption, Out
from reflfield.util.terminal import say


def calibrate(
    capture: Annotated[Path, typer.Argument(help="Folder or description file of a capture.")],
    out: Out,
    cameras: Annotated[
        bool, typer.Option("--cameras", help="Correct poses of cameras by silhouettes.")
    ] = False,
    lights: Annotated[
        bool, typer.Option("--lights", help="Correct places of lights by a matt surface.")
    ] = False,
    color_checker: Annotated[
        Path | None,
        typer.Option(
            metavar="PHOTOGRAPH",
            help="Of a ColorChecker, taken as the capture was: white balance and matrix.",
        ),
    ] = None,
    link: Annotated[
        bool, typer.Option("--link", help="Link the photographs instead of copying them.")
    ] = False,
    format: Format = None,
    follow_links: FollowLinks = False,
    encoding: EncodingOption = None,
    layer: LayerOption = None,
) -> None:
    """Correct a calibration by what was photographed; writes the capture and calibration.json.

    What would gain nothing stays as it is described, and is said to.
    """
    from reflfield.api.capture_calibration import REPORT
    from reflfield.api.capture_calibration import calibrate as calibrate_capture

    with working():
        calibration = calibrate_capture(
            capture,
            out,
            cameras=cameras,
            lights=lights,
            color_checker=color_checker,
            link=link,
            format=format,
            encoding=encoding,
            layer=layer,
            follow_links=follow_links,
        )
    for line in calibration.lines():
        say(line)
    say(str(out))
    say(str(out / REPORT))
