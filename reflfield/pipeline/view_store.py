"""Silhouettes, or depth edges, of all training views in one file: each is read by itself."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.util.files import load_arrays

# In the folders of their stages.
SILHOUETTES, EDGES = "silhouettes.npz", "edges.npz"
# Room for the header of an array beside its bytes.
HEADER_BYTES = 4096


def name_of(view: int) -> str:
    """Name of the array of a view.

    Examples
    --------
    >>> name_of(3)
    'view3'
    """
    return f"view{view}"


def store_views(path: Path, arrays: Iterable[tuple[str, NDArray[np.uint8]]]) -> None:
    """Write arrays of 8 bits by name as an npz file, one in memory at a time."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def stored_view(path: Path, view: int, camera: Camera) -> NDArray[np.uint8]:
    """Array of one view as `store_views` wrote it: a byte for each pixel at most."""
    name, most = name_of(view), camera.width * camera.height + HEADER_BYTES
    return load_arrays(path, most, names=[name])[name]


@dataclass(frozen=True, eq=False)
class StoredSilhouettes(Sequence[NDArray[np.float32]]):
    """Coverage (height, width) float32 of each view in [0, 1], read when it is asked for.

    Parameters
    ----------
    path : Path
        Written by `store_views`, in 255ths.
    cameras : sequence of Camera
        Of the views.
    """

    path: Path
    cameras: Sequence[Camera]

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, view: Any) -> Any:
        if not 0 <= view < len(self):
            raise IndexError(view)
        coverage = stored_view(self.path, view, self.cameras[view])
        return coverage.astype(np.float32) / np.float32(255)


def packed_mask(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Pixels of a mask row by row, eight in a byte."""
    return np.packbits(mask)


def unpacked_mask(bits: NDArray[np.uint8], camera: Camera) -> NDArray[np.bool_]:
    """Mask (height, width) of a camera's image that `packed_mask` has packed."""
    pixels = np.unpackbits(bits, count=camera.width * camera.height)
    return pixels.reshape(camera.height, camera.width).astype(np.bool_)
