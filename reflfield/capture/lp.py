"""Reader of ``.lp`` light files: one fixed view under many distant lights (RTI).

Line 1 holds the number of photographs; each further line a file name (which may hold spaces)
and the direction towards its light: x right, y up in the image, z towards the camera, with
decimal points or commas. Folders get lost, and paths come from other computers: the longest
end of a path that names a file beside the description counts, else the file of that name in one
of the folders there.

The directions' frame is taken as the world. Nothing is known of the camera, so it is
orthographic, its image 1 m wide and centred on the world's origin; the base geometry is the
image plane.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reflfield.capture.capture import Capture
from reflfield.capture.documents import check_counts, parse_count, parse_number, read_text
from reflfield.capture.fixed_view import (
    FixedView,
    dark_beside,
    fixed_view_capture,
    notes_on_lengths,
    notes_on_lights_behind,
    orthographic_camera,
)
from reflfield.capture.image_files import image_size
from reflfield.capture.lights import LARGEST_COORDINATE, Light
from reflfield.capture.paths import NamedFiles
from reflfield.errors import CaptureError
from reflfield.util.quoting import quoted

SUFFIX = ".lp"


def read_lp(description: Path, *, follow_links: bool = False) -> Capture:
    """Read an RTI capture.

    Parameters
    ----------
    description : Path
        The ``.lp`` file.
    follow_links : bool
        Whether symbolic links may lead out of its folder.

    Returns
    -------
    Capture
        One orthographic camera, one directional light of irradiance 1 per photograph.

    Raises
    ------
    CaptureError
        If the count and the lines disagree, a line is malformed, a direction is zero, or
        the first photograph is missing.
    """
    files = NamedFiles(description, follow_links=follow_links)
    lines = [line.strip() for line in read_text(description).splitlines() if line.strip()]
    if len(lines) < 2 or parse_count(lines[0]) != len(lines) - 1:
        raise CaptureError(
            f"{description}: expected the number of photographs in line 1 and as many lines, "
            f"received {quoted(lines[0][:80] if lines else '')} and {max(len(lines) - 1, 0)} "
            "lines"
        )
    check_counts(str(description), 1, len(lines) - 1, len(lines) - 1)
    parsed = [_parsed(line, description) for line in lines[1:]]
    paths = [_photograph(name, files) for name, _ in parsed]
    for (name, _), path in zip(parsed, paths, strict=True):
        _check_no_more_numbers(name, path, description)
    lights = [
        Light("l", "directional", direction=np.array(direction)) for _, direction in parsed
    ]
    directions = [direction for _, direction in parsed]
    notes = (
        *notes_on_lights_behind(directions, description),
        *notes_on_lengths(directions, description),
    )
    return fixed_view_capture(
        FixedView(tuple(paths), None, dark_beside(paths[0].parent, files, paths)),
        lights,
        files,
        camera=orthographic_camera(image_size(paths[0])),
        format="lp",
        notes=notes,
    )


def _photograph(name: str, files: NamedFiles) -> Path:
    """File of a line; where it lacks its folder, in the one folder here that holds it."""
    path = files.path_by_last_parts(name)
    if path.is_file():
        return path
    last = name.replace("\\", "/").rpartition("/")[2]
    folders = sorted(folder.name for folder in files.root.iterdir() if folder.is_dir())
    paths = [files.path(f"{folder}/{last}") for folder in folders if last not in ("", "..")]
    present = [path for path in paths if path.is_file()]
    if len(present) > 1:
        raise CaptureError(
            f"{files.description}: photograph {quoted(name)}: expected it in one folder, "
            f"received {present[0]} and {present[1]}; write the folder before the name"
        )
    return present[0] if present else path


def _check_no_more_numbers(name: str, path: Path, description: Path) -> None:
    """Refuse lines that go on behind the direction, as with intensities."""
    words = name.split()
    if len(words) > 1 and parse_number(words[-1]) is not None and not path.exists():
        raise CaptureError(
            f"{description}: expected a file name and three numbers, light direction x y z, "
            f"received more numbers in the line of {quoted(name)}; leave the direction alone, "
            "or write capture.json, whose lights have an 'irradiance' each"
        )


def _parsed(line: str, description: Path) -> tuple[str, list[float]]:
    """File name and direction of a line: the last three words are the direction."""
    words = line.split()
    direction = [parse_number(word) for word in words[-3:]]
    if len(words) < 4 or None in direction:
        raise CaptureError(
            f"{description}: expected a file name and three finite numbers, light direction x "
            f"y z, received {quoted(line)}"
        )
    name = line.rsplit(maxsplit=3)[0]  # keeps repeated spaces within the name
    numbers = [float(component or 0.0) for component in direction]
    if np.abs(numbers).max() > LARGEST_COORDINATE or np.linalg.norm(numbers) < 1e-4:
        raise CaptureError(
            f"{description}: light direction of {quoted(name)}: expected a vector that is not "
            f"zero, of at most {LARGEST_COORDINATE:g}, received {numbers}"
        )
    return name, numbers
