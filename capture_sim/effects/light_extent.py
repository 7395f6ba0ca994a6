r"""Lamps with an area: soft shadows, soft terminators and wider highlights.

A lamp is a disc that faces the object, cut into patches of equal area; its light is the
sum of theirs. A directional light becomes a cone, like the sun's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Stage, Workload
from capture_sim.effects.bounds import (
    light_distances,
    pixels_per_metre,
    shift_bound,
    steepness,
)
from capture_sim.model import Scene, Table
from capture_sim.tables import bounded

NAME = "light_extent"
STAGE = Stage.LIGHT

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Options:
    """Size of the lamps.

    Attributes
    ----------
    radius : float
        Of point and spot lights, metres.
    angle_deg : float
        Half angle of directional lights, degrees; the sun's is 0.266.
    samples : int
        Patches of each lamp.
    """

    radius: float = bounded(0.01, low=0.0)
    angle_deg: float = bounded(0.5, low=0.0, high=45.0)
    samples: int = bounded(16, low=1, high=4096)


def needed(scene: Scene) -> Decision:
    r"""Bound the change at terminators, highlights and edges of shadows.

    Seen under the angular radius `a`, half the disc is above the horizon where its centre
    is on it: :math:`\frac{2}{3\pi} a` of the light arrives there, where a point gives
    none. A highlight loses at most the square of `a` times the steepness of the material,
    being symmetric about its peak. The penumbra is `2 a` times the way from what casts
    the shadow, at most the object's diameter.
    """
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("lamps are points: no [effects.light_extent]", 0.0)
    angle = float(_angles(scene, options).max())
    slope = steepness(scene.material)
    change = 2.0 / (3.0 * np.pi) * angle * slope + min(1.0, (angle * slope) ** 2)
    bound = scene.brightness.headroom * change
    if not scene.mesh.convex:
        penumbra = 4.0 * angle * scene.mesh.radius * pixels_per_metre(scene)
        bound += shift_bound(scene, 0.5 * penumbra)
    return Decision(f"lamps appear {np.degrees(angle):.2g} degrees in radius", bound)


def _angles(scene: Scene, options: Options) -> Array:
    """Angular radius of each lamp seen from the object's centre, radians."""
    distance = light_distances(scene)
    near = np.arctan(options.radius / np.where(np.isfinite(distance), distance, 1.0))
    return np.where(np.isfinite(distance), near, np.radians(options.angle_deg))


def cost(scene: Scene, work: Workload) -> Cost:
    """Each lamp is shaded once a patch."""
    more = scene.effects.get(Options).samples - 1
    return Cost(rays=more * work.n_lit, operations=more * work.n_points * work.n_lights)


def apply(scene: Scene, light: Table) -> tuple[dict[str, Any], ...]:
    """Cut a lamp into patches of equal area.

    Parameters
    ----------
    scene : Scene
        Gives the size, and the centre that lamps face.
    light : dict
        Light of the native capture format.

    Returns
    -------
    tuple of dict
        Lights that together shine as much as the lamp.

    References
    ----------
    M. Pharr, W. Jakob and G. Humphreys, "Physically Based Rendering", 4th edition, 2023,
    section 12.3: area lights by samples of equal area.
    """
    options = scene.effects.get(Options)
    towards = _towards(light, scene.mesh.centre)
    offsets = _disc(options.samples) @ _across(towards)
    key = "irradiance" if light["type"] == "directional" else "intensity"
    share = (np.asarray(light[key], np.float64) / options.samples).tolist()
    return tuple(
        {
            **light,
            **_placed(light, offset, towards, options),
            "id": f"{light['id']}_{i}",
            key: share,
        }
        for i, offset in enumerate(offsets)
    )


def _towards(light: Table, centre: Array) -> Array:
    if light["type"] == "directional":
        vector = np.asarray(light["direction"], np.float64)
    else:
        vector = np.asarray(light["position"], np.float64) - centre
    return np.asarray(vector / np.linalg.norm(vector))


def _placed(light: Table, offset: Array, towards: Array, options: Options) -> dict[str, Any]:
    if light["type"] == "directional":
        direction = towards + np.tan(np.radians(options.angle_deg)) * offset
        return {"direction": (direction / np.linalg.norm(direction)).tolist()}
    position = np.asarray(light["position"], np.float64) + options.radius * offset
    return {"position": position.tolist()}


def _disc(n: int) -> Array:
    """Points of the unit disc that stand for equal areas, (n, 2)."""
    index = np.arange(n) + 0.5
    radius, turn = np.sqrt(index / n), np.pi * (3.0 - np.sqrt(5.0)) * index
    return np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=1)


def _across(direction: Array) -> Array:
    """Two unit vectors that are orthogonal to a direction and to each other, (2, 3)."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])
