"""The command that calibrates lights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from reflfield.cli.limits import NOTHING_LEFT
from reflfield.cli.shared_options import EncodingOption, LayerOption, Out
from reflfield.util.terminal import say, showing_progress


def lights(
    photographs: Annotated[
        list[Path],
        typer.Argument(help="Photographs of one view, one lamp each; or a folder of them."),
    ],
    out: Out,
    sphere: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,R|auto",
            help="Outline of a mirror or glossy sphere, pixels; repeatable: two spheres tell "
            "positions. 'auto' looks for it.",
        ),
    ] = None,
    matt_sphere: Annotated[
        str | None,
        typer.Option(metavar="X,Y,R", help="Outline of a matt sphere: intensities."),
    ] = None,
    grey_card: Annotated[
        str | None,
        typer.Option(metavar="X0,Y0,X1,Y1", help="Box in a grey card, pixels: intensities."),
    ] = None,
    radius: Annotated[float, typer.Option(help="Of the spheres; the unit of positions.")] = 1.0,
    focal: Annotated[
        float | None,
        typer.Option(help="Focal length, pixels; absent: a long lens, parallel rays."),
    ] = None,
    encoding: EncodingOption = None,
    layer: LayerOption = None,
) -> None:
    """Find lights by their reflections in spheres; writes lights.csv and lights.lp.

    Axes: x right, y up in the image, z to the camera.
    """
    from reflfield.api.light_calibration import light_references, lights_of_photographs
    from reflfield.calibration.reference_lights import write_lights

    references = light_references(
        sphere or [], matt_sphere, grey_card, radius=radius, focal=focal
    )
    with showing_progress(NOTHING_LEFT):
        calibrated, used = lights_of_photographs(
            photographs, references, encoding=encoding, layer=layer
        )
    for circle in used.spheres:
        say(f"sphere {circle.x:.1f},{circle.y:.1f},{circle.radius:.1f}")
    for light in calibrated:
        say(light.line())
    for path in write_lights(out, calibrated):
        say(str(path))
