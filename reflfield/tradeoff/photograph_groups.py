"""Photographs in three groups: to make fields of, to choose settings on, to report.

Settings that were chosen on some photographs look better on these than they are: what is
reported is measured on photographs that no choice has seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.capture.photographs import Photograph
from reflfield.errors import InputError
from reflfield.options import HoldOut
from reflfield.pipeline.hold_out import counted, split_of

Indices = NDArray[np.intp]

# Views, and lights, of a dome that are held out for each purpose; of one with fewer, a quarter.
USUAL, LARGEST_SHARE = 2, 0.25
# Lights, or views, where the other does not vary; photographs where each has both of its own.
MOST_ALONE, ALONE_SHARE = 24, 0.1
LEAST_DIRECTIONS = 4


@dataclass(frozen=True, eq=False)
class PhotographGroups:
    """The capture of a sweep.

    Parameters
    ----------
    trained : Capture
        Photographs that make fields; and those that settings are chosen on, as its test split.
    reported : Capture
        Photographs that only the fields that were chosen are measured on.
    whole : Capture
    """

    trained: Capture
    reported: Capture
    whole: Capture

    @property
    def training_views(self) -> Indices:
        """Views with photographs that make fields."""
        return np.unique([p.camera for p in self.trained.photographs if not p.is_test])

    @property
    def training_lights(self) -> Indices:
        """Lights with photographs that make fields."""
        return np.unique([p.light for p in self.trained.photographs if not p.is_test])

    def with_fewer(self, views: float = 1.0, lights: float = 1.0) -> Capture:
        """The capture with a share of the views and lights that make fields, spread evenly.

        Parameters
        ----------
        views, lights : float
            Shares in (0, 1]; one of each is kept at least.

        Returns
        -------
        Capture
            With the same photographs to choose settings on.
        """
        kept_views = spread(self.training_views, views)
        kept_lights = spread(self.training_lights, lights)
        photographs = tuple(
            p
            for p in self.trained.photographs
            if p.is_test or (p.camera in kept_views and p.light in kept_lights)
        )
        used_views = np.unique([p.camera for p in photographs])
        used_lights = np.unique([p.light for p in photographs])
        fewer = replace(self.trained, photographs=photographs)
        return fewer.subset(used_views, used_lights)

    def sentence(self) -> str:
        """How many photographs are used for what."""
        n_test = sum(p.is_test for p in self.trained.photographs)
        n = len(self.trained.photographs) - n_test
        return (
            f"{counted(n, 'photograph')} make the fields, settings are chosen on {n_test} "
            f"others, and what is chosen is reported on {len(self.reported.photographs)} more"
        )


def spread(among: Indices, share: float) -> set[int]:
    """A share of some numbers, evenly spread: all of them if it is 1.

    Examples
    --------
    >>> sorted(spread(np.arange(8), 0.5))
    [1, 3, 5, 7]
    """
    n = max(1, round(share * len(among)))
    chosen = ((np.arange(n) + 0.5) * len(among) / n).astype(int)
    return {int(i) for i in among[chosen]}


def usual_hold_out(capture: Capture) -> HoldOut:
    """What is held out for one purpose where nothing is asked for.

    Raises
    ------
    InputError
        If there are not photographs enough for three groups.
    """
    views = len({p.camera for p in capture.photographs})
    lights = len({p.light for p in capture.photographs})
    n = len(capture.photographs)
    if min(views, lights) >= LEAST_DIRECTIONS and n >= 0.5 * views * lights:
        most = (max(1, int(LARGEST_SHARE * count)) for count in (views, lights))
        of_views, of_lights = (min(USUAL, count) for count in most)
        return HoldOut(views=of_views, lights=of_lights)
    alone = min(MOST_ALONE, max(1, int(ALONE_SHARE * n)))
    if n < LEAST_DIRECTIONS:
        raise InputError(
            f"{capture.name}: expected at least {LEAST_DIRECTIONS} photographs, to make fields "
            f"of, to choose settings on and to report, received {n}"
        )
    if lights == 1:
        return HoldOut(views=alone)
    return HoldOut(lights=alone) if views == 1 else HoldOut(photographs=alone)


def photograph_groups(capture: Capture, hold_out: HoldOut | None = None) -> PhotographGroups:
    """Divide the photographs of a capture into three groups.

    Parameters
    ----------
    capture : Capture
    hold_out : HoldOut, optional
        What is reported; as much, spread over what is left, is to choose settings on. Of the
        capture's own test split as many photographs of the others.

    Returns
    -------
    PhotographGroups

    Raises
    ------
    InputError
        If too few photographs would be left.
    """
    asked = hold_out if hold_out is not None and str(hold_out) else usual_hold_out(capture)
    outer = split_of(capture, asked)
    rest = outer.training(capture)
    again = HoldOut(photographs=len(outer.compared)) if asked.test else asked
    inner = split_of(rest, again)
    chosen = set(inner.compared.tolist())
    kept = [*inner.trained.tolist(), *inner.compared.tolist()]
    photographs = tuple(_as_test(rest.photographs[i], i in chosen) for i in sorted(kept))
    trained = replace(rest, photographs=photographs)
    return PhotographGroups(trained, outer.compared_capture(capture), capture)


def _as_test(photograph: Photograph, is_test: bool) -> Photograph:
    return replace(photograph, is_test=is_test)
