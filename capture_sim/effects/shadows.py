"""Shadows that the object casts on itself, traced on the true mesh.

A convex object cannot shadow itself: light above the horizon of a point
always reaches it. For others, rays are traced only where the light is above
the shading horizon; all else is dark anyway.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Stage, Workload
from capture_sim.model import Scene
from capture_sim.rays import RayTracer
from capture_sim.surface import SurfacePoints

NAME = "shadows"
STAGE = Stage.LIGHT


@dataclass(frozen=True)
class Options:
    """None: what casts shadows is the object itself."""


def needed(scene: Scene) -> Decision:
    """Tell whether the object can shadow itself; a shadow takes all light away."""
    if scene.mesh.convex:
        return Decision("a convex object cannot shadow itself", 0.0)
    reason = "the object is not convex: parts of it hide lights from others"
    return Decision(reason, scene.brightness.headroom)


def cost(scene: Scene, work: Workload) -> Cost:
    """One ray for each point and light above its horizon."""
    del scene
    return Cost(rays=work.n_lit)


def apply(
    tracer: RayTracer,
    points: SurfacePoints,
    point: NDArray[np.intp],
    targets: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Tell which lights are seen from points of the surface.

    Parameters
    ----------
    tracer : RayTracer
        The surface that may be in the way.
    points : SurfacePoints
        Where light is wanted.
    point : (n,) int
        Index into `points` of each pair.
    targets : (n, 3) float64
        The pair's light position, or any point outside the object on the
        way to a distant light; world, metres.

    Returns
    -------
    (n,) bool
        True where nothing lies between.
    """
    lift = tracer.start_offset * points.face_normal
    starts = points.start + lift
    return ~tracer.occluded(starts[point], targets)
