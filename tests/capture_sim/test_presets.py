"""The plan is right: on each preset, what it leaves out changes nothing, what it keeps does."""

import math
from dataclasses import replace

import pytest

from capture_sim.brightness import measured
from capture_sim.contributions import arriving, contributions, some_pairs
from capture_sim.effects import threshold
from capture_sim.effects.effect_registry import EFFECTS, decided
from capture_sim.rays import RayTracer
from capture_sim.scene import load_scene

PRESETS = ("vase", "relief", "spot", "two_materials", "translucent", "bowl")
TAKE_LONG = {"translucent", "bowl", "spot", "vase"}
SIDE = 16  # pixels
# Effects that have no picture of their own to compare.
NO_PICTURE = {"dropped_photographs"}


def small(name):
    """A preset with few cameras and lights and small images."""
    scene = load_scene(name)
    cameras = scene.cameras[:: math.ceil(len(scene.cameras) / 3)]
    return replace(
        scene,
        cameras=tuple(_coarse(camera) for camera in cameras),
        lights=scene.lights[:: math.ceil(len(scene.lights) / 3)],
    )


def _coarse(camera):
    factor = camera["w"] / SIDE
    scaled = {key: camera[key] / factor for key in ("fl_x", "fl_y", "cx", "cy")}
    return {**camera, **scaled, "w": SIDE, "h": SIDE}


@pytest.mark.parametrize(
    "name",
    [pytest.param(p, marks=pytest.mark.slow) if p in TAKE_LONG else p for p in PRESETS],
)
def test_the_plan_is_right(name):
    scene = small(name)
    tracer = RayTracer(scene.mesh, n_threads=2)
    known = measured(scene, tracer)
    shares = {one.name: one for one in contributions(known, tracer, some_pairs(known, 3))}
    on = known.effects.active
    wrong = {}
    for effect in EFFECTS:
        if effect.NAME in NO_PICTURE or effect.NAME not in shares:
            continue
        change, bound = shares[effect.NAME].change, effect.needed(known).bound
        visible = change > threshold(known, effect.STAGE)
        if visible is not (effect.NAME in on) or change > bound:
            wrong[effect.NAME] = (change, bound)
    assert wrong == {}
    assert {"antialiasing", "near_lights", "shadows"} <= set(shares)


def test_presets_call_for_different_effects():
    """Each preset leaves some of its own effects out, and no two are alike."""
    active = {}
    for name in PRESETS:
        scene = small(name)
        active[name] = measured(scene, RayTracer(scene.mesh, n_threads=2)).effects.active
    assert len(set(active.values())) == len(PRESETS)
    assert "shadows" not in active["two_materials"]
    assert "near_lights" not in active["two_materials"]
    assert "defocus" not in active["relief"]
    assert "environment" not in active["vase"]
    assert "interreflection" in active["bowl"]
    assert "bayer" in active["spot"]


def test_effects_that_are_off_never_run(monkeypatch):
    """Off is free: a scene that describes everything and simulates nothing calls nothing."""
    described = load_scene("vase").effects.parameters

    def fail(*_, **__):
        raise AssertionError

    for effect in EFFECTS:
        if effect.NAME != "near_lights":  # its `apply` gives the light at the centre, once
            monkeypatch.setattr(effect, "apply", fail)
    scene = small("vase")
    off = replace(scene.effects, simulate="none", parameters=described)
    scene = decided(replace(scene, effects=off))
    images, _ = arriving(scene, RayTracer(scene.mesh), [(0, 0)])
    assert images[0, 0].max() > 0.0
    assert not scene.effects.active
