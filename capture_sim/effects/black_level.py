"""The sensor's zero: what it records in the dark, and how well that is subtracted.

A pedestal is added before digitising so that noise is not cut off at zero, and its nominal
value is subtracted afterwards. Noise below the pedestal is cut off all the same, and the
true pedestal drifts from photograph to photograph.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Photograph, Stage, Workload, sensor_noise
from capture_sim.model import Scene
from capture_sim.tables import bounded

NAME = "black_level"
STAGE = Stage.SENSOR


@dataclass(frozen=True)
class Options:
    """The pedestal, in units of radiance (times 1 s of exposure).

    Attributes
    ----------
    level : float
        Its nominal value, which is subtracted.
    drift : float
        Standard deviation of the true value about it, by photograph and channel.
    """

    level: float = bounded(0.01, low=0.0)
    drift: float = bounded(2e-3, low=0.0)


def needed(scene: Scene) -> Decision:
    """Bound the offset by five standard deviations, the cut by the noise in the dark."""
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("dark is zero: no [effects.black_level]", 0.0)
    noise = scene.effects.declared(sensor_noise.Options)
    dark = 0.0 if noise is None else sensor_noise.standard_deviation(noise, 0.0)
    offset = sensor_noise.SIGMAS * options.drift
    cut = max(0.0, sensor_noise.SIGMAS * dark - options.level)
    rounding = float(np.finfo(np.float32).eps) * (scene.brightness.brightest + options.level)
    reason = f"pedestal {options.level:g}, drift {options.drift:g}"
    return Decision(reason, (offset + cut + rounding) / scene.brightness.percentile99)


def cost(scene: Scene, work: Workload) -> Cost:
    """One sum for each channel of each pixel."""
    del scene
    return Cost(operations=work.n_values)


def apply(
    values: NDArray[np.float32], scene: Scene, photograph: Photograph
) -> NDArray[np.float32]:
    """Add the true pedestal, cut off what is below zero, subtract the nominal one.

    References
    ----------
    EMVA Standard 1288, release 4.0, 2021: dark signal and its offset.
    """
    options = scene.effects.get(Options)
    channels = values.shape[2:]
    drift = options.drift * photograph.rng(scene, NAME).standard_normal(channels)
    pedestal = (options.level + drift).astype(np.float32)
    return np.maximum(values + pedestal, np.float32(0.0)) - np.float32(options.level)
