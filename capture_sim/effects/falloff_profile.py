r"""Lamps that shine less to the side: :math:`I(\theta) = I_0 \cos^p\theta` about their axis.

The axis points to the object's centre. :math:`p = 1` is a flat diffuse emitter; a light
emitting diode whose half angle is :math:`\theta_{1/2}` has
:math:`p = -\ln 2 / \ln\cos\theta_{1/2}`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from capture_sim.effects import Cost, Decision, Rig, Stage, Workload
from capture_sim.effects.bounds import light_distances
from capture_sim.model import Scene, Table
from capture_sim.tables import bounded

NAME = "falloff_profile"
STAGE = Stage.RIG


@dataclass(frozen=True)
class Options:
    """Profile of the lamps.

    Attributes
    ----------
    exponent : float
        Power of the cosine.
    calibrated : bool
        True if the capture reports spot lights with this exponent, False if it
        takes the lamps for point lights that shine equally to all sides.
    """

    exponent: float = bounded(1.0, low=0.0, high=1e4)
    calibrated: bool = False


def needed(scene: Scene) -> Decision:
    r"""Bound the loss at the rim of the object, :math:`1 - \cos^p(\arcsin(r / d))`."""
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("lamps shine equally to all sides: no [effects.falloff_profile]", 0.0)
    sine = min(1.0, scene.mesh.radius / float(light_distances(scene).min()))
    loss = 1.0 - (1.0 - sine**2) ** (options.exponent / 2.0)
    reason = f"lamps lose up to {100.0 * loss:.2g} % towards the rim of the object"
    return Decision(reason, scene.brightness.headroom * loss)


def cost(scene: Scene, work: Workload) -> Cost:
    """One power for each point and light."""
    del scene
    return Cost(operations=work.n_points * work.n_lights)


def apply(rig: Rig, scene: Scene) -> Rig:
    """Turn point lights into spot lights that aim at the object's centre.

    References
    ----------
    I. Moreno and C.-C. Sun, "Modeling the radiation pattern of LEDs", Optics Express
    16(3), 2008.
    """
    options = scene.effects.get(Options)
    reported = rig.reported_lights
    return replace(
        rig,
        lights=tuple(_aimed(light, scene, options) for light in rig.lights),
        reported_lights=tuple(_aimed(light, scene, options) for light in reported)
        if options.calibrated
        else reported,
    )


def _aimed(light: Table, scene: Scene, options: Options) -> dict[str, Any]:
    if light["type"] != "point":
        return dict(light)
    axis = scene.mesh.centre - np.asarray(light["position"], np.float64)
    spot = {"type": "spot", "direction": axis.tolist(), "exponent": options.exponent}
    return {**light, **spot}
