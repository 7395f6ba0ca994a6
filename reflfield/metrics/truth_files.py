"""The truth that simulated captures carry: its files (``truth/``) opened, checked and read."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from reflfield.capture.documents import read_json
from reflfield.errors import CaptureError
from reflfield.util.files import load_arrays, read_bytes

Array = NDArray[np.float64]

TRUTH_VERSION = 1
# A file that takes more memory is not read; nor a view of more than eleven doubles a pixel.
MOST_BYTES = 1 << 30
BYTES_PER_PIXEL = 88
# Arrays of the files, and the lengths of their axes; one name is one length within a file.
VIEW_SHAPES = {
    "depth": "h w",
    "position": "h w 3",
    "normal": "h w 3",
    "tangent": "h w 3",
    "label": "h w",
}
SAMPLE_SHAPES = {
    "position": "n 3",
    "frame": "n 3 3",
    "views": "n views 3",
    "lights": "n lights 3",
    "light_visible": "n lights",
    "samples": "n views lights 3",
}


@dataclass(frozen=True, eq=False)
class TruthView:
    """What one camera truly sees, per pixel.

    Attributes
    ----------
    depth : (h, w) float32
        Distance along the ray of the pixel centre, metres; inf where it misses.
    position, normal, tangent : (h, w, 3) float32
        Surface point, shading normal and shading tangent, world frame.
    label : (h, w) int
        Material; -1 where the ray misses.
    """

    depth: NDArray[np.float32]
    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    tangent: NDArray[np.float32]
    label: NDArray[np.integer[Any]]


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth of a simulated capture; images and views are read on demand.

    Attributes
    ----------
    root : Path
        Folder of the capture.
    description : mapping
        Content of ``truth.json``.
    """

    root: Path
    description: Mapping[str, Any]

    def mesh(self) -> tuple[Array, NDArray[np.int32]]:
        """Vertices (n, 3), metres, and faces (m, 3) of the true surface."""
        path = self.path("mesh", "truth/mesh.ply")
        if path.suffix.lower() != ".ply":
            raise CaptureError(f"{path}: expected a mesh in a PLY file")
        content = read_bytes(path, MOST_BYTES, CaptureError)
        try:
            loaded = trimesh.load(
                io.BytesIO(content), file_type="ply", process=False, force="mesh"
            )
            vertices = np.array(loaded.vertices, np.float64).reshape(-1, 3)
            faces = np.array(loaded.faces, np.int32).reshape(-1, 3)
        except Exception as error:  # whatever its readers raise on damaged files
            text = " ".join(str(error).split()) or type(error).__name__
            raise CaptureError(
                f"{path}: expected a mesh, received a damaged or different file ({text})"
            ) from error
        promised = re.search(rb"element[ \t]+face[ \t]+(\d{1,18})", content)
        whole = promised is None or int(promised[1]) <= len(faces)
        inside = whole and ((faces >= 0) & (faces < len(vertices))).all()
        if not len(faces) or not inside or not np.isfinite(vertices).all():
            raise CaptureError(
                f"{path}: expected a mesh of faces between finite vertices, received "
                f"{len(vertices)} vertices and {len(faces)} faces that are not, or not all"
            )
        return vertices, faces

    def view(self, camera_id: str, size: tuple[int, int] | None = None) -> TruthView:
        """What the camera of this name, of (width, height) pixels, truly sees."""
        path, names = self._view_path(camera_id), TruthView.__annotations__
        most = MOST_BYTES if size is None else BYTES_PER_PIXEL * (size[0] * size[1] + 1024)
        arrays = load_arrays(path, most, CaptureError, names)
        _check_arrays(path, arrays, VIEW_SHAPES)
        if size is not None and arrays["depth"].shape != size[::-1]:
            raise CaptureError(
                f"{path}: expected {size[0]} x {size[1]} pixels as the camera has, received "
                f"{arrays['depth'].shape[1]} x {arrays['depth'].shape[0]}"
            )
        for name in ("position", "normal", "tangent", "depth"):
            if np.isnan(arrays[name]).any():
                raise CaptureError(f"{path}: {name}: expected numbers, received NaN")
        return TruthView(**{name: arrays[name] for name in names})

    def has_view(self, camera_id: str) -> bool:
        """Whether the truth of this camera's pixels was written."""
        return os.path.lexists(self._view_path(camera_id))

    def heldout(self) -> Path | None:
        """The frames file of unseen views and lights, if there is one."""
        path = self.path("heldout", "truth/heldout.json")
        return path if os.path.lexists(path) else None

    def samples(self) -> dict[str, NDArray[Any]] | None:
        """True apparent BRDFs of some surface points (``abrdf.npz``), if written.

        See `SAMPLE_SHAPES`. Positions and directions are finite; samples may be NaN.
        """
        path = self.path("abrdf", "truth/abrdf.npz")
        if not os.path.lexists(path):
            return None
        arrays = load_arrays(path, MOST_BYTES, CaptureError, SAMPLE_SHAPES)
        _check_arrays(path, arrays, SAMPLE_SHAPES)
        for name in ("position", "views", "lights", "frame"):
            if not np.isfinite(arrays[name]).all():
                raise CaptureError(f"{path}: {name}: expected finite numbers")
        return arrays

    def path(self, key: str, default: str) -> Path:
        """File that ``truth.json`` names under a key, inside the capture."""
        return _inside(self.root, self._named(key, default))

    def _view_path(self, camera_id: str) -> Path:
        pattern = self._named("views", "truth/views/{camera}.npz")
        return _inside(self.root, pattern.replace("{camera}", camera_id))

    def _named(self, key: str, default: str) -> str:
        named = self.description.get(key, default)
        if not isinstance(named, str):
            raise CaptureError(
                f"{self.root / 'truth' / 'truth.json'}: {key}: expected a path, received "
                f"{named!r:.100}"
            )
        return named


def open_truth(root: Path | str) -> Truth | None:
    """Open the truth of a capture directory.

    Parameters
    ----------
    root : Path or str
        Folder that holds ``truth/truth.json``.

    Returns
    -------
    Truth or None
        None where the capture carries no truth (photographs).

    Raises
    ------
    CaptureError
        If the file is not valid or of a newer version.
    """
    path = Path(root) / "truth" / "truth.json"
    if not os.path.lexists(path):
        return None
    description = read_json(path)
    version = description.get("version")
    if version != TRUTH_VERSION:
        raise CaptureError(
            f"{path}: expected version {TRUTH_VERSION}, received {version!r}; simulate again "
            "or update reflfield"
        )
    return Truth(Path(root), description)


def _inside(root: Path, relative: str) -> Path:
    path = root / relative
    try:
        inside = path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, a NUL character
        raise CaptureError(f"{relative!r}: expected a path, received none ({error})") from error
    if not inside:
        raise CaptureError(f"{relative!r}: expected a path inside {root}, received one outside")
    return path


def _check_arrays(
    path: Path, arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, str]
) -> None:
    """Demand numbers, and axes of one name to be of one length in all arrays."""
    lengths: dict[str, int] = {}
    for name, axes in shapes.items():
        array, expected = arrays[name], axes.split()
        fits = array.ndim == len(expected) and array.dtype.kind in "biuf"
        if not fits or any(
            lengths.setdefault(axis, int(axis) if axis.isdigit() else length) != length
            for axis, length in zip(expected, array.shape, strict=True)
        ):
            raise CaptureError(
                f"{path}: {name}: expected numbers of shape ({', '.join(expected)}), received "
                f"{array.dtype} of shape {array.shape}"
            )
