"""Which photographs make the field and which it is compared with."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.capture.inspect import object_centre
from reflfield.capture.lights import DIRECTIONAL, POINT, SPOT
from reflfield.errors import InputError
from reflfield.options import HoldOut
from reflfield.util.even_order import GOLDEN_SHARE

Indices = NDArray[np.intp]
Bools = NDArray[np.bool_]

# Of views or lights with many photographs, so many are compared: more are redundant.
MOST_COMPARED = 64
# Of dense domes at least so many lights make the field, if each has as many photographs.
LEAST_LIGHTS = 32
# Which of the photographs that do not make the field it is compared with.
BOTH, EITHER, CHOSEN, TEST = "both", "either", "photographs", "test"


@dataclass(frozen=True, eq=False)
class Split:
    """Photographs of a capture by what a run does with them.

    Parameters
    ----------
    views, lights : (k,) int
        Held out as a whole.
    training_views, training_lights : (k,) int
        Those that the field is made with.
    trained, compared, aside : (k,) int
        Indices into the capture's photographs, ascending, no two alike: these make the
        field, these it is compared with, and these are used for neither.
    kind : {"", "both", "either", "photographs", "test"}
        What the compared ones are: of a held-out view and under a held-out light (where
        views and lights are held out), of either, chosen one by one, or the capture's own
        test split. Empty where nothing is held out.
    redundant : (k,) int
        Indices of photographs that are not needed and make nothing.
    """

    views: Indices
    lights: Indices
    training_views: Indices
    training_lights: Indices
    trained: Indices
    compared: Indices
    aside: Indices
    kind: str
    redundant: Indices = field(default_factory=lambda: np.zeros(0, np.intp))

    def training(self, capture: Capture) -> Capture:
        """The capture that the field is made of."""
        kept = tuple(capture.photographs[i] for i in self.trained)
        training = replace(capture, photographs=kept)
        return training.subset(self.training_views, self.training_lights)

    def compared_capture(self, capture: Capture) -> Capture:
        """The compared photographs, with their views and lights alone."""
        kept = tuple(capture.photographs[i] for i in self.compared)
        views = np.unique([p.camera for p in kept]).astype(np.intp)
        lights = np.unique([p.light for p in kept]).astype(np.intp)
        return replace(capture, photographs=kept).subset(views, lights)


def split_of(capture: Capture, hold_out: HoldOut) -> Split:
    """Decide what each photograph is used for.

    Photographs of a held-out view, or under a held-out light, do not make the field. Where
    both are held out it is compared with those of a held-out view under a held-out light;
    a capture with one light for each view may have none such, and then with all of either.

    Parameters
    ----------
    capture : Capture
    hold_out : HoldOut

    Returns
    -------
    Split

    Raises
    ------
    InputError
        If there are no photographs, or none would be left to make the field of, or the
        capture has no test split.
    """
    view = np.array([p.camera for p in capture.photographs], np.intp)
    light = np.array([p.light for p in capture.photographs], np.intp)
    if not len(view):
        raise InputError(f"{capture.name}: expected photographs, received none")
    views = _spread(hold_out.views, np.unique(view), "views")
    lights = _spread(hold_out.lights, np.unique(light), "lights")
    if hold_out.light_cone:
        lights = lights_in_cone(capture, np.unique(light), hold_out.light_cone)
    removed, compared, kind = _removed(capture, hold_out, (view, light), (views, lights))
    if removed.all():
        raise InputError(
            f"hold_out: expected photographs left to make the field of, received none: "
            f"{hold_out} holds out all {len(view)}; hold out fewer, or photographs=K"
        )
    return Split(
        views,
        lights,
        np.flatnonzero(_kept_views(capture, view, removed)),
        np.unique(light[~removed]),
        np.flatnonzero(~removed),
        np.flatnonzero(compared),
        np.flatnonzero(removed & ~compared),
        kind if removed.any() else "",
    )


def with_fewer_lights(split: Split, capture: Capture, most: int) -> Split:
    """Split of a dense dome that makes the field under some of its lights.

    Parameters
    ----------
    split : Split
    capture : Capture
        Its lights have known positions or directions.
    most : int
        Photographs that make the field, about; 0 for all. No fewer than `LEAST_LIGHTS` lights
        are left, and none is left out where each has few photographs.

    Returns
    -------
    Split
        Every view keeps photographs under the same lights.
    """
    lights = split.training_lights
    of_light = np.array([capture.photographs[i].light for i in split.trained], np.intp)
    each = len(of_light) / max(len(lights), 1)
    n = max(LEAST_LIGHTS, round(most / max(each, 1.0)))
    if not most or len(of_light) <= most or each < LEAST_LIGHTS or n >= len(lights):
        return split
    centre = object_centre(capture)[None]
    towards = np.concatenate([capture.lights[i].directions(centre) for i in lights])
    kept = lights[farthest_first(towards, n)]
    needed = np.isin(of_light, kept)
    return replace(
        split,
        training_lights=kept,
        trained=split.trained[needed],
        redundant=split.trained[~needed],
    )


def farthest_first(directions: NDArray[np.floating], count: int) -> Indices:
    """Indices (count,), ascending, of directions spread evenly.

    Each is the farthest from those before it.

    Parameters
    ----------
    directions : (n, 3) float
        Unit vectors.
    count : int
        At most n.

    Examples
    --------
    >>> angle = np.radians([0, 1, 2, 45, 89, 90])
    >>> farthest_first(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), 3)
    array([0, 3, 5])
    """
    nearest = np.full(len(directions), -np.inf)
    chosen = [0]
    while len(chosen) < count:
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
        nearest[chosen[-1]] = np.inf
        chosen.append(int(np.argmin(nearest)))
    return np.sort(np.array(chosen[:count], np.intp))


def _spread(count: int, among: Indices, what: str) -> Indices:
    return among[evenly_spread(count, len(among), what)]


def lights_in_cone(capture: Capture, among: Indices, degrees: float) -> Indices:
    """Lights within an angle of the middle one, as seen from the object.

    Parameters
    ----------
    capture : Capture
    among : (n,) int
        Lights that have photographs.
    degrees : float

    Returns
    -------
    (k,) int

    Raises
    ------
    InputError
        If a light has no known direction, or none would be left.
    """
    centre = object_centre(capture)[None]
    unknown = [i for i in among if capture.lights[i].kind not in (POINT, SPOT, DIRECTIONAL)]
    if unknown:
        raise InputError(
            "hold_out: light-cone: expected lights of known positions or directions, received "
            f"{listed([light.id for light in capture.lights], unknown)} of another kind; take "
            "lights=K"
        )
    towards = np.concatenate([capture.lights[i].directions(centre) for i in among])
    middle = towards[len(among) // 2]
    inside = towards @ middle >= np.cos(np.deg2rad(degrees)) - 1e-9
    if inside.all():
        raise InputError(
            f"hold_out: expected a cone of lights that leaves some, {degrees:g} degrees hold "
            f"{_all_of(len(among), 'lights')}; take a smaller angle"
        )
    return among[inside]


def _removed(
    capture: Capture,
    hold_out: HoldOut,
    pairs: tuple[Indices, Indices],
    held: tuple[Indices, Indices],
) -> tuple[Bools, Bools, str]:
    """Which photographs do not make the field, which are compared, and what those are."""
    if hold_out.test:
        chosen = _test_split(capture)
        return chosen, chosen, TEST
    if hold_out.photographs:
        chosen = spread_photographs(*pairs, hold_out.photographs)
        return chosen, chosen, CHOSEN
    of_view, of_light = (np.isin(p, h) for p, h in zip(pairs, held, strict=True))
    removed = of_view | of_light
    both = (of_view | (len(held[0]) == 0)) & (of_light | (len(held[1]) == 0)) & removed
    return removed, _thinned(both if both.any() else removed), BOTH if both.any() else EITHER


def _test_split(capture: Capture) -> Bools:
    test = np.zeros(len(capture.photographs), bool)
    test[capture.test_split] = True
    if not test.any():
        raise InputError(
            f"hold_out: test: expected a capture with a test split (transforms_test.json), "
            f"{capture.description or capture.root} has none; use photographs=K, or "
            "views=K,lights=K"
        )
    return test


def _thinned(compared: Bools) -> Bools:
    indices = np.flatnonzero(compared)
    n = min(len(indices), MOST_COMPARED)
    kept = np.zeros_like(compared)
    kept[indices[np.linspace(0, len(indices) - 1, n).astype(int)]] = True
    return kept


def _kept_views(capture: Capture, view: Indices, removed: Bools) -> Bools:
    """Views with photographs that make the field, or that have a silhouette to carve with."""
    used, photographed = np.zeros((2, capture.n_views), bool)
    used[view[~removed]], photographed[view] = True, True
    carves = np.array([path is not None for path in capture.silhouettes], bool)
    return used | (carves & ~photographed)


def spread_photographs(views: Indices, lights: Indices, count: int) -> Bools:
    """True for so many photographs, spread evenly over views and lights.

    Along the one of which there are more, at even steps; along the other, at steps of the
    golden ratio, to the nearest photograph that there is.

    Parameters
    ----------
    views, lights : (n,) int
        Of every photograph.
    count : int
        Fewer than n.

    Returns
    -------
    (n,) bool

    Raises
    ------
    InputError
        If none would be left.

    Examples
    --------
    Of eight photographs with a light of their own each, the third and the seventh:

    >>> np.flatnonzero(spread_photographs(np.arange(8), np.arange(8), 2))
    array([2, 6])
    """
    if count >= len(views):
        raise InputError(
            f"hold_out: expected fewer than {_all_of(len(views), 'photographs')}, "
            f"received {count}"
        )
    ranks = [np.unique(ids, return_inverse=True) for ids in (views, lights)]
    first, second = sorted(ranks, key=lambda rank: -len(rank[0]))
    share = (second[1] + 0.5) / len(second[0])
    chosen = np.zeros(len(views), bool)
    order = np.lexsort((lights, views))  # which decides between equally near ones
    for k in range(count):
        along = np.abs(first[1] - int((k + 0.5) * len(first[0]) / count))
        across = np.abs(share - (k + 0.5) * GOLDEN_SHARE % 1)
        distance = np.where(chosen, np.inf, along + 0.999 * across)
        chosen[order[np.argmin(distance[order])]] = True
    return chosen


def _all_of(total: int, what: str) -> str:
    return f"the only {what.removesuffix('s')}" if total == 1 else f"the {total} {what}"


def evenly_spread(count: int, total: int, what: str) -> Indices:
    """Indices of `count` of `total` things, evenly spread.

    Raises
    ------
    InputError
        If none would be left.

    Examples
    --------
    >>> evenly_spread(2, 32, "views")
    array([ 8, 24])
    """
    if count and count >= total:
        raise InputError(
            f"hold_out: expected fewer than {_all_of(total, what)}, received {count}"
        )
    return ((np.arange(count) + 0.5) * total / max(count, 1)).astype(np.intp)


# --- sentences ----------------------------------------------------------------------------


def held_out_sentence(split: Split) -> str:
    """One sentence on which photographs are compared and how many make the field.

    Examples
    --------
    >>> one, none = np.array([3]), np.zeros(0, int)
    >>> split = Split(none, none, none, none, np.arange(9), one, none, CHOSEN)
    >>> held_out_sentence(split)
    '1 photograph, spread over views and lights, is compared; 9 of 10 make the field'
    """
    n = len(split.trained)
    total = n + len(split.compared) + len(split.aside) + len(split.redundant)
    field_of = f"{n} of {total} make the field"
    if len(split.redundant):
        lights = len(split.training_lights)
        field_of += f", those under {lights} of the lights: the others are redundant"
    if not split.kind:
        return f"no photograph is held out; {field_of}"
    compared = counted(len(split.compared), "photograph")
    are = "is" if len(split.compared) == 1 else "are"
    parts = [f"{compared}{_which(split)} {are} compared"]
    if len(split.aside):
        parts.append(f"{len(split.aside)} others of those are used for neither")
    return "; ".join([*parts, field_of])


def held_out_counts(split: Split) -> dict[str, Any]:
    """How many photographs were used for what, for ``metrics.json``."""
    return {
        "kind": split.kind or "nothing",
        "photographs_compared": len(split.compared),
        "photographs_used_for_neither": len(split.aside),
        "photographs_of_the_field": len(split.trained),
        "photographs_redundant": len(split.redundant),
    }


def _which(split: Split) -> str:
    held = {"view": len(split.views), "light": len(split.lights)}
    parts = [counted(n, f"held-out {what}") for what, n in held.items() if n]
    return {
        BOTH: f" of {' under '.join(parts)}",
        EITHER: f" of {' or '.join(parts)}, none of them of both,",
        CHOSEN: ", spread over views and lights,",
        TEST: " of the capture's test split",
    }[split.kind]


def left_out_sentences(capture: Capture, split: Split) -> Iterator[str]:
    """One sentence for each kind of camera or light that has no photograph, or none left.

    Parameters
    ----------
    capture : Capture
    split : Split
        Of the capture.

    Yields
    ------
    str
    """
    cameras = [camera.id for camera in capture.cameras]
    photographed = np.unique([p.camera for p in capture.photographs])
    without = np.setdiff1d(range(capture.n_views), photographed)
    for indices, what in (
        (
            np.setdiff1d(np.setdiff1d(photographed, split.training_views), split.views),
            "of which all photographs are held out; not in the hull either",
        ),
        (
            np.intersect1d(without, split.training_views),
            "without a photograph, of which only the silhouette is used",
        ),
        (
            np.setdiff1d(without, split.training_views),
            "without a photograph and a silhouette, left out",
        ),
    ):
        if len(indices):
            yield f"{counted(len(indices), 'camera')} {what}: {listed(cameras, indices)}"
    dark = np.setdiff1d(range(capture.n_lights), [p.light for p in capture.photographs])
    if len(dark):
        names = listed([light.id for light in capture.lights], dark)
        yield f"{counted(len(dark), 'light')} without a photograph, left out: {names}"


def counted(n: int, what: str) -> str:
    """A number of things.

    Examples
    --------
    >>> counted(1, "view"), counted(3, "view")
    ('1 view', '3 views')
    """
    return f"{n} {what}" + ("" if n == 1 else "s")


def listed(names: Sequence[str], indices: Iterable[int], most: int = 6) -> str:
    """The names at some indices, for a message: the first few.

    Examples
    --------
    >>> listed(["a", "b", "c", "d"], [0, 2, 3], most=2)
    "'a', 'c' and 1 more"
    """
    chosen = [repr(names[i]) for i in indices]
    rest = f" and {len(chosen) - most} more" if len(chosen) > most else ""
    return ", ".join(chosen[:most]) + rest
