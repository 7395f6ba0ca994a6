r"""Light of the room that leaks into the dome: in every photograph, whatever lamp is on.

.. math:: L(\omega) = L_0\,(1 + g\, \omega \cdot d)

from all directions, in shares of equal solid angle, with the object's own shadow on it.
It does not depend on the lamp and is rendered once a view.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from capture_sim.dome import fibonacci
from capture_sim.effects import Cost, Decision, Stage, Workload
from capture_sim.errors import scene_error
from capture_sim.model import Scene
from capture_sim.tables import bounded

NAME = "environment"
STAGE = Stage.LIGHT


@dataclass(frozen=True)
class Options:
    """The room's light.

    Attributes
    ----------
    radiance : float
        Its mean, in the units of the photographs.
    tint : tuple of float
        Its colour; three factors of the radiance.
    direction : tuple of float
        Where it is brighter.
    directionality : float
        How much brighter there than the mean, 0 to 1.
    samples : int
        Directions that stand for all.
    """

    radiance: float = bounded(0.005, low=0.0)
    tint: tuple[float, ...] = bounded((1.0, 0.9, 0.8), low=0.0, high=100.0)
    direction: tuple[float, ...] = bounded((1.0, 0.0, 0.5), low=-1e6, high=1e6)
    directionality: float = bounded(0.5, low=0.0, high=1.0)
    samples: int = bounded(64, low=4, high=4096)

    def __post_init__(self) -> None:
        for key in ("tint", "direction"):
            if len(getattr(self, key)) != 3 or not any(getattr(self, key)):
                raise scene_error(
                    f"effects.{NAME}.{key}", "three numbers, not all zero", getattr(self, key)
                )


def needed(scene: Scene) -> Decision:
    """Bound the change by the radiance of a white surface that faces the brighter side."""
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("the dome is dark: no [effects.environment]", 0.0)
    brightest = options.radiance * (1.0 + options.directionality) * max(options.tint)
    reason = f"the room shines with {options.radiance:g} into the dome"
    return Decision(reason, brightest / scene.brightness.percentile99)


def cost(scene: Scene, work: Workload) -> Cost:
    """Each view is shaded by all directions once."""
    samples = scene.effects.get(Options).samples
    return Cost(rays=work.n_points * samples // 2, operations=work.n_points * samples)


def apply(scene: Scene) -> tuple[dict[str, Any], ...]:
    """Directional lights that together are the room.

    Parameters
    ----------
    scene : Scene
        Gives its light.

    Returns
    -------
    tuple of dict
        Lights of the native capture format.
    """
    options = scene.effects.get(Options)
    axis = np.asarray(options.direction) / np.linalg.norm(options.direction)
    directions = fibonacci(options.samples, np.pi)
    radiance = options.radiance * (1.0 + options.directionality * directions @ axis)
    share = 4.0 * np.pi / options.samples * radiance[:, None] * np.asarray(options.tint)
    return tuple(
        {"id": f"{NAME}{i}", "type": "directional", "direction": d, "irradiance": e}
        for i, (d, e) in enumerate(zip(directions.tolist(), share.tolist(), strict=True))
    )
