r"""Bracketed 8-bit exposures instead of one linear photograph.

An exposure of :math:`t` seconds stores :math:`\mathrm{sRGB}(\min(t L, 1))` in
8 bits: what is brighter than :math:`1 / t` saturates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Stage, Workload
from capture_sim.model import Scene
from capture_sim.tables import bounded

NAME = "exposure_brackets"
STAGE = Stage.SENSOR


@dataclass(frozen=True)
class Options:
    """Exposure times.

    Attributes
    ----------
    seconds : tuple of float
        Radiance ``1 / seconds`` saturates.
    """

    seconds: tuple[float, ...] = bounded((0.05, 0.25, 1.0, 4.0), low=1e-9, high=1e9)


def needed(scene: Scene) -> Decision:
    """Tell whether the scene asks for bracketed exposures.

    What saturates in the shortest exposure is lost whatever its radiance was,
    so the bound is the brightest value.
    """
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("photographs are linear: no [effects.exposure_brackets]", 0.0)
    times = ", ".join(f"{time:g} s" for time in options.seconds)
    return Decision(f"8-bit exposures of {times}", scene.brightness.headroom)


def cost(scene: Scene, work: Workload) -> Cost:
    """One encoding for each channel of each pixel and exposure."""
    return Cost(operations=work.n_values * len(scene.effects.get(Options).seconds))


def apply(exposed: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Encode one exposure in sRGB, 8 bits.

    Parameters
    ----------
    exposed : (h, w, 3) float32
        Linear, radiance times seconds; negative values (noise) become black, 1
        and above white.

    Returns
    -------
    (h, w, 3) uint8

    References
    ----------
    IEC 61966-2-1:1999, the sRGB colour space.

    Examples
    --------
    >>> apply(np.array([[[0.0, 0.5, 3.0]]], np.float32))
    array([[[  0, 188, 255]]], dtype=uint8)
    """
    linear = np.clip(exposed.astype(np.float64), 0.0, 1.0)
    power = 1.055 * linear ** (1.0 / 2.4) - 0.055
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, power)
    return np.rint(255.0 * encoded).astype(np.uint8)


def best_exposure(radiance: NDArray[np.float32], scene: Scene) -> NDArray[np.float32]:
    """Radiance as the longest exposure that does not saturate a pixel holds it.

    Parameters
    ----------
    radiance : (h, w, 3) float32
        Linear.
    scene : Scene
        Gives the exposure times.

    Returns
    -------
    (h, w, 3) float32
        What any merge of the exposures can know, up to rounding.
    """
    best = np.zeros_like(radiance)
    for seconds in sorted(scene.effects.get(Options).seconds):
        encoded = apply(radiance * np.float32(seconds)) / 255.0
        power = ((encoded + 0.055) / 1.055) ** 2.4
        linear = np.where(encoded <= 0.04045, encoded / 12.92, power) / seconds
        replaced = (encoded < 1.0) | (best == 0.0)
        best = np.where(replaced, linear, best).astype(np.float32)
    return best
