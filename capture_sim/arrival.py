"""Light that arrives at many points, compiled.

The same physics as `capture_sim.effects.near_lights`, which a test compares
with this, in the layout and precision of the compiled BRDFs: lights along the
last axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import near_lights, simulated
from capture_sim.errors import SceneError
from capture_sim.model import Scene, Table

Array = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]

FAR = 1e3  # metres to a stand-in for a light at infinity; only shadow rays use it


@dataclass(frozen=True)
class LightArrays:
    """Lights of the native capture format as arrays.

    Attributes
    ----------
    place : (n_lights, 3) float64
        Position in metres, or unit direction towards a light at infinity.
    near : (n_lights,) float64
        1 for lights at a finite distance, 0 at infinity.
    colour : (n_lights, 3) float64
        Intensity in W/sr, or irradiance of a facing surface at infinity.
    axis : (n_lights, 3) float64
        Unit direction of the beam; zero for lights without one.
    exponent : (n_lights,) float64
        The beam falls off as this power of the cosine to `axis`.
    """

    place: Array
    near: Array
    colour: Array
    axis: Array
    exponent: Array

    def __len__(self) -> int:
        return len(self.place)

    @classmethod
    def of(cls, scene: Scene, lights: tuple[Table, ...]) -> LightArrays:
        """Arrays of some lights, all at infinity if the scene does without near lights.

        Parameters
        ----------
        scene : Scene
            Decides whether lights are at a finite distance.
        lights : tuple of dict
            Lights of the native capture format.

        Returns
        -------
        LightArrays

        Raises
        ------
        SceneError
            If a light is of an unknown type or a spot light has no exponent.
        """
        if not simulated(scene, near_lights):
            there = near_lights.apply(lights, scene.mesh.centre[None])
            none = np.zeros(len(lights))
            beamless = np.zeros((len(lights), 3))
            return cls(there.directions[0], none, there.irradiance[0], beamless, none)
        rows = [_row(light) for light in lights]
        return cls(*(np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)))

    def targets(self, light: NDArray[np.intp], points: Array) -> Array:
        """Where shadow rays from points (n, 3) to lights (n,) end, (n, 3)."""
        near = self.near[light, None]
        return near * self.place[light] + (1.0 - near) * (points + FAR * self.place[light])

    def arrive(
        self, points: Array, frames: Array, precision: type[np.floating[Any]]
    ) -> tuple[Floats, Floats]:
        """Directions to the lights and their strength at points.

        Parameters
        ----------
        points : (n, 3) float64
            World, metres.
        frames : (n, 3, 3) float64
            ``shading_from_world``.
        precision : type
            Of the results.

        Returns
        -------
        directions : (n, 3, n_lights) `precision`
            Unit, in the shading frame.
        strength : (n, n_lights) `precision`
            Times `colour`: the irradiance of a surface that faces the light.
        """
        directions = np.zeros((len(points), 3, len(self)), dtype=precision)
        strength = np.zeros((len(points), len(self)), dtype=precision)
        _arrive(points, frames, self.place, self.near, directions, strength)
        for light in np.flatnonzero(self.exponent):
            cosine = self._beam_cosine(light, points)
            strength[:, light] *= cosine ** self.exponent[light]
        return directions, strength

    def _beam_cosine(self, light: np.intp, points: Array) -> Array:
        offsets = points - self.place[light]
        distance = np.linalg.norm(offsets, axis=1)
        return np.asarray(np.maximum(offsets @ self.axis[light] / distance, 0.0))


def _row(light: Table) -> tuple[Any, float, Any, Any, float]:
    """Place, nearness, colour, axis and exponent of one light."""
    none = np.zeros(3)
    if light["type"] == "directional":
        return _unit(light["direction"]), 0.0, light["irradiance"], none, 0.0
    if light["type"] == "point":
        return light["position"], 1.0, light["intensity"], none, 0.0
    if light["type"] == "spot" and "exponent" in light:
        axis = _unit(light["direction"])
        return light["position"], 1.0, light["intensity"], axis, float(light["exponent"])
    raise SceneError(
        f"light {light['id']!r}: expected a point, directional or spot light with an "
        f"exponent, received {dict(light)}; use one that the simulator knows"
    )


def _unit(vector: Any) -> Array:
    values = np.asarray(vector, dtype=np.float64)
    return np.asarray(values / np.linalg.norm(values))


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _arrive(
    points: Floats,
    frames: Floats,
    place: Floats,
    near: Floats,
    directions: Floats,
    strength: Floats,
) -> None:
    """Fill directions (n, 3, n_lights) and strength (n, n_lights)."""
    number = strength.dtype.type
    one = number(1.0)
    n_lights = len(place)
    offsets = np.zeros((3, n_lights), dtype=strength.dtype)
    for i in range(len(points)):
        # Differences in double precision; what follows only needs relative accuracy.
        for c in range(3):
            for k in range(n_lights):
                offsets[c, k] = number(place[k, c] - near[k] * points[i, c])
        for k in range(n_lights):
            x, y, z = offsets[0, k], offsets[1, k], offsets[2, k]
            squared = x * x + y * y + z * z
            inverse = one / np.sqrt(squared)
            strength[i, k] = one / squared
            offsets[0, k], offsets[1, k], offsets[2, k] = x * inverse, y * inverse, z * inverse
        for c in range(3):
            fx, fy, fz = (
                number(frames[i, c, 0]),
                number(frames[i, c, 1]),
                number(frames[i, c, 2]),
            )
            for k in range(n_lights):
                directions[i, c, k] = (
                    fx * offsets[0, k] + fy * offsets[1, k] + fz * offsets[2, k]
                )
