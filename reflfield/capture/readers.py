"""Opening a capture: which reader, and the checks that every capture passes."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from reflfield.capture import lp, middlebury, native, transforms_json
from reflfield.capture.capture import Capture
from reflfield.capture.consistency import (
    check_environments,
    check_lights,
    check_pairs,
    check_photographs,
    unphotographed,
)
from reflfield.capture.documents import parse_count, read_json, read_text
from reflfield.capture.image_files import AS_STATED, ImageReading
from reflfield.capture.plausibility import check_code_range, far_lights, oblong_pixels
from reflfield.capture.pose_convention import check_poses
from reflfield.errors import CaptureError
from reflfield.util.files import check_regular

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Reader:
    """A way to read captures: the files it recognises by name, and how it reads them."""

    pattern: str  # glob, within the capture's folder
    read: Callable[..., Capture]


READERS = {
    "native": Reader(native.FILE_NAME, native.read_native),
    "transforms": Reader(transforms_json.FILE_NAME, transforms_json.read_transforms),
    "middlebury": Reader("*" + middlebury.SUFFIX, middlebury.read_middlebury),
    "lp": Reader("*" + lp.SUFFIX, lp.read_lp),
}


def open_capture(
    path: Path | str,
    format: str | None = None,
    *,
    require_photographs: bool = True,
    follow_links: bool = False,
    test_split: bool = False,
    reading: ImageReading = AS_STATED,
) -> Capture:
    """Open a capture, or frames to relight.

    Parameters
    ----------
    path : Path or str
        A folder with exactly one description in it, or a description file.
    format : {"native", "transforms", "middlebury", "lp"}, optional
        Reader to use; None tells by content.
    require_photographs : bool
        Whether every photograph must exist, once per camera and light, in its camera's
        size. False for frames that are only rendered.
    follow_links : bool
        Whether symbolic links may lead out of the capture's folder, as those of a download
        cache do.
    test_split : bool
        Whether to add the photographs that the capture's maker keeps for comparison, as
        ``transforms_test.json`` beside ``transforms_train.json`` does. They are marked
        (`Photograph.is_test`) and come after the others.
    reading : ImageReading, optional
        Encoding, layer and white level of all photographs, before what the description says.

    Returns
    -------
    Capture

    Raises
    ------
    CaptureError
        If there is no description or several, what it describes cannot be used, or there
        is no test split to add.
    """
    if format is not None and format not in READERS:
        raise CaptureError(f"format: expected {', '.join(READERS)}, received {format!r}")
    path = Path(path)
    if not path.exists():
        raise CaptureError(
            f"{path}: expected a capture's folder or description; does not exist"
        )
    if path.is_dir():
        description, kind = _description_in(path, format)
    else:
        description, kind = path, format or _kind_of_file(path)
    capture = _read(description, kind, follow_links=follow_links, test_split=test_split)
    capture = capture.read_as(reading)
    check_environments(capture)
    if require_photographs:
        check_pairs(capture)
        check_lights(capture)
        check_poses(capture.cameras, capture.description)
        check_photographs(capture)
        check_code_range(capture)
        more = (*unphotographed(capture), *far_lights(capture), *oblong_pixels(capture))
        capture = replace(capture, notes=(*capture.notes, *more))
    for note in capture.notes:
        _logger.warning("%s", note)
    return capture


def _read(description: Path, format: str, *, follow_links: bool, test_split: bool) -> Capture:
    """Read a description of a known format."""
    if format == "transforms":
        return transforms_json.read_transforms(
            description, follow_links=follow_links, test_split=test_split
        )
    if test_split:
        raise CaptureError(
            f"test_split: expected transforms.json with a test split, received {description}, "
            f"a {format} capture, which has none; hold out views=K, lights=K or "
            "photographs=K instead"
        )
    return READERS[format].read(description, follow_links=follow_links)


def _description_in(folder: Path, format: str | None) -> tuple[Path, str]:
    """The one description in a folder and its format."""
    descriptions = [
        (file, name)
        for name, reader in READERS.items()
        if format in (None, name)
        for file in sorted(folder.glob(reader.pattern))
        if not file.is_dir()
    ]
    train = folder / transforms_json.TRAIN_NAME
    if not descriptions and format in (None, "transforms") and train.is_file():
        return train, "transforms"
    if len(descriptions) == 1:
        return descriptions[0]
    for name in (native.FILE_NAME, transforms_json.FILE_NAME):
        other = folder / name
        if not descriptions and (other.is_dir() or other.is_symlink()):
            check_regular(other, CaptureError)  # says what it is
    wanted = ", ".join(r.pattern for name, r in READERS.items() if format in (None, name))
    received = ", ".join(file.name for file, _ in descriptions) or "none of them"
    remedy = "name the file itself" if descriptions else "is this the capture's own folder?"
    raise CaptureError(f"{folder}: expected one of {wanted}, received {received}; {remedy}")


def _kind_of_file(path: Path) -> str:
    """Format of a description file, by what it holds."""
    text = read_text(path)
    if text.lstrip().startswith("{"):
        document = read_json(path)
        if document.get("format") == native.FORMAT:
            return "native"
        if "frames" in document:
            return "transforms"
    else:
        lines = middlebury.uncommented(text)
        words = lines[1] if len(lines) > 1 and parse_count(" ".join(lines[0])) else []
        if len(words) > middlebury.N_NUMBERS:
            return "middlebury"
        if len(words) > 3:
            return "lp"
    raise CaptureError(
        f"{path}: expected a capture description (capture.json, transforms.json, *_par.txt or "
        f"*.lp), received {json.dumps(text[:40])}"
    )
