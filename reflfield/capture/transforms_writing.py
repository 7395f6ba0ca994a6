"""Description ``transforms.json`` of a capture: one frame for each photograph."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from reflfield.capture.cameras import FISHEYE, ORTHOGRAPHIC, Camera
from reflfield.capture.capture import Capture, usual_base_geometry
from reflfield.capture.lenses import NAMES as LENS_KEYS
from reflfield.capture.lights import ENVIRONMENT, POINT, UNKNOWN, Light
from reflfield.capture.transforms_camera import OPENCV_FROM_OPENGL
from reflfield.capture.transforms_json import FILE_NAME
from reflfield.capture.written_files import WrittenFiles, first_reading, refuse_light
from reflfield.errors import InputError


def transforms_description(capture: Capture, files: WrittenFiles) -> None:
    """Write ``transforms.json`` and the files that it names.

    Raises
    ------
    InputError
        If a camera is orthographic, a light distant or a spotlight, or exposures bracketed.
    """
    check_target(capture, FILE_NAME)
    cameras = [_camera(camera) for camera in capture.cameras]
    lights = [_light(light, files) for light in capture.lights]
    silhouettes = files.silhouettes(capture, "masks")
    names = files.photographs(capture, "images")
    frames = []
    for photograph, (name, *_) in zip(capture.photographs, names, strict=True):
        frame = {"file_path": name, **cameras[photograph.camera], **lights[photograph.light]}
        frame |= files.reading(first_reading(photograph, FILE_NAME))
        if (mask := silhouettes[photograph.camera]) is not None:
            frame["mask_path"] = mask
        frames.append(frame)
    document = {"up": capture.up.tolist(), "frames": frames}
    files.text(FILE_NAME, json.dumps(document, indent=1) + "\n")


def check_target(capture: Capture, target: str) -> None:
    """Refuse what descriptions of calibrated views cannot say.

    Raises
    ------
    InputError
        If a camera is orthographic, or the base geometry is not the one that follows from
        the number of cameras.
    """
    for camera in capture.cameras:
        if camera.kind == ORTHOGRAPHIC:
            raise InputError(
                f"camera {camera.id!r}: expected a perspective camera, which is all that "
                f"{target} can say, received an orthographic one; write it with `to='native'`"
            )
    if capture.base_geometry != usual_base_geometry(capture.n_views):
        raise InputError(
            f"{capture.name}: expected base geometry "
            f"{usual_base_geometry(capture.n_views)!r} of {capture.n_views} views, received "
            f"{capture.base_geometry!r}, which {target} cannot say; write it with "
            "`to='native'`"
        )


def _camera(camera: Camera) -> dict[str, Any]:
    rational = any(camera.distortion[5:])
    model = "FULL_OPENCV" if rational else "OPENCV"
    matrix = np.linalg.solve(OPENCV_FROM_OPENGL @ camera.camera_from_world, np.eye(4))
    return {
        "camera_model": "OPENCV_FISHEYE" if camera.kind == FISHEYE else model,
        "w": camera.width, "h": camera.height, "fl_x": camera.fl_x, "fl_y": camera.fl_y,
        "cx": camera.cx, "cy": camera.cy,
        **{k: v for k, v in zip(LENS_KEYS, camera.distortion, strict=True) if v},
        "transform_matrix": matrix.tolist(),
    }  # fmt: skip


def _light(light: Light, files: WrittenFiles) -> dict[str, Any]:
    if light.kind == UNKNOWN:
        return {}
    if light.kind == ENVIRONMENT:
        if not np.array_equal(light.world_from_environment, np.eye(3)):
            raise refuse_light(light, FILE_NAME)
        name = files.environment(light)
        return {"environment": name, "environment_convention": light.convention}
    if any(source.kind != POINT or not source.falls_off for source in light.sources):
        raise refuse_light(light, FILE_NAME)
    positions = [source.position.tolist() for source in light.sources]
    intensities = [source.intensity.tolist() for source in light.sources]
    if len(positions) == 1:
        return {"pl_pos": positions[0], "pl_intensity": intensities[0]}
    return {"pl_pos": positions, "pl_intensity": intensities}
