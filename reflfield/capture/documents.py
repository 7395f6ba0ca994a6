"""Description files: bounded reading, finite numbers, paths that stay inside."""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any, NoReturn

from reflfield.errors import CaptureError

# 151 x 151 frames of transforms.json, indented, are about 60 MB.
MAX_DOCUMENT_BYTES = 256 * 2**20

IMAGE_SUFFIXES = (".exr", ".png", ".jpg", ".jpeg", ".tif", ".tiff")


def read_text(path: Path) -> str:
    """Text of a description file.

    Raises
    ------
    CaptureError
        If the file is missing, too large, or not text. The message names it.
    """
    try:
        size = path.stat().st_size
        if size > MAX_DOCUMENT_BYTES:
            raise CaptureError(
                f"{path}: expected a description of at most {MAX_DOCUMENT_BYTES >> 20} MB, "
                f"received {size >> 20} MB; is this the right file?"
            )
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise CaptureError(
            f"{path}: expected a text file (UTF-8), received {_binary_kind(path)}"
        ) from error
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror or error})") from error


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file; NaN, infinities and numbers beyond double are refused.

    Raises
    ------
    CaptureError
        If the file cannot be read, is not JSON, or not an object.
    """
    text = read_text(path)
    try:
        document = json.loads(text, parse_constant=_refuse_constant, parse_float=_finite_float)
    except (ValueError, RecursionError) as error:
        raise CaptureError(f"{path}: expected JSON, received {error}") from error
    if not isinstance(document, dict):
        raise CaptureError(
            f"{path}: expected a JSON object, received {type(document).__name__}"
        )
    return document


def path_inside(root: Path, text: str, described_in: Path) -> Path:
    """The path of a file named in a description, which must lie inside its folder.

    Parameters
    ----------
    root : Path
        Folder of the description.
    text : str
        Relative path as written there.
    described_in : Path
        The description, named in messages.

    Returns
    -------
    Path
        ``root / text``. The file need not exist.

    Raises
    ------
    CaptureError
        If the path is absolute or leads outside, symbolic links followed.
    """
    try:
        path = root / text
        inside = path.resolve().is_relative_to(root.resolve())
    except (ValueError, OSError, RuntimeError) as error:
        raise CaptureError(
            f"{described_in}: {text!r} is not a usable path ({error})"
        ) from error
    if Path(text).is_absolute() or not inside:
        raise CaptureError(
            f"{described_in}: path {text!r} leaves the folder {root}; expected a relative path "
            "to a file inside it: copy the file there"
        )
    return path


def frame_name(path: Path) -> str:
    """File name without an image suffix; other dots stay.

    Examples
    --------
    >>> frame_name(Path("a/r_0.5.exr")), frame_name(Path("a/r_0.5"))
    ('r_0.5', 'r_0.5')
    """
    return path.stem if path.suffix.lower() in IMAGE_SUFFIXES else path.name


def unique_names(paths: list[Path], root: Path) -> list[str]:
    """A distinct name for each file: its stem, with folders in front where stems repeat.

    Examples
    --------
    >>> unique_names([Path("/c/a/1.exr"), Path("/c/b/1.exr"), Path("/c/2.exr")], Path("/c"))
    ['a_1', 'b_1', '2']
    """
    names = [frame_name(path) for path in paths]
    repeated = {name for name, count in Counter(names).items() if count > 1}
    taken: dict[str, int] = {}
    result = []
    for name, path in zip(names, paths, strict=True):
        if name in repeated:
            folder = path.parent.relative_to(root) if path.is_relative_to(root) else Path()
            name = "_".join([*folder.parts, name])
        count = taken.get(name, 0)
        taken[name] = count + 1
        result.append(f"{name}_{count}" if count else name)
    return result


def _refuse_constant(text: str) -> NoReturn:
    raise ValueError(f"the number {text}, which is not finite")


def _finite_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {text}, which is not finite")
    return value


def _binary_kind(path: Path) -> str:
    with path.open("rb") as file:
        magic = file.read(4)
    return "a zip archive; unpack it first" if magic[:2] == b"PK" else "a binary file"
