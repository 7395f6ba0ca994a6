"""Light that the object throws on itself: not simulated, and said so."""

from __future__ import annotations

from capture_sim.effects import Cost, Workload
from capture_sim.scene import Scene

NAME = "interreflection"


def needed(scene: Scene) -> tuple[bool, str]:
    """Tell why no light is passed on from the object to itself.

    Parameters
    ----------
    scene : Scene
        What is to be simulated.

    Returns
    -------
    simulated : bool
        Always False.
    reason : str
    """
    if scene.mesh.convex:
        return False, "a convex object throws no light on itself"
    return False, "not simulated: photographs hold direct light only"


def cost(scene: Scene, work: Workload) -> Cost:
    """Nothing is traced."""
    del scene, work
    return Cost()
