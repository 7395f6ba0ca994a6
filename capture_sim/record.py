"""What was simulated, as the capture keeps it: the plan's table with what it really took.

``truth/effects.json`` holds the choice, the tolerance, how bright photographs were taken
to be, and a line for each effect: on or off, why, the bound on what leaving it out
changes, and the seconds that it took. On demand it also holds what each effect
contributed to some photographs, whose difference images lie in ``truth/contributions/``.
``truth/rig.json`` holds cameras and lights as they really were, where that is not what
the capture reports.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from capture_sim.contributions import Contribution
from capture_sim.effects import Effect, simulated, threshold
from capture_sim.effects.effect_registry import EFFECTS
from capture_sim.files import write_exr, write_json, write_whole
from capture_sim.model import Scene
from capture_sim.photograph import Setup

EFFECTS_FILE = "truth/effects.json"
RIG_FILE = "truth/rig.json"


def write_record(setup: Setup, contributed: list[Contribution], folder: Path) -> dict[str, str]:
    """Write what was simulated.

    Parameters
    ----------
    setup : Setup
        Its effects decided, everything rendered.
    contributed : list of Contribution
        Empty if nobody asked for them.
    folder : Path
        The capture.

    Returns
    -------
    dict of str to str
        Entries for ``truth/truth.json``: which file is what.
    """
    by_name = {one.name: one for one in contributed}
    write_whole(folder / EFFECTS_FILE, write_json, effects_record(setup.scene, by_name))
    listing = {"effects": EFFECTS_FILE}
    for one in contributed:
        _write_differences(setup.scene, one, folder / "truth" / "contributions" / one.name)
        listing["contributions"] = "truth/contributions/{effect}/{camera}_{light}.exr"
    if setup.differs:
        lights = [dict(light) for light in setup.rig.lights]
        cameras = [dict(camera) for camera in setup.rig.cameras]
        write_whole(folder / RIG_FILE, write_json, {"cameras": cameras, "lights": lights})
        listing["rig"] = RIG_FILE
    return listing


def effects_record(scene: Scene, contributed: Mapping[str, Contribution]) -> dict[str, Any]:
    """The table of effects, of JSON types.

    Parameters
    ----------
    scene : Scene
        Its effects decided.
    contributed : dict of str to Contribution
        By the name of the effect.

    Returns
    -------
    dict
        Bounds that are infinite are None.
    """
    choice = scene.effects.simulate
    return {
        "simulate": choice if isinstance(choice, str) else list(choice),
        "tolerance": scene.effects.tolerance,
        "brightness": asdict(scene.brightness),
        "repairs": list(scene.mesh.notes),
        "effects": [_line(scene, effect, contributed.get(effect.NAME)) for effect in EFFECTS],
    }


def _line(scene: Scene, effect: Effect, contribution: Contribution | None) -> dict[str, Any]:
    decision, is_on = effect.needed(scene), simulated(scene, effect)
    line: dict[str, Any] = {
        "name": effect.NAME,
        "stage": str(effect.STAGE),
        "on": is_on,
        "reason": decision.reason,
        "bound": _finite(decision.bound),
        "threshold": threshold(scene, effect.STAGE),
        "seconds": scene.costs.seconds(effect.NAME),
    }
    if contribution is not None:
        line["contribution"] = _finite(contribution.change)
        line["seconds_per_photograph"] = contribution.seconds
    return line


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _write_differences(scene: Scene, one: Contribution, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for (view, light), difference in one.differences.items():
        name = f"{scene.cameras[view]['id']}_{scene.lights[light]['id']}.exr"
        write_whole(folder / name, write_exr, difference)


def table_lines(folder: Path) -> list[str]:
    """The table of effects that a capture holds, as text.

    Parameters
    ----------
    folder : Path
        The capture.

    Returns
    -------
    list of str
        One line an effect: on or off, name, bound, what it contributed if that was asked
        for, the seconds that it took, and why.
    """
    record = json.loads((folder / EFFECTS_FILE).read_text(encoding="utf-8"))
    return [_text(line) for line in record["effects"]]


def _text(line: Mapping[str, Any]) -> str:
    changed = ""
    if "contribution" in line:
        change = line["contribution"]
        changed = "infinite" if change is None else f"{100.0 * change:.3g} %"
    return (
        f"{'on' if line['on'] else 'off':3}  {line['name']:20} {bound_text(line['bound']):>12}"
        f" {changed:>9} {line['seconds']:8.2f} s  {line['reason']}"
    )


def bound_text(bound: float | None) -> str:
    """A bound in percent, for tables.

    Parameters
    ----------
    bound : float or None
        Part of a photograph's 99th percentile.

    Returns
    -------
    str

    Examples
    --------
    >>> bound_text(0.0123), bound_text(None), bound_text(0.0)
    ('<= 1.23 %', 'no bound', '0')
    """
    if bound is None or not math.isfinite(bound):
        return "no bound"
    return f"<= {100.0 * bound:.3g} %" if bound else "0"
