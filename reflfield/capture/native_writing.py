"""Description of the native format, `native`, of any capture."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.capture.gain_grids import GainGrid, gain_entry
from reflfield.capture.lenses import NAMES as LENS_KEYS
from reflfield.capture.lights import DIRECTIONAL, ENVIRONMENT, GROUP, POINT, SPOT, Light
from reflfield.capture.native import FILE_NAME, FORMAT, VERSION
from reflfield.capture.written_files import WrittenFiles, refuse_light

_ID = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}")


def native_description(capture: Capture, files: WrittenFiles) -> None:
    """Write ``capture.json`` and the files that it names.

    Raises
    ------
    InputError
        If a light is a group of several.
    """
    cameras = _ids([camera.id for camera in capture.cameras], "v")
    lights = _ids([light.id for light in capture.lights], "l")
    silhouettes = files.silhouettes(capture, "silhouettes")
    names = files.photographs(capture, "photographs")
    of_cameras = _gains_of_cameras(capture)
    photographs = []
    for photograph, own in zip(capture.photographs, names, strict=True):
        first = photograph.exposures[0]
        entry: dict[str, Any] = {
            "camera": cameras[photograph.camera],
            "light": lights[photograph.light],
            **files.reading(first.reading),
        }
        dark = photograph.dark
        timed = first.seconds != 1 or (dark is not None and dark.seconds != 1)
        if len(own) == 1 and not timed:
            entry["file"] = own[0]
        else:
            entry["exposures"] = [
                {"file": name, "seconds": exposure.seconds}
                for name, exposure in zip(own, photograph.exposures, strict=True)
            ]
        if dark is not None:
            of_dark = {} if "file" in entry else {"seconds": dark.seconds}
            of_dark |= files.reading(dark.reading) if dark.reading != first.reading else {}
            entry["dark"] = {"file": files.dark_frame(dark.path), **of_dark}
        if photograph.gain is not None and of_cameras[photograph.camera] is None:
            entry["gain"] = gain_entry(photograph.gain)
        photographs.append(entry)
    document = {
        "format": FORMAT,
        "version": VERSION,
        "name": capture.name or "capture",
        "base_geometry": capture.base_geometry,
        "up": capture.up.tolist(),
        "cameras": [
            camera_entry(camera, id_, silhouette)
            | ({} if gain is None else {"gain": gain_entry(gain)})
            for camera, id_, silhouette, gain in zip(
                capture.cameras, cameras, silhouettes, of_cameras, strict=True
            )
        ],
        "lights": [
            _light(light, id_, files) for light, id_ in zip(capture.lights, lights, strict=True)
        ],
        "photographs": photographs,
    }
    files.text(FILE_NAME, json.dumps(document, indent=1) + "\n")


def _gains_of_cameras(capture: Capture) -> list[GainGrid | None]:
    """The gain that all photographs of a camera have; None where they differ or have none."""
    gains: list[set[GainGrid | None]] = [set() for _ in capture.cameras]
    for photograph in capture.photographs:
        gains[photograph.camera].add(photograph.gain)
    return [next(iter(some)) if len(some) == 1 else None for some in gains]


def _ids(ids: Sequence[str], letter: str) -> list[str]:
    """Ids that the format allows: those there are, or numbers."""
    if all(_ID.fullmatch(id_) for id_ in ids):
        return list(ids)
    return [f"{letter}{i:04d}" for i in range(len(ids))]


def camera_entry(camera: Camera, id_: str, silhouette: str | None) -> dict[str, Any]:
    """Entry of a camera in ``capture.json``, with the name of its silhouette's file."""
    entry: dict[str, Any] = {
        "id": id_, "model": camera.kind, "w": camera.width, "h": camera.height,
        "fl_x": camera.fl_x, "fl_y": camera.fl_y, "cx": camera.cx, "cy": camera.cy,
        **{k: v for k, v in zip(LENS_KEYS, camera.distortion, strict=True) if v},
        "camera_from_world": camera.camera_from_world.tolist(),
    }  # fmt: skip
    if camera.skew:
        entry["skew"] = camera.skew
    if silhouette is not None:
        entry["silhouette"] = silhouette
    return entry


def _light(light: Light, id_: str, files: WrittenFiles) -> dict[str, Any]:
    if light.kind == GROUP:
        raise refuse_light(light, "capture.json")
    entry: dict[str, Any] = {"id": id_, "type": light.kind}
    if light.kind == DIRECTIONAL:
        entry |= {"direction": light.direction.tolist(), "irradiance": light.intensity.tolist()}
    if light.kind in (POINT, SPOT):
        strength = "intensity" if light.falls_off else "irradiance"
        entry |= {"position": light.position.tolist(), strength: light.intensity.tolist()}
    if light.kind == SPOT:
        entry |= {
            "direction": light.direction.tolist(), "exponent": light.exponent,
            "cone_angle": light.cone_angle, "falloff_angle": light.falloff_angle,
        }  # fmt: skip
    if light.kind == ENVIRONMENT:
        entry |= {
            "file": files.environment(light), "convention": light.convention,
            "world_from_environment": light.world_from_environment.tolist(),
        }  # fmt: skip
    return entry
