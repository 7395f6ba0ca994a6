"""The command that makes masks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

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


def masks(
    capture: CapturePath,
    out: Out,
    backdrop: Annotated[
        list[str] | None,
        typer.Option(
            metavar="RRGGBB",
            help="Colour of the backdrop, hexadecimal sRGB; repeatable: cloth and table.",
        ),
    ] = None,
    clean_plate: Annotated[
        Path | None,
        typer.Option(help="Photograph without the object, or a folder with one of each view."),
    ] = None,
    rounds: Annotated[
        int, typer.Option(min=1, max=5, help="Times that hull and masks are made.")
    ] = 2,
    format: Format = None,
    follow_links: FollowLinks = False,
    encoding: EncodingOption = None,
    layer: LayerOption = None,
) -> None:
    """Make a mask of each view, each by the hull of all, with scores.

    Put the folder beside the photographs as `masks`, after a look at those with low scores.
    """
    from reflfield.api.masks import SCORES, make_masks
    from reflfield.geometry.open3d_library import load_open3d

    load_open3d()
    with showing_progress(NOTHING_LEFT):
        made = make_masks(
            capture,
            out,
            backdrop=backdrop or (),
            clean_plate=clean_plate,
            rounds=rounds,
            format=format,
            encoding=encoding,
            layer=layer,
            follow_links=follow_links,
        )
    for mask in sorted(made, key=lambda mask: mask.score):
        if mask.is_doubtful:
            say(f"look at {mask.path}: overlap with the hull of the masks {mask.score:.2f}")
    scores = sorted(mask.score for mask in made)
    say(
        f"{len(made)} masks, least overlap {scores[0]:.2f}, median {scores[len(made) // 2]:.2f}"
    )
    say(str(out / SCORES))
