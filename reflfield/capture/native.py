"""Reader of the native capture directory, version 1 (`schema/capture-v1.json`)."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import resources
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match
from numpy.typing import NDArray

from reflfield.capture.cameras import ORTHOGRAPHIC, Camera
from reflfield.capture.capture import Capture, usual_base_geometry
from reflfield.capture.dark_frames import DarkFrame
from reflfield.capture.documents import LARGEST_COORDINATE, check_counts, read_json
from reflfield.capture.gain_grids import GainGrid, gain_grid
from reflfield.capture.image_files import ImageReading
from reflfield.capture.lenses import NAMES as LENS_KEYS
from reflfield.capture.lights import Light
from reflfield.capture.names import unique_names
from reflfield.capture.paths import NamedFiles
from reflfield.capture.photographs import Exposure, Photograph
from reflfield.capture.stated_readings import stated_reading
from reflfield.errors import CaptureError
from reflfield.util.quoting import has_controls, printable, quoted

FILE_NAME = "capture.json"
FORMAT = "reflfield-capture"
VERSION = 1
# Faults of a description that are looked at to find the most telling one.
FAULTS_COMPARED = 50
# Keys at the top that would change geometry or values if anything read them.
_WOULD_CHANGE = re.compile(
    r"((world|scene)_)?scale|(length_)?units?|gamma|colou?r_?space|(is_)?(linear|srgb)"
    r"|axes|((camera|pose|coordinate)_)?(convention|system|frame)|white_balance|exposure"
)


def read_native(description: Path, *, follow_links: bool = False) -> Capture:
    """Read a native capture.

    Parameters
    ----------
    description : Path
        Its ``capture.json``.
    follow_links : bool
        Whether symbolic links may lead out of its folder.

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
    root, files = description.parent, NamedFiles(description, follow_links=follow_links)
    cameras = tuple(_camera(entry, description) for entry in document["cameras"])
    lights = tuple(_light(entry, files) for entry in document["lights"])
    return Capture(
        name=document.get("name", printable(root.resolve().name)),
        root=root,
        cameras=cameras,
        lights=lights,
        photographs=_photographs(document, cameras, lights, files),
        base_geometry=document.get("base_geometry", usual_base_geometry(len(cameras))),
        silhouettes=tuple(
            files.path(entry["silhouette"]) if "silhouette" in entry else None
            for entry in document["cameras"]
        ),
        up=_up(document, description),
        format="native",
        description=description,
        notes=_notes(document, description),
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
    lists = {key: document.get(key) for key in ("cameras", "lights", "photographs")}
    n_cameras, n_lights, n_listed = (
        len(value) if isinstance(value, list) else 0 for value in lists.values()
    )
    by_pattern = isinstance(document.get("photographs"), dict)
    n_photographs = n_cameras * n_lights if by_pattern else n_listed
    check_counts(str(description), n_cameras, n_lights, n_photographs)
    listed = document.get("photographs")
    photographs = listed if isinstance(listed, list) else []
    # The first stands for the whole list, whose entries follow one by one.
    short = {**document, "photographs": photographs[:1]} if photographs else document
    _check_part(_validator(), short, "", description)
    for number, entry in enumerate(photographs):
        if not _is_plain(entry):
            _check_part(_photograph_validator(), entry, f".photographs[{number}]", description)
    name = document.get("name", "")
    if has_controls(name):
        raise CaptureError(
            f"{description}: name: expected text without control characters, received "
            f"{quoted(name)}"
        )


def schema() -> dict[str, Any]:
    """The JSON Schema of ``capture.json``, version 1.

    Examples
    --------
    >>> schema()["properties"]["format"]
    {'const': 'reflfield-capture'}
    """
    source = resources.files("reflfield.capture").joinpath("schema", "capture-v1.json")
    loaded: dict[str, Any] = json.loads(source.read_text(encoding="utf-8"))
    return loaded


@cache
def _validator() -> Any:
    return Draft202012Validator(schema())


@cache
def _photograph_validator() -> Any:
    """Of one entry of the list of photographs."""
    return Draft202012Validator({"$defs": schema()["$defs"], "$ref": "#/$defs/photograph"})


def _check_part(validator: Any, part: Any, where: str, description: Path) -> None:
    """Refuse a part of the description by its most telling fault."""
    error = best_match(islice(validator.iter_errors(part), FAULTS_COMPARED))
    if error is not None:
        path = where + error.json_path.removeprefix("$")
        text = error.message if len(error.message) < 300 else error.message[:300] + " ..."
        raise CaptureError(
            f"{description}: {printable(path.removeprefix('.') or 'the description')}: "
            f"{printable(text)} (schema capture-v{VERSION}.json)"
        )


def _is_plain(entry: Any) -> bool:
    """Whether an entry surely fits the schema: a camera, a light and a file, all texts."""
    plain = isinstance(entry, dict) and set(entry) == {"camera", "light", "file"}
    return plain and all(isinstance(v, str) and 0 < len(v) <= 200 for v in entry.values())


def _camera(entry: Mapping[str, Any], description: Path) -> Camera:
    kind = entry.get("model", "opencv")
    distortion = tuple(entry.get(name, 0.0) for name in LENS_KEYS)
    if kind == ORTHOGRAPHIC and any(distortion):
        raise CaptureError(
            f"{description}: camera {entry['id']!r}: expected an orthographic camera without "
            f"distortion, received {distortion}; undistort the photographs first"
        )
    try:
        return Camera(
            id=entry["id"],
            kind=kind,
            width=entry["w"],
            height=entry["h"],
            fl_x=entry["fl_x"],
            fl_y=entry["fl_y"],
            cx=entry["cx"],
            cy=entry["cy"],
            distortion=distortion,
            skew=entry.get("skew", 0.0),
            camera_from_world=np.array(entry["camera_from_world"], dtype=np.float64),
        )
    except CaptureError as error:
        raise CaptureError(f"{description}: {error}") from error


def _light(entry: Mapping[str, Any], files: NamedFiles) -> Light:
    """A light; the schema has checked which fields each type has."""
    fields = {key: value for key, value in entry.items() if key not in ("type", "irradiance")}
    if "irradiance" in entry:
        fields["intensity"] = entry["irradiance"]
        fields["falls_off"] = entry["type"] == "directional"
    if entry["type"] == "environment":
        fields["file"] = files.path(entry["file"])
    if "cone_angle" in fields:
        fields.setdefault("falloff_angle", fields["cone_angle"])
    try:
        return Light(kind=entry["type"], **fields)
    except CaptureError as error:
        raise CaptureError(f"{files.description}: {error}") from error


def _up(document: Mapping[str, Any], description: Path) -> NDArray[np.float64]:
    up = np.array(document.get("up", (0.0, 0.0, 1.0)), dtype=np.float64)
    if not 0 < np.abs(up).max() <= LARGEST_COORDINATE:
        raise CaptureError(
            f"{description}: up: expected a direction that is not zero, received {up.tolist()}"
        )
    return up


def _notes(document: Mapping[str, Any], description: Path) -> tuple[str, ...]:
    """Keys at the top that nothing reads; those of a camera or light are refused there."""
    unused = sorted(set(document) - set(schema()["properties"]))
    parts = [part for part in schema()["$defs"].values() if "properties" in part]
    misplaced = [key for key in unused if any(key in part["properties"] for part in parts)]
    if misplaced:
        raise CaptureError(
            f"{description}: {misplaced[0]}: expected within a camera, light or photograph, "
            "received it at the top, where it would be without effect; move it there"
        )
    changing = next((key for key in unused if _WOULD_CHANGE.fullmatch(key)), None)
    if changing:
        raise CaptureError(
            f"{description}: {changing}: expected no such key, received "
            f"{quoted(document[changing])}, which nothing would apply; apply it to cameras, "
            "lights and photographs, or say how they are encoded in 'encoding'"
        )
    listed = ", ".join(quoted(key) for key in unused[:20])
    return (f"{description}: not used: {listed}",) if unused else ()


def _photographs(
    document: Mapping[str, Any],
    cameras: tuple[Camera, ...],
    lights: tuple[Light, ...],
    files: NamedFiles,
) -> tuple[Photograph, ...]:
    """Photographs from the list, or every pair of the pattern."""
    listed = document["photographs"]
    if isinstance(listed, dict):
        listed = _expanded(listed["pattern"], cameras, lights)
    view = {camera.id: i for i, camera in enumerate(cameras)}
    light = {light.id: i for i, light in enumerate(lights)}
    reading = stated_reading(document, files, str(files.description))
    exposures = [_exposures(entry, files, reading) for entry in listed]
    dark_frames = _dark_frames(document, listed, files, reading)
    gains = _gains(document, listed, files.description)
    names = unique_names([e[0].path for e in exposures], files.root)
    return tuple(
        Photograph(
            name=name,
            camera=_known(view, entry["camera"], "camera", files),
            light=_known(light, entry["light"], "light", files),
            exposures=files_of_entry,
            dark=dark,
            gain=gain,
        )
        for name, entry, files_of_entry, dark, gain in zip(
            names, listed, exposures, dark_frames, gains, strict=True
        )
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


def _exposures(
    entry: Mapping[str, Any], files: NamedFiles, of_all: ImageReading
) -> tuple[Exposure, ...]:
    listed = entry.get("exposures") or [{"file": entry["file"], "seconds": 1.0}]
    reading = stated_reading(entry, files, f"{files.description}: photographs", of_all)
    return tuple(Exposure(files.path(e["file"]), e["seconds"], reading) for e in listed)


def _dark_frames(
    document: Mapping[str, Any],
    listed: Sequence[Mapping[str, Any]],
    files: NamedFiles,
    of_all: ImageReading,
) -> Iterator[DarkFrame | None]:
    """Dark frame of each photograph: its own, its camera's, or that of all."""
    of_cameras = {camera["id"]: camera.get("dark") for camera in document["cameras"]}
    for entry in listed:
        dark = entry.get("dark") or of_cameras.get(entry["camera"]) or document.get("dark")
        if not dark:
            yield None
            continue
        stated: Mapping[str, Any] = {"file": dark} if isinstance(dark, str) else dark
        timed = "exposures" in entry
        if timed != ("seconds" in stated):
            expected, received = ("no ", "one") if not timed else ("an ", "none")
            raise CaptureError(
                f"{files.description}: dark frame {quoted(stated['file'])}: expected "
                f"{expected}exposure time, 'seconds', as its photographs have, received "
                f"{received}; state the times of both, or of neither if they are equal"
            )
        reading = stated_reading(entry, files, f"{files.description}: photographs", of_all)
        where = f"{files.description}: dark"
        yield DarkFrame(
            files.path(stated["file"]),
            stated.get("seconds", 1.0),
            stated_reading(stated, files, where, reading),
        )


def _gains(
    document: Mapping[str, Any], listed: Sequence[Mapping[str, Any]], description: Path
) -> Iterator[GainGrid | None]:
    """Gain of each photograph: its own, its camera's, or that of all; each is read once."""
    of_cameras = {camera["id"]: camera.get("gain") for camera in document["cameras"]}
    grids: dict[int, GainGrid] = {}
    for i, entry in enumerate(listed):
        of_camera = of_cameras.get(entry["camera"])
        stated = entry.get("gain") or of_camera or document.get("gain")
        if not stated:
            yield None
            continue
        if id(stated) not in grids:
            where = f"photographs[{i}].gain" if "gain" in entry else "gain"
            if "gain" not in entry and of_camera:
                where = f"camera {entry['camera']!r}: gain"
            grids[id(stated)] = gain_grid(stated, f"{description}: {where}")
        yield grids[id(stated)]


def _known(index: Mapping[str, int], id_: str, what: str, files: NamedFiles) -> int:
    if id_ not in index:
        raise CaptureError(
            f"{files.description}: photographs: expected the id of a {what} in this file, "
            f"received {id_!r}"
        )
    return index[id_]
