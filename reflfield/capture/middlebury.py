"""Reader of Middlebury multi-view stereo captures: ``*_par.txt`` beside the photographs.

Line 1 holds the number of images; each further line the image name, K and R row by row, and
t, with ``x_pixel ~ K [R | t] x_world``; ``#`` begins a comment. Their pixel centres are whole
numbers; ours lie at .5, so half a pixel is added to the principal point. The lighting was not
measured and moves with no camera: one unknown light.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera, not_rigid_because
from reflfield.capture.capture import Capture, usual_base_geometry
from reflfield.capture.documents import check_counts, parse_count, parse_number, read_text
from reflfield.capture.image_files import image_size
from reflfield.capture.lights import LARGEST_COORDINATE, Light
from reflfield.capture.names import frame_name, unique_names
from reflfield.capture.orientation import estimated_up
from reflfield.capture.paths import NamedFiles
from reflfield.capture.photographs import Exposure, Photograph
from reflfield.errors import CaptureError
from reflfield.util.quoting import printable, quoted

SUFFIX = "_par.txt"
N_NUMBERS = 21

# Skew of a sensor's axes, in pixels per pixel, that cannot be told from rounding.
LARGEST_SKEW = 1e-6


def read_middlebury(description: Path, *, follow_links: bool = False) -> Capture:
    """Read a Middlebury capture.

    Parameters
    ----------
    description : Path
        Its ``*_par.txt``.
    follow_links : bool
        Whether symbolic links may lead out of its folder.

    Returns
    -------
    Capture
        One camera and one photograph per line; image sizes come from the image headers.

    Raises
    ------
    CaptureError
        If the count and the lines disagree, a line is malformed, an image is missing, or
        a calibration is not one.
    """
    root, files = description.parent, NamedFiles(description, follow_links=follow_links)
    lines = uncommented(read_text(description))
    rows = lines[1:]
    if not rows or parse_count(" ".join(lines[0])) != len(rows):
        raise CaptureError(
            f"{description}: expected the number of images in line 1 and as many lines, "
            f"received {quoted(' '.join(lines[0]) if lines else '')} and {len(rows)} lines"
        )
    check_counts(str(description), len(rows), 1, len(rows))
    parsed = [_parsed(row, description) for row in rows]
    paths = [files.path(name) for name, _ in parsed]
    cameras = tuple(
        _camera(name, numbers, image_size(path), description)
        for (name, numbers), path in zip(parsed, paths, strict=True)
    )
    return Capture(
        name=printable(root.resolve().name),
        root=root,
        cameras=cameras,
        lights=(Light("constant", "unknown"),),
        photographs=tuple(
            Photograph(name, view, 0, (Exposure(path),))
            for view, (name, path) in enumerate(
                zip(unique_names(paths, root), paths, strict=True)
            )
        ),
        base_geometry=usual_base_geometry(len(cameras)),
        up=estimated_up(cameras),
        format="middlebury",
        description=description,
    )


def uncommented(text: str) -> list[list[str]]:
    r"""Words of the lines that are left without comments.

    Examples
    --------
    >>> uncommented("# two\n2 # images\n\na.png 1")
    [['2'], ['a.png', '1']]
    """
    lines = [line.split("#", 1)[0].split() for line in text.splitlines()]
    return [words for words in lines if words]


def _parsed(row: list[str], description: Path) -> tuple[str, NDArray[np.float64]]:
    """Image name and the 21 numbers of a line; names may hold spaces."""
    name = " ".join(row[:-N_NUMBERS])
    numbers = [parse_number(word) for word in row[-N_NUMBERS:]]
    if not name or None in numbers:
        raise CaptureError(
            f"{description}: expected an image name and {N_NUMBERS} finite numbers (K, R, t), "
            f"received {quoted(' '.join(row))}"
        )
    array = np.array(numbers, dtype=np.float64)
    if np.abs(array).max() > LARGEST_COORDINATE:
        raise CaptureError(
            f"{description}: camera {quoted(name)}: expected numbers of at most "
            f"{LARGEST_COORDINATE:g}, received {array.tolist()}"
        )
    return name, array


def _camera(
    name: str, numbers: NDArray[np.float64], size: tuple[int, int], description: Path
) -> Camera:
    intrinsic = numbers[:9].reshape(3, 3)
    lower = [intrinsic[1, 0], intrinsic[2, 0], intrinsic[2, 1]]
    if abs(np.linalg.det(intrinsic)) < 1e-12 or any(lower) or intrinsic[2, 2] <= 0:
        raise CaptureError(
            f"{description}: camera {name!r}: expected a camera matrix K with zeros below its "
            f"diagonal, received one that is singular or none: {intrinsic.tolist()}"
        )
    intrinsic = intrinsic / intrinsic[2, 2]
    if abs(intrinsic[0, 1]) > LARGEST_SKEW * intrinsic[0, 0]:
        raise CaptureError(
            f"{description}: camera {name!r}: expected K without skew, received "
            f"{intrinsic[0, 1]}; rectify the photographs first"
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = numbers[9:18].reshape(3, 3), numbers[18:]
    fault = not_rigid_because(pose)
    if fault:
        raise CaptureError(
            f"{description}: camera {name!r}: expected a rotation R, received {fault}; check "
            "the order of the numbers (K, R, t)"
        )
    return Camera(
        id=frame_name(Path(name)),
        kind="opencv",
        width=size[0],
        height=size[1],
        fl_x=float(intrinsic[0, 0]),
        fl_y=float(intrinsic[1, 1]),
        cx=float(intrinsic[0, 2]) + 0.5,
        cy=float(intrinsic[1, 2]) + 0.5,
        camera_from_world=pose,
    )
