"""What each effect contributes: photographs with it, less photographs without it.

Effects up to the lens are left out of the whole chain and compared before the sensor, so
that noise does not hide them. What the sensor does is compared with what arrives at it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from capture_sim.brightness import relative_change, spread
from capture_sim.effects import (
    Effect,
    Photograph,
    Stage,
    dropped_photographs,
    exposure_brackets,
    simulated,
)
from capture_sim.effects.effect_registry import EFFECTS
from capture_sim.effects.sensor import exposed
from capture_sim.model import Scene
from capture_sim.photograph import photographs, set_up, toggled
from capture_sim.rays import RayTracer

Float32 = NDArray[np.float32]
Pair = tuple[int, int]
Images = Mapping[Pair, Float32]


@dataclass(frozen=True)
class Contribution:
    """What one effect does to some photographs.

    Attributes
    ----------
    name : str
    differences : dict of (view, light) to (h, w, 3) float32
        With the effect less without it, linear.
    change : float
        Largest of all changes, each as a part of its photograph's 99th percentile.
    seconds : float
        Processor seconds that it added to the rendering of one photograph, those of
        all threads together: with it less without it. Noise can make it negative.
    """

    name: str
    differences: Images
    change: float
    seconds: float


def some_pairs(scene: Scene, count: int) -> list[Pair]:
    """Pairs of view and light that are spread over the rig.

    Parameters
    ----------
    scene : Scene
    count : int
        How many at most.

    Returns
    -------
    list of (view, light)
    """
    n_lights = len(scene.lights)
    chosen = spread(len(scene.cameras) * n_lights, count)
    return [divmod(pair, n_lights) for pair in chosen]


def contributions(scene: Scene, tracer: RayTracer, pairs: list[Pair]) -> list[Contribution]:
    """What each effect that the scene describes does to some photographs.

    Parameters
    ----------
    scene : Scene
        Its effects decided.
    tracer : RayTracer
        Of the scene's mesh.
    pairs : list of (view, light)

    Returns
    -------
    list of Contribution
        In the order of the effects. Those that are on are left out for comparison, those
        that are off but described are added. Missing photographs have none.
    """
    arriving(scene, tracer, pairs)  # what is compiled or found once for all is no part of it
    everything, seconds = arriving(scene, tracer, pairs)
    changes = []
    for effect in EFFECTS:
        if not _described(scene, effect) or effect is dropped_photographs:
            continue
        if effect.STAGE is Stage.SENSOR:
            changes.append(_of_sensor(scene, effect, everything))
            continue
        other, others_seconds = arriving(toggled(scene, effect), tracer, pairs)
        added = (seconds - others_seconds) / len(pairs)
        if simulated(scene, effect):
            changes.append(_compared(effect, everything, other, added))
        else:
            changes.append(_compared(effect, other, everything, -added))
    return changes


def _described(scene: Scene, effect: Effect) -> bool:
    """True if the scene says enough about an effect to simulate it."""
    in_every_scene = not fields(effect.Options) or effect.STAGE is Stage.TRANSPORT
    return in_every_scene or scene.effects.declared(effect.Options) is not None


def n_described(scene: Scene) -> int:
    """How many effects the scene says enough about to simulate them."""
    return sum(_described(scene, effect) for effect in EFFECTS)


def arriving(scene: Scene, tracer: RayTracer, pairs: list[Pair]) -> tuple[Images, float]:
    """Some photographs before the sensor, and the processor seconds that they took.

    Parameters
    ----------
    scene : Scene
        Its effects decided.
    tracer : RayTracer
        Of the scene's mesh.
    pairs : list of (view, light)

    Returns
    -------
    images : dict of (view, light) to (h, w, 3) float32
    seconds : float
    """
    real = set_up(scene).real
    start = time.process_time()
    images: dict[Pair, Float32] = {}
    for view in sorted({view for view, _ in pairs}):
        lights = np.array(sorted(light for v, light in pairs if v == view), dtype=np.intp)
        for photograph, radiance in photographs(real, tracer, view, lights):
            images[view, photograph.light] = radiance
    return images, time.process_time() - start


def _of_sensor(scene: Scene, effect: Effect, images: Images) -> Contribution:
    """The effect alone on what arrives at the sensor."""
    alone = replace(scene, effects=replace(scene.effects, active=frozenset({effect.NAME})))
    start = time.process_time()
    recorded = {
        pair: _recorded(alone, image, Photograph(alone.cameras[pair[0]], *pair))
        for pair, image in images.items()
    }
    seconds = (time.process_time() - start) / len(images)
    contribution = _compared(effect, recorded, images, seconds)
    change = max(relative_change(images[p], recorded[p]) for p in images)
    return replace(contribution, change=change)


def _recorded(scene: Scene, image: Float32, photograph: Photograph) -> Float32:
    if not simulated(scene, exposure_brackets):
        return exposed(scene, image, photograph)
    return exposure_brackets.best_exposure(image, scene)


def _compared(effect: Effect, images: Images, reduced: Images, seconds: float) -> Contribution:
    return Contribution(
        name=effect.NAME,
        differences={pair: images[pair] - reduced[pair] for pair in images},
        change=max(relative_change(images[pair], reduced[pair]) for pair in images),
        seconds=seconds,
    )
