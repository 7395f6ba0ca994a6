r"""Bracketed 8-bit exposures instead of one linear photograph.

An exposure of :math:`t` seconds stores :math:`\mathrm{sRGB}(\min(t L, 1))` in
8 bits: what is brighter than :math:`1 / t` saturates.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Workload
from capture_sim.scene import Scene

NAME = "8-bit exposures"


def needed(scene: Scene) -> tuple[bool, str]:
    """Tell whether the scene asks for bracketed exposures.

    Parameters
    ----------
    scene : Scene
        What is to be simulated.

    Returns
    -------
    simulated : bool
    reason : str
    """
    seconds = scene.effects.exposure_seconds
    if not seconds:
        return False, "photographs are linear; the scene has no effects.exposure_seconds"
    return True, "exposures of " + ", ".join(f"{time:g} s" for time in seconds)


def cost(scene: Scene, work: Workload) -> Cost:
    """One encoding for each channel of each pixel and exposure."""
    per_light = 3 * work.n_pixels * len(scene.effects.exposure_seconds)
    return Cost(operations=per_light * work.n_lights)


def expose(radiance: NDArray[np.float32], seconds: float) -> NDArray[np.uint8]:
    """Encode one exposure in sRGB.

    Parameters
    ----------
    radiance : (h, w, 3) float32
        Linear; negative values (noise) become black.
    seconds : float
        Radiance ``1 / seconds`` saturates.

    Returns
    -------
    (h, w, 3) uint8

    References
    ----------
    IEC 61966-2-1:1999, the sRGB colour space.

    Examples
    --------
    >>> expose(np.array([[[0.0, 0.5, 3.0]]], np.float32), seconds=1.0)
    array([[[  0, 188, 255]]], dtype=uint8)
    """
    linear = np.clip(radiance.astype(np.float64) * seconds, 0.0, 1.0)
    power = 1.055 * linear ** (1.0 / 2.4) - 0.055
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, power)
    return np.rint(255.0 * encoded).astype(np.uint8)
