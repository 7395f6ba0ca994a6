"""Silhouettes of all training views in one file, from which each is read by itself."""

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

# In the folder of their stage.
SILHOUETTES = "silhouettes.npz"


def store_silhouettes(path: Path, silhouettes: Iterable[tuple[str, NDArray[np.uint8]]]) -> None:
    """Write silhouettes of 8 bits by name as an npz file, one in memory at a time."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, coverage in silhouettes:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, coverage, allow_pickle=False)


@dataclass(frozen=True, eq=False)
class StoredSilhouettes(Sequence[NDArray[np.float32]]):
    """Coverage (height, width) float32 of each view in [0, 1], read when it is asked for.

    Parameters
    ----------
    path : Path
        Written by `store_silhouettes`, with the names view0, view1 and so on.
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
        camera, name = self.cameras[view], f"view{view}"
        # Room for the header of an array beside its bytes.
        most = camera.width * camera.height + 4096
        coverage = load_arrays(self.path, most, names=[name])[name]
        return coverage.astype(np.float32) / np.float32(255)
