"""Reader of photometric stereo sets: one view, and a list of directions to its lights.

``light_directions.txt`` (DiLiGenT, PSBox) holds a row of three numbers for each light, or three
rows; ``lights.txt`` the same, with the number of lights in its first line. Directions are x
right, y up in the image, z towards the camera. Beside it may stand

* ``light_intensities.txt`` (three numbers or one for each light) or ``light_strength.txt``:
  irradiance of a surface that faces the light, by which DiLiGenT's photographs are divided;
* ``filenames.txt``: the photographs, in the order of the lights. Without it they are the images
  in this folder, or in one of its folders, in the order of their names.

PNG files that state no colour are taken as linear, as the programs of these sets take them.
A list may also serve several folders of photographs: each of them is opened as one capture.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.capture.described_items import described_light
from reflfield.capture.documents import (
    LARGEST_COORDINATE,
    check_counts,
    parse_number,
    read_text,
)
from reflfield.capture.fixed_view import (
    FixedView,
    dark_beside,
    fixed_view_capture,
    linear_unless_stated,
    mask_beside,
    notes_on_lights_behind,
    orthographic_camera,
    photographs_beside,
)
from reflfield.capture.image_files import image_size
from reflfield.capture.names import IMAGE_SUFFIXES
from reflfield.capture.paths import NamedFiles
from reflfield.errors import CaptureError
from reflfield.util.quoting import quoted

Array = NDArray[np.float64]

DIRECTIONS, LIGHTS = "light_directions.txt", "lights.txt"
INTENSITIES = ("light_intensities.txt", "light_strength.txt")
FILE_NAMES = "filenames.txt"
# The list of a folder of photographs may stand above it.
PATTERNS = (DIRECTIONS, LIGHTS, f"../{DIRECTIONS}", f"../{LIGHTS}")
_UNIT_TOLERANCE = 0.05


def is_light_list(path: Path) -> bool:
    """Whether a file is a list of lights; one above counts for a folder with photographs."""
    if not path.is_file():
        return False
    if path.parent.name != "..":
        return True
    folder = path.parent.parent
    own = any((folder / name).is_file() for name in (DIRECTIONS, LIGHTS))
    return not own and any(f.suffix.lower() in IMAGE_SUFFIXES for f in folder.iterdir())


def read_light_list(description: Path, *, follow_links: bool = False) -> Capture:
    """Read a photometric stereo set.

    Parameters
    ----------
    description : Path
        ``light_directions.txt`` or ``lights.txt``.
    follow_links : bool
        Whether symbolic links may lead out of its folder.

    Returns
    -------
    Capture
        One orthographic camera, one directional light for each photograph.

    Raises
    ------
    CaptureError
        If a file is malformed, or counts of lights, intensities and photographs differ.
    """
    folder = description.parent
    folder = folder.parent if folder.name == ".." else folder
    files = NamedFiles(description, follow_links=follow_links, root=folder)
    directions = directions_of(description)
    intensities, source = intensities_beside(description.parent, len(directions))
    view = listed_view(files, len(directions))
    lights = [
        described_light(f"{description}: light {i}", "directional", direction=d, intensity=e)
        for i, (d, e) in enumerate(zip(directions, intensities, strict=True))
    ]
    reading = linear_unless_stated(view.photographs[0])
    linear = ", files taken as linear" if reading.encoding else ""
    return fixed_view_capture(
        view,
        lights,
        files,
        camera=orthographic_camera(image_size(view.photographs[0])),
        format="lights",
        details=[
            f"directions of {description}, irradiances {source or 'all 1'}{linear}",
            f"photographs in {view.photographs[0].parent}, {view.photographs[0].name} first",
        ],
        notes=notes_on_lights_behind(directions.tolist(), description),
        reading=reading,
    )


def listed_view(files: NamedFiles, n_lights: int) -> FixedView:
    """Photographs that ``filenames.txt`` names, or those beside the description."""
    path = files.root / FILE_NAMES
    if not path.is_file():
        return photographs_beside(files.description, files, n_lights)
    names = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    if len(names) != n_lights:
        raise CaptureError(
            f"{path}: expected {n_lights} names, one for each light, received {len(names)}"
        )
    photographs = tuple(files.path(name) for name in names)
    if not photographs[0].is_file():
        raise CaptureError(f"{photographs[0]}: photograph missing, which {path} names first")
    return FixedView(
        photographs,
        mask_beside(files.root, files),
        dark_beside(photographs[0].parent, files, photographs),
    )


def directions_of(path: Path) -> Array:
    """Directions (n, 3) of a list that has them as rows or as columns.

    Raises
    ------
    CaptureError
        If there are no three numbers for each light, or a direction is zero.
    """
    rows = _numbers(path)
    if len(rows) > 1 and rows[0] == [len(rows) - 1]:
        rows = rows[1:]
    widths = {len(row) for row in rows}
    if len(widths) != 1 or not (widths == {3} or len(rows) == 3):
        raise CaptureError(
            f"{path}: expected three numbers for each light, as rows or as three rows, "
            f"received {len(rows)} rows of {sorted(widths)} numbers"
        )
    array = np.array(rows, dtype=np.float64)
    if array.shape == (3, 3):
        array = _rows_or_columns(array, path)
    elif array.shape[1] != 3:
        array = array.T
    check_counts(str(path), 1, len(array), len(array))
    return array


def intensities_beside(folder: Path, n_lights: int) -> tuple[Array, str]:
    """Irradiances (n, 3), 1 where no file says them, and the name of the file.

    Raises
    ------
    CaptureError
        If the file holds another number of them.
    """
    path = next((folder / name for name in INTENSITIES if (folder / name).is_file()), None)
    if path is None:
        return np.ones((n_lights, 3)), ""
    values = np.array([value for row in _numbers(path) for value in row])
    if len(values) not in (n_lights, 3 * n_lights):
        raise CaptureError(
            f"{path}: expected one or three numbers for each of {n_lights} lights, received "
            f"{len(values)} numbers"
        )
    return np.broadcast_to(values.reshape(n_lights, -1), (n_lights, 3)), f"of {path}"


def _rows_or_columns(array: Array, path: Path) -> Array:
    """Three directions as rows, told by their length."""
    are_units = [
        bool((abs(np.linalg.norm(a, axis=1) - 1) < _UNIT_TOLERANCE).all())
        for a in (array, array.T)
    ]
    if are_units[0] == are_units[1]:
        raise CaptureError(
            f"{path}: expected three unit vectors, as rows or as columns, received numbers "
            "that do not tell which; write an .lp file"
        )
    return array if are_units[0] else array.T


def _numbers(path: Path) -> list[list[float]]:
    """Numbers of the lines of a text file."""
    rows = []
    for line in read_text(path).splitlines():
        words = line.replace(",", " ").split()
        numbers = [parse_number(word) for word in words]
        values = [number for number in numbers if number is not None]
        if len(values) < len(numbers) or any(abs(v) > LARGEST_COORDINATE for v in values):
            raise CaptureError(
                f"{path}: expected finite numbers, received the line {quoted(line)}"
            )
        if values:
            rows.append(values)
    return rows
