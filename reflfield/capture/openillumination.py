"""Reader of OpenIllumination's one-light-at-a-time sets.

``output/transforms_train.json`` holds the cameras: an object ``frames`` keyed by their names,
each with a ``transform_matrix`` (camera to world, OpenGL axes) and ``camera_angle_x``.
Photographs are ``Lights/017/raw_undistorted/CA2.JPG``, masks ``output/obj_masks/CA2.png`` (the
object) or else in ``output/com_masks``; the lamp of folder 017 stands at row 17 of
``light_pos.npy``, which belongs to the data set: put it beside ``Lights``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.calibrated_views import View, assembled_capture
from reflfield.capture.capture import Capture
from reflfield.capture.described_items import described_light
from reflfield.capture.documents import LARGEST_COORDINATE, check_counts, parse_count, read_json
from reflfield.capture.lights import Light
from reflfield.capture.names import IMAGE_SUFFIXES
from reflfield.capture.paths import NamedFiles
from reflfield.capture.transforms_camera import frame_camera, frame_size
from reflfield.capture.transforms_frame import Frame, check_keys
from reflfield.errors import CaptureError
from reflfield.util.files import load_array
from reflfield.util.quoting import listed, quoted

PATTERN = "output/transforms_train.json"
POSITIONS = "light_pos.npy"
MOST_LAMPS = 10_000
_PHOTOGRAPHS = "raw_undistorted"
_MASKS = ("output/obj_masks", "output/com_masks")


def is_openillumination(path: Path) -> bool:
    """Whether folders of lamps stand where they do in this data set."""
    return path.is_file() and (path.parent.parent / "Lights").is_dir()


def read_openillumination(description: Path, *, follow_links: bool = False) -> Capture:
    """Read a one-light-at-a-time set of OpenIllumination.

    Parameters
    ----------
    description : Path
        ``output/transforms_train.json``.
    follow_links : bool
        Whether symbolic links may lead out of the folder of the object.

    Returns
    -------
    Capture
        Point lights of intensity 1. Photographs that are absent are left out.

    Raises
    ------
    CaptureError
        If there is no ``light_pos.npy``, a folder belongs to no lamp, or the photographs are
        under patterns of several lamps.
    """
    root = description.parent.parent
    files = NamedFiles(description, follow_links=follow_links, root=root)
    frames = _frames(description)
    listed_frames = list(frames.values())
    unused = check_keys(listed_frames[0].common, listed_frames)
    notes = [f"{description}: {note}" for note in unused]
    lamps = _lamps(root)
    n_pairs = len(frames) * len(lamps)
    check_counts(str(description), len(frames), len(lamps), n_pairs)
    views, paths = [], []
    for name, frame in frames.items():
        shown = [(_photograph(files, folder, name), light) for folder, light in lamps.items()]
        present = [(path, light) for path, light in shown if path.is_file()] or shown
        camera = frame_camera(frame, name, frame_size(frame, present[0][0]))
        views += [View(name, camera, light) for _, light in present]
        paths += [path for path, _ in present]
    if len(paths) < n_pairs:
        notes.append(f"{root}: {n_pairs - len(paths)} of {n_pairs} photographs are absent")
    masks = {name: _mask(files, name) for name in frames}
    return assembled_capture(
        *(views, paths, [masks[view.name] for view in views], files),
        format="openillumination",
        details=[
            f"OpenIllumination {description}: {len(frames)} cameras, {len(lamps)} lamps of "
            f"{root / POSITIONS}, intensity 1"
        ],
        notes=notes,
    )


def _frames(description: Path) -> dict[str, Frame]:
    """Frames by the names of their cameras."""
    document = read_json(description)
    frames = document.get("frames")
    if not isinstance(frames, dict) or not frames:
        raise CaptureError(
            f"{description}: frames: expected an object of cameras by name, as of "
            f"OpenIllumination, received {quoted(frames)[:80]}"
        )
    common = {key: value for key, value in document.items() if key != "frames"}
    result = {}
    for name, own in frames.items():
        what = f"{description}: frame {quoted(name)}"
        if not isinstance(own, dict):
            raise CaptureError(f"{what}: expected an object, received {quoted(own)}")
        result[name] = Frame(own, common, what)
    return result


def _lamps(root: Path) -> dict[str, Light]:
    """Light of each folder below ``Lights``."""
    folders = sorted(path.name for path in (root / "Lights").iterdir() if path.is_dir())
    numbers = {name: parse_count(name) if name.isdecimal() else None for name in folders}
    if None in numbers.values() or 0 not in numbers.values():
        raise CaptureError(
            f"{root / 'Lights'}: expected folders 000, 001 and so on of single lamps, received "
            f"{listed(folders)}; the patterns 001 to 013 have several lamps at once and "
            "are not supported"
        )
    positions = _positions(root / POSITIONS)
    lamps = {}
    for name, number in numbers.items():
        if number is None or number >= len(positions):
            raise CaptureError(
                f"{root / 'Lights' / name}: expected a number below {len(positions)}, the rows "
                f"of {root / POSITIONS}; remove the folder"
            )
        what = f"{root / POSITIONS}: row {number}"
        lamps[name] = described_light(what, "point", position=positions[number])
    return lamps


def _positions(path: Path) -> NDArray[np.float64]:
    if not path.is_file():
        raise CaptureError(
            f"{path}: expected the positions of the lamps; copy {POSITIONS} of the data set "
            "there"
        )
    array = load_array(path, 24 * MOST_LAMPS, CaptureError)
    fits = array.ndim == 2 and array.shape[1] == 3 and array.dtype.kind == "f"
    if not fits or not (np.abs(array) <= LARGEST_COORDINATE).all():
        raise CaptureError(
            f"{path}: expected an array of finite floats, n x 3, received {array.dtype} "
            f"{array.shape}"
        )
    return array.astype(np.float64)


def _photograph(files: NamedFiles, folder: str, name: str) -> Path:
    """Photograph of a camera under a lamp."""
    within = f"Lights/{folder}/{_PHOTOGRAPHS}"
    within = within if (files.root / within).is_dir() else f"Lights/{folder}"
    return files.path(f"{within}/{name}", IMAGE_SUFFIXES)


def _mask(files: NamedFiles, name: str) -> Path | None:
    paths = [files.path(f"{folder}/{name}", IMAGE_SUFFIXES) for folder in _MASKS]
    return next((path for path in paths if path.is_file()), None)
