"""Findings on lights: dead, dim, in another place or order than the file says."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.checking.findings import ERROR, WARNING, Finding, robust_spread
from reflfield.checking.light_order import LightFit
from reflfield.checking.shading_fit import Shading, view_and_light_gains

Array = NDArray[np.float64]

# Brightness over what is expected: of a light that is dead; logarithms of gains that are off by
# at least so much, and by so many standard deviations of all.
DEAD, LEAST_OFF, DEVIATIONS = 0.05, 0.12, 6.0
LEAST_OFF_OF_PHOTOGRAPH = 0.2
# Share of values that may be off; where more are, the model does not describe the material.
MOST_OFF = 0.25
# Twice as bright, or half, spoils a result.
GRAVE = np.log(2.0)
# How much better another place fits, at least, and how much worse than usual the own one.
LEAST_REGRET, LEAST_LOSS, LOSS_DEVIATIONS = 0.04, 0.04, 5.0
# The same of two lights of which each fits better to the other's place.
MUTUAL_REGRET = 0.1
# Lights whose place is near that of another one are told apart by little.
LEAST_ANGLE = np.radians(8.0)


@dataclass(frozen=True)
class Misplaced:
    """A light whose photographs fit better to another place.

    Parameters
    ----------
    light, better : int
    own, other : float
        Correlations.
    """

    light: int
    better: int
    own: float
    other: float


def misplaced_lights(fit: LightFit, directions: Array) -> list[Misplaced]:
    """Lights whose photographs fit far better to the place of another light."""
    own = fit.own
    others = [fit.best_other(light) for light in range(len(own))]
    regret = np.array([other for _, other in others]) - own
    usual, scatter = robust_spread(own)
    lowest = usual - max(LEAST_LOSS, LOSS_DEVIATIONS * scatter)
    mutual = {
        light
        for light, (better, _) in enumerate(others)
        if others[better][0] == light
        and min(regret[light], regret[better]) > MUTUAL_REGRET
        and max(own[light], own[better]) < usual - LEAST_LOSS
    }
    wrong = {
        light: Misplaced(light, better, float(own[light]), other)
        for light, (better, other) in enumerate(others)
        if regret[light] > LEAST_REGRET
        and (own[light] < lowest or light in mutual)
        and directions[light] @ directions[better] < np.cos(LEAST_ANGLE)
    }
    # Of two that are exchanged one may lose little, as a light overhead does.
    for one in list(wrong.values()):
        place, fit_there = others[one.better]
        if one.better not in wrong and place == one.light and regret[one.better] > 0:
            partner = one.better
            wrong[partner] = Misplaced(partner, place, float(own[partner]), fit_there)
    return [wrong[light] for light in sorted(wrong)]


def order_findings(
    capture: Capture, wrong: list[Misplaced], directions: Array
) -> Iterator[Finding]:
    """Findings on lights that are swapped, permuted, or somewhere else."""
    better = {one.light: one.better for one in wrong}
    told: set[int] = set()
    for one in wrong:
        if one.light in told:
            continue
        cycle = _cycle(one.light, better)
        told.update(cycle)
        names = tuple(capture.lights[light].id for light in cycle)
        fits = f"correlation {one.other:.2f} instead of {one.own:.2f}"
        if len(cycle) == 2:
            yield Finding(
                "swapped lights",
                ERROR,
                names,
                f"the photographs under {names[0]} are shaded as under {names[1]}, and the "
                f"reverse ({fits})",
                f"exchange the positions of {names[0]} and {names[1]}, or their photographs",
                file=str(capture.description or ""),
            )
        elif len(cycle) > 2:
            yield Finding(
                "order of lights",
                ERROR,
                names,
                "the photographs under each of these lights are shaded as under the next one "
                f"of the list ({fits} for the first)",
                "check the order of lights and of photographs",
                file=str(capture.description or ""),
            )
        else:
            to = capture.lights[one.better].id
            angle = np.degrees(
                np.arccos(np.clip(directions[one.light] @ directions[one.better], -1, 1))
            )
            yield Finding(
                "misplaced light",
                ERROR,
                names,
                f"its photographs are shaded as if it stood near {to}, {angle:.0f} degrees off "
                f"({fits})",
                "measure its position again, or check which photographs belong to it",
                file=str(capture.description or ""),
            )


def _cycle(start: int, better: dict[int, int]) -> list[int]:
    """Lights that exchange their places in a ring; the start alone if there is no ring."""
    ring = [start]
    while better.get(ring[-1], start) != start:
        following = better[ring[-1]]
        if following in ring or following not in better:
            return [start]
        ring.append(following)
    return ring if ring[-1] in better and better[ring[-1]] == start else [start]


def gain_findings(
    capture: Capture, shading: Shading, wrong_photographs: frozenset[int], wrong: set[int]
) -> Iterator[Finding]:
    """Findings on the strength of lights, exposures of views and of single photographs."""
    usable = np.array([int(i) not in wrong_photographs for i in shading.photographs])
    photographs = shading.photographs[usable]
    of_views, of_lights, left = view_and_light_gains(
        capture, photographs, shading.gains[usable]
    )
    alone = len({capture.photographs[int(i)].light for i in photographs}) == len(photographs)
    dead = {int(i) for i in np.flatnonzero(of_lights < np.log(DEAD)) if i not in wrong}
    rest = of_lights.copy()
    rest[[*dead, *wrong]] = np.nan  # lest they hide what is off by less
    off = _off(rest, LEAST_OFF if not alone else LEAST_OFF_OF_PHOTOGRAPH)
    for light in (*sorted(dead), *map(int, off)):
        yield _of_light(capture, light, float(of_lights[light]))
    for view in _off(of_views, LEAST_OFF):
        yield _exposure("exposure of a camera", capture.cameras[view].id, of_views[view])
    scatter = shading.scatter[usable]
    for row in _off(left, LEAST_OFF_OF_PHOTOGRAPH):
        if abs(left[row]) < LEAST_OFF_OF_PHOTOGRAPH + 2 * scatter[row]:
            continue  # not the same everywhere: highlights or shadows, not the exposure
        photograph = capture.photographs[int(photographs[row])]
        if photograph.light not in dead | wrong:
            yield _exposure(
                "exposure of a photograph",
                photograph.name,
                float(left[row]),
                str(photograph.path),
            )


def _off(gains: Array, least: float) -> NDArray[np.intp]:
    """Gains that are no part of the scatter of all."""
    median, scatter = robust_spread(gains)
    with np.errstate(invalid="ignore"):
        far = np.abs(gains - median) > max(least, DEVIATIONS * scatter)
    return np.flatnonzero(far if far.sum() <= MOST_OFF * len(gains) else np.zeros_like(far))


def _of_light(capture: Capture, light: int, gain: float) -> Finding:
    name, times = capture.lights[light].id, float(np.exp(gain))
    file = str(capture.description or "")
    if times < DEAD:
        return Finding(
            "dead light",
            ERROR,
            (name,),
            f"the surface is {100 * times:.2g} % as bright under it as its intensity and "
            "distance say",
            "take its photographs again, or leave them out",
            file=file,
        )
    return Finding(
        "dim light" if gain < 0 else "bright light",
        ERROR if abs(gain) > GRAVE else WARNING,
        (name,),
        f"the surface is {_percent(times)} under it than its intensity and distance say, "
        "compared with the other lights",
        f"measure it, or multiply its intensity by {times:.3g}",
        file=file,
    )


def _exposure(kind: str, name: str, gain: float, file: str = "") -> Finding:
    times = float(np.exp(gain))
    return Finding(
        kind,
        ERROR if abs(gain) > GRAVE else WARNING,
        (name,),
        f"the surface is {_percent(times)} than the other photographs say",
        "fix aperture, exposure time and ISO for the whole session, and take it again; or "
        f"divide its values by {times:.3g}",
        file=file,
    )


def _percent(times: float) -> str:
    if times >= 3:
        return f"{times:.1f} times as bright"
    return f"{100 * abs(times - 1):.0f} % {'brighter' if times > 1 else 'darker'}"
