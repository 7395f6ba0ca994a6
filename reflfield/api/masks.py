"""Making masks of the views of a capture, from Python and by the command."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.api.captures import open_capture
from reflfield.capture.capture import PLANE, Capture
from reflfield.capture.encoding import parse_encoding
from reflfield.capture.image_files import ImageReading, read_image
from reflfield.capture.image_writing import write_png
from reflfield.errors import InputError
from reflfield.geometry.guided_masks import MaskOptions, guided_masks
from reflfield.util.files import filling

# Photographs of a view whose mean is looked at, at most.
MOST_PHOTOGRAPHS = 8
SCORES = "scores.json"
_HEX = re.compile(r"#?([0-9a-fA-F]{6})")


@dataclass(frozen=True)
class MadeMask:
    """A mask that was written.

    Parameters
    ----------
    view : str
    path : Path
    score : float
        Overlap with the outline of the hull of all masks, 0 to 1.
    is_doubtful : bool
    """

    view: str
    path: Path
    score: float
    is_doubtful: bool


def make_masks(
    capture: Capture | Path | str,
    out: Path | str,
    *,
    backdrop: Sequence[str] = (),
    clean_plate: Path | None = None,
    rounds: int = 2,
    format: str | None = None,
    encoding: str | None = None,
    layer: str | None = None,
    follow_links: bool = False,
) -> list[MadeMask]:
    """Write a mask for each view, and ``scores.json``; masks of the capture are not looked at.

    Parameters
    ----------
    capture : Capture, Path or str
        Of several views.
    out : Path or str
        Folder; gets NAME.png of each view, named as its first photograph within the folder of
        all photographs. Masks there that this function did not write stay as they are.
    backdrop : sequence of str
        Colours of the backdrop as sRGB, ``d8d6da`` in hexadecimal digits.
    clean_plate : Path, optional
        Photograph without the object, of a camera that stands still; or a folder with one for
        each view, named as the view or as its first photograph.
    rounds : int
        Times that hull and masks are made, 1 to 5.
    format, encoding, layer, follow_links
        As of `open_capture`.

    Raises
    ------
    InputError
        If the capture has one view, a colour cannot be read, a plate is missing, or other
        masks are in the way.
    GeometryError
        If the first masks have no common hull.
    """
    if not isinstance(capture, Capture):
        capture = open_capture(
            capture, format, encoding=encoding, layer=layer, follow_links=follow_links
        )
    if capture.base_geometry == PLANE:
        raise InputError(
            "capture: expected several views, which show where the object is, received one "
            "view of a flat sample"
        )
    if backdrop and clean_plate is not None:
        raise InputError("clean_plate: expected either this or backdrop, received both")
    options = MaskOptions(tuple(parse_colour(text) for text in backdrop), rounds)
    stated = parse_encoding(encoding) if encoding is not None else None
    views = _Views(capture, clean_plate, ImageReading(encoding=stated, layer=layer))
    plate = views.plate if clean_plate is not None else None
    names = [views.name(i) for i in range(capture.n_views)]
    out = Path(out)
    _refuse_other_masks(out, names)
    masks = guided_masks(capture.cameras, views.photograph, options, plate)
    with filling(out) as folder:
        for name, mask in zip(names, masks, strict=True):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_png(folder / f"{name}.png", mask.covered.astype(np.uint8) * np.uint8(255))
        scores = {name: round(mask.score, 4) for name, mask in zip(names, masks, strict=True)}
        (folder / SCORES).write_text(json.dumps(scores, indent=1) + "\n")
    return [
        MadeMask(camera.id, out / f"{name}.png", mask.score, mask.is_doubtful)
        for camera, name, mask in zip(capture.cameras, names, masks, strict=True)
    ]


def _refuse_other_masks(out: Path, names: Sequence[str]) -> None:
    """Refuse names that two views share, and masks that were made or corrected by others."""
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(
            f"capture: expected photographs whose names differ without their suffixes, "
            f"received two views {twice!r}; rename one"
        )
    scores = out / SCORES
    there = [path for name in names if (path := out / f"{name}.png").exists()]
    if scores.is_file():
        written, own = scores.stat().st_mtime_ns, scores.read_text(errors="replace")
        there = [
            path
            for path in there
            if path.stat().st_mtime_ns > written
            or json.dumps(path.relative_to(out).with_suffix("").as_posix()) not in own
        ]
    if there:
        raise InputError(
            f"{there[0]}: expected no mask, or one as this command left it, received another "
            f"({len(there)} of {len(names)}); choose another folder, or remove it"
        )


def parse_colour(text: str) -> tuple[float, float, float]:
    """Read sRGB values in [0, 1] from six hexadecimal digits.

    Examples
    --------
    >>> parse_colour("ff0000"), parse_colour("#0000FF")
    ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    """
    matched = _HEX.fullmatch(text.strip())
    if matched is None:
        raise InputError(
            f"backdrop: expected a colour of six hexadecimal digits such as d8d6da, received "
            f"{text!r}"
        )
    red, green, blue = (int(matched[1][i : i + 2], 16) / 255 for i in (0, 2, 4))
    return red, green, blue


@dataclass(frozen=True, eq=False)
class _Views:
    """Photographs and plates of the views of a capture."""

    capture: Capture
    plates: Path | None
    reading: ImageReading

    def _photographs(self, view: int) -> list[int]:
        indices = [i for i, p in enumerate(self.capture.photographs) if p.camera == view]
        if not indices:
            raise InputError(
                f"view {self.capture.cameras[view].id!r}: expected a photograph, received none"
            )
        return indices[:: -(-len(indices) // MOST_PHOTOGRAPHS)]

    def name(self, view: int) -> str:
        """Path of the first photograph of a view, without suffix, in the folder of all."""
        paths = [photograph.path for photograph in self.capture.photographs]
        folder = os.path.commonpath([path.parent for path in paths])
        first = paths[self._photographs(view)[0]]
        return first.relative_to(folder).with_suffix("").as_posix()

    def photograph(self, view: int) -> NDArray[np.float32]:
        """Mean of some photographs of a view, linear."""
        some = self._photographs(view)
        total = sum(self.capture.read_photograph(i).astype(np.float64) for i in some)
        return np.asarray(total / len(some), np.float32)

    def plate(self, view: int) -> NDArray[np.float32]:
        """Photograph of a view without the object, linear."""
        path = self.plates
        assert path is not None
        if path.is_dir():
            stems = (Path(self.name(view)).name, self.capture.cameras[view].id)
            fitting = sorted(p for p in path.iterdir() if p.stem in stems and p.is_file())
            if not fitting:
                raise InputError(
                    f"{path}: expected a photograph called {stems[0]} or {stems[1]}, the view "
                    "without the object, found none"
                )
            path = fitting[0]
        return _read_plate(path, self.reading)


@lru_cache(maxsize=1)
def _read_plate(path: Path, reading: ImageReading) -> NDArray[np.float32]:
    return read_image(path, reading)
