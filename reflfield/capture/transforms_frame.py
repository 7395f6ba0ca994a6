"""Frames of ``transforms.json``: their values, the file's, and keys that cannot be read over.

What changes geometry or values and is not supported is refused; other keys that nothing
reads are listed in a note.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from reflfield.capture.documents import number
from reflfield.capture.stated_readings import READING_KEYS
from reflfield.errors import CaptureError
from reflfield.util.quoting import quoted

LENS_KEYS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
SPLIT_KEYS = ("train_filenames", "val_filenames", "test_filenames")
_READ = {
    "file_path", "file_ext", "transform_matrix", "mask_path", "up", "frames", *SPLIT_KEYS,
    "camera_model", "is_fisheye", "w", "h", "fl_x", "fl_y", "cx", "cy", *LENS_KEYS,
    "camera_angle_x", "camera_angle_y", "camera_intrinsics",
    "pl_pos", "pl_intensity", "environment", "environment_convention", *READING_KEYS,
}  # fmt: skip
# Of the scene's bounds, depth maps and other programs' records: they say nothing of cameras,
# lights or values.
_WITHOUT_EFFECT = {
    "aabb", "aabb_scale", "render_aabb", "ply_file_path", "depth_file_path", "depth_path",
    "colmap_im_id", "sharpness", "rotation", "camera_near", "camera_far", "n_frames",
    "png_white",
    # Done to the poses before they were written.
    "applied_transform", "applied_scale",
}  # fmt: skip

_UNDISTORT = "undistort the photographs first"
_LIGHT = "give the light as 'pl_pos' and 'pl_intensity', or as 'environment'"
_ENCODING = "say how files are encoded in 'encoding'"
_VALUES = "write the photographs as they were measured, without it"
# Names (regular expressions) of what changes geometry or values, and what to do about it.
_REFUSED = tuple(
    (re.compile(names), remedy)
    for names, remedy in (
        (r"b[12]|s[1-4]?|skew|sk_[xy]|k([7-9]|\d\d+)|p([03-9]|\d\d+)", _UNDISTORT),
        (r"tau\w*|ftheta_\w+", _UNDISTORT),
        (r"dist(ortion)?(_(params|coeffs?|coefficients))?|(radial|tangential)_distortion",
         "name the coefficients k1, k2, p1, p2, k3"),
        (r"(is_)?(latlong|equirectangular|spherical|panorama|orthographic)", _UNDISTORT),
        (r"(camera|projection|lens|distortion)(_(type|model|mode))?", _UNDISTORT),
        (r"((camera|pose|axis|coordinate)_)?(convention|system|frame)|coordinates|handedness",
         "write 'transform_matrix' in OpenGL axes"),
        (r"gamma|colou?r_?space|transfer_function|(is_)?linear", _ENCODING),
        (r"[xy]_fov|fov(_[xy])?|fov[xy]", "give 'camera_angle_x' in radians, or 'fl_x'"),
        (r"f[xy]|focal(_length)?(_[xy])?|K|(cam_)?intrinsics?(_matrix)?|(camera|K)_matrix",
         "give 'fl_x', 'fl_y', 'cx' and 'cy' in pixels"),
        (r"rolling_shutter\w*|transform_matrix_(start|end)|camera_\w+_velocity",
         "only cameras at rest are supported"),
        (r"[RT]_opt", "write the refined pose as 'transform_matrix'"),
        (r"crop\w*", "crop the photographs and shift cx and cy"),
        (r"img_path", "name the photograph in 'file_path'"),
        (r"normal_mts_args|from_mitsuba|from_na", "write 'transform_matrix' in OpenGL axes"),
        (r"white_transparent|black_transparent|fix_premult|sharpen|mask_color", _VALUES),
        (r"env_?map\w*|driver_parameters|lights?|light_\w+|pl_(?!pos|intensity)\w+", _LIGHT),
    )
)  # fmt: skip
# Values of refused keys that change nothing.
_NEUTRAL = (None, False, 0, "", "none", "perspective", "pinhole", "srgb", "opengl")
_SRGB = re.compile(r"(is_)?srgb")
# Frames of another time show an object that has moved.
_TIME = re.compile(r"time(_id)?|warp_id")
# Differences between frames in these are differences in values.
_EXPOSURE = re.compile(
    r"exposure(_time|_value)?|shutter(_speed)?|iso|gain|ev|aperture|f_?number|white_balance"
)

_ONE_EXPOSURE = (
    "bring the photographs to one exposure, or give 'exposures' with seconds in capture.json"
)
_ONE_TIME = "leave the frames of one time: objects that move are not supported"


@dataclass(frozen=True)
class Frame:
    """One frame: what it says itself, what the file says of all, and its name for messages."""

    own: Mapping[str, Any]
    common: Mapping[str, Any]
    what: str

    @property
    def levels(self) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
        """The frame's own values before those of the file."""
        return self.own, self.common

    def get(self, name: str) -> Any:
        """The value of a key; null counts as absent."""
        own = self.own.get(name)
        return self.common.get(name) if own is None else own

    def number(self, name: str, default: float) -> float:
        """A number, or the default where there is none."""
        value = self.get(name)
        return default if value is None else number(value, f"{self.what}: {name}")


def check_keys(common: Mapping[str, Any], frames: Sequence[Frame]) -> list[str]:
    """Refuse keys that change what is read and are not supported; note the other unknown ones.

    Parameters
    ----------
    common : mapping
        Values at the top of the file.
    frames : sequence of Frame

    Returns
    -------
    list of str
        Notes.

    Raises
    ------
    CaptureError
        Naming the frame and the key.
    """
    keys = set(common).union(*(frame.own for frame in frames)) - _READ
    for key in sorted(keys):
        remedy = next((text for names, text in _REFUSED if names.fullmatch(key)), None)
        if remedy is not None:
            _refuse(key, remedy, frames)
        if key == "orientation_override":
            _refuse(key, "turn poses and lights before they are written", frames)
        if _SRGB.fullmatch(key) and any(frame.get(key) is False for frame in frames):
            raise CaptureError(
                f"{frames[0].what}: {key}: expected true, received false; {_ENCODING}"
            )
        if _EXPOSURE.fullmatch(key):
            _check_same(key, frames, _ONE_EXPOSURE)
        if _TIME.fullmatch(key):
            _check_same(key, frames, _ONE_TIME)
    _check_frame_count(common, len(frames), frames[0].what)
    unused = sorted(keys - _WITHOUT_EFFECT)
    if not unused:
        return []
    listed = ", ".join(quoted(key) for key in unused[:20]) + (
        " ..." if len(unused) > 20 else ""
    )
    return [f"not used: {listed}"]


def _refuse(key: str, remedy: str, frames: Sequence[Frame]) -> None:
    for frame in frames:
        value = frame.get(key)
        if not _is_neutral(value):
            raise CaptureError(
                f"{frame.what}: {key}: expected none or 0, received {quoted(value)}, which is "
                f"not supported; {remedy}"
            )


def _is_neutral(value: Any) -> bool:
    if isinstance(value, list):
        return all(_is_neutral(item) for item in value[:100]) and len(value) <= 100
    plain = value.lower() if isinstance(value, str) else value
    return not isinstance(plain, dict) and plain in _NEUTRAL


def _check_same(key: str, frames: Sequence[Frame], remedy: str) -> None:
    """Demand one value of all frames."""
    first = frames[0].get(key)
    for frame in frames:
        if frame.get(key) != first:
            raise CaptureError(
                f"{frame.what}: {key}: expected {quoted(first)} as in the first frame, "
                f"received {quoted(frame.get(key))}; {remedy}"
            )


def _check_frame_count(common: Mapping[str, Any], n_frames: int, what: str) -> None:
    wanted = common.get("n_frames")
    if wanted is not None and wanted != n_frames:
        raise CaptureError(
            f"{what}: n_frames: expected the {n_frames} frames of the list, received "
            f"{quoted(wanted)}; remove the frames that are not to be used"
        )
