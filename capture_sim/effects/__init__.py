"""Physical effects, one module each; a scene pays only for those it calls for.

Every module has the same interface:

============================  =====================================================
``NAME``                      key of the effect in scene files
``STAGE``                     where in the formation of the image it acts (`Stage`)
``Options``                   frozen dataclass of its parameters, all with defaults;
                              the table ``[effects.NAME]`` of the scene is read into it
``needed(scene)``             `Decision`: a bound on what leaving it out changes, and why
``cost(scene, work)``         `Cost`: what it adds to the rendering
``apply(...)``                the effect itself, called only where it is on
============================  =====================================================

Stages, in the order in which they act, and what ``apply`` gets and returns there:

=============  =======================================================================
``RIG``        ``apply(rig, scene) -> Rig``: what the rig really is, against what its
               calibration says; once a capture
``VIEW``       rays of the pixels; once a view, the same for all lights
``LIGHT``      direct light that arrives at surface points
``TRANSPORT``  ``apply(scene, tracer, points, views, lights, traced)
               -> (n, 3, n_lights)``: radiance that n surface points send to the camera
               beyond direct light; `views` are unit directions to it, (n, 3), in the
               world, `traced` the visibility of the lights, where it is known
``OPTICS``     ``apply(radiance, scene, photograph) -> radiance``: from the radiance of the
               scene to what arrives at the pixels, (h, w, 3) float32
``SENSOR``     ``apply(values, scene, photograph) -> values``: from what arrives to what is
               recorded
=============  =======================================================================

`simulated` decides. Code asks it and calls ``apply`` only if the answer is True, so
that an effect which is off costs nothing.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from capture_sim.model import Scene, Table


class Stage(StrEnum):
    """Where in the formation of a photograph an effect acts."""

    RIG = "rig"
    VIEW = "view"
    LIGHT = "light"
    TRANSPORT = "transport"
    OPTICS = "optics"
    SENSOR = "sensor"


@dataclass(frozen=True)
class Decision:
    """What leaving an effect out would change.

    Attributes
    ----------
    reason : str
        One line for the reader of the plan.
    bound : float
        Upper bound on the largest change of any value of any photograph, as a
        part of that photograph's 99th percentile; infinite if there is none,
        0 if the effect changes nothing.
    """

    reason: str
    bound: float


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

    @property
    def n_values(self) -> int:
        """Channels of pixels of all photographs."""
        return 3 * self.n_pixels * self.n_lights


@dataclass(frozen=True)
class Cost:
    """What an effect adds to a rendering.

    Attributes
    ----------
    rays : int
        Rays traced.
    operations : int
        Evaluations other than rays (directions, random numbers).
    note : str
        What the work leaves open, for the reader of the plan.
    """

    rays: int = 0
    operations: int = 0
    note: str = ""


@dataclass(frozen=True)
class Photograph:
    """The photograph that optics and sensor act on, as one exposure takes it.

    Attributes
    ----------
    camera : dict
        Camera of the native capture format.
    view, light : int
        Indices of camera and light.
    exposure : int
        Index among the exposures of the photograph.
    seconds : float
        Exposure time; 1 for photographs that are not bracketed.
    depth : (h, w) float32, optional
        Mean distance of what a pixel shows along the optical axis, metres; 0 where
        it shows nothing. Given where the lens blurs.
    """

    camera: Table
    view: int
    light: int
    exposure: int = 0
    seconds: float = 1.0
    depth: NDArray[np.float32] | None = None

    def rng(self, scene: Scene, effect: str) -> np.random.Generator:
        """Generator of this photograph and effect: results depend on no order of work."""
        return effect_rng(scene, effect, self.view, self.light, self.exposure)


@dataclass(frozen=True)
class Rig:
    """Cameras and lights as they are, and as the capture says they are.

    Attributes
    ----------
    cameras, lights : tuple of dict
        As they are: photographs are rendered with these.
    reported_cameras, reported_lights : tuple of dict
        Calibration that is written into the capture.
    photographed : (n_views, n_lights) bool
        True for photographs that exist.
    """

    cameras: tuple[Table, ...]
    lights: tuple[Table, ...]
    reported_cameras: tuple[Table, ...]
    reported_lights: tuple[Table, ...]
    photographed: NDArray[np.bool_]


def effect_rng(scene: Scene, effect: str, *indices: int) -> np.random.Generator:
    """Random numbers of one effect, the same whatever other effects are on.

    Parameters
    ----------
    scene : Scene
        Gives the seed.
    effect : str
        Its name.
    *indices : int
        Of view, light, exposure, where each has numbers of its own.

    Returns
    -------
    numpy.random.Generator
    """
    return np.random.default_rng((scene.seed, *indices, zlib.crc32(effect.encode())))


def normal_errors(scene: Scene, effect: str, *shape: int) -> NDArray[np.float64]:
    """Standard normal numbers from which an effect of the rig draws its errors.

    Parameters
    ----------
    scene : Scene
        Gives the seed: the errors are known before anything is rendered.
    effect : str
        Its name.
    *shape : int

    Returns
    -------
    ndarray of float64, of that shape
    """
    return effect_rng(scene, effect).standard_normal(shape)


class Effect(Protocol):
    """The part of an effect's module that all stages share."""

    NAME: str
    STAGE: Stage

    @property
    def Options(self) -> type:
        """Dataclass of the effect's parameters."""

    def needed(self, scene: Scene) -> Decision:
        """Bound what leaving the effect out changes."""

    def cost(self, scene: Scene, work: Workload) -> Cost:
        """Count what the effect adds."""


def threshold(scene: Scene, stage: Stage) -> float:
    """Change below which an effect is not called for.

    Parameters
    ----------
    scene : Scene
    stage : Stage
        Of the effect. What the sensor does is not compared with its own noise.

    Returns
    -------
    float
        Part of a photograph's 99th percentile.
    """
    if stage is Stage.SENSOR:
        return scene.effects.tolerance
    return max(scene.effects.tolerance, scene.brightness.noise)


def simulated(scene: Scene, effect: Effect) -> bool:
    """Tell whether an effect is on.

    Parameters
    ----------
    scene : Scene
    effect : module
        Of this package.

    Returns
    -------
    bool
        What was decided for the scene, or else what its choice says.
    """
    choice = scene.effects
    if choice.active is not None:
        return effect.NAME in choice.active
    if effect.NAME in choice.forced:
        return choice.forced[effect.NAME]
    if choice.simulate in ("all", "none"):
        return choice.simulate == "all"
    if choice.simulate == "auto":
        return effect.needed(scene).bound > threshold(scene, effect.STAGE)
    return effect.NAME in choice.simulate


class ImageEffect(Effect, Protocol):
    """An effect on whole photographs: of the lens or of the sensor's pixels."""

    def apply(
        self, values: NDArray[np.float32], scene: Scene, photograph: Photograph
    ) -> NDArray[np.float32]:
        """Change a photograph."""


def in_turn(
    effects: tuple[ImageEffect, ...],
    values: NDArray[np.float32],
    scene: Scene,
    photograph: Photograph,
) -> NDArray[np.float32]:
    """Apply those effects on a photograph that are on, one after the other.

    Parameters
    ----------
    effects : tuple of modules
    values : (h, w, 3) or (h, w) float32
    scene : Scene
        Decides, and keeps the time that each takes.
    photograph : Photograph

    Returns
    -------
    (h, w, 3) or (h, w) float32
    """
    for effect in effects:
        if simulated(scene, effect):
            with scene.costs.measure(effect.NAME):
                values = effect.apply(values, scene, photograph)
    return values
