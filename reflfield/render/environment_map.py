"""Environment maps: radiance from all directions, far away.

A map is a latitude-longitude image, twice as wide as high, row 0 at the zenith; see
`reflfield.render.map_directions` for the directions of its pixels and for the way a
map is rotated into a world. A map whose frame in the world is stated
(`world_from_environment`, as captures state it) is used as it is; else its up axis is
rotated to that of the field it lights.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.capture.color_spaces import luminance
from reflfield.capture.image_files import image_size, read_alpha, read_image, stores_alpha
from reflfield.capture.lights import CONVENTIONS, Light
from reflfield.errors import InputError
from reflfield.render.distant_lights import DistantLights, merged_lights
from reflfield.render.map_directions import direction_from_uv, world_from_map
from reflfield.util.validation import check_shape, not_a_rotation_because

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)

# Maps are reduced to at most this many rows before they are cut into lights:
# 1.4 degrees a row, finer than the cells of a thousand lights.
QUANTISATION_ROWS = 128
# Pixels of maps with fewer rows are cut, so that each lights from all of its area: one row
# would light from the horizon alone.
LEAST_ROWS = 16
# Share of the width by which a map may be off twice its height: borders cut or added.
ASPECT_TOLERANCE = 0.01
# Other layouts by width / height, and what images of that shape usually are.
OTHER_LAYOUTS = (
    (1.0, "a square: an angular map (light probe), a mirror ball or an octahedral map"),
    (3 / 4, "a vertical cross of a cube map"),
    (4 / 3, "a horizontal cross of a cube map"),
    (6.0, "a horizontal strip of the six faces of a cube map"),
    (1 / 6, "a vertical strip of the six faces of a cube map"),
    (4.0, "a latitude-longitude map of one hemisphere"),
    (1 / 2, "a latitude-longitude map turned by a quarter, or two halves"),
)


@dataclass(frozen=True, eq=False)
class EnvironmentMap:
    """Radiance from all directions, as a latitude-longitude image.

    Parameters
    ----------
    radiance : (height, width, 3) float32
        Linear radiance, W sr^-1 m^-2; negative values count as 0.
    convention : {"openexr", "mitsuba", "blender"}
        How pixels become directions; see `map_directions`.
    world_from_environment : (3, 3) float, optional
        Rotation from the map's frame to the world. By default it is open: the renderer
        turns the map's up to the field's, and what stands for itself stays in the map's
        frame.

    Raises
    ------
    ShapeError
        If the image is not (height, width, 3).
    InputError
        If the convention is unknown, the image empty, not twice as wide as high or not
        finite, or the matrix no rotation.

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
    world_from_environment: Array | None = None

    def __post_init__(self) -> None:
        check_shape("radiance", self.radiance, (None, None, 3))
        height, width, _ = self.radiance.shape
        check_latlong("radiance", width, height)
        _check_finite(self.radiance)
        if self.convention not in CONVENTIONS:
            raise InputError(
                f"convention: expected one of {', '.join(CONVENTIONS)}, "
                f"received {self.convention!r}"
            )
        if self.world_from_environment is not None:
            rotation = np.asarray(self.world_from_environment, np.float64)
            if reason := not_a_rotation_because(rotation):
                raise InputError(
                    f"world_from_environment: expected a 3 x 3 rotation, received {reason}: "
                    f"{rotation.tolist()}"
                )
            object.__setattr__(self, "world_from_environment", rotation)

    @classmethod
    def open(
        cls,
        path: Path | str,
        convention: str = "openexr",
        world_from_environment: ArrayLike | None = None,
    ) -> EnvironmentMap:
        """Read a map from an image file.

        Negative values, and a map without any light, are told through `logging`.

        Raises
        ------
        CaptureError
            If the file cannot be read.
        InputError
            As the class; the message names the file.
        """
        width, height = image_size(path)
        check_latlong(str(path), width, height)
        radiance = read_image(path, what="environment map")
        _tell_of_oddities(path, radiance, read_alpha(path) if stores_alpha(path) else None)
        rotation = None
        if world_from_environment is not None:
            rotation = np.asarray(world_from_environment, np.float64)
        return cls(radiance, convention, rotation)

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

    def turned_to(self, up: ArrayLike, rotation_deg: float = 0.0) -> EnvironmentMap:
        """Return the map with its zenith towards a direction of the world.

        Parameters
        ----------
        up : (3,) array_like
            World direction.
        rotation_deg : float
            Further rotation about it, degrees, counter-clockwise seen from above.

        Raises
        ------
        InputError
            If `up` is no direction or the angle not finite.

        Examples
        --------
        >>> sky = EnvironmentMap(np.ones((8, 16, 3), np.float32))
        >>> (sky.turned_to([0, 0, 1]).world_from_environment @ [0, 1, 0]).round(12) + 0.0
        array([0., 0., 1.])
        """
        rotation = world_from_map(self.convention, up, rotation_deg)
        return replace(self, world_from_environment=rotation)

    @cached_property
    def directions(self) -> Array:
        """(height, width, 3) unit vectors to the pixels' centres, world frame."""
        return self._row_directions(0, len(self.radiance))

    @cached_property
    def solid_angles(self) -> Array:
        """(height,) solid angle of a pixel of each row; all pixels sum to 4 pi."""
        height, width, _ = self.radiance.shape
        edges = np.cos(np.pi * np.arange(height + 1) / height)
        return (edges[:-1] - edges[1:]) * (2 * np.pi / width)

    def quantise(self, n_lights: int) -> DistantLights:
        """Directional lights that together send what the map sends.

        Parameters
        ----------
        n_lights : int
            Lights wanted; fewer are returned if the map has fewer lit pixels.

        Returns
        -------
        DistantLights
            Their irradiances sum to the map's, exactly to rounding; see `merged_lights`.

        Raises
        ------
        InputError
            If `n_lights` is below 1.

        Notes
        -----
        Cost O(pixels + 2 QUANTISATION_ROWS^2 log n_lights).
        """
        if n_lights < 1:
            raise InputError(f"n_lights: expected at least 1, received {n_lights}")
        directions, irradiances = self._reduced()
        return merged_lights(directions, irradiances, luminance(irradiances), n_lights)

    def _row_directions(self, first: int, end: int) -> Array:
        """(end - first, width, 3) unit vectors to the pixels of some rows."""
        height, width, _ = self.radiance.shape
        u, v = (np.arange(width) + 0.5) / width, (np.arange(first, end) + 0.5) / height
        columns, rows = np.meshgrid(u, v)
        local = direction_from_uv(columns, rows, self.convention)
        if self.world_from_environment is None:
            return local
        return local @ self.world_from_environment.T

    def _reduced(self) -> tuple[Array, Array]:
        """Directions and irradiances of pixels, merged to at most QUANTISATION_ROWS rows.

        Of coarse maps those of at least LEAST_ROWS rows.
        """
        height = len(self.radiance)
        if height < LEAST_ROWS:
            parts = -(-LEAST_ROWS // height)
            finer = self.radiance.repeat(parts, axis=0).repeat(parts, axis=1)
            return replace(self, radiance=finer)._reduced()
        step = -(-height // QUANTISATION_ROWS)
        # Strip by strip: double precision of a whole map takes gigabytes.
        strips = [self._merged_rows(row, step) for row in range(0, height, step)]
        directions, irradiances = zip(*strips, strict=True)
        return np.concatenate(directions), np.concatenate(irradiances)

    def _merged_rows(self, first: int, step: int) -> tuple[Array, Array]:
        """Directions and irradiances of the blocks of `step` x `step` pixels of some rows."""
        end = min(first + step, len(self.radiance))
        directions = self._row_directions(first, end)
        radiance = np.maximum(self.radiance[first:end], 0.0)
        irradiances = radiance * self.solid_angles[first:end, None, None]
        moments = _summed_by_blocks(luminance(irradiances)[..., None] * directions, step)
        # An unlit block has no mean direction; any of its pixels stands for it.
        spare = directions[0, ::step]
        lengths = np.linalg.norm(moments, axis=1, keepdims=True)
        unit = np.divide(moments, lengths, out=spare.copy(), where=lengths > 0)
        return unit, _summed_by_blocks(irradiances, step)


def check_latlong(name: str, width: int, height: int) -> None:
    """Demand the shape of a latitude-longitude map: twice as wide as high.

    Raises
    ------
    InputError
        Saying what an image of that shape usually is.
    """
    if width < 1 or height < 1:
        raise InputError(f"{name}: expected a map with pixels, received {width} x {height}")
    if abs(width - 2 * height) <= max(1, ASPECT_TOLERANCE * width):
        return
    ratio = width / height
    similar = [words for shape, words in OTHER_LAYOUTS if abs(ratio / shape - 1) < 0.02]
    looks = f", which looks like {similar[0]}" if similar else ""
    raise InputError(
        f"{name}: expected a latitude-longitude map, twice as wide as high, received "
        f"{width} x {height} pixels{looks}; convert it to latitude-longitude first"
    )


def _check_finite(radiance: NDArray[np.floating]) -> None:
    finite = np.isfinite(radiance).all(axis=2)
    if not finite.all():
        row, column = np.argwhere(~finite)[0]
        raise InputError(
            f"radiance: expected a map of finite radiance, received "
            f"{int((~finite).sum())} pixels of NaN or infinity, first at row {row}, column "
            f"{column}: {radiance[row, column].tolist()}; repair the map"
        )


def _tell_of_oddities(
    path: Path | str, radiance: NDArray[np.float32], alpha: NDArray[np.float32] | None
) -> None:
    """Log what a map holds that is allowed and hardly meant."""
    if alpha is not None:
        logger.warning(
            "%s: %d pixels of the map are not opaque, %d of them, of alpha 0, count as "
            "black; remove the alpha channel if the whole map shall light",
            path, int((alpha < 1).sum()), int((alpha <= 0).sum()),
        )  # fmt: skip
    negative = int((radiance < 0).any(axis=2).sum())
    if negative:
        logger.warning(
            "%s: %d pixels of the map are negative (down to %.3g); they count as 0",
            path, negative, float(radiance.min()),
        )  # fmt: skip
    if not (radiance > 0).any():
        logger.warning("%s: the map is black; whatever it lights is black", path)


def _summed_by_blocks(image: Array, step: int) -> Array:
    """Sums over blocks of `step` columns of all rows of a strip, (n_blocks, channels)."""
    blocks = np.add.reduceat(image.sum(axis=0), np.arange(0, image.shape[1], step), axis=0)
    return np.asarray(blocks)
