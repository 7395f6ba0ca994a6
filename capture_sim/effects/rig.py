"""The chain of the rig's effects: what it really is, against its calibration."""

from __future__ import annotations

import numpy as np

from capture_sim.effects import (
    Rig,
    dropped_photographs,
    falloff_profile,
    lens_distortion,
    light_position_error,
    light_variation,
    misregistration,
    pose_error,
    simulated,
)
from capture_sim.model import Scene

# In the order in which they act.
RIG_EFFECTS = (
    lens_distortion,
    pose_error,
    misregistration,
    falloff_profile,
    light_position_error,
    light_variation,
    dropped_photographs,
)


def real_rig(scene: Scene) -> Rig:
    """Apply the rig's effects that are on.

    Parameters
    ----------
    scene : Scene
        Its cameras and lights are the calibrated ones.

    Returns
    -------
    Rig
        As it really is, and as it is reported.
    """
    rig = Rig(
        cameras=scene.cameras,
        lights=scene.lights,
        reported_cameras=scene.cameras,
        reported_lights=scene.lights,
        photographed=np.ones((len(scene.cameras), len(scene.lights)), dtype=bool),
    )
    for effect in RIG_EFFECTS:
        if simulated(scene, effect):
            rig = effect.apply(rig, scene)
    return rig
