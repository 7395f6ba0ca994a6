"""Cameras of ``transforms.json``: intrinsics, lens and pose of a frame.

Of a frame and its file, the frame is asked first: its ``camera_intrinsics``
(``[cx, cy, fx, fy]``), ``fl_x`` or ``camera_angle_x``, in this order, before any of the
file's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import FISHEYE, LONGEST_SIDE, OPENCV, Camera, not_rigid_because
from reflfield.capture.documents import number, number_array
from reflfield.capture.image_files import image_size
from reflfield.capture.transforms_frame import LENS_KEYS, Frame
from reflfield.errors import CaptureError
from reflfield.util.quoting import quoted

# Camera models and the coefficients that each has; others must be 0.
MODELS = {
    "OPENCV": LENS_KEYS,
    "FULL_OPENCV": LENS_KEYS,
    "PINHOLE": (),
    "SIMPLE_PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}

# What a frame says of its camera, its size apart.
CAMERA_KEYS = (
    "transform_matrix", "camera_model", "is_fisheye", "fl_x", "fl_y", "cx", "cy", *LENS_KEYS,
    "camera_angle_x", "camera_angle_y", "camera_intrinsics",
)  # fmt: skip

# Focal lengths of angles that are written with three digits differ by less, relatively.
ANGLE_ROUNDING = 2e-3

# OpenGL camera axes (x right, y up, z back) seen from OpenCV's (x right, y down, z forward).
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def frame_camera(frame: Frame, name: str, size: tuple[int, int]) -> Camera:
    """Camera of a frame.

    Parameters
    ----------
    frame : Frame
    name : str
        Id of the camera in messages.
    size : (width, height) int
        See `frame_size`.

    Returns
    -------
    Camera

    Raises
    ------
    CaptureError
        Naming the frame and the key.
    """
    width, height = size
    fl_x, fl_y = _focal_lengths(frame, width, height)
    cx, cy = _principal_point(frame, width, height)
    try:
        return Camera(
            id=name,
            kind=FISHEYE if _model(frame) == "OPENCV_FISHEYE" else OPENCV,
            width=width,
            height=height,
            fl_x=fl_x,
            fl_y=fl_y,
            cx=cx,
            cy=cy,
            camera_from_world=_pose(frame),
            distortion=_distortion(frame),
        )
    except CaptureError as error:
        text = str(error)
        raise CaptureError(
            text if text.startswith(frame.what) else f"{frame.what}: {text}"
        ) from error


def _pose(frame: Frame) -> NDArray[np.float64]:
    """`camera_from_world` with OpenCV axes."""
    what = f"{frame.what}: transform_matrix"
    matrix = number_array(frame.get("transform_matrix"), [(4, 4), (3, 4)], what)
    matrix = np.vstack([matrix[:3], matrix[3:] if len(matrix) == 4 else [[0.0, 0.0, 0.0, 1.0]]])
    fault = not_rigid_because(matrix)
    if fault:
        raise CaptureError(
            f"{what}: expected a rotation and a translation, received {fault}; check the "
            "calibration that wrote it, and apply scale in the program that exports it"
        )
    return OPENCV_FROM_OPENGL @ np.linalg.solve(matrix, np.eye(4))


def frame_size(frame: Frame, path: Path) -> tuple[int, int]:
    """Width and height as stated, else as the header of the photograph at `path` says.

    Raises
    ------
    CaptureError
        If a stated size is out of range, one side that is stated alone is not that of the
        photograph, or there is no photograph to ask.
    """
    stated = {name: _pixels(frame, name) for name in "wh" if frame.get(name) is not None}
    if len(stated) == 2:
        return stated["w"], stated["h"]
    if not path.is_file():
        raise CaptureError(f"{frame.what}: expected 'w' and 'h', since {path} does not exist")
    size = image_size(path)
    for name, length in zip("wh", size, strict=True):
        if stated.get(name, length) != length:
            raise CaptureError(
                f"{frame.what}: {name}: expected the {size[0]} x {size[1]} pixels of {path}, "
                f"received {stated[name]}; give 'w', 'h' and the lens for the photograph as "
                "it is"
            )
    return size


def _pixels(frame: Frame, name: str) -> int:
    value = frame.number(name, 0.0)
    if not 1 <= value <= LONGEST_SIDE or value != int(value):
        raise CaptureError(
            f"{frame.what}: {name}: expected 1 to {LONGEST_SIDE} whole pixels, received {value}"
        )
    return int(value)


def _model(frame: Frame) -> str:
    """Camera model; ``is_fisheye`` alone names one too."""
    model, fisheye = frame.get("camera_model"), frame.get("is_fisheye")
    if fisheye not in (None, False, True):
        raise CaptureError(
            f"{frame.what}: is_fisheye: expected true or false, received {quoted(fisheye)}"
        )
    if model is None:
        return "OPENCV_FISHEYE" if fisheye else "OPENCV"
    if not isinstance(model, str) or model not in MODELS:
        raise CaptureError(
            f"{frame.what}: camera_model: expected {', '.join(MODELS)}, "
            f"received {quoted(model)}; undistort the photographs first"
        )
    if fisheye is not None and bool(fisheye) != (model == "OPENCV_FISHEYE"):
        raise CaptureError(
            f"{frame.what}: camera_model {model} and is_fisheye {fisheye} contradict each "
            "other; remove the wrong one"
        )
    return model


def _distortion(frame: Frame) -> tuple[float, ...]:
    model = _model(frame)
    values = {name: frame.number(name, 0.0) for name in LENS_KEYS}
    for name, value in values.items():
        if value != 0 and name not in MODELS[model]:
            raise CaptureError(
                f"{frame.what}: {name}: expected 0 with camera_model {model}, received "
                f"{value}; correct the model, or undistort the photographs first"
            )
    rational = model == "FULL_OPENCV" or all(frame.get(k) is not None for k in ("k5", "k6"))
    if model == "OPENCV" and values["k4"] != 0 and not rational:
        raise CaptureError(
            f"{frame.what}: k4: expected 0, received {values['k4']}; without k5 and k6, "
            "writers of transforms.json disagree on its meaning: name the camera_model "
            "FULL_OPENCV if it stands in OpenCV's denominator, else undistort first"
        )
    return tuple(values.values())


def _focal_lengths(frame: Frame, width: int, height: int) -> tuple[float, float]:
    """Focal lengths in pixels, from the frame's own values before the file's."""
    own, common = (_stated(frame, level, width, height) for level in frame.levels)
    fl_x, fl_y = (
        own[axis] or _of_file(own[other], own["is_length"], common, axis)
        for axis, other in (("x", "y"), ("y", "x"))
    )
    fl_x, fl_y = fl_x or fl_y, fl_y or fl_x
    if fl_x is None or fl_y is None:
        raise CaptureError(
            f"{frame.what}: expected a focal length: 'fl_x' (pixels), 'camera_angle_x' "
            "(radians) or 'camera_intrinsics' ([cx, cy, fx, fy]) in the frame or at the top, "
            "received none"
        )
    return fl_x, fl_y


def _of_file(
    other: float | None, is_length: float | None, common: Mapping[str, Any], axis: str
) -> float | None:
    """The file's focal length of an axis that the frame does not state.

    Where the frame states that of the other axis, a length leaves the file's length, an
    angle does not.
    """
    if other is None or (is_length and common["is_length"]):
        value: float | None = common[axis]
        return value
    return None


def _stated(
    frame: Frame, level: Mapping[str, Any], width: int, height: int
) -> dict[str, float | None]:
    """Focal lengths that one level states; None where it does not."""
    matrix = _intrinsics(frame, level)
    if matrix is not None:
        return {"x": matrix[2], "y": matrix[3], "is_length": 1.0}
    lengths = {axis: _length(frame, level, f"fl_{axis}") for axis in "xy"}
    angles = {
        axis: _from_angle(frame, level, f"camera_angle_{axis}", side)
        for axis, side in (("x", width), ("y", height))
    }
    stated = {axis: lengths[axis] or angles[axis] for axis in "xy"}
    if lengths["x"] is not None and lengths["y"] is None:
        stated["y"] = None  # square pixels rather than an angle that belongs to another fl_x
    return {**stated, "is_length": 1.0 if any(lengths.values()) else None}


def contradicted_angle(frame: Frame, size: tuple[int, int]) -> str | None:
    """Say which angle of view is not that of the focal length which stands beside it.

    The length is used, as other readers do: some programs write the angles of the whole
    sensor, whatever the image shows of it.

    Parameters
    ----------
    frame : Frame
    size : (width, height) int
    """
    for level in frame.levels:
        angles = {
            axis: _from_angle(frame, level, f"camera_angle_{axis}", side)
            for axis, side in zip("xy", size, strict=True)
        }
        stated = _stated(frame, level, *size)
        lengths = {axis: stated[axis] or stated["x"] for axis in "xy"}  # square pixels
        for axis, length in lengths.items():
            angle = angles[axis]
            if length and angle and not math.isclose(length, angle, rel_tol=ANGLE_ROUNDING):
                return (
                    f"camera_angle_{axis} means a focal length of {angle:.6g} pixels, and "
                    f"{length:.6g} stand beside it"
                )
        if any(lengths.values()):
            return None  # the file's are not used
    return None


def _length(frame: Frame, level: Mapping[str, Any], name: str) -> float | None:
    if level.get(name) is None:
        return None
    value = number(level[name], f"{frame.what}: {name}")
    if value <= 0:
        raise CaptureError(
            f"{frame.what}: {name}: expected a focal length above 0 pixels, received {value}"
        )
    return value


def _from_angle(frame: Frame, level: Mapping[str, Any], name: str, side: int) -> float | None:
    if level.get(name) is None:
        return None
    angle = number(level[name], f"{frame.what}: {name}")
    if not 0 < angle < math.pi:
        raise CaptureError(
            f"{frame.what}: {name}: expected an angle between 0 and pi radians, received "
            f"{angle}; is it in degrees?"
        )
    if _model(frame) == "OPENCV_FISHEYE":
        return None  # an angle of a fisheye lens is not that of a pinhole
    return 0.5 * side / math.tan(angle / 2)


def _principal_point(frame: Frame, width: int, height: int) -> tuple[float, float]:
    """Principal point in pixels; the centre of the image where it is not stated."""
    point = []
    for axis, (name, side) in enumerate((("cx", width), ("cy", height))):
        value = None
        for level in frame.levels:
            matrix = _intrinsics(frame, level)
            if value is None and matrix is not None:
                value = matrix[axis]
            elif value is None and level.get(name) is not None:
                value = number(level[name], f"{frame.what}: {name}")
        point.append(side / 2 if value is None else value)
    return point[0], point[1]


def _intrinsics(frame: Frame, level: Mapping[str, Any]) -> list[float] | None:
    """``[cx, cy, fx, fy]`` of one level, which its other keys must not contradict."""
    if level.get("camera_intrinsics") is None:
        return None
    what = f"{frame.what}: camera_intrinsics"
    array = number_array(level["camera_intrinsics"], [(4,)], f"{what} [cx, cy, fx, fy]")
    for name, value in zip(("cx", "cy", "fl_x", "fl_y"), array, strict=True):
        if name.startswith("fl") and not value > 0:
            raise CaptureError(
                f"{what}: expected [cx, cy, fx, fy] with fx, fy > 0, received {array.tolist()}"
            )
        other = level.get(name)
        if other is not None and not math.isclose(number(other, name), value, rel_tol=1e-6):
            raise CaptureError(
                f"{what}: expected the same {name} twice, received {value} and {other}; "
                "remove the wrong one"
            )
    return [float(value) for value in array]
