"""Apparent BRDF samples of all texels on disk, written by views, read by texels.

A store is a folder with one zarr array ``samples`` of shape
(n_texels, n_views, n_lights, 3), half floats, in chunks of some texels and some
views. Which samples count follows from three small arrays beside it: the views
and lights that each texel sees, and the pairs that were photographed.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zarr
from numpy.typing import NDArray

from reflfield.checks import check_shape
from reflfield.errors import InputError

Bools = NDArray[np.bool_]

# A chunk of 1024 texels x 8 views x 32 lights x RGB is 1.5 MB as halves: small enough to
# be read by texels, large enough to be written by views.
TEXELS_PER_CHUNK = 1024
VIEWS_PER_CHUNK = 8


@dataclass(frozen=True, eq=False)
class Observed:
    """Which samples were measured.

    Parameters
    ----------
    views : (n_texels, n_views) bool
        True where the camera sees the texel.
    lights : (n_texels, n_lights) bool
        True where the light's sample counts: everywhere if shadows stay in the data,
        else where the light reaches the texel.
    pairs : (n_views, n_lights) bool
        True where a photograph exists.
    """

    views: Bools
    lights: Bools
    pairs: Bools

    def __post_init__(self) -> None:
        check_shape("views", self.views, (None, None))
        check_shape("lights", self.lights, (len(self.views), None))
        check_shape("pairs", self.pairs, (self.views.shape[1], self.lights.shape[1]))

    def count(self) -> int:
        """Number of samples measured.

        Examples
        --------
        Two texels, two views, three lights; the second texel is seen from one view:

        >>> views = np.array([[True, True], [True, False]])
        >>> Observed(views, np.ones((2, 3), bool), np.ones((2, 3), bool)).count()
        9
        """
        # Floats go through BLAS; the counts of views are exact in them.
        views_of_light = self.views.astype(np.float32) @ self.pairs.astype(np.float32)
        return int((views_of_light * self.lights).sum(dtype=np.float64))


@dataclass(frozen=True, eq=False)
class ObservationStore:
    """Samples on disk with what is observed of them.

    Parameters
    ----------
    folder : Path
        Folder that holds the zarr array.
    observed : Observed
        What counts; kept in memory, one byte per texel and direction.
    """

    folder: Path
    observed: Observed

    @property
    def samples(self) -> zarr.Array:
        """(n_texels, n_views, n_lights, 3) float16 on disk."""
        return zarr.open_array(self.folder / "samples", mode="r")

    @property
    def n_texels(self) -> int:
        """Number of texels."""
        return len(self.observed.views)

    def read(self, texels: slice | NDArray[np.integer]) -> NDArray[np.float16]:
        """Samples (k, n_views, n_lights, 3) of some texels; those never written are zero.

        Parameters
        ----------
        texels : slice or (k,) int
            In any order, with repeats; ascending ones read each chunk once.
        """
        array = self.samples
        if isinstance(texels, slice):
            return np.asarray(array[texels])
        return np.asarray(array.oindex[np.asarray(texels)])

    def raw_bytes(self) -> int:
        """Size of all samples as half floats."""
        return int(np.prod(self.samples.shape)) * 2


def create_samples(
    folder: Path, n_texels: int, n_views: int, n_lights: int, n_views_per_chunk: int
) -> zarr.Array:
    """Create an empty ``samples`` array; whatever the folder held is removed.

    Parameters
    ----------
    folder : Path
        Folder to hold the array.
    n_texels, n_views, n_lights : int
    n_views_per_chunk : int
        Views that will be written together.

    Returns
    -------
    zarr.Array
        (n_texels, n_views, n_lights, 3) float16, all zero.

    Raises
    ------
    InputError
        If a count is zero.
    """
    for name, count in (("texels", n_texels), ("views", n_views), ("lights", n_lights)):
        if count < 1:
            raise InputError(f"{name}: expected at least one, received {count}")
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    chunk = (min(TEXELS_PER_CHUNK, n_texels), min(n_views_per_chunk, n_views), n_lights, 3)
    return zarr.create_array(
        folder / "samples",
        shape=(n_texels, n_views, n_lights, 3),
        chunks=chunk,
        dtype="float16",
        fill_value=0,
    )
