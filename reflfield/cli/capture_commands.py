"""The commands that read a capture and make nothing of it: ``inspect`` and ``convert``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from reflfield.cli.limits import working
from reflfield.cli.shared_options import (
    CapturePath,
    EncodingOption,
    FollowLinks,
    Format,
    LayerOption,
    MaxMemory,
    Out,
)
from reflfield.util.terminal import say


def inspect(
    path: Annotated[Path, typer.Argument(help="A capture or a field.rfld.")],
    max_memory: MaxMemory = "4GB",
    format: Format = None,
    follow_links: FollowLinks = False,
    encoding: EncodingOption = None,
    layer: LayerOption = None,
) -> None:
    """Say what a capture or a field holds."""
    from reflfield.options import parse_bytes

    most_bytes = parse_bytes(max_memory)
    if path.suffix.lower() == ".rfld":
        from reflfield.api.fields import open_field

        lines = open_field(path, max_memory=most_bytes).describe()
    else:
        from reflfield.api.captures import describe_capture, open_capture

        opened = open_capture(
            path, format, encoding=encoding, layer=layer, follow_links=follow_links
        )
        lines = describe_capture(opened)
    for line in lines:
        say(line)


def convert(
    capture: CapturePath,
    out: Out,
    to: Annotated[
        str, typer.Option(metavar="native|transforms|colmap", help="Format to write.")
    ] = "native",
    link: Annotated[
        bool, typer.Option("--link", help="Link the photographs instead of copying them.")
    ] = False,
    format: Format = None,
    follow_links: FollowLinks = False,
    encoding: EncodingOption = None,
    layer: LayerOption = None,
) -> None:
    """Write a capture, or a .btf, in another format; what that cannot say is refused."""
    from reflfield.api.captures import open_capture
    from reflfield.capture.btf_means import holds_btf
    from reflfield.capture.conversion import convert_btf, convert_capture

    if to == "native" and holds_btf(capture):
        with working():
            say(f"{convert_btf(capture, out)} images in {out}")
        return
    opened = open_capture(
        capture, format, encoding=encoding, layer=layer, follow_links=follow_links
    )
    written = convert_capture(opened, out, to, link=link)
    say(f"{len(opened.photographs)} photographs, {len(written)} files in {out}")
