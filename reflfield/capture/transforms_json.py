"""Reader of ``transforms.json`` (nerfstudio axes) with a light or environment per frame.

``transform_matrix`` is camera-to-world with OpenGL camera axes: +X right, +Y up, +Z back.
Relightable-Gaussian captures add ``pl_pos`` and ``pl_intensity`` (W/sr) to each frame; a list
of positions stands for several lights at once. A frame may name an ``environment`` map
instead; where no frame has either, all are under one constant, unknown lighting.

A capture may come as ``transforms_train.json`` with a test split in ``transforms_test.json``
(else ``transforms_val.json``) beside it, or as one file that lists ``test_filenames``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture, usual_base_geometry
from reflfield.capture.documents import check_counts, number_array, read_json
from reflfield.capture.image_files import ImageReading
from reflfield.capture.names import IMAGE_SUFFIXES, unique_names
from reflfield.capture.orientation import estimated_up
from reflfield.capture.paths import NamedFiles
from reflfield.capture.photographs import Exposure, Photograph
from reflfield.capture.stated_readings import READING_KEYS, stated_reading
from reflfield.capture.transforms_camera import (
    CAMERA_KEYS,
    contradicted_angle,
    frame_camera,
    frame_size,
)
from reflfield.capture.transforms_frame import SPLIT_KEYS, Frame, check_keys
from reflfield.capture.transforms_light import LIGHT_KEYS, check_lights, frame_light
from reflfield.capture.unique_items import UniqueItems, camera_key, numbered
from reflfield.errors import CaptureError
from reflfield.util.quoting import printable, quoted

FILE_NAME = "transforms.json"
TRAIN_NAME = "transforms_train.json"
TEST_NAMES = ("transforms_test.json", "transforms_val.json", "transforms_valid.json")


@dataclass
class _Reading:
    """What has been read of one or two files: cameras and lights are shared by the splits."""

    files: NamedFiles
    cameras: UniqueItems = field(default_factory=UniqueItems)
    lights: UniqueItems = field(default_factory=UniqueItems)
    silhouettes: dict[int, Path] = field(default_factory=dict)
    other_masks: dict[int, Path] = field(default_factory=dict)
    photographs: list[Photograph] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    said: dict[str, int] = field(default_factory=dict)
    contradicted: list[str] = field(default_factory=list)
    readings: dict[str, ImageReading] = field(default_factory=dict)

    def add(self, frame: Frame, is_test: bool) -> None:
        """Read one frame."""
        path = _image_path(self.files, frame)
        view, light = self._view(frame, path), self._light(frame)
        if frame.get("mask_path"):
            mask = self.files.path(frame.get("mask_path"))
            if self.silhouettes.setdefault(view, mask) != mask:
                self.other_masks.setdefault(view, mask)
        exposure = Exposure(path, reading=self._image_reading(frame))
        self.photographs.append(Photograph("", view, light, (exposure,), is_test=is_test))

    def _view(self, frame: Frame, path: Path) -> int:
        """Index of the frame's camera; frames that say the same are read once."""
        size = frame_size(frame, path)
        said = repr((id(frame.common), size, [frame.own.get(key) for key in CAMERA_KEYS]))
        if said not in self.said:
            camera = frame_camera(frame, path.stem, size)
            self.said[said] = self.cameras.add(camera_key(camera), camera)
            contradicted = contradicted_angle(frame, size)
            if contradicted:
                self.contradicted.append(f"{frame.what}: {contradicted}")
        return self.said[said]

    def _light(self, frame: Frame) -> int:
        """Index of the frame's light; frames that say the same are read once."""
        said = repr((id(frame.common), [frame.own.get(key) for key in LIGHT_KEYS]))
        if said not in self.said:
            self.said[said] = self.lights.add(*frame_light(frame, self.files))
        return self.said[said]

    def _image_reading(self, frame: Frame) -> ImageReading:
        """How the frame's file is read; frames that say the same share one reading."""
        values = {key: frame.get(key) for key in READING_KEYS}
        key = repr(values)
        if key not in self.readings:
            self.readings[key] = stated_reading(values, self.files, frame.what)
        return self.readings[key]


def read_transforms(
    description: Path, *, follow_links: bool = False, test_split: bool = False
) -> Capture:
    """Read a capture, or frames to relight, from a ``transforms.json``.

    Parameters
    ----------
    description : Path
        The file; its paths are relative to it.
    follow_links : bool
        Whether symbolic links may lead out of its folder.
    test_split : bool
        Whether to add the photographs of the test split, after the others.

    Returns
    -------
    Capture
        Identical cameras and lights become one. Photographs keep the order of the frames.
        A camera's silhouette is the first ``mask_path`` among its frames.

    Raises
    ------
    CaptureError
        If a frame lacks what it needs, a matrix is no rigid motion, a path leaves the
        folder, a key is not supported, or there is no test split to add. The message names
        the frame.
    """
    document = read_json(description)
    reading = _Reading(NamedFiles(description, follow_links=follow_links))
    train, test = _splits(document, description, reading.notes)
    beside = None if test else _test_file(description)
    if test_split and beside is not None:
        test = _frames(read_json(beside), beside)
    if test_split and not test:
        raise CaptureError(
            f"{description}: expected a test split, as 'test_filenames' or in "
            f"{' or '.join(TEST_NAMES[:2])} beside {TRAIN_NAME}, received none; hold out "
            "views, lights or photographs instead"
        )
    used = [*train, *(test if test_split else ())]
    reading.notes += _notes(train, description)
    if test_split and beside is not None:
        reading.notes += _notes(test, beside)
    elif test or beside is not None:
        reading.notes.append(
            f"{description}: the test split ({beside.name if beside else len(test)}) is not "
            "used; `hold_out=HoldOut(test=True)` compares with it"
        )
    check_counts(str(description), 0, 0, len(used))
    check_lights(used)
    for number, frame in enumerate(used):
        reading.add(frame, is_test=number >= len(train))
    reading.notes += _mask_notes(reading, description) + _angle_notes(reading)
    return _capture(reading, document, description)


def _mask_notes(reading: _Reading, description: Path) -> list[str]:
    """Say that of several masks of one camera the first is used."""
    if not reading.other_masks:
        return []
    view, other = next(iter(reading.other_masks.items()))
    return [
        f"{description}: mask_path: {len(reading.other_masks)} of {len(reading.cameras.items)} "
        f"cameras have several masks, of which the first is used ({reading.silhouettes[view]}, "
        f"not {other})"
    ]


def _angle_notes(reading: _Reading) -> list[str]:
    """Say that focal lengths are used, where angles contradict them."""
    if not reading.contradicted:
        return []
    count = f"{len(reading.contradicted)} of {len(reading.cameras.items)} cameras"
    return [f"{reading.contradicted[0]} ({count}); the length is used"]


def _capture(reading: _Reading, document: Mapping[str, Any], description: Path) -> Capture:
    cameras, lights, root = reading.cameras.items, reading.lights.items, description.parent
    check_counts(str(description), len(cameras), len(lights), len(reading.photographs))
    names = unique_names([p.path for p in reading.photographs], root)
    return Capture(
        name=printable(root.resolve().name),
        root=root,
        cameras=numbered(cameras, "v"),
        lights=numbered(lights, "l"),
        photographs=tuple(
            replace(photograph, name=name)
            for photograph, name in zip(reading.photographs, names, strict=True)
        ),
        base_geometry=usual_base_geometry(len(cameras)),
        silhouettes=tuple(reading.silhouettes.get(view) for view in range(len(cameras))),
        up=_up(document, cameras, description),
        format="transforms",
        description=description,
        notes=tuple(reading.notes),
    )


def _frames(document: Mapping[str, Any], description: Path) -> list[Frame]:
    """All frames of a file."""
    frames = document.get("frames")
    if not isinstance(frames, list) or not frames:
        raise CaptureError(f"{description}: expected a list 'frames' that is not empty")
    common = {key: value for key, value in document.items() if key != "frames"}
    result = []
    for index, own in enumerate(frames):
        if not isinstance(own, dict) or not isinstance(own.get("file_path"), str):
            raise CaptureError(f"{description}: frames[{index}]: expected a 'file_path'")
        what = f"{description}: frame {index} ({quoted(own['file_path'])})"
        result.append(Frame(own, common, what))
    return result


def _notes(frames: Sequence[Frame], description: Path) -> list[str]:
    return [f"{description}: {note}" for note in check_keys(frames[0].common, frames)]


def _splits(
    document: Mapping[str, Any], description: Path, notes: list[str]
) -> tuple[list[Frame], list[Frame]]:
    """Frames of the capture, and of the test split that the file itself lists."""
    frames = _frames(document, description)
    listed = {key: _file_names(document, key, description) for key in SPLIT_KEYS}
    train, test = (
        listed["train_filenames"],
        listed["test_filenames"] or listed["val_filenames"],
    )
    if not train and not test:
        return frames, []
    elsewhere = set().union(*listed.values()) if not train else set()
    kept = [f for f in frames if (_key(f) in train if train else _key(f) not in elsewhere)]
    tests = [f for f in frames if _key(f) in test]
    missing = set().union(*listed.values()) - {_key(f) for f in frames}
    both = train & test
    if missing or both or not kept:
        raise CaptureError(
            f"{description}: expected each of {', '.join(SPLIT_KEYS)} to name frames of this "
            f"file, no frame for training and test, and some for training, received "
            f"{quoted(sorted(missing or both)[:3])}"
        )
    if len(kept) + len(tests) < len(frames):
        unused = len(frames) - len(kept) - len(tests)
        notes.append(f"{description}: {unused} frames of other splits are not used")
    return kept, tests


def _file_names(document: Mapping[str, Any], key: str, description: Path) -> set[str]:
    names = document.get(key) or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise CaptureError(
            f"{description}: {key}: expected a list of file names, received {quoted(names)}"
        )
    return {_slashed(name) for name in names}


def _key(frame: Frame) -> str:
    return _slashed(frame.own["file_path"])


def _slashed(name: str) -> str:
    return name.replace("\\", "/").removeprefix("./")


def _test_file(description: Path) -> Path | None:
    """File of the test split beside a file of the training split."""
    if description.name != TRAIN_NAME:
        return None
    candidates = [description.with_name(name) for name in TEST_NAMES]
    return next((file for file in candidates if file.is_file()), None)


def _image_path(files: NamedFiles, frame: Frame) -> Path:
    """The frame's file; without a suffix, ``file_ext`` or the first image suffix that fits."""
    text, suffix = frame.own["file_path"], frame.get("file_ext")
    if suffix is not None and not (isinstance(suffix, str) and suffix.startswith(".")):
        raise CaptureError(
            f"{frame.what}: file_ext: expected a suffix such as '.png', received "
            f"{quoted(suffix)}"
        )
    if text.lower().endswith(IMAGE_SUFFIXES):
        return files.path(text)
    return files.path(text, [suffix, *IMAGE_SUFFIXES] if suffix else IMAGE_SUFFIXES)


def _up(
    document: Mapping[str, Any], cameras: list[Camera], description: Path
) -> NDArray[np.float64]:
    if document.get("up") is None:
        return estimated_up(cameras)
    up = number_array(document["up"], [(3,)], f"{description}: up")
    if not np.linalg.norm(up) > 0:
        raise CaptureError(f"{description}: up: expected 3 numbers, not all zero")
    return up / np.linalg.norm(up)
