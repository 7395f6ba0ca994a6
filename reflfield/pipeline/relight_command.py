"""The command "relight": images of a field for the cameras and lights of a capture."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from reflfield.capture.capture import Capture
from reflfield.errors import InputError
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.render.relit_photographs import relight_photographs
from reflfield.render.renderer import RenderOptions
from reflfield.util.files import filling


def write_relit_frames(
    field: ReflectanceField, frames: Capture, out: Path, options: RenderOptions
) -> list[Path]:
    """Relight frames; all files, or none after an error.

    Parameters
    ----------
    field : ReflectanceField
    frames : Capture
        Whose photographs are not read, and need not be there.
    out : Path
        Gets NAME.exr and NAME.png of every frame.
    options : RenderOptions

    Returns
    -------
    list of Path
        The EXR files, in the order of the frames.

    Raises
    ------
    InputError
        If a frame cannot be relit, or a file of the frames would be replaced.
    """
    check_kept(frames, image_files(frames, out))
    with filling(out) as partial:
        made = [frame.exr for frame in relight_photographs(field, frames, partial, options)]
    return [out / path.name for path in made]


def check_kept(frames: Capture, written: Iterable[Path]) -> None:
    """Refuse to write over files that frames are read from.

    Raises
    ------
    InputError
        Naming the first of them.
    """
    read = {e.path.resolve() for p in frames.photographs for e in p.exposures}
    read |= {path.resolve() for path in frames.silhouettes if path is not None}
    read |= {light.file.resolve() for light in frames.lights if light.file is not None}
    for path in written:
        if Path(os.path.realpath(path)) in read:
            raise InputError(
                f"{path}: expected a folder for results where no file of the frames is "
                "replaced, received one with this file; choose another folder"
            )


def image_files(frames: Capture, folder: Path) -> list[Path]:
    """Return the files that a capture's images are written to."""
    names = [photograph.name for photograph in frames.photographs]
    return [folder / f"{name}.{kind}" for name in names for kind in ("exr", "png")]
