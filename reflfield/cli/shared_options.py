"""Options that several commands share."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer


def results_folder(name: str | Path) -> Path:
    """Folder of a name; none and the root come of a variable of the shell that is not set."""
    whole = Path(os.path.normpath(Path.cwd() / name))
    if not str(name).strip() or whole == whole.parent:
        raise typer.BadParameter(f"expected a folder for results, received {str(name)!r}")
    return Path(name)


Out = Annotated[
    Path,
    typer.Option(
        "-o", "--out", metavar="FOLDER", parser=results_folder, help="Folder for the results."
    ),
]
Format = Annotated[
    str | None,
    typer.Option(help="Such as colmap; detected by content if absent."),
]
FollowLinks = Annotated[
    bool,
    typer.Option("--follow-links", help="Read files that symbolic links lead to elsewhere."),
]
EncodingOption = Annotated[
    str | None,
    typer.Option(
        metavar="linear|srgb|gamma=N|PAIRS.csv",
        help="Of the photographs, instead of what the files say.",
    ),
]
LayerOption = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Layer, part or page of the photographs' files."),
]
Workers = Annotated[int, typer.Option(help="Threads; 0 takes one per core.")]
MaxMemory = Annotated[str, typer.Option(help="Ceiling of resident memory.")]
RaysPerPixel = Annotated[int, typer.Option(help="A square number.")]
CapturePath = Annotated[Path, typer.Argument(help="Folder or description file of a capture.")]
Config = Annotated[Path | None, typer.Option(help="Options in TOML.")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="stage.option=value", help="One option; repeatable."),
]
Preset = Annotated[
    str,
    typer.Option(
        metavar="preview|standard|best",
        help="Options from measured fronts; --config and --set change them.",
    ),
]
HoldOutWords = Annotated[
    str,
    typer.Option(
        metavar="views=K,lights=K",
        help="Kept for comparison; or views=K,light-cone=25deg, or photographs=K, or test: "
        "the capture's test split.",
    ),
]
