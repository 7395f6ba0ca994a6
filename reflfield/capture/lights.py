"""Lights: where they stand and how much they give.

Directions point from the surface to the light. What a light gives is stated as the
irradiance of a surface that faces it, so that an apparent BRDF sample is radiance divided
by this number and the cosine stays in the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.capture.directions import Whereabouts, directions_towards
from reflfield.errors import CaptureError, InputError
from reflfield.util.late_import import LateImport
from reflfield.util.validation import check_shape, not_a_rotation_because
from reflfield.util.vector_lengths import lengths

if TYPE_CHECKING:
    from reflfield.capture import point_kernels as kernels
else:
    kernels = LateImport("reflfield.capture.point_kernels")

Array = NDArray[np.float64]

POINT = "point"
DIRECTIONAL = "directional"
SPOT = "spot"
ENVIRONMENT = "environment"
UNKNOWN = "unknown"
GROUP = "group"
KINDS = (POINT, DIRECTIONAL, SPOT, ENVIRONMENT, UNKNOWN, GROUP)

# Orientation of latitude-longitude maps, as the programs that write them name it.
CONVENTIONS = ("openexr", "mitsuba", "blender")

# Largest coordinate and largest intensity, in whatever units: what follows from them (squares
# of distances, irradiances) stays finite in single precision.
LARGEST_COORDINATE, LARGEST_INTENSITY, LEAST_INTENSITY = 1e12, 1e18, 1e-30

# Two lights closer than this would be one light; it also keeps 1/d^2 finite.
SMALLEST_DISTANCE = 1e-9


def _zeros() -> Array:
    return np.zeros(3)


def _ones() -> Array:
    return np.ones(3)


@dataclass(frozen=True, eq=False)
class Light:
    """One lighting condition: a single light, an environment map, or one nobody measured.

    Parameters
    ----------
    id : str
        Unique name within the capture.
    kind : {"point", "directional", "spot", "environment", "unknown", "group"}
        ``unknown`` is a constant lighting that was not measured: one condition, whose
        irradiance counts as 1 everywhere. ``group`` is several lights at once, as a frame
        to relight may name.
    position : (3,) array_like
        World position, metres (point, spot).
    direction : (3,) array_like
        Towards the light (directional) or along the beam (spot); normalised here.
    intensity : (3,) array_like
        Radiant intensity, W/sr per channel (point, spot), or irradiance of a facing
        surface, W/m^2 per channel (directional, and point that does not fall off).
    exponent : float
        Spot: intensity falls like ``cos(angle to the beam) ** exponent``.
    cone_angle, falloff_angle : float
        Spot: half angles, radians; full intensity inside `falloff_angle`, none outside
        `cone_angle`, a smooth step between (as in pbrt's spotlight).
    file : Path, optional
        Environment: the map.
    convention : {"openexr", "mitsuba", "blender"}
        Environment: how the map's pixels turn into directions.
    world_from_environment : (3, 3) array_like
        Environment: rotation from the map's frame to the world.
    members : tuple of Light
        Group: the lights that are on together.
    falls_off : bool
        Point: whether the irradiance falls like 1/d^2. False where photographs are corrected
        for the distance of the lamp: it is then the same everywhere, its direction is not.

    Raises
    ------
    CaptureError
        If a number is not finite or beyond its range (`LARGEST_COORDINATE`,
        `LARGEST_INTENSITY`, `LEAST_INTENSITY`), an intensity negative, a direction zero.

    Examples
    --------
    Eight watts per steradian, two metres above the origin, give 2 W/m^2:

    >>> lamp = Light("l0", "point", position=[0, 0, 2], intensity=[8, 8, 8])
    >>> lamp.irradiance([[0, 0, 0]])
    array([[2., 2., 2.]])
    >>> lamp.directions([[0, 0, 0]])
    array([[0., 0., 1.]])
    """

    id: str
    kind: str
    position: Array = field(default_factory=_zeros)
    direction: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    intensity: Array = field(default_factory=_ones)
    exponent: float = 0.0
    cone_angle: float = float(np.pi)
    falloff_angle: float = float(np.pi)
    file: Path | None = None
    convention: str = "openexr"
    world_from_environment: Array = field(default_factory=lambda: np.eye(3))
    members: tuple[Light, ...] = ()
    falls_off: bool = True

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise CaptureError(
                f"light {self.id!r}: expected type {', '.join(KINDS)}, received {self.kind!r}"
            )
        for name in ("position", "direction", "intensity"):
            object.__setattr__(self, name, _vector(self, name))
        object.__setattr__(self, "direction", _unit(self))
        if (self.intensity < 0).any():
            raise CaptureError(
                f"light {self.id!r}: intensity: expected values >= 0, "
                f"received {self.intensity.tolist()}"
            )
        _check_spot(self)
        if not self.falls_off and self.kind != POINT:
            raise CaptureError(
                f"light {self.id!r}: irradiance: expected a point light where it is constant, "
                f"received one of type {self.kind!r}"
            )
        if self.kind == ENVIRONMENT:
            _check_environment(self)
        if self.kind == GROUP and not self.members:
            raise CaptureError(f"light {self.id!r}: a group needs at least one light")

    @property
    def sources(self) -> tuple[Light, ...]:
        """The single lights that are on: the members of a group, else this light."""
        return self.members if self.kind == GROUP else (self,)

    @property
    def known(self) -> bool:
        """Whether the light's direction was measured."""
        return self.kind != UNKNOWN

    @property
    def shines(self) -> bool:
        """Whether anything is lit: True for an environment and for an unknown light."""
        numbered = (POINT, SPOT, DIRECTIONAL)
        return any(
            s.kind not in numbered or bool((s.intensity > 0).any()) for s in self.sources
        )

    def directions(self, points: ArrayLike) -> Array:
        """Unit directions (n, 3) from world points (n, 3) to the light.

        An unknown light answers +Z of the world everywhere: one constant condition.

        Raises
        ------
        InputError
            For an environment or a group, which have no single direction.
        """
        directions: Array = directions_towards(self._points(points), [place_of_light(self)])[
            :, 0
        ]
        return directions

    def distances(self, points: ArrayLike) -> Array:
        """Distances (n,) from world points (n, 3), metres; inf for far lights."""
        world = self._points(points)
        if self.kind in (POINT, SPOT):
            return self._distances(world)
        return np.full(len(world), np.inf)

    def irradiance(self, points: ArrayLike) -> Array:
        r"""Irradiance (n, 3) of surfaces at world points (n, 3) that face the light.

        :math:`E = I\,s(\theta) / d^2` for point and spot lights (`s` is the spot's falloff),
        the given irradiance for directional ones and for point lights that do not fall off,
        1 for an unknown light. W/m^2.
        """
        world = self._points(points)
        if self.kind == UNKNOWN:
            return np.ones((len(world), 3))
        if self.kind == DIRECTIONAL or not self.falls_off:
            return np.tile(self.intensity, (len(world), 1))
        falloff = self._falloff(world) / self._distances(world) ** 2
        return falloff[:, None] * self.intensity

    def reaches(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether any irradiance comes from the light to world points (n, 3); (n,) bool.

        Nothing is asked of shadows: False outside of a spot's cone, or of a light that is off.
        """
        if self.kind == SPOT:
            return np.asarray(self.irradiance(points).any(axis=1))
        return np.full(len(self._points(points)), self.shines)

    def _points(self, points: ArrayLike) -> Array:
        check_single(self)
        world = np.asarray(points, dtype=np.float64)
        check_shape("points", world, (None, 3))
        return world

    def _distances(self, world: Array) -> Array:
        return np.maximum(lengths(self.position - world), SMALLEST_DISTANCE)

    def _falloff(self, world: Array) -> Array:
        """Fraction (n,) of the spot's intensity that goes towards each point."""
        if self.kind != SPOT:
            return np.ones(len(world))
        cosine = (world - self.position) @ self.direction / self._distances(world)
        inner, outer = np.cos(self.falloff_angle), np.cos(self.cone_angle)
        step = np.clip((cosine - outer) / max(inner - outer, 1e-12), 0.0, 1.0)
        smooth = step * step * (3 - 2 * step) * (cosine >= outer)
        if self.exponent == 0:
            return smooth
        return smooth * np.maximum(cosine, 0.0) ** self.exponent


def check_single(light: Light) -> None:
    """Refuse an environment and a group.

    Raises
    ------
    InputError
        Naming the light.
    """
    if light.kind in (ENVIRONMENT, GROUP):
        raise InputError(
            f"light {light.id!r}: expected a single light, received kind {light.kind!r}, "
            "which has no single direction or irradiance; sum over its map or its members"
        )


def facing_irradiance(
    lights: Sequence[Light], positions: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Irradiance (n, n_lights, 3) that surfaces facing each light get; see `Light.irradiance`.

    Raises
    ------
    InputError
        For an environment or a group.

    Examples
    --------
    >>> lamps = [PointLight([0, 0, 2], 8.0), DirectionalLight([0, 0, 1], 3.0)]
    >>> facing_irradiance(lamps, np.zeros((1, 3)))[0, :, 0]
    array([2., 3.], dtype=float32)
    """
    points = np.ascontiguousarray(positions, np.float64)
    for light in lights:
        check_single(light)
    irradiance = np.zeros((len(points), len(lights), 3), np.float32)
    places = np.array([light.position for light in lights]).reshape(-1, 3)
    known = np.array([light.known for light in lights], np.bool_)
    intensities = np.array([light.intensity for light in lights]).reshape(-1, 3)
    intensities = np.where(known[:, None], intensities, 1.0)
    falling = np.array([light.kind == POINT and light.falls_off for light in lights], np.bool_)
    kernels.irradiance_of_points(
        points, places, intensities, falling, SMALLEST_DISTANCE, irradiance
    )
    for j, light in enumerate(lights):
        if light.kind == SPOT:
            irradiance[:, j] = light.irradiance(points)
    return irradiance


def place_of_light(light: Light) -> Whereabouts:
    """Where a light is; +Z of the world for one that is unknown.

    Raises
    ------
    InputError
        For an environment or a group, which are at no single place.
    """
    check_single(light)
    if light.kind in (POINT, SPOT):
        return Whereabouts(light.position, is_point=True)
    towards = np.array([0.0, 0.0, 1.0]) if light.kind == UNKNOWN else light.direction
    return Whereabouts(towards, is_point=False)


class PointLight(Light):
    """A light at a point.

    Parameters
    ----------
    position : (3,) array_like
        World, metres.
    intensity : float or (3,) array_like
        Radiant intensity, W/sr per channel.
    id : str

    Examples
    --------
    >>> PointLight([0, 0, 2], 8.0).irradiance([[0, 0, 0]])
    array([[2., 2., 2.]])
    """

    def __init__(
        self, position: ArrayLike, intensity: ArrayLike = 1.0, *, id: str = POINT
    ) -> None:
        power = np.broadcast_to(np.asarray(intensity, np.float64), 3)
        super().__init__(id, POINT, position=np.asarray(position), intensity=power)


class DirectionalLight(Light):
    """A light so far away that its direction is the same everywhere.

    Parameters
    ----------
    direction : (3,) array_like
        World, towards the light; normalised here.
    irradiance : float or (3,) array_like
        Of a surface that faces the light, W/m^2 per channel.
    id : str

    Examples
    --------
    >>> DirectionalLight([0, 0, 2], np.pi).directions([[1, 0, 0]])
    array([[0., 0., 1.]])
    """

    def __init__(
        self, direction: ArrayLike, irradiance: ArrayLike = 1.0, *, id: str = DIRECTIONAL
    ) -> None:
        power = np.broadcast_to(np.asarray(irradiance, np.float64), 3)
        super().__init__(id, DIRECTIONAL, direction=np.asarray(direction), intensity=power)


def _vector(light: Light, name: str) -> Array:
    vector = np.array(getattr(light, name), dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise CaptureError(
            f"light {light.id!r}: {name}: expected 3 finite numbers, received {vector.tolist()}"
        )
    largest = LARGEST_INTENSITY if name == "intensity" else LARGEST_COORDINATE
    if (np.abs(vector) > largest).any():
        raise CaptureError(
            f"light {light.id!r}: {name}: expected numbers of at most {largest:g}, received "
            f"{vector.tolist()}; choose another unit"
        )
    if name == "intensity" and 0 < np.abs(vector).max() < LEAST_INTENSITY:
        raise CaptureError(
            f"light {light.id!r}: intensity: expected one of at least {LEAST_INTENSITY:g} in "
            f"some channel, or none, received {vector.tolist()}; choose another unit"
        )
    vector.setflags(write=False)
    return vector


def _unit(light: Light) -> Array:
    length = np.linalg.norm(light.direction)
    if length < 1e-4:  # the limit of the .lp readers in use
        raise CaptureError(
            f"light {light.id!r}: direction: expected a vector that is not zero, "
            f"received {light.direction.tolist()}"
        )
    unit = light.direction / length
    unit.setflags(write=False)
    return unit


def _check_spot(light: Light) -> None:
    ordered = 0 <= light.falloff_angle <= light.cone_angle <= np.pi
    if not (ordered and np.isfinite(light.exponent) and light.exponent >= 0):
        raise CaptureError(
            f"light {light.id!r}: expected 0 <= falloff_angle <= cone_angle <= pi radians and "
            f"exponent >= 0, received {light.falloff_angle}, {light.cone_angle}, "
            f"{light.exponent}"
        )


def _check_environment(light: Light) -> None:
    if light.file is None:
        raise CaptureError(f"light {light.id!r}: an environment needs the file of its map")
    if light.convention not in CONVENTIONS:
        raise CaptureError(
            f"light {light.id!r}: convention: expected {', '.join(CONVENTIONS)}, "
            f"received {light.convention!r}"
        )
    rotation = np.array(light.world_from_environment, dtype=np.float64)
    if reason := not_a_rotation_because(rotation):
        raise CaptureError(
            f"light {light.id!r}: world_from_environment: expected a 3 x 3 rotation, "
            f"received {reason}: {rotation.tolist()}"
        )
    object.__setattr__(light, "world_from_environment", rotation)
