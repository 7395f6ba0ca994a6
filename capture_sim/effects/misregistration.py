"""Views shifted in the image against their calibration: a sensor that moved in its mount.

The principal point is moved, so that the shift is exact and costs no resampling.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Rig, Stage, Workload, normal_errors
from capture_sim.effects.bounds import shift_bound
from capture_sim.model import Scene
from capture_sim.tables import bounded

NAME = "misregistration"
STAGE = Stage.RIG


@dataclass(frozen=True)
class Options:
    """How far views are shifted.

    Attributes
    ----------
    pixels : float
        Standard deviation of a view's shift, per axis.
    """

    pixels: float = bounded(0.3, low=0.0, high=1e4)


def needed(scene: Scene) -> Decision:
    """Bound the change by the largest shift; the shifts drawn are known."""
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("views lie as calibrated: no [effects.misregistration]", 0.0)
    largest = float(np.abs(_shifts(scene, options)).sum(axis=1).max())
    return Decision(f"views shifted by up to {largest:.2g} px", shift_bound(scene, largest))


def _shifts(scene: Scene, options: Options) -> NDArray[np.float64]:
    return options.pixels * normal_errors(scene, NAME, len(scene.cameras), 2)


def cost(scene: Scene, work: Workload) -> Cost:
    """One principal point a view."""
    del scene
    return Cost(operations=work.n_views)


def apply(rig: Rig, scene: Scene) -> Rig:
    """Shift the true cameras' images; the reported principal points stay."""
    shifts = _shifts(scene, scene.effects.get(Options)).tolist()
    return replace(
        rig,
        cameras=tuple(
            {**camera, "cx": camera["cx"] + x, "cy": camera["cy"] + y}
            for camera, (x, y) in zip(rig.cameras, shifts, strict=True)
        ),
    )
