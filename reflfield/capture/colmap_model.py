"""COLMAP's sparse models, text and binary: cameras and images; points are not needed.

Formats: COLMAP, ``doc/format.rst`` and ``src/colmap/sensor/models.h``. Quaternions are
(w, x, y, z) from world to camera, in OpenCV axes; the centre of the first pixel is (0.5, 0.5).
Newer models hold rigs and frames, too: the poses of images hold without them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.binary_files import BinaryFile, opened
from reflfield.capture.cameras import FISHEYE, OPENCV, Camera
from reflfield.capture.described_items import described_camera
from reflfield.capture.documents import (
    LARGEST_COORDINATE,
    MAX_PHOTOGRAPHS,
    parse_count,
    parse_number,
    read_text,
)
from reflfield.capture.lenses import NAMES as LENS_TERMS
from reflfield.errors import CaptureError
from reflfield.util.quoting import quoted

# Number of each camera model in binary files, its name, and its parameters where it is
# supported: those of a lens come in the order of `Camera.distortion`.
MODELS: dict[int, tuple[str, tuple[str, ...] | None]] = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    5: ("OPENCV_FISHEYE", ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    6: ("FULL_OPENCV", ("fx", "fy", "cx", "cy", *LENS_TERMS)),
    7: ("FOV", None),
    8: ("SIMPLE_RADIAL_FISHEYE", None),
    9: ("RADIAL_FISHEYE", None),
    10: ("THIN_PRISM_FISHEYE", None),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", None),
    12: ("SIMPLE_DIVISION", None),
    13: ("DIVISION", None),
    14: ("SIMPLE_FISHEYE", None),
    15: ("FISHEYE", None),
    16: ("EUCM", None),
    17: ("EQUIRECTANGULAR", None),
}  # fmt: skip
_PARAMETERS = dict(MODELS.values())
# Bytes of an image's point in a binary file, and of an image without name and points.
_POINT_BYTES, _LEAST_IMAGE_BYTES, _LEAST_CAMERA_BYTES = 24, 73, 48
# Of quaternions, which are normalised: six digits and more are written.
_UNIT_TOLERANCE = 1e-2


@dataclass(frozen=True)
class ModelCamera:
    """Lens of a model: COLMAP's name of it, image size in pixels, parameters."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class ModelImage:
    """Image of a model: its name, rotation (w, x, y, z), translation, and id of its lens."""

    name: str
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int


def read_model(folder: Path, suffix: str) -> tuple[dict[int, ModelCamera], list[ModelImage]]:
    """Lenses by their ids, and images of the model in a folder.

    Parameters
    ----------
    folder : Path
    suffix : {".bin", ".txt"}
        Of the files ``cameras`` and ``images``.

    Raises
    ------
    CaptureError
        If a file is missing, truncated, longer than its contents, or no such file, or a lens
        is of a model that is not supported.
    """
    cameras, images = folder / f"cameras{suffix}", folder / f"images{suffix}"
    if suffix == ".txt":
        return _cameras_of_text(cameras), _images_of_text(images)
    with opened(cameras) as file:
        lenses = _cameras_of_binary(BinaryFile(file, cameras))
    with opened(images) as file:
        return lenses, _images_of_binary(BinaryFile(file, images))


def model_camera(lens: ModelCamera, image: ModelImage, what: str) -> Camera:
    """Camera of an image.

    Parameters
    ----------
    lens : ModelCamera
    image : ModelImage
    what : str
        Named in messages.

    Raises
    ------
    CaptureError
        If a number is out of range.
    """
    names = _PARAMETERS[lens.model] or ()
    values = dict(zip(names, lens.parameters, strict=True))
    pose = np.eye(4)
    pose[:3, :3] = rotation_of_quaternion(image.quaternion, what)
    pose[:3, 3] = image.translation
    return described_camera(
        what,
        kind=FISHEYE if lens.model == "OPENCV_FISHEYE" else OPENCV,
        width=lens.width,
        height=lens.height,
        fl_x=values.get("fx", values.get("f", 0.0)),
        fl_y=values.get("fy", values.get("f", 0.0)),
        cx=values["cx"],
        cy=values["cy"],
        camera_from_world=pose,
        distortion=tuple(values.get(name, 0.0) for name in LENS_TERMS),
    )


def rotation_of_quaternion(quaternion: Sequence[float], what: str) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) of a quaternion (w, x, y, z).

    Raises
    ------
    CaptureError
        If it is not of length 1.

    Examples
    --------
    A quarter turn about z takes y to -x:

    >>> rotation_of_quaternion((0.5**0.5, 0, 0, 0.5**0.5), "image")[0].round(6) + 0.0
    array([ 0., -1.,  0.])
    """
    length = math.sqrt(sum(q * q for q in quaternion))
    if not abs(length - 1) < _UNIT_TOLERANCE:
        raise CaptureError(
            f"{what}: expected a rotation quaternion of length 1, received "
            f"{[float(q) for q in quaternion]}; is the order qw qx qy qz?"
        )
    w, x, y, z = (q / length for q in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _lens(
    path: Path, id_: int, model: str, size: Sequence[int], numbers: Sequence[float]
) -> ModelCamera:
    """A lens whose model is supported and has all its parameters."""
    names = _PARAMETERS.get(model)
    if names is None:
        supported = ", ".join(name for name, known in MODELS.values() if known)
        raise CaptureError(
            f"{path}: camera {id_}: expected a camera model among {supported}, received "
            f"{quoted(model)}; calibrate with one of them, or undistort the photographs with "
            "`colmap image_undistorter`"
        )
    if len(numbers) != len(names):
        raise CaptureError(
            f"{path}: camera {id_}: expected {len(names)} parameters of {model} "
            f"({', '.join(names)}), received {len(numbers)}"
        )
    _check_numbers(path, f"camera {id_}", numbers)
    return ModelCamera(model, size[0], size[1], tuple(float(number) for number in numbers))


def _check_numbers(path: Path, what: str, numbers: Sequence[float]) -> None:
    if not all(abs(number) <= LARGEST_COORDINATE for number in numbers):  # False for NaN
        raise CaptureError(
            f"{path}: {what}: expected finite numbers of at most {LARGEST_COORDINATE:g}, "
            f"received {[float(number) for number in numbers]}; is the file damaged?"
        )


# --- text ---------------------------------------------------------------------------------


def _cameras_of_text(path: Path) -> dict[int, ModelCamera]:
    lenses: dict[int, ModelCamera] = {}
    for line in _lines(path):
        words = line.split()
        id_, *size = (_count(path, line, word) for word in (*words[:1], *words[2:4]))
        numbers = [parse_number(word) for word in words[4:]]
        if len(size) < 2 or None in numbers or id_ in lenses:
            _refuse_line(path, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS, each id once", line)
        values = [number for number in numbers if number is not None]
        lenses[id_] = _lens(path, id_, words[1], size, values)
    return lenses


def _images_of_text(path: Path) -> list[ModelImage]:
    """Images; the line after each holds its points and may be empty."""
    images = []
    lines = iter(read_text(path).split("\n"))
    for raw in lines:
        line = raw.strip()
        if not line or line.startswith("#"):
            continue
        words = line.split(maxsplit=9)
        numbers = [parse_number(word) for word in words[1:8]]
        if len(words) < 10 or None in numbers:
            _refuse_line(path, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", line)
        values = tuple(number for number in numbers if number is not None)
        _check_numbers(path, f"image {quoted(words[9])}", values)
        images.append(
            ModelImage(words[9], values[:4], values[4:], _count(path, line, words[8]))
        )
        next(lines, "")
    return images


def _lines(path: Path) -> list[str]:
    stripped = (line.strip() for line in read_text(path).splitlines())
    return [line for line in stripped if line and not line.startswith("#")]


def _count(path: Path, line: str, word: str) -> int:
    number = parse_count(word)
    if number is None:
        _refuse_line(path, "whole numbers for ids and sizes", line)
    return number


def _refuse_line(path: Path, expected: str, line: str) -> NoReturn:
    raise CaptureError(f"{path}: expected {expected}, received the line {quoted(line)}")


# --- binary -------------------------------------------------------------------------------


def _cameras_of_binary(data: BinaryFile) -> dict[int, ModelCamera]:
    lenses: dict[int, ModelCamera] = {}
    for _ in range(data.count("cameras", _LEAST_CAMERA_BYTES, MAX_PHOTOGRAPHS)):
        id_, number, width, height = data.numbers("IiQQ")
        name, parameters = MODELS.get(number, (f"number {number}", None))
        n_parameters = 0 if parameters is None else len(parameters)
        lenses[id_] = _lens(
            data.path, id_, name, (width, height), data.numbers(f"{n_parameters}d")
        )
    data.end()
    return lenses


def _images_of_binary(data: BinaryFile) -> list[ModelImage]:
    images = []
    for _ in range(data.count("images", _LEAST_IMAGE_BYTES, MAX_PHOTOGRAPHS)):
        _, *numbers, camera = data.numbers("I7dI")
        name = data.text()
        _check_numbers(data.path, f"image {quoted(name)}", numbers)
        data.skip(_POINT_BYTES * data.count("points of an image", _POINT_BYTES))
        images.append(ModelImage(name, tuple(numbers[:4]), tuple(numbers[4:]), camera))
    data.end()
    return images
