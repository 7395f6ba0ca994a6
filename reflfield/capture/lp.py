"""Reader of ``.lp`` light files: one fixed view under many distant lights (RTI).

Line 1 holds the number of photographs; each further line a file name (which may hold spaces)
and the direction towards its light: x right, y up in the image, z towards the camera, with
decimal points or commas. Folders get lost, and paths come from other computers: the longest
end of a path that names a file beside the description counts.

The directions' frame is taken as the world. Nothing is known of the camera, so it is
orthographic, its image 1 m wide and centred on the world's origin; the base geometry is the
image plane.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import PLANE, Capture, Exposure, Photograph
from reflfield.capture.documents import check_counts, parse_count, parse_number, read_text
from reflfield.capture.image_files import image_size
from reflfield.capture.lights import LARGEST_COORDINATE, Light
from reflfield.capture.names import unique_names
from reflfield.capture.paths import NamedFiles
from reflfield.errors import CaptureError
from reflfield.util.quoting import printable, quoted

SUFFIX = ".lp"
IMAGE_WIDTH = 1.0  # metres
# Lights all lower than this (a sine) over the image plane light nothing evenly: their numbers
# mean something else.
LOWEST = 0.05
MOST_BEHIND = 0.25  # share of the lights with z <= 0 that may be slips or nearly level
CAMERA_HEIGHT = 10.0  # metres above the plane; only a sign for an orthographic camera


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
    root, files = description.parent, NamedFiles(description, follow_links=follow_links)
    lines = [line.strip() for line in read_text(description).splitlines() if line.strip()]
    if len(lines) < 2 or parse_count(lines[0]) != len(lines) - 1:
        raise CaptureError(
            f"{description}: expected the number of photographs in line 1 and as many lines, "
            f"received {quoted(lines[0][:80] if lines else '')} and {max(len(lines) - 1, 0)} "
            "lines"
        )
    check_counts(str(description), 1, len(lines) - 1, len(lines) - 1)
    parsed = [_parsed(line, description) for line in lines[1:]]
    paths = [files.path_by_last_parts(name) for name, _ in parsed]
    for (name, _), path in zip(parsed, paths, strict=True):
        _check_no_more_numbers(name, path, description)
    names = unique_names(paths, root)
    notes = _behind([direction for _, direction in parsed], description)
    lights = tuple(
        Light(f"l{i:04d}", "directional", direction=np.array(direction))
        for i, (_, direction) in enumerate(parsed)
    )
    return Capture(
        name=printable(root.resolve().name),
        root=root,
        cameras=(_camera(image_size(paths[0])),),
        lights=lights,
        photographs=tuple(
            Photograph(name, 0, i, (Exposure(path),))
            for i, (name, path) in enumerate(zip(names, paths, strict=True))
        ),
        base_geometry=PLANE,
        up=np.array([0.0, 1.0, 0.0]),
        format="lp",
        description=description,
        notes=notes,
    )


def _check_no_more_numbers(name: str, path: Path, description: Path) -> None:
    """Refuse lines that go on behind the direction, as with intensities."""
    words = name.split()
    if len(words) > 1 and parse_number(words[-1]) is not None and not path.exists():
        raise CaptureError(
            f"{description}: expected a file name and three numbers, light direction x y z, "
            f"received more numbers in the line of {quoted(name)}; leave the direction alone, "
            "or write capture.json, whose lights have an 'irradiance' each"
        )


def _behind(directions: list[list[float]], description: Path) -> tuple[str, ...]:
    """A note on lights behind the image plane; many of them are of another convention."""
    behind = sum(direction[2] <= 0 for direction in directions)
    if behind > MOST_BEHIND * len(directions):
        raise CaptureError(
            f"{description}: expected light directions (x right, y up, z towards the camera) "
            f"in front of the image, z > 0, received {behind} of {len(directions)} others; "
            "do they have another axis towards the camera, or are they angles?"
        )
    heights = [direction[2] / math.hypot(*direction) for direction in directions]
    if len(heights) > 1 and max(heights) < LOWEST:
        raise CaptureError(
            f"{description}: expected light directions x y z, z towards the camera, received "
            f"{len(directions)} that are all within {math.degrees(math.asin(LOWEST)):.0f} "
            "degrees of the image plane; are they angles?"
        )
    if not behind:
        return ()
    return (
        f"{description}: {behind} of {len(directions)} lights are behind the image plane "
        "(z <= 0); their photographs show nothing of it",
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


def _camera(size: tuple[int, int]) -> Camera:
    width, height = size
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = CAMERA_HEIGHT
    return Camera(
        id="view",
        kind="orthographic",
        width=width,
        height=height,
        fl_x=width / IMAGE_WIDTH,
        fl_y=width / IMAGE_WIDTH,
        cx=width / 2,
        cy=height / 2,
        camera_from_world=pose,
    )
