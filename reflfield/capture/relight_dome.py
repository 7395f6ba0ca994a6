"""Reader of relight's ``.dome``: the lamps of an RTI dome, which photographs lie beside.

Lengths are millimetres, axes x right, y up in the image, z to the camera, the origin is the
centre of the image, which is ``imageWidth`` wide. Photographs are taken in the order of their
names. There are two forms:

* as the program writes it: ``lightConfiguration`` says which lights count, ``directional``
  (``directions``, far away), ``spherical`` (``positionsSphere``) or ``lights3d``
  (``positions3d``);
* as its documentation has it: ``positions``, else ``directions``. The origin of these positions
  is that of the dome, ``verticalOffset`` above the image plane. ``lightsCalibration`` corrects
  lamps (`relight_calibration`); it is read in the first form, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.capture.described_items import described_light
from reflfield.capture.documents import check_counts, number, number_array, read_json
from reflfield.capture.fixed_view import (
    IMAGE_WIDTH,
    fixed_view_capture,
    notes_on_lights_behind,
    orthographic_camera,
    photographs_beside,
)
from reflfield.capture.image_files import image_size
from reflfield.capture.lights import Light
from reflfield.capture.paths import NamedFiles
from reflfield.capture.relight_calibration import (
    GRID_KEY,
    MILLIMETRE,
    LampCalibration,
    lamp_calibrations,
    notes_on_grids,
)
from reflfield.capture.relight_calibration import KEY as CALIBRATION
from reflfield.errors import CaptureError
from reflfield.util.quoting import quoted

SUFFIX = ".dome"
_LISTS = {
    "directional": "directions", "spherical": "positionsSphere", "lights3d": "positions3d",
}  # fmt: skip
# The kind of light of the documented form, whose positions have an origin of their own.
_DOCUMENTED = "positions"
_WITHOUT_EFFECT = {"label", "notes", "path", "diameter", "domeDiameter", *_LISTS.values()}
_KNOWN = {
    *("imageWidth", "verticalOffset", "lightConfiguration", "ledAdjust"),
    *(_DOCUMENTED, CALIBRATION),
    *_WITHOUT_EFFECT,
}


def read_dome(description: Path, *, follow_links: bool = False) -> Capture:
    """Read an RTI capture whose lamps stand in a ``.dome``.

    Parameters
    ----------
    description : Path
        The file.
    follow_links : bool
        Whether symbolic links may lead out of its folder.

    Returns
    -------
    Capture
        One orthographic camera; its image is ``imageWidth`` wide where lamps are near, else
        one metre. Grids of ``lightsCalibration`` are the gains of its photographs.

    Raises
    ------
    CaptureError
        If the lights are malformed, adjusted in colour by ``ledAdjust``, near an image of
        unknown width, or more or fewer than the photographs; if a calibration is malformed, or
        has a grid where lights are directions only.
    """
    document = read_json(description)
    _check_keys(document, description)
    kind = _kind(document, description)
    key = _LISTS.get(kind, kind)
    vectors = _vectors(document.get(key), f"{description}: {key}")
    check_counts(str(description), 1, len(vectors), len(vectors))
    offset = _offset(document, description) if kind == _DOCUMENTED else 0.0
    vectors += [0, 0, offset]
    lamps = _lamps(document, kind, len(vectors), description)
    files = NamedFiles(description, follow_links=follow_links)
    view = photographs_beside(description, files, len(vectors))
    width = IMAGE_WIDTH if kind == "directional" else _width(document, description)
    lights = [
        _light(kind, vector, lamp, f"{description}: {key}[{i}]")
        for i, (vector, lamp) in enumerate(zip(vectors, lamps, strict=True))
    ]
    camera = orthographic_camera(image_size(view.photographs[0]), width)
    capture = fixed_view_capture(
        view,
        lights,
        files,
        camera=camera,
        format="dome",
        details=[
            f"relight's {description}: {len(lights)} lights, {kind}",
            f"photographs in {view.photographs[0].parent}, {view.photographs[0].name} first",
            *([f"the image {offset:g} mm below the origin of the lamps"] if offset else []),
        ],
        notes=[
            *notes_on_lights_behind(vectors.tolist(), description),
            *notes_on_grids(lamps, vectors * MILLIMETRE, f"{description}: {CALIBRATION}"),
        ],
    )
    return _with_gains(capture, lamps, camera, f"{description}: {CALIBRATION}")


def _check_keys(document: Mapping[str, Any], description: Path) -> None:
    for name in sorted(set(document) - _KNOWN):
        raise CaptureError(
            f"{description}: {name}: expected the keys of relight's .dome "
            f"({', '.join(sorted(_KNOWN))}), received {quoted(name)}, which may change the "
            "lights; save the file anew with relight, or remove the key"
        )
    adjustments = document.get("ledAdjust") or []
    if not isinstance(adjustments, list):
        raise CaptureError(
            f"{description}: ledAdjust: expected a list, received {quoted(adjustments)}; "
            "remove it"
        )
    for i, adjusted in enumerate(adjustments):
        values = adjusted.values() if isinstance(adjusted, dict) else [adjusted]
        if any(value != 1 for value in values):
            raise CaptureError(
                f"{description}: ledAdjust[{i}]: expected 1 for all colours, received "
                f"{quoted(adjusted)}; adjust the photographs, or state the factors as "
                f"whiteBalance of {CALIBRATION}"
            )


def _kind(document: Mapping[str, Any], description: Path) -> str:
    """Which lights count: a `lightConfiguration`, or the positions of the documented form."""
    if "lightConfiguration" not in document:
        if _DOCUMENTED in document:
            return _DOCUMENTED
        if "directions" in document:
            return "directional"
        raise CaptureError(
            f"{description}: expected lights, as positions or directions (or a "
            f"lightConfiguration), received the keys {quoted(sorted(document))}; add them"
        )
    kind = document["lightConfiguration"]
    if not isinstance(kind, str) or kind not in _LISTS:
        raise CaptureError(
            f"{description}: lightConfiguration: expected {', '.join(_LISTS)}, received "
            f"{quoted(kind)}"
        )
    if _DOCUMENTED in document:
        raise CaptureError(
            f"{description}: {_DOCUMENTED}: expected {_LISTS[kind]} beside "
            f"lightConfiguration {kind!r}, received positions too, of the other form of the "
            "file; remove one of both"
        )
    return kind


def _lamps(
    document: Mapping[str, Any], kind: str, n_lights: int, description: Path
) -> list[LampCalibration]:
    """Calibrations of all lamps; none of them corrects anything where there are none."""
    if CALIBRATION not in document:
        return [LampCalibration()] * n_lights
    what = f"{description}: {CALIBRATION}"
    lamps = lamp_calibrations(document[CALIBRATION], n_lights, what)
    if kind == "directional" and any(lamp.grid is not None for lamp in lamps):
        raise CaptureError(
            f"{what}[0].{GRID_KEY}: expected none where lights are directions only, received "
            "one: it includes the distance of the lamp; state positions and imageWidth, or "
            "remove the grids"
        )
    return lamps


def _with_gains(
    capture: Capture, lamps: list[LampCalibration], camera: Camera, what: str
) -> Capture:
    """The capture with the grids of its lamps as gains."""
    grids = [
        None if lamp.grid is None else lamp.grid.in_image(camera, f"{what}[{i}].{GRID_KEY}")
        for i, lamp in enumerate(lamps)
    ]
    if not any(grids):
        return capture
    photographs = tuple(replace(p, gain=grids[p.light]) for p in capture.photographs)
    words = "photographs are multiplied by the grids, which hold the distance: lights are even"
    return replace(capture, photographs=photographs, details=(*capture.details, words))


def _vectors(entries: Any, what: str) -> NDArray[np.float64]:
    """Vectors (n, 3) of a list of objects x, y, z."""
    if not isinstance(entries, list) or not entries:
        raise CaptureError(f"{what}: expected a list of lights, received {quoted(entries)}")
    rows = []
    for i, entry in enumerate(entries):
        values = [entry.get(axis) for axis in "xyz"] if isinstance(entry, dict) else entry
        rows.append(number_array(values, [(3,)], f"{what}[{i}]"))
    return np.array(rows)


def _width(document: Mapping[str, Any], description: Path) -> float:
    """Width of the image in metres."""
    width = number(document.get("imageWidth"), f"{description}: imageWidth")
    if not width > 0:
        raise CaptureError(
            f"{description}: imageWidth: expected the width of the image in millimetres, since "
            f"the lamps are near, received {width}; measure it"
        )
    return width * MILLIMETRE


def _offset(document: Mapping[str, Any], description: Path) -> float:
    """Height of the origin of documented positions above the image plane, millimetres."""
    return number(document.get("verticalOffset", 0.0), f"{description}: verticalOffset")


def _light(kind: str, vector: NDArray[np.float64], lamp: LampCalibration, what: str) -> Light:
    if kind == "directional":
        return described_light(what, kind, direction=vector, intensity=lamp.strength)
    return described_light(
        what,
        "point",
        position=vector * MILLIMETRE,
        intensity=lamp.strength,
        falls_off=lamp.grid is None,
    )
