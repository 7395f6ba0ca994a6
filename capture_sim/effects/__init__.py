"""Physical effects, one module each; a scene pays only for those it calls for.

Every module has `needed(scene)`, which says whether the effect changes this
scene's photographs and why, and `cost(scene, work)`, what it adds.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Workload:
    """What one rendering of a scene amounts to.

    Attributes
    ----------
    n_views, n_lights : int
        Cameras and lights; every pair is one photograph.
    n_pixels : int
        Pixels of all views.
    n_points : int
        Shaded surface points of all views; every light shines on each.
    n_lit : int
        Pairs of point and light with the light above the point's horizon.
    """

    n_views: int
    n_lights: int
    n_pixels: int
    n_points: int
    n_lit: int

    @property
    def n_photographs(self) -> int:
        """One for each pair of view and light."""
        return self.n_views * self.n_lights


@dataclass(frozen=True)
class Cost:
    """What an effect adds to a rendering.

    Attributes
    ----------
    rays : int
        Rays traced.
    operations : int
        Evaluations other than rays (directions, random numbers).
    """

    rays: int = 0
    operations: int = 0
