"""Reader of ReNe (Relight My NeRF): one folder for each lamp, poses beside the photographs.

A folder ``lset000`` holds ``camera.yml`` (the lens, as of OpenCV's calibration), ``light.txt``
(a 4 x 4 matrix, whose last column is the lamp's position), and in ``data`` the photographs
``00_image.png`` with their poses ``00_pose.txt`` (4 x 4, camera to world, OpenCV axes). A scene
has forty such folders; one alone is a capture of one lamp. The photographs that the published
data set holds back are black; they are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.calibrated_views import View, assembled_capture
from reflfield.capture.cameras import Camera, not_rigid_because
from reflfield.capture.capture import Capture
from reflfield.capture.described_items import camera_of_matrix, described_light
from reflfield.capture.documents import number_array, parse_number, read_text
from reflfield.capture.image_files import read_image
from reflfield.capture.lights import Light
from reflfield.capture.names import IMAGE_SUFFIXES
from reflfield.capture.paths import NamedFiles
from reflfield.errors import CaptureError
from reflfield.util.quoting import quoted

try:
    import yaml
except ModuleNotFoundError:
    yaml = None

Array = NDArray[np.float64]

FILE_NAME, LIGHT_NAME, DATA = "camera.yml", "light.txt", "data"
# The first lamp's folder stands for the scene.
PATTERNS = (FILE_NAME, f"lset000/{FILE_NAME}")
MOST_YAML_BYTES = 100_000
# A black PNG takes this share of the bytes of the median photograph at most.
BLACK_SHARE = 0.05


def is_rene(path: Path) -> bool:
    """Whether a lens has a lamp and photographs beside it."""
    return path.with_name(LIGHT_NAME).is_file() and path.with_name(DATA).is_dir()


def read_rene(description: Path, *, follow_links: bool = False) -> Capture:
    """Read a scene of ReNe, or the photographs under one of its lamps.

    Parameters
    ----------
    description : Path
        ``camera.yml`` of one lamp; of a scene that of ``lset000``.
    follow_links : bool
        Whether symbolic links may lead out of the folder of the scene.

    Returns
    -------
    Capture
        Point lights of intensity 1.

    Raises
    ------
    CaptureError
        If a file is malformed or missing, or PyYAML is not installed.
    """
    first = description.parent
    scene = first.name == "lset000"
    root = first.parent if scene else first
    lamps = (
        sorted(p for p in root.glob("lset*") if is_rene(p / FILE_NAME)) if scene else [first]
    )
    files = NamedFiles(description, follow_links=follow_links, root=root)
    views: list[View] = []
    paths: list[Path] = []
    for lamp in lamps:
        _add_lamp(lamp, files, views, paths)
    if not paths:
        raise CaptureError(
            f"{first / DATA}: expected photographs N_image.png with poses N_pose.txt, received "
            "none; extract the data set"
        )
    black = _black(paths)
    kept = [i for i, path in enumerate(paths) if path not in black]
    notes = [f"{root}: {len(black)} black photographs are left out"] if black else []
    return assembled_capture(
        [views[i] for i in kept],
        [paths[i] for i in kept],
        [None] * len(kept),
        files,
        format="rene",
        details=[f"ReNe {root}: {len(lamps)} lamps, intensity 1"],
        notes=notes,
    )


def _add_lamp(lamp: Path, files: NamedFiles, views: list[View], paths: list[Path]) -> None:
    """Add the photographs under one lamp."""
    lens = _lens(lamp / FILE_NAME)
    light = _light(lamp / LIGHT_NAME)
    names = [p.name for p in (lamp / DATA).iterdir() if p.suffix.lower() in IMAGE_SUFFIXES]
    for name in sorted(name for name in names if "_image." in name):
        folder = (lamp / DATA).relative_to(files.root).as_posix()
        path = files.path(f"{folder}/{name}")
        pose = path.with_name(name.rpartition("_image.")[0] + "_pose.txt")
        views.append(View(name, _camera(lens, _matrix(pose), str(pose)), light))
        paths.append(path)


def _lens(path: Path) -> dict[str, Array]:
    """Camera matrix, distortion and image size."""
    if yaml is None:
        raise CaptureError(
            f"{path}: expected PyYAML to read it, which is not installed; pip install "
            '"reflfield[yaml]"'
        )
    text = read_text(path)
    if len(text) > MOST_YAML_BYTES or "&" in text or "*" in text:
        raise CaptureError(
            f"{path}: expected at most {MOST_YAML_BYTES:,} characters of YAML without anchors"
        )
    try:
        document: Any = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise CaptureError(f"{path}: expected YAML, received {error}") from error
    inner = document.get("intrinsics") if isinstance(document, Mapping) else None
    if not isinstance(inner, Mapping):
        raise CaptureError(f"{path}: expected 'intrinsics', received {quoted(document)[:200]}")
    _check_keys(inner, path)
    shapes: dict[str, list[tuple[int | None, ...]]] = {
        "camera_matrix": [(3, 3)],
        "image_size": [(2,)],
        "dist_coeffs": [(4,), (5,), (8,), (1, 4), (1, 5), (1, 8), (5, 1), (4, 1), (8, 1)],
    }
    return {
        key: number_array(inner.get(key), allowed, f"{path}: {key}")
        for key, allowed in shapes.items()
    }


def _check_keys(inner: Mapping[str, Any], path: Path) -> None:
    known = {"camera_matrix", "image_size", "dist_coeffs"}
    for key in sorted(set(map(str, inner)) - known):
        raise CaptureError(
            f"{path}: {quoted(key)}: expected only {', '.join(sorted(known))} of 'intrinsics'"
        )


def _camera(lens: Mapping[str, Array], world_from_camera: Array, what: str) -> Camera:
    fault = not_rigid_because(world_from_camera)
    if fault:
        raise CaptureError(f"{what}: expected a rotation and a translation, received {fault}")
    matrix, size = lens["camera_matrix"], lens["image_size"]
    return camera_of_matrix(
        what,
        matrix,
        size,
        np.linalg.solve(world_from_camera, np.eye(4)),
        distortion=tuple(lens["dist_coeffs"].ravel().tolist()),
    )


def _light(path: Path) -> Light:
    return described_light(str(path), "point", position=_matrix(path)[:3, 3])


def _matrix(path: Path) -> Array:
    """Matrix (4, 4) of a text file."""
    words = read_text(path).replace(",", " ").split()
    numbers = [parse_number(word) for word in words[:17]]
    if len(numbers) != 16 or None in numbers:
        raise CaptureError(
            f"{path}: expected a matrix of 4 x 4 finite numbers, received "
            f"{quoted(' '.join(words)[:200])}"
        )
    return np.array(numbers, dtype=np.float64).reshape(4, 4)


def _black(paths: list[Path]) -> set[Path]:
    """Photographs without any light; only small files are looked into."""
    sizes = {path: path.stat().st_size for path in paths}
    least = BLACK_SHARE * float(np.median(list(sizes.values())))
    return {p for p, size in sizes.items() if size < least and not read_image(p).any()}
