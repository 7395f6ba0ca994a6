"""A measured felt: its mean reflectance, smoothly interpolated, and turned by known rotations.

Data: the felt `felt05` of M. Weinmann, J. Gall and R. Klein, "Material classification based on
training data synthesized using a BTF database" (ECCV 2014), UBO2014, as the mean over its
texels on the 151 x 151 directions of the Bonn dome.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator

from reflfield.errors import InputError

Array = NDArray[np.float64]

LAST_RING = float(np.deg2rad(75.0))
N_DIRECTIONS = 151
DIRECTIONS, REFLECTANCE = "xyz_loc.bin", "felt05_mean_std.bin"


def read_felt(folder: Path) -> tuple[Array, Array]:
    """Directions and reflectance without the light's cosine.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    directions : (151, 3) float64
        Unit vectors.
    reflectance : (151, 151) float64
        Views by lights.

    Raises
    ------
    InputError
        If a file is missing or has another size.
    """
    n = N_DIRECTIONS
    directions = _numbers(folder / DIRECTIONS, 4 * n).reshape(4, n)[:3].T
    log_mean = _numbers(folder / REFLECTANCE, 2 * n * n).reshape(2, n, n)[0]
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    if not (np.isfinite(log_mean).all() and (np.abs(lengths - 1) < 0.01).all()):
        raise InputError(
            f"{folder}: expected unit directions and finite logarithms, received others"
        )
    directions = directions / lengths
    # The file holds a third of log(Y) + log(U) + log(V); the felt is nearly grey.
    return directions, np.exp(3.0 * log_mean) / directions[:, 2]


def _numbers(path: Path, count: int) -> Array:
    """All numbers of a file of float64."""
    if not path.is_file():
        raise InputError(
            f"{path}: expected the felt's file, found none; name the folder ubo2014_felt05"
        )
    if path.stat().st_size != 8 * count:
        raise InputError(
            f"{path}: expected {8 * count} bytes, {count} numbers of float64, "
            f"received {path.stat().st_size}"
        )
    return np.fromfile(path)


class Felt:
    """The measured reflectance as a smooth function of two directions.

    Thin-plate splines of the logarithm, one in the view and one in the light: exact at the
    measured directions, and unrelated to the harmonics and the nodes of the alignment. Beyond
    the last measured ring (75 degrees) the reflectance is that of the ring.

    Parameters
    ----------
    directions : (n, 3) float64
    reflectance : (n, n) float64
        Positive.
    """

    def __init__(self, directions: Array, reflectance: Array) -> None:
        self.spline = RBFInterpolator(
            directions, np.eye(len(directions)), kernel="thin_plate_spline"
        )
        self.log = np.log(reflectance)

    def shares(self, directions: Array) -> Array:
        """(n, 151) weights of the measured directions; those beyond the last ring are its."""
        polar = np.minimum(np.arccos(np.clip(directions[:, 2], -1, 1)), LAST_RING)
        azimuth = np.arctan2(directions[:, 1], directions[:, 0])
        ring = np.sin(polar)[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
        weights: Array = self.spline(np.concatenate([ring, np.cos(polar)[:, None]], axis=1))
        return weights

    def samples(self, views: Array, lights: Array) -> NDArray[np.float32]:
        """Samples with the light's cosine, (n, k, m) float32; 0 below the horizon.

        Parameters
        ----------
        views : (n, k, 3) float64
            Unit directions in the frame of each texel.
        lights : (n, m, 3) float64
        """
        of_views, of_lights = (
            self.shares(local.reshape(-1, 3)).reshape(*local.shape[:2], -1)
            for local in (views, lights)
        )
        values = np.exp(of_views @ self.log @ np.swapaxes(of_lights, 1, 2))
        cosine = lights[..., 2]
        seen = (views[..., 2] > 0)[:, :, None] & (cosine > 0)[:, None, :]
        return np.where(seen, values * cosine[:, None, :], 0.0).astype(np.float32)
