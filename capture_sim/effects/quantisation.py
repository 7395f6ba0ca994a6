r"""Values that are whole steps of a digitiser, :math:`\Delta = L_\mathrm{full} / (2^b - 1)`.

What is brighter than full scale is recorded as the largest code. Values below zero, of
which a pedestal was subtracted (`black_level`), stay: a converter codes them before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Photograph, Stage, Workload
from capture_sim.model import Scene
from capture_sim.tables import bounded

NAME = "quantisation"
STAGE = Stage.SENSOR


@dataclass(frozen=True)
class Options:
    """The digitiser.

    Attributes
    ----------
    bits : int
        Of each value.
    full_scale : float
        Radiance (times 1 s of exposure) of the largest code.
    """

    bits: int = bounded(12, low=1, high=24)
    full_scale: float = bounded(4.0, low=1e-12)

    @property
    def largest_code(self) -> int:
        """Steps up to full scale."""
        return int(2**self.bits - 1)

    @property
    def step(self) -> float:
        """Radiance of one step.

        Examples
        --------
        >>> Options(bits=8, full_scale=255.0).step
        1.0
        """
        return self.full_scale / self.largest_code


def needed(scene: Scene) -> Decision:
    """Bound the change by half a step, and by what full scale cuts off."""
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("values are continuous: no [effects.quantisation]", 0.0)
    brightest = scene.brightness.brightest
    lost = max(0.0, brightest - options.full_scale)
    reason = f"{options.bits} bits up to {options.full_scale:g}: steps of {options.step:.2g}"
    if lost:
        reason += f"; values may reach {brightest:.3g}"
    return Decision(reason, (0.5 * options.step + lost) / scene.brightness.percentile99)


def cost(scene: Scene, work: Workload) -> Cost:
    """One rounding for each channel of each pixel."""
    del scene
    return Cost(operations=work.n_values)


def apply(
    values: NDArray[np.float32], scene: Scene, photograph: Photograph
) -> NDArray[np.float32]:
    """Round to whole steps, at most the largest code."""
    del photograph
    options = scene.effects.get(Options)
    step = np.float32(options.step)
    return np.minimum(np.rint(values / step), np.float32(options.largest_code)) * step
