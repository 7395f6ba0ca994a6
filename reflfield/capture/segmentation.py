"""Silhouettes made from photographs, where none are given.

A backdrop shows at the border of the image. Where the border is of one colour (black cloth,
a lit wall), the object is what differs from a smooth surface fitted to the backdrop, which a
flash lights unevenly; otherwise OpenCV's GrabCut separates what the border shows from the rest.
Both work on the mean of a view's photographs: a part in
shadow under one light is lit under another, and noise averages out.

A silhouette that misses part of the object carves that part off the hull for good, one that
is a little too large does not: dark parts in doubt are kept, small holes are filled.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from reflfield.capture.encoding import encode_srgb
from reflfield.errors import CaptureError, InputError
from reflfield.util.validation import check_shape

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]


# Lengths are fractions of the longer image side.
# Width of the border whose pixels stand for the backdrop.
BORDER = 0.015
# The backdrop counts as uniform if three quarters of the border differ from its median colour
# by less than this (sRGB-encoded, in [0, 1]); the object may cross the rest.
UNIFORM_SPREAD = 0.25
# Difference from the backdrop (encoded) below which nothing is object.
LEAST_CONTRAST = 0.02
# Distance from what is certainly object beyond which all is backdrop.
MARGIN = 0.015
# Gaps up to this width do not part the object.
CRACK = 0.02
# Notches in the outline up to this width are filled: mostly parts in cast shadow, as dark as
# the backdrop. Holes are left as they are.
CLOSING = 0.036
# The backdrop is a polynomial of this degree in the place, fitted to an image with at most this
# longer side, degree after degree, without what strays by more than so many standard deviations
# from the one before.
BACKDROP_DEGREE, BACKDROP_SIZE, BACKDROP_OUTLIER = 4, 128, 4.0
# The backdrop strays from that by less than its variation in this share of its pixels; the
# rest may be the object.
BACKDROP_SHARE = 0.95
# Differences from the backdrop, over its variation, of what is certainly object and of what
# belongs to it if it is near.
STRONG, WEAK = 3.5, 1.75
# The surface counts where it strays from the border's colour by so much, and by this share of
# what the backdrop strays from the surface: cloth that is dark all over is taken for even.
LEAST_UNEVEN, UNEVEN_SHARE = 0.02, 0.7
# The same thresholds over the variation of an even backdrop, by the difference from one colour.
STRONG_EVEN, WEAK_EVEN = 3.0, 1.25
# Parts and holes with a smaller share of the object's area are removed and filled; what is lit
# unevenly may be seen in pieces.
SMALLEST_PART, SMALLEST_PIECE = 0.05, 0.005
SMALLEST_HOLE = 0.015
# Width of the band beside the outline in which coverage may lie between 0 and 1.
SOFT_EDGE = 0.003
GRABCUT_ITERATIONS = 6
# GrabCut works on an image with at most this longer side, pixels.
GRABCUT_SIZE = 512


def silhouette_from_photographs(
    photographs: Iterable[Float32], *, name: str = "view"
) -> Float32:
    """Coverage of the object in the photographs of one view.

    Parameters
    ----------
    photographs : iterable of (h, w, 3) float32
        Linear photographs of one view, one per light; taken one at a time.
    name : str
        Named in errors.

    Returns
    -------
    (h, w) float32
        Coverage in [0, 1], anti-aliased along the outline.

    Raises
    ------
    CaptureError
        If no object is found.
    InputError
        If there are no photographs, they are not (h, w, 3), or their sizes differ.

    Examples
    --------
    A bright square on black:

    >>> photograph = np.zeros((40, 40, 3), np.float32)
    >>> photograph[10:30, 10:30] = 0.5
    >>> coverage = silhouette_from_photographs([photograph])
    >>> round(float(coverage.sum()))
    400
    """
    image = _exposed(_mean(photographs, name))
    encoded = encode_srgb(image)
    border = _border(image.shape[0], image.shape[1], BORDER)
    backdrop = np.median(encoded[border], axis=0)
    difference = largest_channel(np.abs(encoded - backdrop))
    uniform = np.quantile(difference[border], 0.75) < UNIFORM_SPREAD
    smallest = SMALLEST_PART
    if uniform:
        inside, smallest = _differs_from_backdrop(encoded, difference, border)
    else:
        inside = _grabcut(encoded, border)
    seen, inside = inside, _cleaned(inside, smallest)
    share = float(inside.mean())
    if not 0.0005 < share < 0.995:
        raise CaptureError(
            f"{name}: expected an object before a backdrop, found one that covers "
            f"{100 * share:.2f} % of the image: empty silhouette; give a silhouette per view"
        )
    if not uniform:
        return _smoothed(inside)
    linear_backdrop = np.median(image[border], axis=0)
    away = largest_channel(np.abs(image - linear_backdrop))
    return _soft_edged(away, seen, inside, smallest)


def largest_channel(image: Float32) -> Float32:
    """Largest of the three channels of each pixel (h, w).

    NumPy's own maximum along an axis as short as this takes 18 times as long.
    """
    red, green, blue = np.moveaxis(image, 2, 0)
    return np.asarray(np.maximum(np.maximum(red, green), blue))


def _mean(photographs: Iterable[Float32], name: str) -> Float32:
    """Mean of the photographs, one in memory at a time."""
    total, count = None, 0
    for photograph in photographs:
        check_shape(f"{name}: photograph", photograph, (None, None, 3))
        if total is not None and total.shape != photograph.shape:
            raise InputError(
                f"{name}: expected photographs of one size, received {total.shape} and "
                f"{photograph.shape}"
            )
        total = photograph.astype(np.float64) if total is None else total + photograph
        count += 1
    if total is None:
        raise InputError(f"{name}: expected photographs or a silhouette file, received neither")
    return (total / count).astype(np.float32)


def _exposed(image: Float32) -> Float32:
    """Scaled so that its brightest pixels, outliers aside, are 1."""
    white = float(np.quantile(largest_channel(image), 0.995))
    return image / np.float32(white) if white > 0 else image


def _border(height: int, width: int, fraction: float) -> Bool:
    """True in a frame along the edge of the image."""
    n = max(2, round(fraction * max(height, width)))
    border = np.ones((height, width), dtype=bool)
    border[n:-n, n:-n] = False
    return border


def _differs_from_backdrop(
    encoded: Float32, difference: Float32, border: Bool
) -> tuple[Bool, float]:
    """Pixels that differ from the backdrop, and the smallest part that counts.

    Pixels that differ a little belong to it, if they are near others. Both thresholds follow
    what the backdrop itself varies by; the upper one is at most Otsu's, which splits the two
    levels of the difference from the border's colour.
    """
    height, width = difference.shape
    n = max(3, round(MARGIN * max(height, width)))
    levels = np.clip(difference * 255, 0, 255).astype(np.uint8)
    otsu = cv2.threshold(levels, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[0] / 255
    bright = difference > max(otsu, LEAST_CONTRAST)
    far = cv2.dilate(bright.astype(np.uint8), _disc(n)) == 0
    surface = _backdrop(encoded, far)
    if not _is_uneven(encoded, surface, border, far):
        in_border = 2.5 * float(np.quantile(difference[border], 0.95)) + 1 / 255
        of_far = float(np.quantile(difference[far], 0.99)) if far.any() else 0.0
        ends = (STRONG_EVEN, WEAK_EVEN, min(in_border, of_far), otsu)
        return _connected(cv2.GaussianBlur(difference, (0, 0), 0.7), ends, n), SMALLEST_PART
    smooth = cv2.GaussianBlur(largest_channel(np.abs(encoded - surface)), (0, 0), 0.7)
    beside = _border(height, width, BORDER)
    variation = min(_variation(smooth[beside]), _variation(smooth[far]))
    inside = _connected(smooth, (STRONG, WEAK, variation, otsu), n)
    # What touches the border must be bright somewhere: the backdrop goes on there.
    at_border = _touching(inside, _border(height, width, 0.0))
    return (inside & ~at_border) | _touching(inside, bright), SMALLEST_PIECE


def _connected(smooth: Float32, ends: tuple[float, float, float, float], n: int) -> Bool:
    """Pixels above the upper threshold, and those above the lower one that are beside them."""
    strong_share, weak_share, variation, otsu = ends
    strong = float(np.clip(strong_share * variation, 2 * LEAST_CONTRAST, max(otsu, 0.1)))
    weak = float(np.clip(weak_share * variation, LEAST_CONTRAST, 0.75 * strong))
    near = cv2.dilate((smooth > strong).astype(np.uint8), _disc(n)) > 0
    return _touching((smooth > weak) & near, smooth > strong)


def _is_uneven(encoded: Float32, surface: Float32, border: Bool, far: Bool) -> bool:
    """Whether a backdrop is lit unevenly: by more than it varies by anyway."""
    if not far.any():
        return False
    colour = np.median(encoded[border], axis=0)
    bend = float(np.quantile(largest_channel(np.abs(surface - colour))[far], BACKDROP_SHARE))
    noise = float(np.quantile(largest_channel(np.abs(encoded - surface))[far], BACKDROP_SHARE))
    return bend > max(LEAST_UNEVEN, UNEVEN_SHARE * noise)


def _variation(difference: Float32) -> float:
    """How far the backdrop strays from its surface, as far as some pixels show it.

    Far from bright pixels dark parts of the object may hide, and the object may cross the
    border: the smaller of both.
    """
    if not len(difference):
        return 0.0
    return float(np.quantile(difference, BACKDROP_SHARE)) + 1 / 255


def _backdrop(encoded: Float32, usable: Bool) -> Float32:
    """Smooth backdrop (h, w, 3).

    Parameters
    ----------
    encoded : (h, w, 3) float32
    usable : (h, w) bool
        Where no object is seen; may hold its dark parts.
    """
    height, width = usable.shape
    scale = min(1.0, BACKDROP_SIZE / max(height, width))
    size = (max(2, round(width * scale)), max(2, round(height * scale)))
    small = cv2.resize(encoded, size, interpolation=cv2.INTER_AREA).reshape(-1, 3)
    kept = (
        cv2.resize(usable.astype(np.float32), size, interpolation=cv2.INTER_AREA).ravel() > 0.99
    )
    y, x = np.meshgrid(np.linspace(-1, 1, size[1]), np.linspace(-1, 1, size[0]), indexing="ij")
    surface = np.broadcast_to(
        np.median(small[kept], axis=0) if kept.any() else 0.0, small.shape
    )
    for degree in range(1, BACKDROP_DEGREE + 1):
        error = np.abs(small - surface).max(axis=1)
        deviation = 1.4826 * float(np.median(error[kept])) if kept.any() else 0.0
        kept = error < max(BACKDROP_OUTLIER * deviation, 1 / 255)
        powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
        if np.count_nonzero(kept) < 2 * len(powers):
            break
        terms = np.stack([x.ravel() ** i * y.ravel() ** j for i, j in powers], axis=1)
        # By normal equations: the condition of powers on [-1, 1] is small, and the solver's
        # pseudo-inverse bears pixels that do not tell all of them apart.
        of_kept = terms[kept]
        products = of_kept.T @ of_kept, of_kept.T @ small[kept]
        surface = terms @ np.linalg.lstsq(*products, rcond=None)[0]
    shaped = surface.reshape(size[1], size[0], 3).astype(np.float32)
    return cv2.resize(shaped, (width, height), interpolation=cv2.INTER_LINEAR)


def _disc(radius: int) -> NDArray[np.uint8]:
    element: NDArray[np.uint8] = cv2.getStructuringElement(
        cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)
    )
    return element


def _touching(candidates: Bool, seeds: Bool) -> Bool:
    """Connected parts of `candidates` that hold a seed."""
    _, labels = cv2.connectedComponents(candidates.astype(np.uint8), connectivity=4)
    kept = np.zeros(labels.max() + 1, dtype=bool)
    kept[np.unique(labels[seeds & candidates])] = True
    kept[0] = False
    return kept[labels]


def _grabcut(encoded: Float32, border: Bool) -> Bool:
    """Object by GrabCut, seeded with the border as backdrop."""
    height, width = border.shape
    scale = min(1.0, GRABCUT_SIZE / max(height, width))
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    small = cv2.resize((encoded * 255).astype(np.uint8), size, interpolation=cv2.INTER_AREA)
    labels = np.full(small.shape[:2], cv2.GC_PR_FGD, dtype=np.uint8)
    labels[_border(size[1], size[0], max(BORDER, 0.03))] = cv2.GC_BGD
    cv2.setRNGSeed(0)  # its k-means draws from OpenCV's global generator
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(small, labels, None, *models, GRABCUT_ITERATIONS, cv2.GC_INIT_WITH_MASK)
    inside = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.float32)
    return cv2.resize(inside, (width, height), interpolation=cv2.INTER_LINEAR) > 0.5


def _cleaned(inside: Bool, smallest: float) -> Bool:
    """Close gaps, remove small components, fill small holes; large holes keep their shape."""
    longer = max(inside.shape)
    joined = _closed(inside, max(1, round(CRACK * longer / 2)))
    parts = _large_parts(joined, smallest)
    solid = ~_large_holes(~parts, float("inf"))
    least = SMALLEST_HOLE * float(parts.sum())
    holes = _large_holes(solid & ~parts, least)
    bridged = _closed(solid, max(1, round(CLOSING * longer / 2)))
    return ~_large_holes(~bridged, least) & ~holes


def _closed(inside: Bool, radius: int) -> Bool:
    """Morphological closing; the object continues beyond the border of the image."""
    padded = np.pad(inside.astype(np.uint8), 2 * radius, mode="edge")
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, _disc(radius))
    return closed[2 * radius : -2 * radius, 2 * radius : -2 * radius] > 0


def _large_parts(inside: Bool, smallest_share: float) -> Bool:
    """Connected parts whose area is at least a share of the largest one's."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        inside.astype(np.uint8), connectivity=8
    )
    if count == 1:
        return inside
    area = stats[:, cv2.CC_STAT_AREA].astype(np.float64)
    area[0] = 0
    kept: Bool = area >= max(smallest_share * area.max(), 1)
    return kept[labels]


def _large_holes(outside: Bool, smallest_area: float) -> Bool:
    """The outside without holes smaller than an area; what touches the border stays."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        outside.astype(np.uint8), connectivity=4
    )
    kept: Bool = stats[:, cv2.CC_STAT_AREA] >= smallest_area
    edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    kept[edge] = True
    kept[0] = False  # label 0 is the object itself
    return kept[labels]


def _smoothed(inside: Bool) -> Float32:
    """Coverage of an outline that is only known to the pixel."""
    return np.clip(cv2.GaussianBlur(inside.astype(np.float32), (0, 0), 0.8), 0, 1)


def _soft_edged(difference: Float32, seen: Bool, inside: Bool, smallest: float) -> Float32:
    r"""Coverage along the outline, from how far each pixel is on its way to the object.

    A pixel that the object covers by :math:`\alpha` differs from the backdrop by
    :math:`\alpha` times what the object does, in linear light. The object's own difference
    is taken from just inside the outline. Where the object itself is dark there, or was
    filled in without being seen, the ratio means nothing and the plain outline is kept.
    """
    n = max(2, round(SOFT_EDGE * max(inside.shape)))
    disc = _disc(n)
    solid = inside.astype(np.uint8)
    padded = cv2.copyMakeBorder(solid, n, n, n, n, cv2.BORDER_REPLICATE)
    core = cv2.erode(padded, disc)[n:-n, n:-n] > 0
    reach = _disc(2 * n).astype(np.float32)
    weight = cv2.filter2D(core.astype(np.float32), -1, reach)
    total = cv2.filter2D(np.where(core, difference, 0), -1, reach)
    object_difference = total / np.maximum(weight, 1)
    filled = cv2.dilate((inside & ~seen).astype(np.uint8), _disc(1)) > 0
    trusted = (weight >= 1) & (object_difference > 0.02) & ~filled
    ratio = np.clip(difference / np.maximum(object_difference, 1e-6), 0, 1)
    band = (cv2.dilate(solid, disc) > 0) & ~core
    soft = np.where(band & trusted, ratio, _smoothed(inside)).astype(np.float32)
    return _without_specks(soft, smallest)


def _without_specks(coverage: Float32, smallest: float) -> Float32:
    """Coverage without the single pixels that a ratio of dark values leaves behind."""
    solid = coverage > 0.5
    parts = _large_parts(solid, smallest)
    clean = ~_large_holes(~parts, SMALLEST_HOLE * float(parts.sum()))
    return np.where(clean == solid, coverage, clean).astype(np.float32)
