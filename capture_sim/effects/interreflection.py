"""Light that the object throws on itself: not simulated, and said so."""

from __future__ import annotations

from dataclasses import dataclass

from capture_sim.effects import Cost, Decision, Stage, Workload
from capture_sim.model import Scene

NAME = "interreflection"
STAGE = Stage.TRANSPORT


@dataclass(frozen=True)
class Options:
    """None."""


def needed(scene: Scene) -> Decision:
    """Tell why no light is passed on from the object to itself.

    Parameters
    ----------
    scene : Scene
        What is to be simulated.

    Returns
    -------
    Decision
    """
    if scene.mesh.convex:
        return Decision("a convex object throws no light on itself", 0.0)
    return Decision("not simulated: photographs hold direct light only", 0.0)


def cost(scene: Scene, work: Workload) -> Cost:
    """Nothing is traced."""
    del scene, work
    return Cost()
