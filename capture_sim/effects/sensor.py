"""The chain of the sensor's effects: from what arrives at the pixels to what is recorded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Frame, sensor_noise, simulated
from capture_sim.model import Scene

Float32 = NDArray[np.float32]


def exposed(scene: Scene, radiance: Float32, frame: Frame) -> Float32:
    """Record one exposure.

    Parameters
    ----------
    scene : Scene
        Decides on the effects.
    radiance : (h, w, 3) float32
        Linear, arriving at the pixels.
    frame : Frame
        Which photograph and exposure.

    Returns
    -------
    (h, w, 3) float32
        Linear; radiance times the exposure's seconds, with the sensor's errors.
    """
    values = radiance if frame.seconds == 1.0 else radiance * np.float32(frame.seconds)
    if simulated(scene, sensor_noise):
        values = sensor_noise.apply(values, scene, frame)
    return values
