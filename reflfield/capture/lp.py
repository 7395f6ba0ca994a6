"""Reader of ``.lp`` light files: one fixed view under many distant lights (RTI).

Line 1 holds the number of photographs; each further line a file name (which may hold spaces)
and the direction towards its light: x right, y up in the image, z towards the camera. That
frame is taken as the world. Nothing is known of the camera, so it is orthographic, its image
1 m wide and centred on the world's origin; the base geometry is the image plane.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from reflfield.capture.cameras import Camera
from reflfield.capture.documents import path_inside, read_text, unique_names
from reflfield.capture.images import image_size
from reflfield.capture.lights import Light
from reflfield.capture.model import PLANE, Capture, Exposure, Photograph
from reflfield.errors import CaptureError

SUFFIX = ".lp"
IMAGE_WIDTH = 1.0  # metres
CAMERA_HEIGHT = 10.0  # metres above the plane; only a sign for an orthographic camera

DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(e[+-]?\d+)?", re.IGNORECASE)


def read_lp(description: Path, *, image_width: float = IMAGE_WIDTH) -> Capture:
    """Read an RTI capture.

    Parameters
    ----------
    description : Path
        The ``.lp`` file.
    image_width : float
        Width of the photographs on the object, metres.

    Returns
    -------
    Capture
        One orthographic camera, one directional light of irradiance 1 per photograph.

    Raises
    ------
    CaptureError
        If the count and the lines disagree, a line is malformed, numbers have decimal
        commas, a direction is zero, or the first photograph is missing.
    """
    root = description.parent
    lines = [line.strip() for line in read_text(description).splitlines() if line.strip()]
    if len(lines) < 2 or not lines[0].isdigit() or int(lines[0]) != len(lines) - 1:
        raise CaptureError(
            f"{description}: expected the number of photographs in line 1 and as many lines, "
            f"received {lines[0][:80] if lines else ''!r} and {max(len(lines) - 1, 0)} lines"
        )
    parsed = [_parsed(line, description) for line in lines[1:]]
    paths = [_photograph_path(root, name, description) for name, _ in parsed]
    names = unique_names(paths, root)
    lights = tuple(
        Light(f"l{i:04d}", "directional", direction=np.array(direction))
        for i, (_, direction) in enumerate(parsed)
    )
    return Capture(
        name=root.resolve().name,
        root=root,
        cameras=(_camera(image_size(paths[0]), image_width),),
        lights=lights,
        photographs=tuple(
            Photograph(name, 0, i, (Exposure(path),))
            for i, (name, path) in enumerate(zip(names, paths, strict=True))
        ),
        base_geometry=PLANE,
        up=np.array([0.0, 1.0, 0.0]),
        format="lp",
        description=description,
    )


def _parsed(line: str, description: Path) -> tuple[str, list[float]]:
    """File name and direction of a line: the last three words are the direction."""
    words = line.split()
    if len(words) >= 4 and all(DECIMAL_COMMA.fullmatch(word) for word in words[-3:]):
        raise CaptureError(
            f"{description}: expected decimal points, received decimal commas in {line!r}; "
            "replace ',' by '.' in the numbers"
        )
    try:
        direction = [float(word) for word in words[-3:]]
    except ValueError:
        direction = []
    if len(words) < 4 or len(direction) != 3:
        raise CaptureError(
            f"{description}: expected a file name and three numbers, received {line[:200]!r}"
        )
    name = line.rsplit(maxsplit=3)[0]  # keeps repeated spaces within the name
    if not np.isfinite(direction).all() or np.linalg.norm(direction) < 1e-4:
        raise CaptureError(
            f"{description}: light direction of {name!r}: expected a finite vector that is not "
            f"zero, received {direction}"
        )
    return name, direction


def _photograph_path(root: Path, name: str, description: Path) -> Path:
    """The file as named, or of that base name beside the description (folders get lost)."""
    path = path_inside(root, name, description)
    beside = root / path.name
    return beside if not path.is_file() and beside.is_file() else path


def _camera(size: tuple[int, int], image_width: float) -> Camera:
    width, height = size
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = CAMERA_HEIGHT
    return Camera(
        id="view",
        kind="orthographic",
        width=width,
        height=height,
        fl_x=width / image_width,
        fl_y=width / image_width,
        cx=width / 2,
        cy=height / 2,
        camera_from_world=pose,
    )
