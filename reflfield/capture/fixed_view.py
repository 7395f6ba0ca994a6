"""Captures of one fixed view: photographs of a flat sample or a face under many lights."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import PLANE, Capture
from reflfield.capture.dark_frames import DarkFrame
from reflfield.capture.documents import check_counts
from reflfield.capture.encoding import LINEAR, Encoding
from reflfield.capture.image_files import AS_STATED, ImageReading
from reflfield.capture.image_headers import read_header
from reflfield.capture.lights import Light
from reflfield.capture.names import IMAGE_SUFFIXES, unique_names
from reflfield.capture.paths import NamedFiles
from reflfield.capture.photographs import Exposure, Photograph
from reflfield.errors import CaptureError
from reflfield.util.quoting import listed, printable

IMAGE_WIDTH = 1.0  # metres
CAMERA_HEIGHT = 10.0  # metres above the plane; only a sign for an orthographic camera
# Lights all lower than this (a sine) over the image plane light nothing evenly: their numbers
# mean something else.
LOWEST = 0.05
MOST_BEHIND = 0.25  # share of the lights with z <= 0 that may be slips or nearly level
# Longest of directions over the shortest; those of one length are rounded.
MOST_UNEQUAL = 1.1
# Words of files that lie beside photographs and are none.
_OTHER_IMAGES = re.compile(r"mask|normals?|gt|ref|depth|albedo|dark|ambient|preview|thumb")
_MASK, _DARK = re.compile(r"mask"), re.compile(r"dark|ambient")
_SHRUNK = re.compile(r"preview|thumb")
_WORD_ENDS = re.compile(r"[_\-. ]+")
_COLOUR_CHUNKS = (b"sRGB", b"gAMA", b"cHRM", b"cICP", b"iCCP")
_FOLDERS = ("Objects", "images", "Images", "photographs", "jpg", "png", "jpeg-exports")


@dataclass(frozen=True)
class FixedView:
    """Photographs of one view, and its mask.

    Parameters
    ----------
    photographs : tuple of Path
        In the order of the lights.
    mask : Path or None
    dark : tuple of Path
        Images that are called a dark frame, or one of ambient light: one is subtracted.
    """

    photographs: tuple[Path, ...]
    mask: Path | None
    dark: tuple[Path, ...] = ()


def fixed_view_capture(
    view: FixedView,
    lights: Sequence[Light],
    files: NamedFiles,
    *,
    camera: Camera,
    format: str,
    details: Sequence[str] = (),
    notes: Sequence[str] = (),
    reading: ImageReading = AS_STATED,
) -> Capture:
    """Make a capture of one view.

    Parameters
    ----------
    view : FixedView
    lights : sequence of Light
        Of the photographs, in their order.
    files : NamedFiles
        Of the description.
    camera : Camera
    format : str
        Name of the reader.
    details, notes, reading
        As of the capture.
    """
    check_counts(str(files.description), 1, len(lights), len(view.photographs))
    names = unique_names(list(view.photographs), files.root)
    dark = DarkFrame(view.dark[0], reading=reading) if len(view.dark) == 1 else None
    if dark is not None:
        details = (*details, f"dark frame {dark.path}, subtracted from all photographs")
    elif view.dark:
        words = f"{files.description}: not subtracted: {listed([p.name for p in view.dark])}"
        notes = (*notes, f"{words}, since only one dark frame can be; name it in capture.json")
    return Capture(
        name=printable(files.root.resolve().name),
        root=files.root,
        cameras=(camera,),
        lights=tuple(replace(light, id=f"l{i:04d}") for i, light in enumerate(lights)),
        photographs=tuple(
            Photograph(name, 0, i, (Exposure(path, reading=reading),), dark=dark)
            for i, (name, path) in enumerate(zip(names, view.photographs, strict=True))
        ),
        base_geometry=PLANE,
        silhouettes=(view.mask,),
        up=np.array([0.0, 1.0, 0.0]),
        format=format,
        description=files.description,
        notes=tuple(notes),
        details=tuple(details),
    )


def orthographic_camera(size: tuple[int, int], width: float = IMAGE_WIDTH) -> Camera:
    """Camera above the world's plane z = 0, whose image is `width` metres wide.

    Examples
    --------
    >>> orthographic_camera((100, 50)).project([[0.5, 0.0, 0.0]])[0]
    array([[100.,  25.]])
    """
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = CAMERA_HEIGHT
    return Camera(
        id="view",
        kind="orthographic",
        width=size[0],
        height=size[1],
        fl_x=size[0] / width,
        fl_y=size[0] / width,
        cx=size[0] / 2,
        cy=size[1] / 2,
        camera_from_world=pose,
    )


def notes_on_lights_behind(
    directions: Sequence[Sequence[float]], description: Path
) -> tuple[str, ...]:
    """A note on lights behind the image plane; many of them are of another convention.

    Raises
    ------
    CaptureError
        If they are more than `MOST_BEHIND` of all, or all are in the image plane.
    """
    behind = sum(direction[2] <= 0 for direction in directions)
    if behind > MOST_BEHIND * len(directions):
        raise CaptureError(
            f"{description}: expected light directions (x right, y up, z towards the camera) "
            f"in front of the image, z > 0, received {behind} of {len(directions)} others; "
            "do they have another axis towards the camera, or are they angles?"
        )
    heights = [direction[2] / math.hypot(*direction) for direction in directions]
    if len(heights) > 1 and max(heights) < LOWEST:
        raise CaptureError(
            f"{description}: expected light directions x y z, z towards the camera, received "
            f"{len(directions)} that are all within {math.degrees(math.asin(LOWEST)):.0f} "
            "degrees of the image plane; are they angles?"
        )
    if not behind:
        return ()
    return (
        f"{description}: {behind} of {len(directions)} lights are behind the image plane "
        "(z <= 0); their photographs show nothing of it",
    )


def notes_on_lengths(
    directions: Sequence[Sequence[float]], description: Path
) -> tuple[str, ...]:
    """A note on directions whose lengths differ, as those of positions do."""
    lengths = [math.hypot(*direction) for direction in directions]
    if max(lengths) <= MOST_UNEQUAL * min(lengths):
        return ()
    return (
        f"{description}: light directions have lengths of {min(lengths):.4g} to "
        f"{max(lengths):.4g}, which count for nothing; if they are positions of near lights, "
        "write them in a .dome of relight or in lights.csv, if intensities, in capture.json",
    )


def photographs_beside(description: Path, files: NamedFiles, n_lights: int) -> FixedView:
    """The photographs of one view beside a description that does not name them.

    They lie in the folder itself or in one of its folders, one for each light in the order of
    their names, numbers counted as numbers. Masks, normals and the like do not count.

    Raises
    ------
    CaptureError
        If no folder holds as many, or several do.
    """
    here = _view_in(files.root, files)
    if len(here.photographs) == n_lights:
        return here
    usual = [files.root / name for name in _FOLDERS if (files.root / name).is_dir()]
    others = sorted(path for path in files.root.iterdir() if path.is_dir())
    for folders in (usual, others):
        views = [_view_in(folder, files) for folder in folders]
        fitting = [v for v in views if len(v.photographs) == n_lights]
        if len(fitting) == 1:
            return fitting[0]
        if fitting:
            names = listed([view.photographs[0].parent.name for view in fitting])
            raise CaptureError(
                f"{description}: expected one folder with {n_lights} photographs, received "
                f"several ({names}); open one of them"
            )
    raise CaptureError(
        f"{description}: expected {n_lights} photographs, one for each light, in {files.root} "
        f"or in a folder there, received {len(here.photographs)}; remove others, or name the "
        "photographs in an .lp file"
    )


def mask_beside(folder: Path, files: NamedFiles) -> Path | None:
    """The one image in a folder that is called a mask."""
    masks = [path for path in _images_in(folder, files) if _is_called(path, _MASK)]
    return masks[0] if len(masks) == 1 else None


def dark_beside(
    folder: Path, files: NamedFiles, photographs: Sequence[Path] = ()
) -> tuple[Path, ...]:
    """Images in a folder that are called a dark frame, or one of ambient light.

    They show the view without any lamp: ``dark.png``, ``ambient.jpg``, ``cup_dark.png``. What
    is listed among the photographs is none.
    """
    if not folder.is_dir():
        return ()
    called = [path for path in _images_in(folder, files) if _is_called(path, _DARK)]
    return tuple(p for p in called if not _is_called(p, _SHRUNK) and p not in photographs)


def linear_unless_stated(path: Path) -> ImageReading:
    """Reading of photometric stereo sets: PNG files that state no colour are linear.

    So the programs of these sets take them; sRGB is what they would be elsewhere.
    """
    if not path.is_file():
        return AS_STATED
    header = read_header(path)
    if header.kind != "png" or not header.chunks.keys().isdisjoint(_COLOUR_CHUNKS):
        return AS_STATED
    return ImageReading(encoding=Encoding(LINEAR))


def _view_in(folder: Path, files: NamedFiles) -> FixedView:
    images = _images_in(folder, files)
    shown = [path for path in images if not _is_called(path, _OTHER_IMAGES)]
    return FixedView(tuple(shown), mask_beside(folder, files), dark_beside(folder, files))


def _images_in(folder: Path, files: NamedFiles) -> list[Path]:
    names = [path.name for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
    relative = folder.relative_to(files.root)
    return [files.path((relative / name).as_posix()) for name in sorted(names, key=natural_key)]


def _is_called(path: Path, words: re.Pattern[str]) -> bool:
    return any(words.fullmatch(word) for word in _WORD_ENDS.split(path.stem.lower()))


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Key that sorts numbers in names by their value.

    Examples
    --------
    >>> sorted(["a10", "a9", "b"], key=natural_key)
    ['a9', 'a10', 'b']
    """
    parts = re.findall(r"\d{1,18}|\D+|\d", name.casefold())
    return [(0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts]
