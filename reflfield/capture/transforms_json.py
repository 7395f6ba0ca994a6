"""Reader of ``transforms.json`` (nerfstudio axes) with a light or environment per frame.

``transform_matrix`` is camera-to-world with OpenGL camera axes: +X right, +Y up, +Z back.
Relightable-Gaussian captures add ``pl_pos`` and ``pl_intensity`` (W/sr) to each frame; a list
of positions stands for several lights at once. A frame may name an ``environment`` map
instead; a frame with neither is under one constant, unknown lighting.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.documents import (
    IMAGE_SUFFIXES,
    path_inside,
    read_json,
    unique_names,
)
from reflfield.capture.images import image_size
from reflfield.capture.lights import Light
from reflfield.capture.model import Capture, Exposure, Photograph, usual_base_geometry
from reflfield.capture.orientation import estimated_up
from reflfield.errors import CaptureError

FILE_NAME = "transforms.json"
DISTORTION_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4")
CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")

# OpenGL camera axes (x right, y up, z back) seen from OpenCV's (x right, y down, z forward).
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

# Frames of one camera repeat its numbers; beyond this many decimals they may differ by the
# rounding of whatever wrote them (metres, pixels).
SAME_DECIMALS = 9

Item = TypeVar("Item", Camera, Light)


@dataclass
class _Unique:
    """Items in order of first appearance, found again by the numbers that define them."""

    index: dict[Any, int] = field(default_factory=dict)
    items: list[Any] = field(default_factory=list)

    def add(self, key: Any, item: Item) -> int:
        """Index of the item with this key; a new one is named by its index."""
        if key not in self.index:
            self.index[key] = len(self.items)
            self.items.append(item)
        return self.index[key]


def read_transforms(description: Path) -> Capture:
    """Read a capture, or frames to relight, from a ``transforms.json``.

    Parameters
    ----------
    description : Path
        The file; its paths are relative to it.

    Returns
    -------
    Capture
        Identical cameras and lights become one. Photographs keep the order of the frames.
        A camera's silhouette is the first ``mask_path`` among its frames.

    Raises
    ------
    CaptureError
        If a frame lacks what it needs, a matrix is no rigid motion, or a path leaves the
        folder. The message names the frame.
    """
    document = read_json(description)
    frames = document.get("frames")
    if not isinstance(frames, list) or not frames:
        raise CaptureError(f"{description}: expected a list 'frames' that is not empty")
    root = description.parent
    merged = [_merged(document, frame, i, description) for i, frame in enumerate(frames)]
    paths = [_image_path(root, frame, description) for frame in merged]
    cameras, lights = _Unique(), _Unique()
    silhouettes: dict[int, Path] = {}
    pairs = []
    for frame, path in zip(merged, paths, strict=True):
        view = _add_camera(cameras, frame, path)
        pairs.append((view, _add_light(lights, frame, description)))
        if frame.get("mask_path"):
            silhouettes.setdefault(view, path_inside(root, frame["mask_path"], description))
    return Capture(
        name=root.resolve().name,
        root=root,
        cameras=_named(cameras.items, "v"),
        lights=_named(lights.items, "l"),
        photographs=tuple(
            Photograph(name, view, light, (Exposure(path),))
            for name, path, (view, light) in zip(
                unique_names(paths, root), paths, pairs, strict=True
            )
        ),
        base_geometry=usual_base_geometry(len(cameras.items)),
        silhouettes=tuple(silhouettes.get(view) for view in range(len(cameras.items))),
        up=_up(document, cameras.items, description),
        format="transforms",
        description=description,
    )


def _merged(
    document: Mapping[str, Any], frame: Any, index: int, description: Path
) -> dict[str, Any]:
    """A frame with the top-level values it does not override, and a name for messages."""
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise CaptureError(f"{description}: frames[{index}]: expected a 'file_path'")
    common = {key: value for key, value in document.items() if key != "frames"}
    what = f"{description}: frame {index} ({frame['file_path']!r})"
    return {**common, **frame, "what": what}


def _image_path(root: Path, frame: Mapping[str, Any], description: Path) -> Path:
    """The frame's file; without a suffix, the first image suffix that exists."""
    path = path_inside(root, frame["file_path"], description)
    if path.suffix.lower() in IMAGE_SUFFIXES or path.is_file():
        return path
    candidates = [path.with_name(path.name + suffix) for suffix in IMAGE_SUFFIXES]
    return next((c for c in candidates if c.is_file()), candidates[0])


def _add_camera(cameras: _Unique, frame: Mapping[str, Any], path: Path) -> int:
    model = frame.get("camera_model", "OPENCV")
    if model not in CAMERA_MODELS:
        raise CaptureError(
            f"{frame['what']}: camera_model: expected {', '.join(CAMERA_MODELS)}, "
            f"received {model!r}; undistort the photographs first"
        )
    world_from_camera = _matrix(frame)
    width, height = _size(frame, path)
    fl_x, fl_y = _focal_lengths(frame, width, height)
    cx, cy = _number(frame, "cx", width / 2), _number(frame, "cy", height / 2)
    distortion = tuple(_number(frame, name, 0.0) for name in DISTORTION_NAMES)
    if distortion[5] != 0:
        raise CaptureError(
            f"{frame['what']}: k4: expected 0, received {distortion[5]}; writers of "
            "transforms.json disagree on its meaning, so undistort the photographs first"
        )
    numbers = [fl_x, fl_y, cx, cy, *distortion, *world_from_camera.ravel()]
    key = (width, height, *np.round(numbers, SAME_DECIMALS))
    if key in cameras.index:
        return cameras.index[key]
    camera = Camera(
        id=f"of {frame['what']}",  # named in errors until all cameras are counted
        kind="opencv",
        width=width,
        height=height,
        fl_x=fl_x,
        fl_y=fl_y,
        cx=cx,
        cy=cy,
        camera_from_world=_inverted(world_from_camera, frame),
        distortion=distortion,
    )
    return cameras.add(key, camera)


def _matrix(frame: Mapping[str, Any]) -> NDArray[np.float64]:
    try:
        matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4):
        raise CaptureError(
            f"{frame['what']}: transform_matrix: expected 4 x 4 numbers, "
            f"received shape {matrix.shape}"
        )
    return matrix


def _inverted(
    world_from_opengl: NDArray[np.float64], frame: Mapping[str, Any]
) -> NDArray[np.float64]:
    """`camera_from_world` with OpenCV axes; a singular matrix is refused."""
    if not np.isfinite(world_from_opengl).all() or (
        np.linalg.matrix_rank(world_from_opengl[:3, :3]) < 3
    ):
        raise CaptureError(
            f"{frame['what']}: transform_matrix: expected a rotation and a translation, "
            "received a singular matrix; check the calibration that wrote it"
        )
    return OPENCV_FROM_OPENGL @ np.linalg.solve(world_from_opengl, np.eye(4))


def _size(frame: Mapping[str, Any], path: Path) -> tuple[int, int]:
    """Image size as stated, else as the photograph's header says."""
    if "w" in frame and "h" in frame:
        return int(_number(frame, "w", 0)), int(_number(frame, "h", 0))
    if path.is_file():
        return image_size(path)
    raise CaptureError(f"{frame['what']}: expected 'w' and 'h', since {path} does not exist")


def _focal_lengths(frame: Mapping[str, Any], width: int, height: int) -> tuple[float, float]:
    """Focal lengths in pixels, stated or from ``camera_angle_x``."""
    angle_x = _number(frame, "camera_angle_x", 0.0)
    angle_y = _number(frame, "camera_angle_y", 0.0)
    fl_x = _number(frame, "fl_x", 0.5 * width / np.tan(angle_x / 2) if angle_x else 0.0)
    fl_y = _number(frame, "fl_y", 0.5 * height / np.tan(angle_y / 2) if angle_y else fl_x)
    if fl_x <= 0 or fl_y <= 0:
        raise CaptureError(
            f"{frame['what']}: expected 'fl_x' > 0 or 'camera_angle_x' > 0 in the frame or at "
            f"the top, received a focal length of {fl_x} x {fl_y} pixels"
        )
    return fl_x, fl_y


def _add_light(lights: _Unique, frame: Mapping[str, Any], description: Path) -> int:
    if "environment" in frame:
        file = path_inside(description.parent, str(frame["environment"]), description)
        convention = frame.get("environment_convention", "mitsuba")
        light = Light("l", "environment", file=file, convention=convention)
        return lights.add((str(file), convention), light)
    if "pl_pos" not in frame:
        return lights.add("unknown", Light("l", "unknown"))
    positions = np.atleast_2d(_vectors(frame, "pl_pos"))
    intensities = np.atleast_2d(_vectors(frame, "pl_intensity", np.ones(3)))
    if intensities.shape[0] not in (1, positions.shape[0]):
        raise CaptureError(
            f"{frame['what']}: pl_intensity: expected {len(positions)} rows like pl_pos, "
            f"received {len(intensities)}"
        )
    intensities = np.broadcast_to(intensities, positions.shape)
    numbers = np.concatenate([positions.ravel(), intensities.ravel()])
    key = tuple(np.round(numbers, SAME_DECIMALS))
    if key in lights.index:
        return lights.index[key]
    return lights.add(key, _point_lights(frame, positions, intensities))


def _point_lights(
    frame: Mapping[str, Any], positions: NDArray[np.float64], intensities: NDArray[np.float64]
) -> Light:
    points = tuple(
        Light(f"of {frame['what']}", "point", position=p, intensity=i)
        for p, i in zip(positions, intensities, strict=True)
    )
    return points[0] if len(points) == 1 else Light("l", "group", members=points)


def _vectors(
    frame: Mapping[str, Any], name: str, default: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """(3,) or (n, 3) numbers; one number counts for all three channels."""
    value = frame.get(name, default)
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape == () and name == "pl_intensity":
        array = np.full(3, float(array))
    if array.ndim not in (1, 2) or array.shape[-1] != 3 or not np.isfinite(array).all():
        raise CaptureError(
            f"{frame['what']}: {name}: expected 3 finite numbers (or a list of such), "
            f"received {value!r}"
        )
    return array


def _number(frame: Mapping[str, Any], name: str, default: float) -> float:
    value = frame.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise CaptureError(f"{frame['what']}: {name}: expected a number, received {value!r}")
    return float(value)


def _named(items: list[Item], letter: str) -> tuple[Item, ...]:
    digits = max(3, len(str(len(items) - 1)))
    return tuple(replace(item, id=f"{letter}{i:0{digits}d}") for i, item in enumerate(items))


def _up(
    document: Mapping[str, Any], cameras: list[Camera], description: Path
) -> NDArray[np.float64]:
    if "up" not in document:
        return estimated_up(cameras)
    up = _vectors({**document, "what": str(description)}, "up")
    if up.shape != (3,) or not np.linalg.norm(up) > 0:
        raise CaptureError(f"{description}: up: expected 3 numbers, not all zero")
    return up / np.linalg.norm(up)
