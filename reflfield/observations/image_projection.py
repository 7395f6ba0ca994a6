"""Photographs into texture space: one apparent BRDF sample per texel and photograph."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import place_of_camera
from reflfield.capture.capture import Capture
from reflfield.capture.clipping import SATURATED, with_bounded_black
from reflfield.capture.directions import directions_towards
from reflfield.capture.lights import Light, facing_irradiance, place_of_light
from reflfield.observations.bilinear_sampling import Kinds, mark_kinds, sample_bilinear
from reflfield.observations.photographed_pairs import PhotographedPairs
from reflfield.observations.store import (
    UNIT,
    Location,
    chunk_shape,
    create_samples,
    is_written,
    note_gaps,
    open_samples,
)
from reflfield.util.blocks import Blocks
from reflfield.util.validation import check_shape

Floats = NDArray[np.float32]
# What a value of a photograph at a texel may be. As `capture.clipping` has it: measured; at the
# upper limit of sensor or file; at code 0; under alpha 0. And of a colour that the light has
# not; where it gives nothing.
VALUE_KINDS = ("measured", "saturated", "black", "transparent", "dark", "unlit")
# Those that say nothing of the sample.
NOT_MEASURED = ("saturated", "transparent", "dark")
# Those that do: black is less than the file can say.
IS_KNOWN = np.array([kind in ("measured", "black") for kind in VALUE_KINDS])
IS_GAP = np.array([kind in NOT_MEASURED for kind in VALUE_KINDS])
# Photographs, and texels of each, that the unit of the samples follows from, and the median
# sample of ordinary captures: a grey of a tenth.
PHOTOGRAPHS_FOR_UNIT, TEXELS_FOR_UNIT = 16, 1024
USUAL_SAMPLE = 2.0**-5
# Largest half float; a mirror-like peak beyond it is held there.
HALF_MAX = 65504.0
# Bytes for the photographs that are held at a time.
BUDGET = 256 << 20
# Lights sampled together: the pixel positions are worked out once for all of them.
LIGHTS_AT_ONCE = 32


def reached(lights: tuple[Light, ...], positions: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether each light sends anything (n, n_lights) to points, shadows aside."""
    points = np.asarray(positions, np.float64)
    return np.stack([light.reaches(points) for light in lights], axis=1)


def shines(lights: tuple[Light, ...], positions: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether points get any of the colours of lights (n, n_lights, 3), shadows aside."""
    has_colour = np.array([light.intensity > 0 for light in lights])
    unknown = np.array([not light.known for light in lights])
    return reached(lights, positions)[..., None] & (has_colour | unknown[:, None])


@dataclass(frozen=True, eq=False)
class Projection:
    """Photographs and the texels that they are projected onto.

    Parameters
    ----------
    capture : Capture
        Photographs, cameras and lights.
    positions : (n_texels, 3) float
        Points of the surface, metres.
    visible : (n_texels, n_views) bool
        True where the camera sees the texel; other samples are zero.
    location : Path or str
        Store to write.
    budget : int
        Bytes for the photographs held at a time. The samples do not depend on it.
    """

    capture: Capture
    positions: NDArray[np.floating]
    visible: NDArray[np.bool_]
    location: Location
    budget: int = BUDGET

    def __post_init__(self) -> None:
        check_shape("positions", self.positions, (None, 3))
        check_shape("visible", self.visible, (len(self.positions), self.capture.n_views))

    @cached_property
    def pairs(self) -> PhotographedPairs:
        """View and light of each photograph, in the order of the store."""
        return PhotographedPairs.of(self.capture)

    def chunks(self) -> list[range]:
        """Places of the photographs whose samples are written together."""
        n, step = len(self.pairs), chunk_shape(len(self.positions), self.pairs)[1]
        return [range(i, min(i + step, n)) for i in range(0, n, step)]


@dataclass(frozen=True, eq=False)
class LookedInto:
    """Samples (n) of a few photographs.

    Parameters
    ----------
    photograph, texel : (n,) int64
        Indices.
    values : (n, 3) float32
        Radiance over the light's irradiance; NaN where nothing is known of it.
    measured : (n, 3) bool
        False where a value is a bound, or known without the photograph.
    """

    photograph: NDArray[np.int64]
    texel: NDArray[np.int64]
    values: Floats
    measured: NDArray[np.bool_]

    def brightness(self) -> NDArray[np.float64]:
        """Mean (n,) of the channels that are known; NaN where none is."""
        known = np.isfinite(self.values)
        total = np.where(known, self.values, 0.0).sum(axis=1, dtype=np.float64)
        mean: NDArray[np.float64] = np.where(
            known.any(axis=1), total / np.maximum(known.sum(axis=1), 1), np.nan
        )
        return mean


@dataclass(frozen=True, eq=False)
class Projected:
    """What the projection found in the photographs.

    Parameters
    ----------
    photographs : int
        That were read.
    values : (n_views, len(VALUE_KINDS)) int64
        Values of the texels that each camera sees, three for each photograph and texel, by
        what they are: see `VALUE_KINDS`.
    measured : (n_texels, n_lights) bool
        True where some camera measured a value under the light.
    brightest, darkest : float
        Largest and smallest sample, 1/sr; 0 where all is dark, where nothing is negative.
    peaks : (n_views, n_lights) float32
        Largest value of each photograph, on the object or off it; 0 where there is none.
    looked_into : LookedInto
        Some of the samples.
    """

    photographs: int
    values: NDArray[np.int64]
    measured: NDArray[np.bool_]
    brightest: float
    darkest: float
    peaks: Floats
    looked_into: LookedInto

    def count(self, kind: str) -> int:
        """Values of one kind, all cameras together."""
        return int(self.values[:, VALUE_KINDS.index(kind)].sum())


def project_photographs(projection: Projection, blocks: Blocks, at_once: int = 1) -> Projected:
    """Write the samples of all texels: radiance divided by the light's irradiance.

    Parameters
    ----------
    projection : Projection
    blocks : Blocks
        Who does it, a few views at a time; what an interrupted run has written is kept.
    at_once : int
        Threads for whose blocks there is memory: a block takes the samples of its views and
        `Projection.budget`.

    Returns
    -------
    Projected

    Raises
    ------
    CaptureError
        If a photograph cannot be read.
    ShapeError
        If shapes disagree.
    InputError
        If the store holds other samples.

    Notes
    -----
    Every photograph is read once, a few of them (`PHOTOGRAPHS_FOR_UNIT`) before, to choose the
    unit of the samples.
    """
    first = LookedInto(**blocks.once("first", lambda: vars(look_into(projection))))
    n_texels, pairs = len(projection.positions), projection.pairs
    create_samples(projection.location, n_texels, pairs, sample_unit(first))
    parts = blocks.map(
        "projecting photographs",
        project_chunk,
        projection,
        projection.chunks(),
        intact=has_chunk,
        at_once=at_once,
    )
    n_photographs, peaks, brightest, darkest = 0, [], 0.0, 0.0
    values = np.zeros((pairs.n_views, len(VALUE_KINDS)), np.int64)
    measured = np.zeros((n_texels, -(-pairs.n_lights // 8)), np.uint8)
    for part in parts:
        n_photographs += int(part["photographs"])
        values[part["views"]] += part["values"]
        peaks.append(part["peaks"])
        measured |= part["measured"]
        brightest = max(brightest, float(part["brightest"]))
        darkest = min(darkest, float(part["darkest"]))
    bits = np.unpackbits(measured, axis=1, count=pairs.n_lights).astype(np.bool_)
    of_photographs = np.zeros((pairs.n_views, pairs.n_lights), np.float32)
    of_photographs[pairs.view, pairs.light] = np.concatenate(peaks)
    projected = Projected(
        *(n_photographs, values, bits, brightest, darkest),
        *(of_photographs, first),
    )
    n_gaps = sum(projected.count(kind) for kind in NOT_MEASURED)
    note_gaps(projection.location, n_gaps / max(int(projected.values.sum()), 1))
    return projected


def project_chunk(projection: Projection, photographs: range) -> dict[str, NDArray[Any]]:
    """Write the samples of a few photographs; gives their number and that of their values."""
    points = np.asarray(projection.positions, np.float64)
    views, lights = (
        of_pairs[photographs.start : photographs.stop]
        for of_pairs in (projection.pairs.view, projection.pairs.light)
    )
    block = np.zeros((len(points), len(photographs), 3), np.float16)
    of_block, starts = np.unique(views, return_index=True)
    counts = np.zeros((len(of_block), len(VALUE_KINDS)), np.int64)
    measured = np.zeros((len(points), projection.pairs.n_lights), np.bool_)
    store = open_samples(projection.location)
    unit = float(store.attrs[UNIT])
    peaks, brightest, darkest = np.zeros(len(photographs), np.float32), 0.0, 0.0
    for i, (view, first, end) in enumerate(
        zip(of_block, starts, np.append(starts[1:], len(views)), strict=True)
    ):
        seen = np.flatnonzero(projection.visible[:, view])
        for some, (values, kinds, brightest_pixels) in _view_samples(
            projection.capture, int(view), lights[first:end], points[seen], projection.budget
        ):
            stored = np.clip(values / np.float32(unit), -HALF_MAX, HALF_MAX)
            block[seen, first + some[0] : first + some[-1] + 1] = stored.astype(np.float16)
            peaks[first + some] = brightest_pixels
            counts[i] += _counts_of(kinds)
            is_known = np.asarray(IS_KNOWN[kinds].any(axis=2)) if kinds.any() else None
            for j, light in enumerate(lights[first + some]):
                measured[seen if is_known is None else seen[is_known[:, j]], light] = True
            brightest = max(brightest, float(np.fmax.reduce(values, axis=None, initial=0.0)))
            darkest = min(darkest, float(np.fmin.reduce(values, axis=None, initial=0.0)))
    store[:, photographs.start : photographs.stop] = block
    return {
        "photographs": np.array(len(photographs)),
        "views": of_block,
        "values": counts,
        "measured": np.packbits(measured, axis=1),
        "brightest": np.array(brightest),
        "darkest": np.array(darkest),
        "peaks": peaks,
    }


def _counts_of(kinds: Kinds) -> NDArray[np.int64]:
    """Values of each kind; most photographs have one."""
    if kinds.any():
        return np.bincount(kinds.ravel(), minlength=len(VALUE_KINDS)).astype(np.int64)
    return np.array([kinds.size] + [0] * (len(VALUE_KINDS) - 1), np.int64)


def has_chunk(projection: Projection, photographs: range) -> bool:
    """Whether the store holds the samples of some photographs, whole."""
    store = open_samples(projection.location)
    return is_written(store, (slice(None), slice(photographs.start, photographs.stop)))


def look_into(projection: Projection) -> LookedInto:
    """Samples of a few photographs, spread over lights and views, at texels spread evenly."""
    capture, n = projection.capture, len(projection.capture.photographs)
    order = sorted(range(n), key=lambda i: (capture.photographs[i].light, i))
    places = np.unique(np.linspace(0, n - 1, min(n, PHOTOGRAPHS_FOR_UNIT)).astype(int))
    chosen = np.sort(np.array(order)[places])
    columns = []
    for index in chosen:
        seen = np.flatnonzero(projection.visible[:, capture.photographs[index].camera])
        some = seen[:: max(1, len(seen) // TEXELS_FOR_UNIT)]
        values, kinds = samples_of_photograph(capture, int(index), projection.positions[some])
        columns.append((np.full(len(some), index), some, values, kinds == 0))
    return LookedInto(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def samples_of_photograph(
    capture: Capture, index: int, positions: NDArray[np.floating], *, bounds: bool = False
) -> tuple[Floats, Kinds]:
    """Samples of one photograph at points that its camera sees.

    Parameters
    ----------
    capture : Capture
    index : int
        Of the photograph.
    positions : (n, 3) float
        Metres, world frame.
    bounds : bool
        Whether saturated values are returned as well, which are bounds from below.

    Returns
    -------
    values : (n, 3) float32
        Radiance over the light's irradiance; NaN where nothing is known of it.
    kinds : (n, 3) uint8
        Places in `VALUE_KINDS`.
    """
    photograph = capture.photographs[index]
    points = np.asarray(positions, np.float64)
    pixels, _ = capture.cameras[photograph.camera].project(points)
    lights = np.array([photograph.light])
    values, kinds, _ = _samples_at(
        capture, photograph.camera, lights, points, pixels, bounds=bounds
    )
    return values[:, 0], kinds[:, 0]


def sample_unit(looked_into: LookedInto) -> float:
    """Unit in which halves hold the samples of a capture: a power of 64.

    Cube and square root of such a power are powers of two, so that no digit changes whatever
    the domain of the factorization is. Samples of ordinary captures, whose median is near
    `USUAL_SAMPLE`, are stored as they are, in units of 1.
    """
    positive = looked_into.values[looked_into.measured & (looked_into.values > 0)]
    if not len(positive):
        return 1.0
    size = float(np.median(positive.astype(np.float64)))
    return float(64.0 ** np.round(np.log2(size / USUAL_SAMPLE) / 6.0))


def _view_samples(
    capture: Capture,
    view: int,
    lights: NDArray[np.intp],
    points: NDArray[np.float64],
    budget: int,
) -> Iterator[tuple[NDArray[np.intp], tuple[Floats, Kinds, Floats]]]:
    """Places of some lights at a time, with samples, kinds (n_points, n, 3) and peaks."""
    pixels, _ = capture.cameras[view].project(points)
    camera = capture.cameras[view]
    # A photograph with the copies made of it while reading, and its samples.
    each = 12 * (3 * camera.width * camera.height + 4 * len(points))
    together = int(np.clip(budget // max(each, 1), 1, LIGHTS_AT_ONCE))
    for some in np.array_split(np.arange(len(lights)), -(-len(lights) // together)):
        yield some, _samples_at(capture, view, lights[some], points, pixels)


def _samples_at(
    capture: Capture,
    view: int,
    lights: NDArray[np.intp],
    points: NDArray[np.float64],
    pixels: NDArray[np.float64],
    *,
    bounds: bool = False,
) -> tuple[Floats, Kinds, Floats]:
    """Samples of one view at the pixels of points, their kinds, and the photographs' peaks."""
    indices = capture.photograph_index[view, lights]
    camera = capture.cameras[view]
    images = np.zeros((len(lights), camera.height, camera.width, 3), np.float32)
    kinds = np.zeros((len(points), len(lights), 3), np.uint8)
    for j, index in enumerate(indices):
        image, of_pixels = capture.read_kinds(int(index))
        if of_pixels.any():
            image = with_bounded_black(image, of_pixels)
            mark_kinds(of_pixels, pixels, kinds[:, j])
        images[j] = image
    peaks = images.max(axis=(1, 2, 3))
    irradiance = facing_irradiance(tuple(capture.lights[i] for i in lights), points)
    # A light may have no blue, a spot may miss a texel: nothing is learned there.
    lit = irradiance > 0
    values = sample_bilinear(images, pixels)
    values /= np.where(lit, irradiance, np.float32(1.0))
    kinds[~lit] = VALUE_KINDS.index("dark")
    unlit = ~lit.any(axis=2)
    kinds[unlit] = VALUE_KINDS.index("unlit")
    # What lies outside a spot's cone follows from the light alone, and stays black.
    values[unlit] = 0.0
    if kinds.any():
        gaps = IS_GAP[kinds]
        if bounds:
            gaps &= kinds != SATURATED
        values[gaps] = np.nan
    return values, kinds, peaks


def directions_of(
    capture: Capture, positions: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Unit directions from each texel to all cameras and all lights, world frame.

    Returns
    -------
    views : (n, n_views, 3) float32
    lights : (n, n_lights, 3) float32
        Of an unknown light, world +Z: its direction does not enter.
    """
    points = np.asarray(positions, np.float64)
    cameras = [place_of_camera(camera) for camera in capture.cameras]
    lights = [place_of_light(light) for light in capture.lights]
    return (
        directions_towards(points, cameras, np.float32),
        directions_towards(points, lights, np.float32),
    )
