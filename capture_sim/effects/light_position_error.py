"""Lights that do not stand quite where the calibration says."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from capture_sim.effects import Cost, Decision, Rig, Stage, Workload, normal_errors
from capture_sim.effects.bounds import (
    light_distances,
    pixels_per_metre,
    shift_bound,
    steepness,
)
from capture_sim.model import Scene, Table
from capture_sim.tables import bounded

NAME = "light_position_error"
STAGE = Stage.RIG

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Options:
    """Standard deviations of the error of a light's position, per axis.

    Attributes
    ----------
    position : float
        Of point and spot lights, metres.
    angle_deg : float
        Of the direction of directional lights, degrees.
    """

    position: float = bounded(2e-3, low=0.0)
    angle_deg: float = bounded(0.2, low=0.0, high=90.0)


def needed(scene: Scene) -> Decision:
    r"""Bound the change of irradiance, highlights and shadows' edges.

    A light that moves by :math:`\delta` at distance `d` turns by :math:`\delta / d`:
    radiance follows with the steepness of the material, irradiance with
    :math:`2 \delta / d`, and the edge of a shadow moves by the turn times the way from
    what casts it, at most the object's diameter.
    """
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("lights stand as calibrated: no [effects.light_position_error]", 0.0)
    turn = float(_turns(scene, options).max())
    change = scene.brightness.headroom * (steepness(scene.material) + 2.0) * turn
    if not scene.mesh.convex:
        change += shift_bound(scene, 2.0 * scene.mesh.radius * turn * pixels_per_metre(scene))
    return Decision(f"lights turn by up to {np.degrees(turn):.2g} degrees", change)


def _turns(scene: Scene, options: Options) -> Array:
    size = np.linalg.norm(normal_errors(scene, NAME, len(scene.lights), 3), axis=1)
    distance = light_distances(scene)
    near = options.position * size / np.where(np.isfinite(distance), distance, 1.0)
    return np.where(np.isfinite(distance), near, np.radians(options.angle_deg) * size)


def cost(scene: Scene, work: Workload) -> Cost:
    """One position a light."""
    del scene
    return Cost(operations=work.n_lights)


def apply(rig: Rig, scene: Scene) -> Rig:
    """Move the true lights; the reported ones stay."""
    options = scene.effects.get(Options)
    errors = normal_errors(scene, NAME, len(scene.lights), 3)
    moved = zip(rig.lights, errors, strict=True)
    return replace(rig, lights=tuple(_moved(light, error, options) for light, error in moved))


def _moved(light: Table, error: Array, options: Options) -> dict[str, Any]:
    if light["type"] == "directional":
        turn = Rotation.from_rotvec(np.radians(options.angle_deg) * error)
        return {**light, "direction": turn.apply(light["direction"]).tolist()}
    position = np.asarray(light["position"], np.float64) + options.position * error
    return {**light, "position": position.tolist()}
