"""Photographs that are missing: a lamp that did not fire, a file that was lost."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Rig, Stage, Workload, effect_rng
from capture_sim.errors import scene_error
from capture_sim.model import Scene
from capture_sim.tables import bounded

NAME = "dropped_photographs"
STAGE = Stage.RIG


@dataclass(frozen=True)
class Options:
    """How many photographs are missing.

    Attributes
    ----------
    fraction : float
        Probability of each.
    """

    fraction: float = bounded(0.02, low=0.0, high=1.0)


def needed(scene: Scene) -> Decision:
    """Count the photographs that are missing: there is no bound on losing one."""
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("all photographs are there: no [effects.dropped_photographs]", 0.0)
    lost = _lost(scene, options)
    reason = f"{int(lost.sum())} of {lost.size} photographs are missing"
    return Decision(reason, float("inf") if lost.any() else 0.0)


def _lost(scene: Scene, options: Options) -> NDArray[np.bool_]:
    shape = (len(scene.cameras), len(scene.lights))
    return np.asarray(effect_rng(scene, NAME).random(shape) < options.fraction)


def cost(scene: Scene, work: Workload) -> Cost:
    """Nothing; photographs that are missing are not rendered."""
    del scene, work
    return Cost()


def apply(rig: Rig, scene: Scene) -> Rig:
    """Lose photographs.

    Raises
    ------
    SceneError
        If none is left.
    """
    options = scene.effects.get(Options)
    photographed = rig.photographed & ~_lost(scene, options)
    if not photographed.any():
        raise scene_error(
            f"effects.{NAME}.fraction", "some photographs left", options.fraction, "lower it"
        )
    return replace(rig, photographed=photographed)
