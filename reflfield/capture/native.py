"""Reader of the native capture directory, version 1 (`schema/capture-v1.json`)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from reflfield.capture.cameras import Camera
from reflfield.capture.documents import path_inside, read_json, unique_names
from reflfield.capture.lights import Light
from reflfield.capture.model import Capture, Exposure, Photograph, usual_base_geometry
from reflfield.errors import CaptureError

FILE_NAME = "capture.json"
FORMAT = "reflfield-capture"
VERSION = 1
DISTORTION_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4")


def read_native(description: Path) -> Capture:
    """Read a native capture.

    Parameters
    ----------
    description : Path
        Its ``capture.json``.

    Returns
    -------
    Capture
        Files are named, not opened.

    Raises
    ------
    CaptureError
        If the description violates the schema, ids repeat or are unknown, a camera or
        light is unusable, or a path leaves the folder.
    """
    document = read_json(description)
    check_native(document, description)
    root = description.parent
    cameras = tuple(_camera(entry) for entry in document["cameras"])
    lights = tuple(_light(entry, root, description) for entry in document["lights"])
    return Capture(
        name=document.get("name", root.resolve().name),
        root=root,
        cameras=cameras,
        lights=lights,
        photographs=_photographs(document, cameras, lights, description),
        base_geometry=document.get("base_geometry", usual_base_geometry(len(cameras))),
        silhouettes=tuple(
            path_inside(root, entry["silhouette"], description)
            if "silhouette" in entry
            else None
            for entry in document["cameras"]
        ),
        up=np.array(document.get("up", (0.0, 0.0, 1.0))),
        format="native",
        description=description,
    )


def check_native(document: Mapping[str, Any], description: Path) -> None:
    """Validate the contents of ``capture.json`` against the schema.

    Raises
    ------
    CaptureError
        Naming the offending entry; a newer version says so.
    """
    version = document.get("version")
    if document.get("format") == FORMAT and isinstance(version, int) and version > VERSION:
        raise CaptureError(
            f"{description}: expected version {VERSION}, received the newer version {version}; "
            "update reflfield"
        )
    error = best_match(_validator().iter_errors(document))
    if error is not None:
        where = error.json_path.removeprefix("$").removeprefix(".") or "the description"
        text = error.message if len(error.message) < 300 else error.message[:300] + " ..."
        raise CaptureError(f"{description}: {where}: {text} (schema capture-v{VERSION}.json)")


def schema() -> dict[str, Any]:
    """The JSON Schema of ``capture.json``, version 1.

    Examples
    --------
    >>> schema()["properties"]["format"]
    {'const': 'reflfield-capture'}
    """
    source = files("reflfield.capture").joinpath("schema", "capture-v1.json")
    loaded: dict[str, Any] = json.loads(source.read_text(encoding="utf-8"))
    return loaded


@cache
def _validator() -> Any:
    return Draft202012Validator(schema())


def _camera(entry: Mapping[str, Any]) -> Camera:
    return Camera(
        id=entry["id"],
        kind=entry.get("model", "opencv"),
        width=entry["w"],
        height=entry["h"],
        fl_x=entry["fl_x"],
        fl_y=entry["fl_y"],
        cx=entry["cx"],
        cy=entry["cy"],
        distortion=tuple(entry.get(name, 0.0) for name in DISTORTION_NAMES),
        camera_from_world=np.array(entry["camera_from_world"], dtype=np.float64),
    )


def _light(entry: Mapping[str, Any], root: Path, description: Path) -> Light:
    """A light; the schema has checked which fields each type has."""
    fields = {key: value for key, value in entry.items() if key not in ("type", "irradiance")}
    if entry["type"] == "directional":
        fields["intensity"] = entry["irradiance"]
    if entry["type"] == "environment":
        fields["file"] = path_inside(root, entry["file"], description)
    if "cone_angle" in fields:
        fields.setdefault("falloff_angle", fields["cone_angle"])
    return Light(kind=entry["type"], **fields)


def _photographs(
    document: Mapping[str, Any],
    cameras: tuple[Camera, ...],
    lights: tuple[Light, ...],
    description: Path,
) -> tuple[Photograph, ...]:
    """Photographs from the list, or every pair of the pattern."""
    listed = document["photographs"]
    if isinstance(listed, dict):
        listed = _expanded(listed["pattern"], cameras, lights)
    view = {camera.id: i for i, camera in enumerate(cameras)}
    light = {light.id: i for i, light in enumerate(lights)}
    exposures = [_exposures(entry, description) for entry in listed]
    names = unique_names([e[0].path for e in exposures], description.parent)
    return tuple(
        Photograph(
            name=name,
            camera=_known(view, entry["camera"], "camera", description),
            light=_known(light, entry["light"], "light", description),
            exposures=files_of_entry,
        )
        for name, entry, files_of_entry in zip(names, listed, exposures, strict=True)
    )


def _expanded(
    pattern: str, cameras: tuple[Camera, ...], lights: tuple[Light, ...]
) -> list[dict[str, str]]:
    return [
        {
            "camera": camera.id,
            "light": light.id,
            "file": pattern.replace("{camera}", camera.id).replace("{light}", light.id),
        }
        for camera in cameras
        for light in lights
    ]


def _exposures(entry: Mapping[str, Any], description: Path) -> tuple[Exposure, ...]:
    listed = entry.get("exposures") or [{"file": entry["file"], "seconds": 1.0}]
    return tuple(
        Exposure(path_inside(description.parent, e["file"], description), e["seconds"])
        for e in listed
    )


def _known(index: Mapping[str, int], id_: str, what: str, description: Path) -> int:
    if id_ not in index:
        raise CaptureError(
            f"{description}: photographs: expected the id of a {what} in this file, "
            f"received {id_!r}"
        )
    return index[id_]
