"""Reader of relight's ``.dome``: the lamps of an RTI dome, which photographs lie beside.

Lengths are millimetres, axes x right, y up in the image, z to the camera, the origin is the
centre of the image, which is ``imageWidth`` wide. ``lightConfiguration`` says which lights
count: ``directional`` (``directions``, far away), ``spherical`` (``positionsSphere``) or
``lights3d`` (``positions3d``). Photographs are taken in the order of their names.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
from reflfield.errors import CaptureError
from reflfield.util.quoting import quoted

SUFFIX = ".dome"
MILLIMETRE = 1e-3
_LISTS = {
    "directional": "directions", "spherical": "positionsSphere", "lights3d": "positions3d",
}  # fmt: skip
_WITHOUT_EFFECT = {"label", "notes", "domeDiameter", "verticalOffset", *_LISTS.values()}
_KNOWN = {"imageWidth", "lightConfiguration", "ledAdjust", *_WITHOUT_EFFECT}


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
        one metre.

    Raises
    ------
    CaptureError
        If the lights are malformed, adjusted in colour, near an image of unknown width, or
        more or fewer than the photographs.
    """
    document = read_json(description)
    _check_keys(document, description)
    kind = document.get("lightConfiguration", "directional")
    if kind not in _LISTS:
        raise CaptureError(
            f"{description}: lightConfiguration: expected {', '.join(_LISTS)}, received "
            f"{quoted(kind)}"
        )
    key = _LISTS[kind]
    vectors = _vectors(document.get(key), f"{description}: {key}")
    check_counts(str(description), 1, len(vectors), len(vectors))
    files = NamedFiles(description, follow_links=follow_links)
    view = photographs_beside(description, files, len(vectors))
    width = IMAGE_WIDTH if kind == "directional" else _width(document, description)
    lights = [
        _light(kind, vector, f"{description}: {key}[{i}]") for i, vector in enumerate(vectors)
    ]
    return fixed_view_capture(
        view,
        lights,
        files,
        camera=orthographic_camera(image_size(view.photographs[0]), width),
        format="dome",
        details=[
            f"relight's {description}: {len(lights)} lights, {kind}",
            f"photographs in {view.photographs[0].parent}, {view.photographs[0].name} first",
        ],
        notes=notes_on_lights_behind(vectors.tolist(), description),
    )


def _check_keys(document: Mapping[str, Any], description: Path) -> None:
    for name in sorted(set(document) - _KNOWN):
        raise CaptureError(
            f"{description}: {name}: expected the keys of relight's present .dome "
            f"({', '.join(sorted(_KNOWN))}), received {quoted(name)}, which may change the "
            "lights; save the file anew with relight, or remove the key"
        )
    for i, adjusted in enumerate(document.get("ledAdjust") or []):
        values = adjusted.values() if isinstance(adjusted, dict) else [adjusted]
        if any(value != 1 for value in values):
            raise CaptureError(
                f"{description}: ledAdjust[{i}]: expected 1 for all colours, received "
                f"{quoted(adjusted)}; adjust the photographs, or state irradiances in "
                "capture.json"
            )


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


def _light(kind: str, vector: NDArray[np.float64], what: str) -> Light:
    if kind == "directional":
        return described_light(what, "directional", direction=vector)
    return described_light(what, "point", position=vector * MILLIMETRE)
