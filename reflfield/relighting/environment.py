"""Environment maps: radiance from all directions, far away.

A map is a latitude-longitude image, row 0 at the zenith. Pixels are areas: the
centre of pixel (row, column) has ``u = (column + 1/2) / width`` and
``v = (row + 1/2) / height``, polar angle ``theta = pi v``. Conventions differ in
what the azimuth means, and in which axis is up:

==========  ====  ===========================================================
convention  up    direction
==========  ====  ===========================================================
openexr     +Y    (sin(2 pi u) sin(theta), cos(theta), -cos(2 pi u) sin(theta))
mitsuba     +Y    the same
blender     +Z    (cos(a) sin(theta), sin(a) sin(theta), cos(theta)), a = pi - 2 pi u
==========  ====  ===========================================================

So the centre of the image is +Z for the first two and +X for Blender.

The OpenEXR library puts the *centres* of the corner pixels on the poles and the
seam, Mitsuba 3.9 those of the first and last rows on the poles; maps in
circulation do not, and neither does this module. The difference is half a pixel.

The frame of the map is the frame of the world unless a rotation
`world_from_environment` is given; a capture with +Z up needs one for a map
with +Y up.

References
----------
.. [1] OpenEXR, ImfEnvmap.h: longitude pi/2 is +X, 0 is +Z.
.. [2] Mitsuba 3, src/emitters/envmap.cpp.
.. [3] Blender, intern/cycles/kernel/camera/projection.h:
       u = (atan2(y, x) - pi) / (-2 pi).
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.capture.images import read_image
from reflfield.capture.lights import CONVENTIONS, Light
from reflfield.checks import check_shape
from reflfield.errors import InputError
from reflfield.relighting.exposure import luminance

Array = NDArray[np.float64]

# Maps are reduced to at most this many rows before they are cut into lights:
# 1.4 degrees a row, finer than the cells of a thousand lights.
QUANTISATION_ROWS = 128


@dataclass(frozen=True, eq=False)
class DistantLights:
    """A set of directional lights.

    Parameters
    ----------
    directions : (n, 3) float64
        Unit vectors to the lights, world frame.
    irradiances : (n, 3) float64
        Irradiance of a surface that faces each light.
    """

    directions: Array
    irradiances: Array

    def __len__(self) -> int:
        return len(self.directions)


@dataclass(frozen=True, eq=False)
class EnvironmentMap:
    """Radiance from all directions, as a latitude-longitude image.

    Parameters
    ----------
    radiance : (height, width, 3) float32
        Linear radiance, W sr^-1 m^-2; negative values count as 0.
    convention : {"openexr", "mitsuba", "blender"}
        How pixels turn into directions; see the module.
    world_from_environment : (3, 3) float
        Rotation from the map's frame to the world.

    Raises
    ------
    ShapeError
        If the image is not (height, width, 3).
    InputError
        If the convention is unknown, the image empty or not finite, or the
        matrix no rotation.

    Examples
    --------
    A constant map of radiance 1 sends the irradiances of all directions, 4 pi in all:

    >>> sky = EnvironmentMap(np.ones((8, 16, 3), np.float32))
    >>> lights = sky.quantise(12)
    >>> len(lights), bool(np.isclose(lights.irradiances.sum(axis=0), 4 * np.pi).all())
    (12, True)
    """

    radiance: NDArray[np.float32]
    convention: str = "openexr"
    world_from_environment: Array = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        check_shape("radiance", self.radiance, (None, None, 3))
        if not self.radiance.size or not np.isfinite(self.radiance).all():
            raise InputError(
                "radiance: expected an image of finite values, received "
                f"{self.radiance.shape} with {int(np.isnan(self.radiance).sum())} NaN"
            )
        if self.convention not in CONVENTIONS:
            raise InputError(
                f"convention: expected one of {', '.join(CONVENTIONS)}, "
                f"received {self.convention!r}"
            )
        rotation = np.asarray(self.world_from_environment, np.float64)
        if rotation.shape != (3, 3) or not np.allclose(
            rotation @ rotation.T, np.eye(3), atol=1e-3
        ):
            raise InputError(
                "world_from_environment: expected a 3 x 3 rotation, "
                f"received {rotation.tolist()}"
            )

    @classmethod
    def open(
        cls,
        path: Path | str,
        convention: str = "openexr",
        world_from_environment: ArrayLike | None = None,
    ) -> EnvironmentMap:
        """Read a map from an image file.

        Raises
        ------
        CaptureError
            If the file cannot be read.
        InputError
            As the class.
        """
        rotation = np.eye(3) if world_from_environment is None else world_from_environment
        return cls(read_image(path), convention, np.asarray(rotation, np.float64))

    @classmethod
    def of_light(cls, light: Light) -> EnvironmentMap:
        """Return the map of a light of kind "environment".

        Raises
        ------
        InputError
            If the light is of another kind.
        CaptureError
            If the file cannot be read.
        """
        if light.kind != "environment" or light.file is None:
            raise InputError(
                f"light {light.id!r}: expected an environment, received {light.kind!r}"
            )
        return cls.open(light.file, light.convention, light.world_from_environment)

    @cached_property
    def directions(self) -> Array:
        """(height, width, 3) unit vectors to the pixels' centres, world frame."""
        height, width, _ = self.radiance.shape
        u, v = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
        columns, rows = np.meshgrid(u, v)
        local = direction_from_uv(columns, rows, self.convention)
        return local @ np.asarray(self.world_from_environment, np.float64).T

    @cached_property
    def solid_angles(self) -> Array:
        """(height,) solid angle of a pixel of each row; all pixels sum to 4 pi."""
        height, width, _ = self.radiance.shape
        edges = np.cos(np.pi * np.arange(height + 1) / height)
        return (edges[:-1] - edges[1:]) * (2 * np.pi / width)

    def quantise(self, n_lights: int) -> DistantLights:
        """Directional lights that together send what the map sends.

        Starting from the whole sphere, the cell whose light would err most, by
        the sum over its pixels of energy times squared distance to the cell's
        mean direction, is cut in two at its mean, until there are enough. Each
        cell becomes one light: the sum of its irradiances, channel by channel,
        from its energy-weighted mean direction. Nothing is random.

        Parameters
        ----------
        n_lights : int
            Lights wanted; fewer are returned if the map has fewer lit pixels.

        Returns
        -------
        DistantLights
            Their irradiances sum to the map's, exactly to rounding.

        Raises
        ------
        InputError
            If `n_lights` is below 1.

        Notes
        -----
        Cost O(pixels log n_lights), at most 128 rows of pixels. The criterion is
        that of variance-based colour quantisation (X. Wu, "Color quantization by
        dynamic programming and principal analysis", ACM TOG 1992), applied to
        directions.
        """
        if n_lights < 1:
            raise InputError(f"n_lights: expected at least 1, received {n_lights}")
        directions, irradiances = self._reduced()
        energy = luminance(irradiances)
        cells = _split(directions, energy, n_lights)
        return DistantLights(
            directions=np.stack([_mean_direction(directions[c], energy[c]) for c in cells]),
            irradiances=np.stack([irradiances[c].sum(axis=0) for c in cells]),
        )

    def _reduced(self) -> tuple[Array, Array]:
        """Directions and irradiances of pixels, merged to at most QUANTISATION_ROWS rows."""
        height = len(self.radiance)
        step = -(-height // QUANTISATION_ROWS)
        irradiances = np.maximum(self.radiance, 0.0) * self.solid_angles[:, None, None]
        energy = luminance(irradiances)[..., None]
        moments = _summed_by_blocks(energy * self.directions, step)
        merged = _summed_by_blocks(irradiances, step)
        # An unlit block has no mean direction; any of its pixels stands for it.
        spare = self.directions[::step, ::step].reshape(-1, 3)
        lengths = np.linalg.norm(moments, axis=1, keepdims=True)
        unit = np.divide(moments, lengths, out=spare.copy(), where=lengths > 0)
        return unit, merged


def direction_from_uv(u: ArrayLike, v: ArrayLike, convention: str) -> Array:
    """Directions of image coordinates, in the frame of the map.

    Parameters
    ----------
    u, v : (...) array_like
        Image coordinates in [0, 1], v down.
    convention : {"openexr", "mitsuba", "blender"}
        See the module.

    Returns
    -------
    (..., 3) float64
        Unit vectors.

    Examples
    --------
    >>> direction_from_uv(0.25, 0.5, "openexr").round(12) + 0.0
    array([1., 0., 0.])
    >>> direction_from_uv(0.25, 0.5, "blender").round(12) + 0.0
    array([0., 1., 0.])
    """
    theta, turn = np.pi * np.asarray(v, np.float64), 2 * np.pi * np.asarray(u, np.float64)
    ring, height = np.sin(theta), np.cos(theta)
    if convention == "blender":
        azimuth = np.pi - turn
        return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), height], axis=-1)
    return np.stack([ring * np.sin(turn), height, -ring * np.cos(turn)], axis=-1)


def _summed_by_blocks(image: Array, step: int) -> Array:
    """Sums over step x step blocks of an image, (n_blocks, channels)."""
    rows = np.add.reduceat(image, np.arange(0, image.shape[0], step), axis=0)
    blocks = np.add.reduceat(rows, np.arange(0, image.shape[1], step), axis=1)
    return blocks.reshape(-1, image.shape[2])


def _mean_direction(directions: Array, energy: Array) -> Array:
    mean = energy @ directions
    length = np.linalg.norm(mean)
    # Opposite directions of equal energy have no mean; either is as good.
    return mean / length if length > 0 else directions[0]


def _split(directions: Array, energy: Array, n_cells: int) -> list[NDArray[np.intp]]:
    """Index arrays of at most `n_cells` cells, split where the energy spreads most."""
    lit = np.flatnonzero(energy > 0)
    whole = lit if len(lit) else np.arange(1)
    heap = [(-_spread(directions, energy).sum(), 0, whole)]
    finished: list[NDArray[np.intp]] = []
    counter = 1  # breaks ties, so that index arrays are never compared
    while heap and len(heap) + len(finished) < n_cells:
        _, _, cell = heapq.heappop(heap)
        parts = _halves(cell, directions[cell], energy[cell])
        if parts is None:
            finished.append(cell)
            continue
        for part in parts:
            error = _spread(directions[part], energy[part]).sum()
            heapq.heappush(heap, (-error, counter, part))
            counter += 1
    return finished + [cell for _, _, cell in sorted(heap, key=lambda entry: entry[1])]


def _spread(directions: Array, energy: Array) -> Array:
    """Energy times squared distance to the mean, for each axis, (3,)."""
    total = energy.sum()
    if not total > 0:
        return np.zeros(3)
    offsets = directions - energy @ directions / total
    return energy @ offsets**2


def _halves(
    cell: NDArray[np.intp], directions: Array, energy: Array
) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
    """Cut a cell at its mean across the axis of largest spread; None if it cannot be."""
    spread = _spread(directions, energy)
    axis = int(np.argmax(spread))
    if not spread[axis] > 0:
        return None
    coordinate = directions[:, axis]
    upper = coordinate > energy @ coordinate / energy.sum()
    if upper.all() or not upper.any():
        return None
    return cell[~upper], cell[upper]
