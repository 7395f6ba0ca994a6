"""One view's photographs through all stages that its effects act at.

Rays and shading come from `render`; here the room's light, lamps with an area, the lens
and the sensor are put around them, each only where it is on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import (
    Effect,
    Photograph,
    Rig,
    defocus,
    environment,
    in_turn,
    light_extent,
    simulated,
    vignetting,
)
from capture_sim.effects.rig import real_rig
from capture_sim.model import Scene, Table
from capture_sim.placement import check_outside
from capture_sim.rays import RayTracer
from capture_sim.render import render_view
from capture_sim.view_samples import ViewSamples, sample_view
from capture_sim.visibility import TracedLights

Float32 = NDArray[np.float32]

OPTICS_EFFECTS = (defocus, vignetting)


@dataclass(frozen=True)
class Setup:
    """A scene, and what stands in the dome in truth.

    Attributes
    ----------
    scene : Scene
        Cameras and lights as calibrated.
    rig : Rig
        What the effects of the rig made of them.
    """

    scene: Scene
    rig: Rig

    @property
    def real(self) -> Scene:
        """The scene with cameras and lights as they are: what is rendered."""
        return replace(
            self.scene, cameras=self.rig.cameras, lights=self.rig.lights, heldout_photographs=0
        )

    @property
    def differs(self) -> bool:
        """True if cameras or lights are not what the capture reports."""
        rig = self.rig
        same = rig.cameras == rig.reported_cameras and rig.lights == rig.reported_lights
        return not same

    @property
    def reported(self) -> Scene:
        """The scene with cameras as the capture reports them and ideal lights."""
        return replace(self.scene, cameras=self.rig.reported_cameras)


def set_up(scene: Scene) -> Setup:
    """Put cameras and lights where they really are.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    Setup

    Raises
    ------
    SceneError
        If an error of the rig brings a camera or a lamp inside the object.
    """
    setup = Setup(scene, real_rig(scene))
    if setup.differs:
        check_outside(scene.mesh, setup.rig.cameras, setup.rig.lights)
    return setup


def photographs(
    scene: Scene,
    tracer: RayTracer,
    index: int,
    lights: NDArray[np.intp],
    view: ViewSamples | None = None,
    traced: TracedLights | None = None,
) -> Iterator[tuple[Photograph, Float32]]:
    """Photographs of one view, up to the sensor.

    Parameters
    ----------
    scene : Scene
        The real one.
    tracer : RayTracer
        Of the scene's mesh.
    index : int
        Of the view.
    lights : (n,) int
        Indices of the lights wanted; in ascending order.
    view : ViewSamples, optional
        Of the view's camera, if the caller has it already.
    traced : TracedLights, optional
        Visibility of the scene's lights, if the caller has it already.

    Yields
    ------
    photograph : Photograph
    radiance : (h, w, 3) float32
        Linear, arriving at the pixels.
    """
    view = view or sample_view(scene, tracer, scene.cameras[index])
    room = _room_light(scene, tracer, view) if simulated(scene, environment) else None
    depth = mean_depth(view) if simulated(scene, defocus) else None
    for light, radiance in _lit_by_lamps(scene, tracer, view, lights, traced):
        photograph = Photograph(view.camera, index, light, depth=depth)
        arriving = radiance if room is None else radiance + room
        yield photograph, in_turn(OPTICS_EFFECTS, arriving, scene, photograph)


def _lit_by_lamps(
    scene: Scene,
    tracer: RayTracer,
    view: ViewSamples,
    lights: NDArray[np.intp],
    traced: TracedLights | None,
) -> Iterator[tuple[int, Float32]]:
    if len(lights) == 0:
        return
    if simulated(scene, light_extent):
        for light in lights.tolist():
            yield light, _lit_by_area(scene, tracer, view, light)
        return
    wanted = replace(scene, lights=tuple(scene.lights[light] for light in lights))
    known = None if traced is None else traced.some(lights)
    for place, radiance in render_view(wanted, tracer, view, known):
        yield int(lights[place]), radiance


def _lit_by_area(scene: Scene, tracer: RayTracer, view: ViewSamples, light: int) -> Float32:
    with scene.costs.measure(light_extent.NAME):
        patches = light_extent.apply(scene, scene.lights[light])
        return _lit_together(scene, tracer, view, patches)


def _room_light(scene: Scene, tracer: RayTracer, view: ViewSamples) -> Float32:
    with scene.costs.measure(environment.NAME):
        return _lit_together(scene, tracer, view, environment.apply(scene))


def _lit_together(
    scene: Scene, tracer: RayTracer, view: ViewSamples, lights: tuple[Table, ...]
) -> Float32:
    """One photograph under all of the lights."""
    total = np.zeros((*view.coverage.shape, 3), dtype=np.float32)
    for _, radiance in render_view(replace(scene, lights=lights), tracer, view):
        total += radiance
    return total


def mean_depth(view: ViewSamples) -> Float32:
    """Mean distance along the optical axis of what each pixel shows.

    Parameters
    ----------
    view : ViewSamples

    Returns
    -------
    (h, w) float32
        Metres; 0 where the pixel shows nothing.
    """
    pose = np.asarray(view.camera["camera_from_world"], np.float64)
    depth = view.points.position @ pose[2, :3] + pose[2, 3]
    total = np.bincount(view.pixel, view.weight * depth, minlength=view.coverage.size)
    covered = np.bincount(view.pixel, view.weight, minlength=view.coverage.size)
    mean = total / np.where(covered > 0.0, covered, 1.0)
    return np.asarray(mean.reshape(view.coverage.shape), np.float32)


def toggled(scene: Scene, effect: Effect) -> Scene:
    """A scene whose effects were decided, with one of them off if on and on if off.

    Parameters
    ----------
    scene : Scene
        From `capture_sim.effects.effect_registry.decided`.
    effect : module

    Returns
    -------
    Scene
    """
    active = (scene.effects.active or frozenset()) ^ {effect.NAME}
    return replace(scene, effects=replace(scene.effects, active=active))
