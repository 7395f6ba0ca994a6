"""Findings on photographs that belong elsewhere: swapped, turned, of another light or view."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.capture.photographs import Photograph
from reflfield.checking.findings import ERROR, WARNING, Evidence, Finding, robust_spread
from reflfield.checking.photograph_statistics import PhotographSet
from reflfield.checking.shading_fit import Shading
from reflfield.checking.shown_images import shown

Array = NDArray[np.float64]

# How much worse than usual in its view and under its light a photograph fits, and by how much
# another place must fit better.
LEAST_LOSS, LOSS_DEVIATIONS, LEAST_GAIN = 0.12, 6.0, 0.1
# Share of the points seen that a light must shine on; correlation that is lost without any
# explanation.
LEAST_LIT, LOST = 0.35, 0.4
# Photographs that are compared with each other's places.
MOST_DOUBTFUL = 40

TURNS = {
    1: "turned by 90 degrees to the right",
    2: "turned by 180 degrees",
    3: "turned by 90 degrees to the left",
    4: "mirrored left to right",
    5: "mirrored and turned",
    6: "mirrored top to bottom",
    7: "mirrored and turned",
}


@dataclass(frozen=True, eq=False)
class PhotographFits:
    """How well photographs fit to their own view and light, and elsewhere.

    Parameters
    ----------
    capture, photographs, shading
    fits : (n, n_lights) float64
        Of `Shading.fits`.
    """

    capture: Capture
    photographs: PhotographSet
    shading: Shading
    fits: Array

    @property
    def own(self) -> Array:
        """Fit (n,) of each photograph to its own light."""
        lights = [self.capture.photographs[int(i)].light for i in self.shading.photographs]
        own: Array = self.fits[np.arange(len(lights)), lights]
        return own

    def doubtful(self) -> list[int]:
        """Rows of photographs that fit worse than the others of their view and light do."""
        own = self.own
        indices = [int(i) for i in self.shading.photographs]
        groups = (
            [self.capture.photographs[i].camera for i in indices],
            [self.capture.photographs[i].light for i in indices],
        )
        loss = np.median(np.nan_to_num(own, nan=np.nanmedian(own))) - own
        for group in groups:
            loss = np.minimum(loss, _below_group(own, np.array(group)))
        _, scatter = robust_spread(loss)
        lit = self.lit()
        rows = np.flatnonzero(lit & (loss > max(LEAST_LOSS, LOSS_DEVIATIONS * scatter)))
        return [int(row) for row in rows[np.argsort(-loss[rows], kind="stable")]]

    def lit(self) -> NDArray[np.bool_]:
        """Whether a light shines on enough of what a photograph shows to tell its place."""
        samples = self.shading.samples
        shares = []
        for index in self.shading.photographs:
            photograph = self.capture.photographs[int(index)]
            seen = samples.seen[photograph.camera]
            lit = samples.irradiance[photograph.light] > 0
            shares.append((seen & lit).sum() / max(seen.sum(), 1))
        return np.array(shares) > LEAST_LIT

    def fit_as(self, row: int, other: int, turn: int = 0) -> float:
        """Fit of the photograph of a row to the view and the light of another's."""
        there = self.capture.photographs[int(self.shading.photographs[other])]
        statistics = self.photographs.of[int(self.shading.photographs[row])]
        luminance = self.shading.samples.look_up(statistics, there.camera, turn)
        return float(self.shading.fit_to_lights(luminance)[there.light])


def _below_group(own: Array, group: NDArray[np.int64]) -> Array:
    """How far each value is below the median of the others of its group; inf if it is alone."""
    below = np.full(len(own), np.inf)
    for name in np.unique(group):
        rows = np.flatnonzero(group == name)
        if len(rows) > 2:
            below[rows] = np.nanmedian(own[rows]) - own[rows]
    return below


def misplaced_photographs(
    fits: PhotographFits, wrong_lights: set[int], dark: frozenset[int]
) -> Iterator[tuple[tuple[int, ...], Finding]]:
    """Findings on photographs, each with their indices.

    Parameters
    ----------
    fits : PhotographFits
    wrong_lights : set of int
        Whose photographs fit badly for that reason.
    dark : frozenset of int
        Photographs of which little but noise is seen.
    """
    index = [int(i) for i in fits.shading.photographs]
    of = fits.capture.photographs
    rows = [
        row
        for row in fits.doubtful()
        if of[index[row]].light not in wrong_lights and index[row] not in dark
    ]
    own = fits.own
    told: set[int] = set()
    for row in rows[:MOST_DOUBTFUL]:
        if row in told:
            continue
        partner = _partner(fits, row, [r for r in rows[:MOST_DOUBTFUL] if r not in told], own)
        if partner is not None:
            told.update((row, partner))
            yield (index[row], index[partner]), _swapped(fits, row, partner)
            continue
        told.add(row)
        finding = _turned(fits, row, own) or _of_other_light(fits, row, own)
        if finding is None and own[row] > _usual(own) - LOST:
            continue  # nothing explains it, and highlights and hollows may do so
        yield (index[row],), finding or _odd(fits, row, own)


def _partner(fits: PhotographFits, row: int, others: Sequence[int], own: Array) -> int | None:
    """The photograph with which one fits better exchanged, both ways."""
    best, most = None, LEAST_GAIN
    for other in others:
        if other == row:
            continue
        gain = min(fits.fit_as(row, other) - own[other], fits.fit_as(other, row) - own[row])
        if gain > most:
            best, most = other, gain
    return best


def _swapped(fits: PhotographFits, row: int, other: int) -> Finding:
    first, second = (_photograph(fits, r) for r in (row, other))
    own = fits.own
    return Finding(
        "swapped photographs",
        ERROR,
        (first.name, second.name),
        f"each is shaded as the other should be (correlations {fits.fit_as(row, other):.2f}, "
        f"{fits.fit_as(other, row):.2f}; in their own places {own[row]:.2f}, {own[other]:.2f})",
        "exchange the two files",
        file=str(first.path),
        pictures=(_picture(fits, row), _picture(fits, other)),
    )


def _turned(fits: PhotographFits, row: int, own: Array) -> Finding | None:
    values = {turn: fits.fit_as(row, row, turn) for turn in TURNS}
    turn = max(values, key=lambda t: -2.0 if np.isnan(values[t]) else values[t])
    if not values[turn] > own[row] + LEAST_GAIN or values[turn] < _usual(own) - LEAST_LOSS:
        return None
    photograph = _photograph(fits, row)
    return Finding(
        "turned photograph",
        ERROR,
        (photograph.name,),
        f"it is {TURNS[turn]}: turned back it fits with a correlation of {values[turn]:.2f} "
        f"instead of {own[row]:.2f}",
        "store its pixels as the others' and remove the Exif orientation",
        file=str(photograph.path),
        pictures=(_picture(fits, row),),
    )


def _of_other_light(fits: PhotographFits, row: int, own: Array) -> Finding | None:
    light = int(np.nanargmax(fits.fits[row])) if np.isfinite(fits.fits[row]).any() else -1
    photograph = _photograph(fits, row)
    if light < 0 or fits.fits[row, light] < max(
        own[row] + LEAST_GAIN, _usual(own) - LEAST_LOSS
    ):
        return None
    name = fits.capture.lights[photograph.light].id
    return Finding(
        "photograph of another light",
        ERROR,
        (photograph.name,),
        f"it is shaded as under {fits.capture.lights[light].id}, not under {name} "
        f"(correlation {fits.fits[row, light]:.2f} instead of {own[row]:.2f})",
        "correct which light it belongs to",
        file=str(photograph.path),
        pictures=(_picture(fits, row),),
    )


def _odd(fits: PhotographFits, row: int, own: Array) -> Finding:
    photograph = _photograph(fits, row)
    return Finding(
        "odd photograph",
        WARNING,
        (photograph.name,),
        "its shading does not fit to its view and its light (correlation "
        f"{own[row]:.2f}, usual {_usual(own):.2f})",
        "look at it: is it of this view and light, and was the object still?",
        file=str(photograph.path),
        pictures=(_picture(fits, row),),
    )


def _usual(own: Array) -> float:
    return float(np.nanmedian(own))


def _photograph(fits: PhotographFits, row: int) -> Photograph:
    return fits.capture.photographs[int(fits.shading.photographs[row])]


def _picture(fits: PhotographFits, row: int) -> Evidence:
    statistics = fits.photographs.of[int(fits.shading.photographs[row])]
    return Evidence(shown(statistics.colour), _photograph(fits, row).name)
