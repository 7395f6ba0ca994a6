"""Pixels that are full: what is brighter is recorded as this bright."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Photograph, Stage, Workload
from capture_sim.model import Scene
from capture_sim.tables import bounded

NAME = "saturation"
STAGE = Stage.SENSOR


@dataclass(frozen=True)
class Options:
    """Where the sensor saturates.

    Attributes
    ----------
    radiance : float
        Largest value that is recorded (times 1 s of exposure).
    """

    radiance: float = bounded(4.0, low=1e-12)


def needed(scene: Scene) -> Decision:
    """Bound the loss by the brightest value that photographs may have."""
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("pixels are never full: no [effects.saturation]", 0.0)
    brightest = scene.brightness.brightest
    lost = max(0.0, brightest - options.radiance)
    reason = f"full at {options.radiance:g}; values may reach {brightest:.3g}"
    return Decision(reason, lost / scene.brightness.percentile99)


def cost(scene: Scene, work: Workload) -> Cost:
    """One comparison for each channel of each pixel."""
    del scene
    return Cost(operations=work.n_values)


def apply(
    values: NDArray[np.float32], scene: Scene, photograph: Photograph
) -> NDArray[np.float32]:
    """Cut off what is too bright."""
    del photograph
    return np.minimum(values, np.float32(scene.effects.get(Options).radiance))
