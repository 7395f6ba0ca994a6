"""Opening a capture: which reader, and the checks that every capture passes."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

from reflfield.capture import middlebury, native, transforms_json
from reflfield.capture.btf_means import holds_btf
from reflfield.capture.capture import Capture
from reflfield.capture.capture_formats import OTHER_READERS, OWN_READERS, READERS, Reader
from reflfield.capture.consistency import (
    check_environments,
    check_lights,
    check_pairs,
    check_photographs,
    unphotographed,
)
from reflfield.capture.documents import parse_count, read_json, read_text
from reflfield.capture.image_files import AS_STATED, ImageReading
from reflfield.capture.light_table import light_table_of, with_lights
from reflfield.capture.masks_beside import with_masks_beside
from reflfield.capture.names import IMAGE_SUFFIXES
from reflfield.capture.plausibility import (
    check_code_range,
    differing_exposures,
    far_lights,
    oblong_pixels,
    stray_principal_points,
    wide_lenses,
)
from reflfield.capture.pose_convention import check_poses
from reflfield.errors import CaptureError
from reflfield.util.files import check_regular
from reflfield.util.quoting import listed

# Images of a folder without a description from which on they may be photographs of one view.
FEWEST_ALONE = 3
_logger = logging.getLogger(__name__)


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
    format : str, optional
        Reader to use, one of `capture_formats.READERS`; None tells by content.
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
    _refuse_btf(path)
    if path.is_dir():
        description, kind = _description_in(path, format)
    else:
        description, kind = path, format or _kind_of_file(path)
    capture = _read(description, kind, follow_links=follow_links, test_split=test_split)
    table = light_table_of(capture)
    if table is not None:
        capture = with_lights(capture, table, follow_links=follow_links)
    if path.is_dir() and format is None and kind in OWN_READERS:
        capture = replace(capture, notes=(*capture.notes, *_beside(path, description)))
    capture = capture.read_as(reading)
    check_environments(capture)
    if require_photographs:
        check_pairs(capture)
        check_lights(capture)
        check_poses(capture.cameras, capture.description)
        check_photographs(capture)
        more = (
            *check_code_range(capture),
            *differing_exposures(capture),
            *unphotographed(capture),
            *far_lights(capture),
            *oblong_pixels(capture),
            *stray_principal_points(capture),
            *wide_lenses(capture),
        )
        capture = replace(capture, notes=(*capture.notes, *more))
    for note in capture.notes:
        _logger.warning("%s", note)
    return capture


def _read(description: Path, format: str, *, follow_links: bool, test_split: bool) -> Capture:
    """Read a description of a known format, and masks that it may not name."""
    if format == "transforms":
        capture = transforms_json.read_transforms(
            description, follow_links=follow_links, test_split=test_split
        )
        return with_masks_beside(capture, follow_links=follow_links)
    if test_split:
        raise CaptureError(
            f"test_split: expected transforms.json with a test split, received {description}, "
            f"a {format} capture, which has none; hold out views=K, lights=K or "
            "photographs=K instead"
        )
    capture = READERS[format].read(description, follow_links=follow_links)
    if format in OWN_READERS:
        return with_masks_beside(capture, follow_links=follow_links)
    return capture


def _description_in(folder: Path, format: str | None) -> tuple[Path, str]:
    """The one description in a folder and its format."""
    own = _descriptions(folder, format, OWN_READERS)
    train = folder / transforms_json.TRAIN_NAME
    if not own and format in (None, "transforms") and train.is_file():
        return train, "transforms"
    descriptions = own or _descriptions(folder, format, OTHER_READERS)
    if len(descriptions) == 1:
        return descriptions[0]
    for name in (native.FILE_NAME, transforms_json.FILE_NAME):
        other = folder / name
        if not descriptions and (other.is_dir() or other.is_symlink()):
            check_regular(other, CaptureError)  # says what it is
    names = READERS if format is None else (format,)
    wanted = ", ".join(READERS[name].patterns[0] for name in names)
    received = ", ".join(str(file.relative_to(folder)) for file, _ in descriptions)
    remedy = "name the file itself" if descriptions else _remedy_without(folder)
    raise CaptureError(
        f"{folder}: expected one of {wanted}, received {received or 'none of them'}; {remedy}"
    )


def _remedy_without(folder: Path) -> str:
    """What to do about a folder without a description: photographs may show their lights."""
    n_images = sum(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.iterdir())
    if n_images < FEWEST_ALONE:
        return "is this the capture's own folder?"
    return (
        f"it holds {n_images} images alone: nothing tells their cameras and lights. Of one "
        "view with mirror or glossy spheres in it, `reflfield lights` finds the lights"
    )


def _descriptions(
    folder: Path, format: str | None, readers: Mapping[str, Reader]
) -> list[tuple[Path, str]]:
    return [
        (file, name)
        for name, reader in readers.items()
        if format in (None, name)
        for file in reader.descriptions(folder)
    ]


def _kind_of_file(path: Path) -> str:
    """Format of a description file, by its name and by what it holds."""
    for format_name, reader in OTHER_READERS.items():
        ends = {pattern.rpartition("/")[2] for pattern in reader.patterns}
        fits = any(
            fnmatch(name, end) for end in ends for name in (path.name, path.name.lower())
        )
        if fits and reader.recognises(path):
            return format_name
    _refuse_results(path)
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
        f"{path}: expected a capture description (capture.json, transforms.json, *_par.txt, "
        f"*.lp or another of the formats in the README), received {json.dumps(text[:40])}"
    )


def _refuse_results(path: Path) -> None:
    """Say that a photograph or a field is no capture."""
    suffix = path.suffix.lower()
    if suffix in (*IMAGE_SUFFIXES, ".rfld"):
        kind = "a field" if suffix == ".rfld" else "a photograph"
        raise CaptureError(
            f"{path}: expected a capture, received {kind}; name the folder or the description "
            "of the capture"
        )


def _refuse_btf(path: Path) -> None:
    """Say how a BTF container becomes a capture."""
    if holds_btf(path):
        raise CaptureError(
            f"{path}: expected a capture, received a BTF container; write it as one first, "
            f"with `reflfield convert {path.name} -o FOLDER`"
        )


def _beside(folder: Path, description: Path) -> tuple[str, ...]:
    """A note on what other programs left beside a description that is made for captures."""
    others = [file.name for file, _ in _descriptions(folder, None, OTHER_READERS)]
    if not others:
        return ()
    return (
        f"{description}: {listed(others)} beside it, which other programs left, is not read; "
        "name the file to read it instead",
    )
