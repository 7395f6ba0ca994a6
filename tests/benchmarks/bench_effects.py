"""Preset by effect: what the plan switches on, what each effect changes, and its cost.

    python tests/benchmarks/bench_effects.py

Renders a few small photographs of every preset with each effect that it describes and
without, and prints a Markdown table: the largest change in percent of the photograph's 99th
percentile, in bold where ``auto`` switches the effect on, and in brackets the milliseconds
of processor time that it adds to a photograph. Ends with status 1 if the plan was wrong.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.measuring import Results, spent

from capture_sim.brightness import measured
from capture_sim.contributions import contributions, some_pairs
from capture_sim.effects import dropped_photographs, threshold
from capture_sim.effects.effect_registry import EFFECTS
from capture_sim.model import Scene
from capture_sim.photograph import set_up
from capture_sim.rays import RayTracer
from capture_sim.scene import load_scene

PRESETS = ("vase", "relief", "spot", "two_materials", "translucent", "bowl")


def small(scene: Scene, side: int, count: int) -> Scene:
    """The scene with some of its cameras and lamps and small images."""
    cameras = scene.cameras[:: math.ceil(len(scene.cameras) / count)]
    return replace(
        scene,
        cameras=tuple(coarse(camera, side) for camera in cameras),
        lights=scene.lights[:: math.ceil(len(scene.lights) / count)],
    )


def coarse(camera: dict, side: int) -> dict:
    """The camera with fewer and larger pixels."""
    factor = camera["w"] / side
    scaled = {key: camera[key] / factor for key in ("fl_x", "fl_y", "cx", "cy")}
    return {**camera, **scaled, "w": side, "h": side}


def column(scene: Scene, n_photographs: int) -> tuple[dict[str, str], list[str]]:
    """Cells of one preset by effect, and the effects that the plan was wrong about."""
    tracer = RayTracer(scene.mesh, n_threads=2)
    known = measured(scene, tracer)
    cells, wrong = {}, []
    shares = {
        one.name: one for one in contributions(known, tracer, some_pairs(known, n_photographs))
    }
    for effect in EFFECTS:
        if effect.NAME not in shares:
            continue
        one, is_on = shares[effect.NAME], effect.NAME in known.effects.active
        if (one.change > threshold(known, effect.STAGE)) is not is_on:
            wrong.append(effect.NAME)
        change = (
            f"{100.0 * one.change:.2g}" if one.change < 1.0 else f"{100.0 * one.change:.0f}"
        )
        milliseconds = f" ({max(0.0, 1e3 * one.seconds):.0f})"
        cells[effect.NAME] = f"**{change}**{milliseconds}" if is_on else change
    if known.effects.declared(dropped_photographs.Options):
        photographed = set_up(known).rig.photographed
        missing = f"{int((~photographed).sum())} of {photographed.size} missing"
        cells[dropped_photographs.NAME] = (
            f"**{missing}**" if not photographed.all() else missing
        )
    return cells, wrong


def main() -> None:
    """Parse, render, tell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=24, help="pixels")
    parser.add_argument("--photographs", type=int, default=6, help="of each preset")
    arguments = parser.parse_args()
    results = Results("effects", "What each effect changes", ["capture_sim.write"])
    columns, mistakes, rows = {}, [], []
    for name in PRESETS:
        scene = small(load_scene(name), arguments.side, 4)
        (columns[name], wrong), cost = spent(lambda s=scene: column(s, arguments.photographs))
        mistakes += [f"{name}: {effect}" for effect in wrong]
        rows.append({"preset": name, "wrong": ", ".join(wrong) or "none"} | cost)
    print("| effect | " + " | ".join(f"`{name}`" for name in PRESETS) + " |")
    print("|---" * (len(PRESETS) + 1) + "|")
    results.table(f"Percent of the 99th percentile; {arguments.side} pixels; (ms); bold: on")
    for effect in EFFECTS:
        cells = [columns[name].get(effect.NAME, "-") for name in PRESETS]
        results.add({"effect": effect.NAME} | dict(zip(PRESETS, cells, strict=True)))
        print(f"| `{effect.NAME}` | " + " | ".join(cells) + " |")
    results.table(
        "Effects that the plan switched wrongly; time and memory of measuring all of them"
    )
    for row in rows:
        results.add(row)
        results.say()
    print("wrong: " + (", ".join(mistakes) or "none"))
    print(results.write())
    sys.exit(bool(mistakes))


if __name__ == "__main__":
    main()
