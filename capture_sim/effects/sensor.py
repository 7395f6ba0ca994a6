"""The chain of the sensor's effects: from what arrives at the pixels to what is recorded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import (
    Photograph,
    bayer,
    black_level,
    in_turn,
    quantisation,
    saturation,
    sensor_noise,
    simulated,
)
from capture_sim.model import Scene

Float32 = NDArray[np.float32]

# In the order in which a sensor does them: photons, full wells, pedestal, digitising.
PIXEL_EFFECTS = (sensor_noise, saturation, black_level, quantisation)


def exposed(scene: Scene, radiance: Float32, photograph: Photograph) -> Float32:
    """Record one exposure.

    Parameters
    ----------
    scene : Scene
        Decides on the effects.
    radiance : (h, w, 3) float32
        Linear, arriving at the pixels.
    photograph : Photograph
        Which photograph and exposure.

    Returns
    -------
    (h, w, 3) float32
        Linear; radiance times the exposure's seconds, with the sensor's errors.
    """
    values = (
        radiance if photograph.seconds == 1.0 else radiance * np.float32(photograph.seconds)
    )
    if not simulated(scene, bayer):
        return in_turn(PIXEL_EFFECTS, values, scene, photograph)
    with scene.costs.measure(bayer.NAME):
        seen = bayer.mosaic(values)
    seen = in_turn(PIXEL_EFFECTS, seen, scene, photograph)
    with scene.costs.measure(bayer.NAME):
        return bayer.apply(seen, scene)


def dark_noise(scene: Scene) -> float:
    """Standard deviation of what the sensor records in the dark, in units of radiance.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    float
        Read noise and rounding, as far as the scene describes them.
    """
    read = scene.effects.declared(sensor_noise.Options)
    digits = scene.effects.declared(quantisation.Options)
    variance = 0.0 if read is None else sensor_noise.standard_deviation(read, 0.0) ** 2
    if digits is not None:
        variance += digits.step**2 / 12.0
    return float(np.sqrt(variance))
