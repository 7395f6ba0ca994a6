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


def write_relit_photographs(
    field: ReflectanceField, capture: Capture, out: Path, options: RenderOptions
) -> list[Path]:
    """Relight photographs; all files, or none after an error.

    Parameters
    ----------
    field : ReflectanceField
    capture : Capture
        Whose photographs are not read, and need not be there.
    out : Path
        Gets NAME.exr and NAME.png of every photograph.
    options : RenderOptions

    Returns
    -------
    list of Path
        The EXR files, in the order of the photographs.

    Raises
    ------
    InputError
        If a photograph cannot be relit, or a file of the capture would be replaced.
    """
    check_kept(capture, image_files(capture, out))
    with filling(out) as partial:
        made = [image.exr for image in relight_photographs(field, capture, partial, options)]
    return [out / path.name for path in made]


def check_kept(capture: Capture, written: Iterable[Path]) -> None:
    """Refuse to write over files that a capture is read from.

    Raises
    ------
    InputError
        Naming the first of them.
    """
    read = {path.resolve() for p in capture.photographs for path in p.files}
    read |= {path.resolve() for path in capture.silhouettes if path is not None}
    read |= {light.file.resolve() for light in capture.lights if light.file is not None}
    for path in written:
        if Path(os.path.realpath(path)) in read:
            raise InputError(
                f"{path}: expected a folder for results where no file of the capture is "
                "replaced, received one with this file; choose another folder"
            )


def image_files(capture: Capture, folder: Path) -> list[Path]:
    """Return the files that a capture's images are written to."""
    names = [photograph.name for photograph in capture.photographs]
    return [folder / f"{name}.{kind}" for name in names for kind in ("exr", "png")]
