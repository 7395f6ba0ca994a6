r"""Lights at a finite distance: direction and irradiance vary over the object.

A point light of intensity :math:`I` (W/sr) at distance :math:`d` gives a
surface that faces it the irradiance :math:`I / d^2`. Directional lights have
one direction and irradiance everywhere. The beam of a spot light falls off as
:math:`\cos^p` of the angle to its axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Stage, Workload
from capture_sim.effects.bounds import steepness
from capture_sim.errors import SceneError
from capture_sim.model import Scene

NAME = "near_lights"
STAGE = Stage.LIGHT

Array = NDArray[np.float64]

_FAR = 1e3  # metres to a stand-in for a light at infinity; only shadow rays use it


@dataclass(frozen=True)
class Options:
    """None: lights stand in the table ``[lights]``."""


def needed(scene: Scene) -> Decision:
    r"""Bound the change of irradiance and direction over the object.

    For a light at distance `d` of the centre of an object of radius `r`, the
    irradiance varies by up to :math:`(1 - r/d)^{-2} - 1`; the direction turns by up
    to :math:`r/d`, and radiance follows with the steepness of the material.
    """
    near = [light for light in scene.lights if light["type"] != "directional"]
    if not near:
        return Decision("all lights are directional: one direction, one irradiance", 0.0)
    positions = np.array([light["position"] for light in near], dtype=np.float64)
    distance = np.linalg.norm(positions - scene.mesh.centre, axis=1).min()
    ratio = scene.mesh.radius / distance
    reason = f"{len(near)} of {len(scene.lights)} lights stand {distance:.3g} m away or more"
    if ratio >= 1.0:
        return Decision(reason, np.inf)
    change = (1.0 - ratio) ** -2 - 1.0 + min(1.0, ratio * steepness(scene.material))
    return Decision(reason, float(scene.brightness.headroom * change))


def cost(scene: Scene, work: Workload) -> Cost:
    """One direction and inverse square for each point and light."""
    del scene
    return Cost(operations=work.n_points * work.n_lights)


@dataclass(frozen=True)
class Illumination:
    """Light that arrives at points of the surface.

    Attributes
    ----------
    directions : (n, n_lights, 3) float64
        Unit, towards the light.
    irradiance : (n, n_lights, 3) float64
        Of a surface that faces the light.
    targets : (n, n_lights, 3) float64
        Where shadow rays end.
    """

    directions: Array
    irradiance: Array
    targets: Array


def far_field(
    lights: tuple[Mapping[str, Any], ...], centre: Array, points: Array
) -> Illumination:
    """What `apply` becomes where the effect is off: the light at the object's centre.

    Parameters
    ----------
    lights : tuple of dict
        Lights of the native capture format.
    centre : (3,) float
        Where direction and irradiance are right; world, metres.
    points : (n, 3) float
        World, metres.

    Returns
    -------
    Illumination
        The same direction and irradiance at all points.
    """
    there = apply(lights, centre[None])
    shape = (len(points), len(lights), 3)
    directions = np.broadcast_to(there.directions, shape)
    return Illumination(
        directions=directions,
        irradiance=np.broadcast_to(there.irradiance, shape),
        targets=points[:, None] + _FAR * directions,
    )


def apply(lights: tuple[Mapping[str, Any], ...], points: Array) -> Illumination:
    """Direction and facing irradiance of every light at every point.

    Parameters
    ----------
    lights : tuple of dict
        Lights of the native capture format: `point`, `directional` or `spot`
        with an exponent.
    points : (n, 3) float
        World, metres.

    Returns
    -------
    Illumination

    Raises
    ------
    SceneError
        If a light is of another type.

    Examples
    --------
    Twice as far gives a quarter:

    >>> light = {"id": "l0", "type": "point", "position": [0, 0, 2], "intensity": [8, 8, 8]}
    >>> arriving = apply((light,), np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -2.0]]))
    >>> arriving.irradiance[:, 0, 0]
    array([2. , 0.5])
    """
    parts = [_one_light(light, points) for light in lights]
    return Illumination(*(np.stack(part, axis=1) for part in zip(*parts, strict=True)))


def _one_light(light: Mapping[str, Any], points: Array) -> tuple[Array, Array, Array]:
    if light["type"] == "directional":
        return _distant(light, points)
    if light["type"] not in ("point", "spot"):
        raise SceneError(
            f"light {light['id']!r}: type: expected point, directional or spot, "
            f"received {light['type']!r}; use one that the simulator knows"
        )
    position = np.asarray(light["position"], dtype=np.float64)
    offsets = position - points
    squared = np.einsum("nc,nc->n", offsets, offsets)[:, None]
    directions = offsets / np.sqrt(squared)
    irradiance = np.asarray(light["intensity"], dtype=np.float64) / squared
    if light["type"] == "spot":
        irradiance = irradiance * _beam(light, directions)[:, None]
    return directions, irradiance, np.broadcast_to(position, points.shape)


def _distant(light: Mapping[str, Any], points: Array) -> tuple[Array, Array, Array]:
    direction = np.asarray(light["direction"], dtype=np.float64)
    direction = direction / np.linalg.norm(direction)
    irradiance = np.asarray(light["irradiance"], dtype=np.float64)
    return (
        np.broadcast_to(direction, points.shape),
        np.broadcast_to(irradiance, points.shape),
        points + _FAR * direction,
    )


def _beam(light: Mapping[str, Any], directions: Array) -> Array:
    """Fall-off of a spot light towards the points; (n,)."""
    if "exponent" not in light:
        raise SceneError(
            f"light {light['id']!r}: exponent: expected a number, received nothing; "
            "spot lights are simulated with a cosine-power beam"
        )
    axis = np.asarray(light["direction"], dtype=np.float64)
    cosine = -directions @ (axis / np.linalg.norm(axis))
    return np.asarray(np.maximum(cosine, 0.0) ** float(light["exponent"]))
