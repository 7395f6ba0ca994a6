"""Correcting the calibration of a capture by what it shows, from Python and by the command."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from reflfield.api.captures import open_capture
from reflfield.calibration.camera_correction import CameraCorrection, correct_cameras
from reflfield.calibration.color_chart import (
    GREYS,
    ColorCorrection,
    check_installed,
    color_correction,
)
from reflfield.calibration.corrected_photographs import with_colors_corrected
from reflfield.calibration.light_correction import LightCorrection, correct_lights
from reflfield.capture.capture import Capture
from reflfield.capture.conversion import check_empty, convert_capture
from reflfield.capture.encoding import LINEAR, Encoding, parse_encoding
from reflfield.capture.image_files import ImageReading, read_image
from reflfield.capture.image_headers import read_header
from reflfield.errors import InputError
from reflfield.util.files import replacing

REPORT = "calibration.json"
# Image files that hold codes, of which a curve can be told.
KINDS_OF_CODES = ("png", "jpeg")


@dataclass(frozen=True, eq=False)
class Calibration:
    """A capture with its calibration corrected.

    Parameters
    ----------
    capture : Capture
        As it was written.
    cameras : CameraCorrection, optional
        Where cameras were to be corrected.
    lights : LightCorrection, optional
        Where lights were.
    color : ColorCorrection, optional
        Where a photograph of a chart was there.
    """

    capture: Capture
    cameras: CameraCorrection | None
    lights: LightCorrection | None
    color: ColorCorrection | None

    def lines(self) -> list[str]:
        """What was changed and gained, in words."""
        return [line for part in self._parts.values() if part for line in part.lines()]

    def entry(self) -> dict[str, Any]:
        """The same for a JSON file."""
        return {name: part and part.entry() for name, part in self._parts.items()}

    @property
    def _parts(self) -> dict[str, CameraCorrection | LightCorrection | ColorCorrection | None]:
        return {"cameras": self.cameras, "color": self.color, "lights": self.lights}


def calibrate(
    capture: Capture | Path | str,
    out: Path | str,
    *,
    cameras: bool = False,
    lights: bool = False,
    color_checker: Path | None = None,
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
    color_checker : Path, optional
        Photograph of a ColorChecker Classic, taken and developed as those of the capture, which
        are then written anew with its white balance and matrix. Needs the extra ``color``.
        Where its greys are plainly not linear, their curve is written as
        ``chart_greys.csv``, which `encoding` takes.
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
    if not (cameras or lights or color_checker):
        raise InputError(
            "calibrate: expected what to correct (`cameras=True`, `lights=True`, "
            "`color_checker`), received nothing"
        )
    if not isinstance(capture, Capture):
        capture = open_capture(
            capture, format, encoding=encoding, layer=layer, follow_links=follow_links
        )
    out = Path(out)
    check_empty(out)
    of_color = None if color_checker is None else _color(color_checker, encoding, layer)
    of_cameras = correct_cameras(capture) if cameras else None
    if of_cameras is not None:
        capture = replace(capture, cameras=of_cameras.cameras)
    out.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.colours") as folder:
        if of_color is not None and of_color.kind != "none":
            capture = with_colors_corrected(capture, of_color.matrix, Path(folder))
        of_lights = correct_lights(capture) if lights else None
        if of_lights is not None:
            capture = replace(capture, lights=of_lights.lights)
        convert_capture(capture, out, link=link)
    calibration = Calibration(open_capture(out), of_cameras, of_lights, of_color)
    if of_color is not None and of_color.curve:
        rows = "".join(f"{code},{grey}\n" for code, grey in of_color.curve)
        with replacing(out / GREYS) as partial:
            partial.write_text(f"encoded,linear\n{rows}")
    with replacing(out / REPORT) as partial:
        partial.write_text(json.dumps(calibration.entry(), indent=1) + "\n")
    return calibration


def _color(path: Path, encoding: str | None, layer: str | None) -> ColorCorrection:
    check_installed()
    curve = parse_encoding(encoding) if encoding is not None else None
    has_codes = read_header(path).kind in KINDS_OF_CODES
    codes = read_image(path, ImageReading(Encoding(LINEAR), layer)) if has_codes else None
    return color_correction(read_image(path, ImageReading(curve, layer)), str(path), codes)
