"""Reader of Kintsugi 3D's view sets (``.vset``): photographs by a flash beside the camera.

Lines begin with what they hold: ``P`` a pose (camera from world, OpenGL axes), ``p`` one by
quaternion, ``D``, ``d``, ``f`` or ``s`` a projection, ``l`` a light in the frame of the camera
with its intensity, ``e`` a pair of the curve of the photographs, ``v`` a view: indices of pose,
projection and light, and a file name within the folder that ``i`` names. As in Kintsugi 3D
itself, photographs are undistorted and their principal point is their centre: offsets and lens
terms of ``D`` lines stand there for the photographs that were reduced to these.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.calibrated_views import UNKNOWN_LIGHT, View, capture_of_views
from reflfield.capture.cameras import Camera, not_rigid_because
from reflfield.capture.capture import Capture
from reflfield.capture.colmap_model import rotation_of_quaternion
from reflfield.capture.described_items import described_camera, described_light
from reflfield.capture.documents import (
    LARGEST_COORDINATE,
    check_counts,
    parse_count,
    parse_number,
    read_text,
)
from reflfield.capture.encoding import read_pairs
from reflfield.capture.image_files import AS_STATED, ImageReading, image_size
from reflfield.capture.lights import Light
from reflfield.capture.paths import usable_path
from reflfield.capture.transforms_camera import OPENCV_FROM_OPENGL
from reflfield.capture.view_folders import IMAGES, ViewFolders, view_folders
from reflfield.errors import CaptureError, InputError
from reflfield.util.quoting import quoted

Array = NDArray[np.float64]

SUFFIX = ".vset"
# Sensor width of lines that do not say it, in the unit of their focal length.
USUAL_SENSOR_WIDTH = 32.0
# Width over height, as stated and as photographed, may differ by this share.
ASPECT_TOLERANCE = 0.01
# Geometry, clipping planes, previews and settings of the program: they change no view.
_WITHOUT_EFFECT = "mcUOrItgz"
_NUMBERS_OF = {"P": 16, "p": 7, "D": 5, "d": 4, "f": 4, "s": 13, "l": 6}


@dataclass
class _ViewSet:
    """What a file holds, in its own order."""

    description: Path
    poses: list[Array] = field(default_factory=list)
    projections: list[tuple[float, float]] = field(default_factory=list)
    lights: list[Array] = field(default_factory=list)
    views: list[tuple[int, int, int, str]] = field(default_factory=list)
    folder: str = IMAGES
    n_pairs: int = 0
    unused: set[str] = field(default_factory=set)


def read_view_set(description: Path, *, follow_links: bool = False) -> Capture:
    """Read a capture from a view set.

    Parameters
    ----------
    description : Path
        The ``.vset``; photographs lie in the folder that it names, or in ``images``.
    follow_links : bool
        Whether symbolic links may lead out of the folder of the photographs and masks.

    Returns
    -------
    Capture
        One point light for each photograph, or one unknown light where there are none.

    Raises
    ------
    CaptureError
        If a line is malformed, an index leads nowhere, or photographs are distorted.
    """
    content = _ViewSet(description)
    for line in read_text(description).splitlines():
        _read_line(line, content, description)
    check_counts(str(description), len(content.poses), len(content.lights), len(content.views))
    if not content.views:
        raise CaptureError(f"{description}: expected views (lines 'v'), received none")
    images = tuple(dict.fromkeys((content.folder, IMAGES)))
    folders = view_folders(description, follow_links=follow_links, images=images)
    views = [_view(content, *numbers, folders) for numbers in content.views]
    reading, notes = _reading(content, description), []
    if content.unused:
        notes.append(f"{description}: lines not used: {', '.join(sorted(content.unused))}")
    return capture_of_views(
        views,
        folders,
        format="kintsugi",
        details=[
            f"Kintsugi 3D's view set {description}: {len(views)} views, "
            f"{len(content.lights)} lights in the camera's frame, encoding: "
            f"{f'{content.n_pairs} pairs' if content.n_pairs else 'as the files say'}",
            f"photographs in {folders.root / folders.images}",
        ],
        notes=notes,
        reading=reading,
    )


def _read_line(line: str, content: _ViewSet, description: Path) -> None:
    words = line.split()
    if not words or words[0].startswith("#"):
        return
    key = words[0]
    if key in _NUMBERS_OF:
        _add_numbers(key, _numbers(words, _NUMBERS_OF[key], line, description), content, line)
    elif key == "v":
        content.views.append(_view_line(line, description))
    elif key == "i":
        folder = usable_path(line.split(maxsplit=1)[-1].strip(), description)
        content.folder = Path(folder.replace("\\", "/")).name
    elif key == "e":
        content.n_pairs += 1
    elif key not in _WITHOUT_EFFECT:
        content.unused.add(quoted(key))


def _add_numbers(key: str, numbers: Array, content: _ViewSet, line: str) -> None:
    """Add a light, a pose or a projection."""
    if key == "l":
        content.lights.append(numbers)
    elif key in "Pp":
        content.poses.append(_pose(numbers, line, content.description))
    else:
        content.projections.append(_projection(key, numbers, line, content.description))


def _numbers(words: Sequence[str], count: int, line: str, description: Path) -> Array:
    numbers = [parse_number(word) for word in words[1 : count + 1]]
    if len(numbers) != count or None in numbers:
        raise CaptureError(
            f"{description}: expected {count} numbers after {words[0]!r}, received the line "
            f"{quoted(line.strip())}"
        )
    array = np.array(numbers, dtype=np.float64)
    if np.abs(array).max() > LARGEST_COORDINATE:
        raise CaptureError(
            f"{description}: expected numbers of at most {LARGEST_COORDINATE:g}, received the "
            f"line {quoted(line.strip())}"
        )
    return array


def _pose(numbers: Array, line: str, description: Path) -> Array:
    """Camera from world, OpenGL axes."""
    if len(numbers) == 16:
        pose = numbers.reshape(4, 4)
    else:  # position and rotation (x, y, z, w)
        rotation = rotation_of_quaternion(numbers[[6, 3, 4, 5]].tolist(), str(description))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ numbers[:3]
    fault = not_rigid_because(pose)
    if fault:
        raise CaptureError(
            f"{description}: expected a rotation and a translation, received {fault} in the "
            f"line {quoted(line.strip())}"
        )
    return pose


def _projection(key: str, numbers: Array, line: str, description: Path) -> tuple[float, float]:
    """Width over height, and focal length over the height of the image."""
    aspect = float(numbers[2])
    if key == "f":
        share = (
            0.5 / math.tan(math.radians(float(numbers[3])) / 2) if 0 < numbers[3] < 180 else 0
        )
    else:
        width = USUAL_SENSOR_WIDTH if key == "d" else float(numbers[4])
        share = float(numbers[3]) * aspect / width if width > 0 else 0.0
    if not (aspect > 0 and share > 0):
        raise CaptureError(
            f"{description}: expected a projection with aspect, focal length and sensor width "
            f"above 0, received the line {quoted(line.strip())}"
        )
    if key == "s" and numbers[5:].any():
        raise CaptureError(
            f"{description}: expected photographs without distortion, received lens terms in "
            f"the line {quoted(line.strip())}; export undistorted photographs and set them to 0"
        )
    return aspect, share


def _view_line(line: str, description: Path) -> tuple[int, int, int, str]:
    """Indices of pose, projection and light, and a file name; a comment may follow."""
    words = line.split("\t#")[0].split(" #")[0].split(maxsplit=4)
    indices = [parse_count(word) for word in words[1:4]]
    if len(words) < 5 or None in indices:
        raise CaptureError(
            f"{description}: expected 'v POSE PROJECTION LIGHT FILE', received the line "
            f"{quoted(line.strip())}"
        )
    pose, projection, light = (int(index or 0) for index in indices)
    return pose, projection, light, words[4].strip()


def _view(
    content: _ViewSet, pose: int, projection: int, light: int, name: str, folders: ViewFolders
) -> View:
    description = folders.files.description
    what = f"{description}: view {quoted(name)}"
    counts = {
        "pose": (pose, len(content.poses)),
        "projection": (projection, len(content.projections)),
    }
    for kind, (index, count) in counts.items():
        if index >= count:
            raise CaptureError(
                f"{what}: expected the index of a {kind} below {count}, received {index}"
            )
    camera = _camera(content.poses[pose], content.projections[projection], name, folders, what)
    return View(name, camera, _light(content, light, content.poses[pose], what))


def _camera(
    pose: Array, projection: tuple[float, float], name: str, folders: ViewFolders, what: str
) -> Camera:
    """Camera in the size of its photograph, which the file does not state."""
    aspect, share = projection
    path = folders.photograph(name)
    width, height = image_size(path) if path.is_file() else (round(1000 * aspect), 1000)
    if abs(width / height / aspect - 1) > max(ASPECT_TOLERANCE, 1 / height):
        raise CaptureError(
            f"{what}: expected a photograph {aspect:.4g} times as wide as high, received "
            f"{width} x {height} pixels; is it turned or cropped?"
        )
    focal = share * height
    return described_camera(
        what,
        kind="opencv",
        width=width,
        height=height,
        fl_x=focal * width / height / aspect,
        fl_y=focal,
        cx=width / 2,
        cy=height / 2,
        camera_from_world=OPENCV_FROM_OPENGL @ pose,
    )


def _light(content: _ViewSet, index: int, pose: Array, what: str) -> Light:
    """Point light in the world, of one in the frame of the camera."""
    if not content.lights:
        return UNKNOWN_LIGHT
    if index >= len(content.lights):
        raise CaptureError(
            f"{what}: expected the index of a light below {len(content.lights)}, received "
            f"{index}"
        )
    numbers = content.lights[index]
    position = np.linalg.solve(pose, np.append(numbers[:3], 1.0))[:3]
    return described_light(what, "point", position=position, intensity=numbers[3:])


def _reading(content: _ViewSet, description: Path) -> ImageReading:
    if not content.n_pairs:
        return AS_STATED
    try:
        return ImageReading(encoding=read_pairs(description))
    except InputError as error:
        raise CaptureError(str(error)) from error
