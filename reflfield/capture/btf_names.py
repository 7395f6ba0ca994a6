"""Reader of BTF images whose names say their directions (UBO2003, ATRIUM, UTIA, SPECTRAL).

A name holds ``tl``, ``pl``, ``tv`` and ``pv``, each with a number of degrees: the angle of the
light and of the view from the normal, and their azimuths from x (right) towards y (up).
Folders for the views, such as ``tv000_pv000``, are allowed. Images are rectified to the sample
(`rectified_samples`). Light gives an irradiance of 1 on a surface that faces it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from reflfield.capture.calibrated_views import View, assembled_capture
from reflfield.capture.capture import PLANE, Capture
from reflfield.capture.described_items import described_light
from reflfield.capture.documents import MAX_PHOTOGRAPHS
from reflfield.capture.image_files import image_size
from reflfield.capture.names import IMAGE_SUFFIXES
from reflfield.capture.paths import NamedFiles
from reflfield.capture.rectified_samples import directions_of_angles, rectified_camera
from reflfield.errors import CaptureError
from reflfield.util.quoting import quoted

_SUFFIXES = (*IMAGE_SUFFIXES, ".hdr")
_ANGLE = re.compile(r"(?<![A-Za-z])(tl|pl|tv|pv)[ _]?(-?\d{1,3}(?:\.\d{1,6})?)", re.ASCII)
_NAME = "*t[lv]*[pt][lv]*[pt][lv]*[pt][lv]*.*"
PATTERNS = (_NAME, f"tv*/{_NAME}")
_UTIA_FOLDER = re.compile(r"tv\d+_pv\d+")


def is_btf_image(path: Path) -> bool:
    """Whether a name says the four angles of an image."""
    return path.suffix.lower() in _SUFFIXES and _angles(path.name) is not None


def read_btf_images(description: Path, *, follow_links: bool = False) -> Capture:
    """Read a flat sample from images that are named by their directions.

    Parameters
    ----------
    description : Path
        One of the images; the others lie beside it, or in folders ``tv...`` beside its own.
    follow_links : bool
        Whether symbolic links may lead out of the folder of the sample.

    Returns
    -------
    Capture
        Of base geometry "plane": the view nearest to the normal comes first.

    Raises
    ------
    CaptureError
        If there are too many images, two of one name's angles, a view below the sample, or
        EXR files of UTIA, which hold XYZ.
    """
    folder = description.parent
    root = folder.parent if folder.name.startswith("tv") else folder
    files = NamedFiles(description, follow_links=follow_links, root=root)
    image_paths = _images(root, files)
    angles = np.radians([_angles(path.name) or () for path in image_paths]).reshape(-1, 2, 2)
    order = np.argsort(angles[:, 1, 0], kind="stable")
    lights, views = (directions_of_angles(angles[order, i]) for i in (0, 1))
    paths = [image_paths[i] for i in order]
    size = image_size(paths[0])
    capture = assembled_capture(
        [
            View(
                path.name,
                rectified_camera(view, size, str(path)),
                described_light(str(path), "directional", direction=light),
            )
            for path, view, light in zip(paths, views, lights, strict=True)
        ],
        paths,
        [None] * len(paths),
        files,
        format="btf-images",
        details=[f"images of a flat sample named by their directions, {paths[0]} first"],
    )
    up = np.array([0.0, 1.0, 0.0])
    return replace(capture, base_geometry=PLANE, up=up)


def _images(root: Path, files: NamedFiles) -> list[Path]:
    """Images below a folder whose names say four angles, in the order of their names."""
    paths = [path for pattern in PATTERNS for path in root.glob(pattern) if is_btf_image(path)]
    if len(paths) > MAX_PHOTOGRAPHS:
        raise CaptureError(
            f"{root}: expected at most {MAX_PHOTOGRAPHS:,} images, received {len(paths):,}"
        )
    for path in paths:
        if path.suffix.lower() == ".exr" and _UTIA_FOLDER.fullmatch(path.parent.name):
            raise CaptureError(
                f"{path}: expected the PNG files of a UTIA sample, received EXR, which hold "
                "XYZ there; use the PNG files, or convert them to linear RGB"
            )
    names = sorted(path.relative_to(root).as_posix() for path in paths)
    return [files.path(name) for name in names]


def _angles(name: str) -> Sequence[float] | None:
    """Degrees of light and view, (tl, pl, tv, pv); None if a name does not say all four."""
    said = _ANGLE.findall(name)
    values = {key: float(number) for key, number in said}
    if len(said) != 4 or len(values) != 4:
        return None
    if any(not 0 <= values[key] <= 90 for key in ("tl", "tv")):
        raise CaptureError(
            f"{quoted(name)}: expected angles tl and tv of 0 to 90 degrees in the name of a "
            f"BTF image, received {values['tl']} and {values['tv']}"
        )
    return [values[key] for key in ("tl", "pl", "tv", "pv")]
