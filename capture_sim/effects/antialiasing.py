"""Several rays per pixel, more of them where an outline crosses the pixel.

Inside the object shading changes slowly over a pixel and a small regular grid
of rays is enough; at its outline and at inner occlusion edges a finer grid
measures how much of the pixel each side takes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Stage, Workload
from capture_sim.model import Scene

NAME = "antialiasing"
STAGE = Stage.VIEW


@dataclass(frozen=True)
class Options:
    """None: rays per pixel stand in the table ``[image]``."""


def needed(scene: Scene) -> Decision:
    """Tell whether pixels have several rays; there is no bound on what one ray meets."""
    inside, edge = scene.image.samples_per_side, scene.image.edge_samples_per_side
    if max(inside, edge) == 1:
        return Decision("one ray per pixel was asked for", 0.0)
    reason = f"{inside} x {inside} rays inside the object, {edge} x {edge} at outlines"
    return Decision(reason, float("inf"))


def cost(scene: Scene, work: Workload) -> Cost:
    """Every pixel is searched for outlines with the finer grid."""
    return Cost(rays=work.n_pixels * scene.image.edge_samples_per_side**2 + work.n_points)


def apply(scene: Scene) -> tuple[int, int]:
    """Rays along each side of a pixel.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    inside, edge : int
        Inside the object and where an outline crosses the pixel.
    """
    inside = scene.image.samples_per_side
    return inside, max(inside, scene.image.edge_samples_per_side)


def sub_pixel_grid(samples_per_side: int) -> NDArray[np.float64]:
    """Centres of a regular division of the unit pixel.

    Parameters
    ----------
    samples_per_side : int
        Rays along each side of the pixel.

    Returns
    -------
    (samples_per_side**2, 2) float64
        Columns x, y in (0, 1).

    Examples
    --------
    >>> sub_pixel_grid(2)
    array([[0.25, 0.25],
           [0.75, 0.25],
           [0.25, 0.75],
           [0.75, 0.75]])
    """
    ticks = (np.arange(samples_per_side) + 0.5) / samples_per_side
    y, x = np.meshgrid(ticks, ticks, indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=1)
