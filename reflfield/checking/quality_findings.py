"""Findings on photographs by themselves: clipped, blurred, repeated, tinted, lit by others."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence, Set

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.checking.findings import ERROR, NOTE, WARNING, Evidence, Finding, robust_spread
from reflfield.checking.photograph_statistics import KEPT_PIXELS, PhotographSet, reduced
from reflfield.checking.shading_fit import Shading, nanmedian, view_and_light_gains
from reflfield.checking.shown_images import shown

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

# Shares of the object in a photograph: that saturated blocks may have as highlights do, and
# from which on it is overexposed.
SOME_SATURATED, MUCH_SATURATED = 0.002, 0.05
MUCH_BLACK = 0.5
# Natural logarithm of how much less sharp a blurred photograph is than others of its view.
BLURRED, BLUR_DEVIATIONS = np.log(1.5), 8.0
# Green over red and over blue of a sensor without white balance, at least; and logarithm of
# a change of colour from one photograph to another.
GREEN, COLOUR_CHANGE = 1.4, 0.08
# Light, of that on a surface that faces the lamp, which is there without any lamp.
AMBIENT = 0.04
# Loss of light in the corners of the image that is worth a note, and standard errors.
VIGNETTING, ERRORS = 0.1, 5.0
MOST_PICTURES = 4
# Share of photographs that repeat others, above which the object looks alike from some sides.
MOST_REPEATED = 0.02


def clipping_findings(
    capture: Capture, photographs: PhotographSet, coverage: Mapping[int, Float32]
) -> Iterator[Finding]:
    """Findings on saturated highlights, overexposed photographs and crushed shadows."""
    saturated, black = ({}, {})  # type: dict[int, float], dict[int, float]
    for index, statistics in photographs.of.items():
        weight = _weight(coverage.get(capture.photographs[index].camera), statistics.saturated)
        if capture.photographs[index].exposures[1:]:
            continue  # bracketed: what is saturated in all of them is a light
        saturated[index] = float((weight * statistics.saturated).sum() / 255)
        black[index] = float((weight * statistics.black).sum() / 255)
    over = [i for i, share in saturated.items() if share > MUCH_SATURATED]
    some = [i for i, share in saturated.items() if SOME_SATURATED < share <= MUCH_SATURATED]
    for kind, severity, indices, remedy in (
        (
            "overexposed photographs",
            ERROR,
            over,
            "expose shorter, or bracket the exposures; saturated values are no measurements",
        ),
        (
            "saturated highlights",
            WARNING if len(some) > 0.5 * len(saturated) else NOTE,
            some,
            "expose shorter or bracket, if the object's highlights matter",
        ),
    ):
        if indices:
            yield _clipped(capture, photographs, kind, severity, indices, saturated, remedy)
    dark = [i for i, share in black.items() if share > MUCH_BLACK]
    if len(dark) > 0.25 * max(len(black), 1):
        yield _clipped(
            *(capture, photographs, "crushed shadows", NOTE, dark, black),
            "expose longer or store more bits: code 0 says only that a value is small",
        )


def _clipped(
    capture: Capture,
    photographs: PhotographSet,
    kind: str,
    severity: str,
    indices: list[int],
    share: Mapping[int, float],
    remedy: str,
) -> Finding:
    indices = sorted(indices, key=lambda i: -share[i])
    at_end = "black" if kind == "crushed shadows" else "saturated"
    return Finding(
        kind,
        severity,
        tuple(capture.photographs[i].name for i in indices),
        f"{len(indices)} of {len(share)} photographs; up to {100 * share[indices[0]]:.1f} % of "
        f"the object is {at_end}",
        remedy,
        file=str(capture.photographs[indices[0]].path),
        pictures=_pictures(capture, photographs, indices),
    )


def _weight(coverage: Float32 | None, like: NDArray[np.uint8]) -> Float32:
    """Weights of the blocks of a reduced photograph, 1 together: the object's, or all."""
    weight = np.ones(like.shape, np.float32)
    if coverage is not None:
        inside = reduced(coverage, max(like.shape))
        weight = inside if inside.shape == like.shape else weight
    return weight / max(float(weight.sum()), 1e-9)


def _pictures(
    capture: Capture, photographs: PhotographSet, indices: Sequence[int]
) -> tuple[Evidence, ...]:
    return tuple(
        Evidence(shown(photographs.of[i].colour), capture.photographs[i].name)
        for i in indices[:MOST_PICTURES]
    )


def sharpness_findings(capture: Capture, photographs: PhotographSet) -> Iterator[Finding]:
    """Findings on photographs that are blurred, beside the others of their view or all."""
    indices = [i for i, s in photographs.of.items() if s.sharpness > 0]
    if len(indices) < 4:
        return
    values = np.log([photographs.of[i].sharpness for i in indices])
    views = np.array([capture.photographs[i].camera for i in indices])
    lights = np.array([capture.photographs[i].light for i in indices])
    left = values - np.median(values)
    for groups in (views, lights):
        for group in np.unique(groups):
            if (groups == group).sum() > 2:
                left[groups == group] -= np.median(left[groups == group])
    _, scatter = robust_spread(left)
    limit = max(BLURRED, BLUR_DEVIATIONS * scatter)
    blurred = [indices[row] for row in np.flatnonzero(left < -limit)]
    if blurred:
        yield Finding(
            "blurred photographs",
            WARNING,
            tuple(capture.photographs[i].name for i in blurred),
            "they show far less fine detail than other photographs of their view "
            f"({np.exp(-left.min()):.1f} times less)",
            "take them again; check focus, and that nothing moved",
            file=str(capture.photographs[blurred[0]].path),
            pictures=_pictures(capture, photographs, blurred),
        )


def repeated_findings(
    capture: Capture, photographs: PhotographSet, doubtful: Set[str] | None
) -> Iterator[Finding]:
    """Findings on photographs that are the same.

    Where it is known which photographs are `doubtful`, by name, those that are not show what
    they should: from two sides of a simulated body of revolution the same pixels are right.
    """
    same: dict[bytes, list[int]] = defaultdict(list)
    for index, statistics in photographs.of.items():
        if statistics.image.any():  # a dark photograph is another finding
            same[statistics.digest].append(index)
    repeated = [indices for indices in same.values() if len(indices) > 1]
    if doubtful is None and len(repeated) > max(1, MOST_REPEATED * len(photographs.of)):
        return
    for indices in repeated:
        names = tuple(capture.photographs[i].name for i in indices)
        if doubtful is None or not doubtful.isdisjoint(names):
            yield Finding(
                "same photograph twice",
                ERROR,
                names,
                f"these {len(indices)} photographs have the same pixels",
                "keep the one that is what its name says",
                file=str(capture.photographs[indices[1]].path),
                pictures=_pictures(capture, photographs, indices),
            )


def colour_findings(capture: Capture, photographs: PhotographSet) -> Iterator[Finding]:
    """Findings on white balance: none, or one that changes."""
    indices = list(photographs.of)
    usual = nanmedian(np.array([_tint(photographs.of[i].colour) for i in indices]), axis=0)
    if np.isfinite(usual).all() and (usual > np.log(GREEN)).all():
        red, blue = np.exp(usual)
        yield Finding(
            "white balance",
            WARNING,
            (),
            f"green is {red:.2f} times red and {blue:.2f} times blue in the median photograph, "
            "as of a sensor without white balance",
            "develop the photographs with the white balance of the lamps, one for all; ignore "
            "this if the object is green",
        )
    rows = np.array(indices, dtype=np.int64)
    shifts = np.array([_colour_shift(capture, photographs, i) for i in indices])
    left = np.array([view_and_light_gains(capture, rows, shifts[:, c])[2] for c in (0, 1)])
    change = np.abs(left).max(axis=0) if len(indices) else np.zeros(0)
    _, scatter = robust_spread(np.concatenate([left.ravel(), [0.0]]))
    odd = np.flatnonzero(change > np.maximum(COLOUR_CHANGE + 2 * shifts[:, 2], 8 * scatter))
    if 0 < len(odd) <= 0.1 * len(indices):
        worst = indices[int(odd[np.argmax(change[odd])])]
        yield Finding(
            "colour of photographs",
            NOTE,
            tuple(capture.photographs[indices[int(row)]].name for row in odd),
            f"their colour differs from that of others of their view and light by up to "
            f"{100 * (np.exp(change[odd].max()) - 1):.0f} %",
            "fix the white balance for the whole session",
            file=str(capture.photographs[worst].path),
            pictures=_pictures(capture, photographs, [worst]),
        )


def _colour_shift(capture: Capture, photographs: PhotographSet, index: int) -> Array:
    """How the colour of a photograph differs from that of its view's mean photograph.

    Returns
    -------
    (3,) float64
        Medians over pixels of the differences of the logarithms of green over red and green
        over blue, and their scatter: a change of white balance is the same everywhere.
    """
    statistics = photographs.of[index]
    mean = reduced(photographs.means[capture.photographs[index].camera], KEPT_PIXELS)
    colour = statistics.colour
    if mean.shape != colour.shape:
        return np.full(3, np.nan)
    bright = colour.min(axis=2) > 0.1 * np.quantile(colour, 0.98)
    bright &= (statistics.saturated == 0) & (mean.min(axis=2) > 0)
    if bright.sum() < 32:
        return np.full(3, np.nan)
    ratio = np.log(colour[bright].astype(np.float64)) - np.log(mean[bright])
    shifts = ratio[:, 1:2] - ratio[:, [0, 2]]
    middle = np.median(shifts, axis=0)
    scatter = 1.4826 * np.median(np.abs(shifts - middle), axis=0).max()
    return np.array([*middle, scatter])


def _tint(colour: Float32) -> Array:
    """Logarithms of green over red and green over blue of the brighter half of an image."""
    bright = colour.max(axis=2)
    some = colour[bright > 0.2 * bright.max(initial=0)]
    if not len(some) or not (some.sum(axis=0) > 0).all():
        return np.full(2, np.nan)
    red, green, blue = np.log(some.mean(axis=0, dtype=np.float64))
    return np.array([green - red, green - blue])


def ambient_findings(capture: Capture, shading: Shading) -> Iterator[Finding]:
    """Findings on light that does not come from the lamps.

    A point that faces away from lamps shows what else lights it. Light from other parts of the
    object does so too, but hardly to all points that face outwards.
    """
    shares = []
    for row, index in enumerate(shading.photographs):
        light = capture.photographs[int(index)].light
        away = shading.samples.cosine[light] < -0.2
        facing = shading.samples.cosine[light] > 0.3
        seen = shading.samples.luminance[int(index)]
        if (away & np.isfinite(seen)).sum() < 24 or np.isnan(shading.gains[row]):
            continue
        albedo = np.exp(shading.albedo + shading.gains[row])
        strength = float(np.median(shading.samples.irradiance[light][facing]))
        if strength > 0:
            dark = nanmedian((seen / albedo)[away].astype(np.float64), axis=0)
            shares.append(float(dark) / strength)
    ambient = float(nanmedian(np.array(shares), axis=0)) if len(shares) >= 4 else 0.0
    if ambient > AMBIENT:
        yield Finding(
            "ambient light",
            WARNING,
            (),
            f"surfaces that face away from the lamp are {100 * ambient:.0f} % as bright as "
            "those that face it (median over photographs)",
            _without_ambient(capture),
        )


def _without_ambient(capture: Capture) -> str:
    if any(photograph.dark is not None for photograph in capture.photographs):
        return (
            "darken the room; the dark frames that are subtracted do not hold this light: take "
            "them again, with the room lit as for the photographs"
        )
    return (
        "darken the room; or photograph each view without any lamp, and name that photograph "
        "'dark' in capture.json: it is subtracted"
    )


def vignetting_findings(shading: Shading, capture: Capture) -> Iterator[Finding]:
    """A note where the same points are darker towards the corners of the image."""
    slope, error = _radial_slope(shading, capture)
    if -slope > VIGNETTING and -slope > ERRORS * error:
        yield Finding(
            "vignetting",
            NOTE,
            (),
            "points are darker away from the image's centre, by "
            f"{100 * (1 - np.exp(slope)):.0f} % in the corners",
            "correct the photographs by one of an evenly lit surface (flat field), or state "
            "its reciprocal as 'gain' in capture.json",
        )


def _radial_slope(shading: Shading, capture: Capture) -> tuple[float, float]:
    """Change of the logarithm of brightness from centre to corner, and its standard error."""
    slopes = []
    for row, index in enumerate(shading.photographs):
        photograph = capture.photographs[int(index)]
        samples = shading.samples
        lit = samples.cosine[photograph.light] > 0.3
        seen = samples.luminance[int(index)]
        usable = lit & np.isfinite(seen) & (seen > 0)
        if usable.sum() < 100 or np.isnan(shading.gains[row]):
            continue
        irradiance = np.maximum(samples.irradiance[photograph.light][usable], 1e-30)
        left = np.log(seen[usable] / irradiance) - shading.albedo[usable]
        radius = 2 * np.sum(np.square(samples.places[photograph.camera][usable] - 0.5), axis=1)
        known = np.isfinite(left) & (np.abs(left - nanmedian(left, axis=0)) < 0.3)
        if known.sum() > 100 and radius[known].std() > 0.03:
            slopes.append(np.polyfit(radius[known], left[known], 1)[0])
    if len(slopes) < 8:
        return 0.0, float("inf")
    return float(np.median(slopes)), float(1.2533 * np.std(slopes) / np.sqrt(len(slopes)))
