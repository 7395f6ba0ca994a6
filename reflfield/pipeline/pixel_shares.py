"""Which pixels of which photographs a fit takes, where all would take too long."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reflfield.util.even_order import GOLDEN_SHARE

Indices = NDArray[np.intp]

# Pixels under a light, and pixels with the texels under them, that are fitted to at most: more
# would take hours, or minutes.
MOST_PIXELS, MOST_FOOTPRINTS = 12_000_000, 1_500_000
# Share of these limits for the fit on a hull that is then moved: only its normals, and where
# the next fit begins, are taken from it.
HULL_EFFORT = 0.5
# Photographs of each view that are fitted to at least, before pixels are left out: neighbouring
# texels under one pixel are told apart by many pixels, not by many lights.
LEAST_PHOTOGRAPHS = 8
# Memory of a pixel under a light, and of a pixel with the texels under it.
VALUE_BYTES, FOOTPRINT_BYTES = 15, 100


class Shares(NamedTuple):
    """Shares, 0 to 1, of the pixels of each view and of its photographs."""

    pixels: float
    photographs: float

    @property
    def values(self) -> float:
        """Share of the pixels under a light."""
        return self.pixels * self.photographs


def shares_within(n_pixels: int, n_values: int, memory: float, effort: float = 1.0) -> Shares:
    """Shares of pixels and photographs within the limits of time and memory.

    Parameters
    ----------
    n_pixels : int
        Of all views.
    n_values : int
        Pixels under a light.
    memory : float
        Bytes.
    effort : float
        Share of the limits of time.

    Examples
    --------
    Of 20,000 pixels of each of 60 views under 40 lights a quarter, of few all:

    >>> shares_within(20_000 * 60, 20_000 * 60 * 40, 1e12)
    Shares(pixels=1.0, photographs=0.25)
    >>> shares_within(1000, 20_000, 1e12)
    Shares(pixels=1.0, photographs=1.0)
    """
    most_values, most_footprints = effort * MOST_PIXELS, effort * MOST_FOOTPRINTS
    least = min(1.0, LEAST_PHOTOGRAPHS * n_pixels / n_values)
    pixels = min(1.0, most_footprints / n_pixels)
    photographs = min(1.0, most_values / (pixels * n_values))
    free = memory / pixels - FOOTPRINT_BYTES * n_pixels
    photographs = min(photographs, free / (VALUE_BYTES * n_values))
    if photographs >= least:
        return Shares(pixels, photographs)
    of_pixel = VALUE_BYTES * least * n_values + FOOTPRINT_BYTES * n_pixels
    within = min(most_values / (least * n_values), memory / of_pixel)
    return Shares(min(pixels, within), least)


def spread_over(photographs: Indices, share: float, view: int) -> Indices:
    """About a share of the photographs of a view, evenly spread; other ones in each view.

    Examples
    --------
    >>> spread_over(np.arange(10), 0.3, 0), spread_over(np.arange(10), 0.3, 1)
    (array([0, 3, 6]), array([2, 5, 8]))
    """
    n = min(len(photographs), max(round(share * len(photographs)), 1))
    places = (np.arange(n) + view * GOLDEN_SHARE % 1.0) * len(photographs) / max(n, 1)
    return photographs[places.astype(np.intp)]


def some_of(
    usable: NDArray[np.bool_], share: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """About a share of the pixels that are usable, drawn at random; all, if that is 1."""
    if share >= 1.0:
        return usable
    at = np.flatnonzero(usable)
    some = np.zeros(usable.shape, np.bool_)
    some.ravel()[at[rng.random(len(at), np.float32) < share]] = True
    return some
