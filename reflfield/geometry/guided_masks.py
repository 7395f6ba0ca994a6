"""Silhouettes by GrabCut, seeded by the hull of the other views' silhouettes.

Colour alone does not tell an object from the cloth that it stands on. The hull of first
silhouettes does, where the cloth is of a colour that is named, or was photographed without the
object, or differs from view to view: what lies outside the hull is backdrop, what lies well
inside is object, and GrabCut decides in a band along its outline, in every view.

References
----------
C. Rother, V. Kolmogorov, A. Blake, "GrabCut: interactive foreground extraction using iterated
graph cuts", SIGGRAPH 2004.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.encoding import encode_srgb
from reflfield.capture.segmentation import largest_channel, silhouette_from_photographs
from reflfield.errors import CaptureError, InputError
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.visual_hull import HullOptions, visual_hull
from reflfield.util.progress import track
from reflfield.util.validation import check_ranges, check_shape

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]

# Longer side of the images that first silhouettes are made on, pixels.
FIRST_SIZE = 400
# Shares of the longer side of the object's box: half the width of the band in which GrabCut
# decides, in the first round and in later ones.
BANDS = (0.05, 0.025)
# Width of the border of the image that is backdrop, share of its longer side.
BORDER = 0.02
# Distance in CIELAB within which a pixel has the colour of a backdrop; lightness counts less,
# since the backdrop is in shadow here and there.
COLOUR_DISTANCE, LIGHTNESS_WEIGHT = 18.0, 0.35
# Difference from the clean plate, encoded, above which a pixel shows the object.
PLATE_DIFFERENCE = 0.06
GRABCUT_STEPS = 4
HULL = HullOptions(resolution=128, n_triangles=20_000)
# One view in so many may miss a part that photographs alone do not show.
VIEWS_PER_WRONG = 8
# Smallest overlap with the hull's outline of a silhouette that needs no second look.
GOOD_SCORE = 0.9


@dataclass(frozen=True)
class MaskOptions:
    """What is known of the backdrop.

    Parameters
    ----------
    colours : tuple of (float, float, float)
        Of the backdrop, sRGB-encoded, in [0, 1]; several where it is not of one colour.
    rounds : int
        Times that hull and silhouettes are made, 1 to 5.
    """

    colours: tuple[tuple[float, float, float], ...] = ()
    rounds: int = 2

    def __post_init__(self) -> None:
        check_ranges(self, {"rounds": (1, 5)})
        for colour in self.colours:
            if len(colour) != 3 or not all(0 <= value <= 1 for value in colour):
                raise InputError(
                    f"colours: expected three values from 0 to 1, received {colour}"
                )


@dataclass(frozen=True, eq=False)
class GuidedMask:
    """Silhouette of one view.

    Parameters
    ----------
    covered : (height, width) bool
    score : float
        Overlap (intersection over union) with the outline of the hull of all silhouettes.
    """

    covered: Bools
    score: float

    @property
    def is_doubtful(self) -> bool:
        """Whether somebody should look at it."""
        return self.score < GOOD_SCORE


def guided_masks(
    cameras: Sequence[Camera],
    read: Callable[[int], Floats],
    options: MaskOptions | None = None,
    plate: Callable[[int], Floats] | None = None,
) -> list[GuidedMask]:
    """Silhouettes of the views of an object, which agree with each other.

    Parameters
    ----------
    cameras : sequence of Camera
        At least two that look from different sides.
    read : callable
        From the number of a view to its photograph, or the mean of its photographs, linear,
        (height, width, 3) float32.
    options : MaskOptions, optional
    plate : callable, optional
        From the number of a view to a photograph without the object, in the same unit.

    Returns
    -------
    list of GuidedMask

    Raises
    ------
    CaptureError
        If no object is found in a view.
    GeometryError
        If the first silhouettes have no common hull.
    ShapeError
        If a plate has another size than the photograph.
    """
    options = options or MaskOptions()
    first = partial(_first_mask, read=read, options=options, plate=plate)
    views = range(len(cameras))
    masks = [first(i) for i in track(views, len(views), "first silhouettes")]
    # Colours and plates leave too much, photographs alone lose dark parts in some views.
    alone = plate is None and not options.colours
    hull = replace(HULL, tolerance=len(cameras) // VIEWS_PER_WRONG) if alone else HULL
    for number in range(options.rounds):
        outlines = _outlines(cameras, masks, hull)
        band = BANDS[min(number, len(BANDS) - 1)]
        masks = [
            refined_mask(_encoded(read(i)), outlines[i], masks[i], band)
            for i in track(views, len(views), f"silhouettes by the hull, round {number + 1}")
        ]
    outlines = _outlines(cameras, masks, hull)
    return [
        GuidedMask(mask, overlap(mask, outline))
        for mask, outline in zip(masks, outlines, strict=True)
    ]


def overlap(one: Bools, other: Bools) -> float:
    """Intersection over union; 1 where both are empty.

    Examples
    --------
    >>> overlap(np.array([True, True, False]), np.array([True, False, False]))
    0.5
    """
    union = np.count_nonzero(one | other)
    return float(np.count_nonzero(one & other) / union) if union else 1.0


def _outlines(
    cameras: Sequence[Camera], masks: Sequence[Bools], options: HullOptions
) -> list[Bools]:
    """What each camera sees of the hull of the silhouettes."""
    coverage = [mask.astype(np.float32) for mask in masks]
    mesh, _ = visual_hull(cameras, coverage, options, made=True)
    scene = RayScene(mesh)
    return [scene.silhouette(camera) for camera in cameras]


def _encoded(photograph: Floats) -> Bytes:
    """Photograph as bytes, sRGB-encoded, its brightest pixels white."""
    white = float(np.quantile(largest_channel(photograph), 0.995))
    shown = encode_srgb(np.clip(photograph / max(white, 1e-12), 0, 1))
    return np.rint(shown * 255).astype(np.uint8)


def _first_mask(
    view: int,
    *,
    read: Callable[[int], Floats],
    options: MaskOptions,
    plate: Callable[[int], Floats] | None,
) -> Bools:
    """Silhouette from the photograph and what is known of the backdrop."""
    photograph = read(view)
    if plate is not None:
        empty = plate(view)
        check_shape(f"plate of view {view}", empty, photograph.shape)
        seeds = _differs_from_plate(photograph, empty)
    elif options.colours:
        seeds = ~has_colours(_encoded(photograph), options.colours)
    else:
        return silhouette_from_photographs([photograph], name=f"view {view}") > 0.5
    mask = _cut(_encoded(photograph), _by_seeds(seeds), FIRST_SIZE)
    if not mask.any():
        raise CaptureError(
            f"view {view}: expected an object before the backdrop, found none; name other "
            "colours, or give a mask"
        )
    return mask


def _differs_from_plate(photograph: Floats, plate: Floats) -> Bools:
    white = max(float(np.quantile(largest_channel(photograph), 0.995)), 1e-12)
    shown, empty = (encode_srgb(np.clip(x / white, 0, 1)) for x in (photograph, plate))
    difference = cv2.GaussianBlur(largest_channel(np.abs(shown - empty)), (0, 0), 1.0)
    return np.asarray(difference > PLATE_DIFFERENCE)


def has_colours(encoded: Bytes, colours: Sequence[tuple[float, float, float]]) -> Bools:
    """Pixels that have one of some colours, in more or less light.

    Parameters
    ----------
    encoded : (h, w, 3) uint8
        sRGB.
    colours : sequence of (float, float, float)
        sRGB-encoded, in [0, 1].

    Examples
    --------
    >>> pixels = np.array([[[40, 120, 60], [30, 90, 45], [120, 60, 40]]], np.uint8)
    >>> has_colours(pixels, [(0.15, 0.45, 0.23)]).tolist()
    [[True, True, False]]
    """
    weights = np.array([LIGHTNESS_WEIGHT, 1.0, 1.0], np.float32)
    lab = cv2.cvtColor(encoded.astype(np.float32) / 255, cv2.COLOR_RGB2LAB) * weights
    named = np.asarray(colours, np.float32)[None]
    named_lab = cv2.cvtColor(named, cv2.COLOR_RGB2LAB)[0] * weights
    near = np.zeros(encoded.shape[:2], bool)
    for colour in named_lab:
        near |= np.linalg.norm(lab - colour, axis=2) < COLOUR_DISTANCE
    return near


def _by_seeds(seeds: Bools) -> Bytes:
    """Labels of GrabCut: the largest part of the seeds is probably the object."""
    smooth = cv2.morphologyEx(seeds.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    height, width = seeds.shape
    labels = np.full(seeds.shape, cv2.GC_BGD, np.uint8)
    n = max(2, round(BORDER * max(height, width)))
    inner = slice(n, height - n), slice(n, width - n)
    labels[inner] = cv2.GC_PR_BGD
    # The object is the part about the middle: others stand at the border of the image.
    parts = _central_part(smooth > 0)
    labels[inner][parts[inner]] = cv2.GC_PR_FGD
    return labels


def _central_part(inside: Bools) -> Bools:
    """Connected part with the largest area, pixels near the middle counted more."""
    _, labels = cv2.connectedComponents(inside.astype(np.uint8), connectivity=4)
    y, x = (np.linspace(-1, 1, n, dtype=np.float32) for n in inside.shape)
    weight = np.exp(-2 * (y[:, None] ** 2 + x**2))
    area = np.bincount(labels.ravel(), weight.ravel())
    area[0] = 0
    return np.asarray(labels == int(np.argmax(area))) & inside


def refined_mask(encoded: Bytes, outline: Bools, mask: Bools, band: float) -> Bools:
    """Silhouette by GrabCut in a band along the outline of the hull.

    Parameters
    ----------
    encoded : (h, w, 3) uint8
        sRGB.
    outline : (h, w) bool
        What the view sees of the hull.
    mask : (h, w) bool
        The view's silhouette so far; kept where the hull is not seen.
    band : float
        Half of the band's width over the longer side of the outline's box.
    """
    if not outline.any():
        return mask
    rows, columns = (np.flatnonzero(outline.any(axis=axis)) for axis in (1, 0))
    size = max(np.ptp(rows), np.ptp(columns)) + 1
    n = max(2, round(band * size))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * n + 1, 2 * n + 1))
    solid = outline.astype(np.uint8)
    labels = np.full(outline.shape, cv2.GC_BGD, np.uint8)
    near = cv2.dilate(solid, disc) > 0
    labels[near] = cv2.GC_PR_BGD
    labels[near & mask] = cv2.GC_PR_FGD
    labels[cv2.erode(solid, disc) > 0] = cv2.GC_FGD
    # Backdrop on all sides, as wide as the band again, shows what it looks like.
    low = np.maximum([rows[0] - 4 * n, columns[0] - 4 * n], 0)
    high = np.array([rows[-1] + 4 * n + 1, columns[-1] + 4 * n + 1])
    box = slice(low[0], high[0]), slice(low[1], high[1])
    refined = np.zeros_like(mask)
    refined[box] = _cut(encoded[box], labels[box], max(outline.shape))
    return _central_part(refined)


def _cut(encoded: Bytes, labels: Bytes, most: int) -> Bools:
    """GrabCut on an image whose longer side has at most so many pixels."""
    height, width = labels.shape
    scale = min(1.0, most / max(height, width))
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    small = cv2.resize(encoded, size, interpolation=cv2.INTER_AREA)
    seeds = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
    kinds = (np.isin(seeds, pair).any() for pair in ((0, 2), (1, 3)))
    if not all(kinds):  # nothing to tell apart
        return np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    cv2.setRNGSeed(0)  # its k-means draws from OpenCV's global generator
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(
        np.ascontiguousarray(small[..., ::-1]), seeds, None, *models, GRABCUT_STEPS,
        cv2.GC_INIT_WITH_MASK,
    )  # fmt: skip
    inside = np.isin(seeds, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.float32)
    large = cv2.resize(inside, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large > 0.5)
