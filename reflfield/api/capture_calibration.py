"""Correcting the calibration of a capture by what it shows, from Python and by the command."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from reflfield.api.captures import open_capture
from reflfield.calibration.camera_correction import CameraCorrection, correct_cameras
from reflfield.calibration.light_correction import LightCorrection, correct_lights
from reflfield.capture.capture import Capture
from reflfield.capture.conversion import check_empty, convert_capture
from reflfield.errors import InputError
from reflfield.util.files import replacing

REPORT = "calibration.json"


@dataclass(frozen=True, eq=False)
class Calibration:
    """A capture with its calibration corrected.

    Parameters
    ----------
    capture : Capture
    cameras : CameraCorrection, optional
        Where cameras were to be corrected.
    lights : LightCorrection, optional
        Where lights were.
    """

    capture: Capture
    cameras: CameraCorrection | None
    lights: LightCorrection | None

    def lines(self) -> list[str]:
        """What was changed and gained, in words."""
        return [line for part in (self.cameras, self.lights) if part for line in part.lines()]

    def entry(self) -> dict[str, Any]:
        """The same for a JSON file."""
        return {
            "cameras": None if self.cameras is None else self.cameras.entry(),
            "lights": None if self.lights is None else self.lights.entry(),
        }


def calibrate(
    capture: Capture | Path | str,
    out: Path | str,
    *,
    cameras: bool = False,
    lights: bool = False,
    link: bool = False,
    format: str | None = None,
    encoding: str | None = None,
    layer: str | None = None,
    follow_links: bool = False,
) -> Calibration:
    """Correct the calibration of a capture, and write it in the native form with a report.

    Parameters
    ----------
    capture : Capture, Path or str
    out : Path or str
        A folder that is new or empty; gets the capture and ``calibration.json``.
    cameras : bool
        Correct the poses of the cameras by the silhouettes.
    lights : bool
        Correct the positions of the lights by the photographs, with cameras as corrected.
    link : bool
        Hard links in place of copies of the photographs, where the file system has them.
    format, encoding, layer, follow_links
        As of `open_capture`.

    Raises
    ------
    InputError
        If nothing is to be corrected, the folder is not empty, or the capture does not tell
        what is to be corrected.
    GeometryError
        If a silhouette cannot be used.
    """
    if not (cameras or lights):
        raise InputError(
            "calibrate: expected what to correct (cameras, lights; --cameras, --lights of the "
            "command), received nothing"
        )
    if not isinstance(capture, Capture):
        capture = open_capture(
            capture, format, encoding=encoding, layer=layer, follow_links=follow_links
        )
    out = Path(out)
    check_empty(out)
    of_cameras = correct_cameras(capture) if cameras else None
    if of_cameras is not None:
        capture = replace(capture, cameras=of_cameras.cameras)
    of_lights = correct_lights(capture) if lights else None
    if of_lights is not None:
        capture = replace(capture, lights=of_lights.lights)
    calibration = Calibration(capture, of_cameras, of_lights)
    convert_capture(capture, out, link=link)
    with replacing(out / REPORT) as partial:
        partial.write_text(json.dumps(calibration.entry(), indent=1) + "\n")
    return calibration
