"""Captures made of what programs that calibrate cameras leave: a camera for each photograph."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture, usual_base_geometry
from reflfield.capture.documents import check_counts
from reflfield.capture.image_files import AS_STATED, ImageReading, image_size
from reflfield.capture.lights import Light
from reflfield.capture.names import unique_names
from reflfield.capture.orientation import estimated_up
from reflfield.capture.paths import NamedFiles
from reflfield.capture.photographs import Exposure, Photograph
from reflfield.capture.unique_items import UniqueItems, camera_key, leading_digits, numbered
from reflfield.capture.view_folders import ViewFolders
from reflfield.errors import CaptureError
from reflfield.util.quoting import printable, quoted

UNKNOWN_LIGHT = Light("l", "unknown")
# Pixels by which the sides of a reduced photograph may differ from the exact ratio.
MOST_ROUNDING = 1.0


@dataclass(frozen=True)
class View:
    """A photograph of a calibration.

    Parameters
    ----------
    name : str
        As the calibration names it, with or without suffix.
    camera : Camera
        As calibrated; its image may be larger than the photograph.
    light : Light
        Unknown and constant where nothing says it.
    """

    name: str
    camera: Camera
    light: Light = UNKNOWN_LIGHT


def capture_of_views(
    views: Sequence[View],
    folders: ViewFolders,
    *,
    format: str,
    details: Sequence[str],
    notes: Sequence[str] = (),
    reading: ImageReading = AS_STATED,
) -> Capture:
    """Make a capture of calibrated views.

    Parameters
    ----------
    views : sequence of View
    folders : ViewFolders
    format : str
        Name of the reader.
    details, notes : sequence of str
        Of the capture; what is said of photographs, sizes and masks is added.
    reading : ImageReading, optional
        How the photographs are encoded.

    Returns
    -------
    Capture
        Of the views whose photographs are there, or of all where none is. Identical cameras
        and lights are one. Cameras have the size of their photographs.

    Raises
    ------
    CaptureError
        If a photograph is no reduced image of its calibration, or there are masks of which
        none belongs to a photograph.
    """
    description = folders.files.description
    check_counts(str(description), len(views), 0, len(views))
    located = [(view, folders.photograph(view.name)) for view in views]
    present = [(view, path) for view, path in located if path.is_file()]
    absent = len(located) - len(present)
    notes = list(notes)
    if present and absent:
        notes.append(
            f"{description}: {len(present)} of {len(located)} photographs are there and used, "
            f"the other {absent} are not (first {_first_absent(located)})"
        )
    used = [
        _in_size_of_photograph(view, path, description) for view, path in present or located
    ]
    paths = [path for _, path in present or located]
    sizes = [
        _reduction(view, of) for view, (of, _) in zip(used, present or located, strict=True)
    ]
    masks = [folders.mask(path) for path in paths]
    capture = assembled_capture(
        *(used, paths, masks, folders.files),
        format=format,
        details=(*details, *_size_details(sizes), *_mask_details(folders)),
        notes=notes,
        reading=reading,
    )
    more = _mask_notes(folders, capture.silhouettes)
    return replace(capture, notes=(*capture.notes, *more))


def assembled_capture(
    views: Sequence[View],
    paths: Sequence[Path],
    masks: Sequence[Path | None],
    files: NamedFiles,
    *,
    format: str,
    details: Sequence[str],
    notes: Sequence[str] = (),
    reading: ImageReading = AS_STATED,
) -> Capture:
    """Make a capture of photographs, their cameras and their lights.

    Parameters
    ----------
    views : sequence of View
        Cameras in the size of their photographs. Identical cameras and lights are one.
    paths, masks : sequence of Path
        Of each view its photograph and its mask, if there is one. Of several masks of one
        camera the first counts.
    files : NamedFiles
        Of the description.
    format, details, notes, reading
        As `capture_of_views`.
    """
    cameras, lights = UniqueItems(), UniqueItems()
    silhouettes: dict[int, Path] = {}
    photographs = []
    names = unique_names(list(paths), files.root)
    for name, view, path, mask in zip(names, views, paths, masks, strict=True):
        camera = cameras.add(camera_key(view.camera), view.camera)
        light = lights.add(_light_key(view.light), view.light)
        if mask is not None:
            silhouettes.setdefault(camera, mask)
        photographs.append(Photograph(name, camera, light, (Exposure(path, reading=reading),)))
    check_counts(
        str(files.description), len(cameras.items), len(lights.items), len(photographs)
    )
    return Capture(
        name=printable(files.root.resolve().name),
        root=files.root,
        cameras=numbered(cameras.items, "v"),
        lights=numbered(lights.items, "l"),
        photographs=tuple(photographs),
        base_geometry=usual_base_geometry(len(cameras.items)),
        silhouettes=tuple(silhouettes.get(i) for i in range(len(cameras.items))),
        up=estimated_up(cameras.items),
        format=format,
        description=files.description,
        notes=tuple(notes),
        details=tuple(details),
    )


def _first_absent(located: Sequence[tuple[View, Path]]) -> str:
    return quoted(next(view.name for view, path in located if not path.is_file()))


def _in_size_of_photograph(view: View, path: Path, description: Path) -> View:
    """The view with the intrinsics of its photograph's size."""
    if not path.is_file():
        return view
    width, height = image_size(path)
    camera = view.camera
    if (width, height) == (camera.width, camera.height):
        return view
    slack = MOST_ROUNDING * max(camera.width, camera.height)
    if abs(width * camera.height - height * camera.width) > slack:
        raise CaptureError(
            f"{description}: photograph {path}: expected {camera.width} x {camera.height} "
            f"pixels as calibrated, or the same image reduced, received {width} x {height}; "
            "use the photographs that were calibrated, neither turned nor cropped nor "
            "undistorted"
        )
    across, down = width / camera.width, height / camera.height
    scaled = replace(
        camera,
        width=width,
        height=height,
        fl_x=camera.fl_x * across,
        fl_y=camera.fl_y * down,
        cx=camera.cx * across,
        cy=camera.cy * down,
    )
    return replace(view, camera=scaled)


def _reduction(view: View, calibrated: View) -> tuple[int, int, int, int] | None:
    """Sizes as calibrated and as photographed, where they differ."""
    new, old = view.camera, calibrated.camera
    if (new.width, new.height) == (old.width, old.height):
        return None
    return old.width, old.height, new.width, new.height


def _size_details(sizes: Sequence[tuple[int, int, int, int] | None]) -> list[str]:
    return [
        f"lens scaled from {old_w} x {old_h}, as calibrated, to {w} x {h}"
        for old_w, old_h, w, h in dict.fromkeys(size for size in sizes if size)
    ]


def _mask_details(folders: ViewFolders) -> list[str]:
    return [f"masks in {folders.root / folders.masks}"] if folders.masks else []


def _mask_notes(folders: ViewFolders, silhouettes: Sequence[Path | None]) -> list[str]:
    """Refuse a folder of masks of which none fits; say where some, or all, are not read."""
    if folders.masks is None:
        return folders.notes_on_other_masks()
    without = sum(path is None for path in silhouettes)
    if not without:
        return []
    where = folders.root / folders.masks
    if without == len(silhouettes):
        raise CaptureError(
            f"{where}: expected masks named as the photographs in "
            f"{folders.root / folders.images} (a.jpg.png or a.png of a.jpg), received none of "
            f"{without}; rename them, or remove the folder"
        )
    return [f"{where}: no mask for {without} of {len(silhouettes)} cameras"]


def _light_key(light: Light) -> Hashable:
    """Equal for lights that differ by the rounding of whatever wrote them."""
    return (
        light.kind,
        *leading_digits(np.asarray(light.position)),
        *leading_digits(np.asarray(light.direction)),
        *leading_digits(np.asarray(light.intensity)),
    )
