"""Lights that differ in intensity and colour though the calibration has them equal."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Rig, Stage, Workload, normal_errors
from capture_sim.model import Scene, Table
from capture_sim.tables import bounded

NAME = "light_variation"
STAGE = Stage.RIG

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Options:
    """Relative standard deviations.

    Attributes
    ----------
    intensity : float
        Of a light as a whole.
    colour : float
        Of each of its channels besides.
    """

    intensity: float = bounded(0.02, low=0.0, high=1.0)
    colour: float = bounded(0.01, low=0.0, high=1.0)


def needed(scene: Scene) -> Decision:
    """Bound the change by the factor that is farthest from 1; the factors are known."""
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("lights are as calibrated: no [effects.light_variation]", 0.0)
    largest = float(np.abs(_factors(scene, options) - 1.0).max())
    return Decision(
        f"lights differ by up to {100.0 * largest:.2g} % from their calibration",
        scene.brightness.headroom * largest,
    )


def _factors(scene: Scene, options: Options) -> Array:
    """What each channel of each light is multiplied by, (n_lights, 3); log-normal."""
    numbers = normal_errors(scene, NAME, len(scene.lights), 4)
    spread = options.intensity * numbers[:, :1] + options.colour * numbers[:, 1:]
    return np.asarray(np.exp(spread))


def cost(scene: Scene, work: Workload) -> Cost:
    """One factor a light."""
    del scene
    return Cost(operations=3 * work.n_lights)


def apply(rig: Rig, scene: Scene) -> Rig:
    """Change the true lights; the reported ones stay."""
    factors = _factors(scene, scene.effects.get(Options))
    changed = zip(rig.lights, factors, strict=True)
    return replace(rig, lights=tuple(_scaled(light, factor) for light, factor in changed))


def _scaled(light: Table, factor: Array) -> dict[str, Any]:
    key = "irradiance" if light["type"] == "directional" else "intensity"
    return {**light, key: (np.asarray(light[key], np.float64) * factor).tolist()}
