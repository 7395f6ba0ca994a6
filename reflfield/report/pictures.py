"""Arrays to pictures: false colour, normals, overlays, textures.

Everything here is an (h, w, 3) uint8 array, sRGB encoded, ready to be stored.
"""

from __future__ import annotations

import math
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image as PillowImage
from scipy.ndimage import binary_dilation

from reflfield.errors import InputError
from reflfield.render.exposure import UNKNOWN_CODE
from reflfield.util.validation import check_shape

Encoded = NDArray[np.uint8]
Colour = tuple[int, int, int]

# Neutral grey: neither the dark nor the light end of any colour map used here.
NOTHING: Colour = (UNKNOWN_CODE, UNKNOWN_CODE, UNKNOWN_CODE)
SILHOUETTE_COLOUR: Colour = (0, 200, 255)
HULL_COLOUR: Colour = (255, 120, 0)
MISSING_COLOUR: Colour = (230, 40, 90)
EXCESS_COLOUR: Colour = (250, 200, 30)


def false_colour(
    values: ArrayLike, low: float, high: float, colours: str = "viridis"
) -> Encoded:
    """Scalars as colours; what is not finite becomes neutral grey.

    Parameters
    ----------
    values : (h, w) array_like
    low, high : float
        Values shown by the first and the last colour; beyond, the ends repeat.
    colours : str
        Name of a matplotlib colour map.

    Returns
    -------
    (h, w, 3) uint8

    Raises
    ------
    InputError
        If not ``low < high``.

    Examples
    --------
    >>> false_colour([[0.0, 1.0, np.nan]], 0, 1, "gray")[0].tolist()
    [[0, 0, 0], [255, 255, 255], [128, 128, 128]]
    """
    if not low < high:
        raise InputError(f"false_colour: expected low < high, received {low} and {high}")
    numbers = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(numbers)
    share = np.clip((np.where(finite, numbers, low) - low) / (high - low), 0.0, 1.0)
    colour = np.asarray(matplotlib.colormaps[colours](share))[..., :3]
    return np.where(finite[..., None], _eight_bit(colour), np.array(NOTHING, dtype=np.uint8))


def colour_stops(colours: str, n_stops: int = 12) -> list[str]:
    """Evenly spaced colours of a map as ``#rrggbb``, first to last.

    Examples
    --------
    >>> colour_stops("gray", 3)
    ['#000000', '#808080', '#ffffff']
    """
    row = false_colour(np.linspace(0, 1, n_stops)[None], 0.0, 1.0, colours)[0]
    return ["#" + "".join(f"{channel:02x}" for channel in colour) for colour in row.tolist()]


def labels_coloured(labels: ArrayLike) -> Encoded:
    """Integers as colours that neighbouring numbers do not share.

    Parameters
    ----------
    labels : (h, w) array_like of int
        Negative means nothing there.

    Returns
    -------
    (h, w, 3) uint8

    Examples
    --------
    >>> picture = labels_coloured([[-1, 0, 1]])
    >>> picture[0, 0].tolist(), bool((picture[0, 1] != picture[0, 2]).any())
    ([128, 128, 128], True)
    """
    numbers = np.asarray(labels)
    # Steps of the golden ratio never come back close to an earlier hue.
    hue = np.mod(np.maximum(numbers, 0) * ((math.sqrt(5) - 1) / 2) + 0.58, 1.0)
    strength = np.where(np.maximum(numbers, 0) % 3 == 1, 0.40, 0.62)
    wheel = np.stack([hue, strength, np.full_like(hue, 0.86)], axis=-1)
    return np.where(
        (numbers >= 0)[..., None],
        _eight_bit(matplotlib.colors.hsv_to_rgb(wheel)),
        np.array(NOTHING, dtype=np.uint8),
    )


def directions_coloured(directions: ArrayLike) -> Encoded:
    """Unit vectors as colours: red +X, green +Y, blue +Z, each from -1 to 1.

    Parameters
    ----------
    directions : (..., 3) array_like
        What is not finite, and zero vectors, become neutral grey.

    Returns
    -------
    (..., 3) uint8

    Examples
    --------
    >>> directions_coloured([[0, 0, 1.0], [-1, 0, 0], [0, 0, 0]]).tolist()
    [[128, 128, 255], [0, 128, 128], [128, 128, 128]]
    """
    vectors = np.asarray(directions, dtype=np.float64)
    known = np.isfinite(vectors).all(axis=-1) & (np.abs(vectors).max(axis=-1) > 0)
    coloured = _eight_bit((np.where(known[..., None], vectors, 0.0) + 1.0) / 2.0)
    return np.where(known[..., None], coloured, np.array(NOTHING, dtype=np.uint8))


def texture(values: ArrayLike, texel_of_pixel: ArrayLike, nothing: float = np.nan) -> Any:
    """Values of texels laid out as the atlas.

    Parameters
    ----------
    values : (n_texels, ...) array_like
    texel_of_pixel : (h, w) array_like of int
        Texel of each pixel, -1 for none.
    nothing : float
        Written where there is no texel.

    Returns
    -------
    (h, w, ...) ndarray
        Of the type that holds both values and `nothing`.

    Raises
    ------
    InputError
        If a pixel names a texel that does not exist.

    Examples
    --------
    >>> texture([7, 8], [[1, -1], [0, 1]], nothing=-1).tolist()
    [[8, -1], [7, 8]]
    """
    data, texels = np.asarray(values), np.asarray(texel_of_pixel)
    if texels.size and int(texels.max()) >= len(data):
        raise InputError(
            f"texel_of_pixel: expected texels below {len(data)}, received {int(texels.max())}; "
            "values and layout belong to different atlases"
        )
    present = texels >= 0
    fill = np.asarray(nothing)
    if np.issubdtype(data.dtype, np.integer) and np.isfinite(nothing):
        fill = fill.astype(data.dtype)
    if not len(data):
        return np.full((*texels.shape, *data.shape[1:]), fill)
    laid_out = data[np.where(present, texels, 0)]
    return np.where(present.reshape(*texels.shape, *[1] * (data.ndim - 1)), laid_out, fill)


def outline(silhouette: ArrayLike, thickness: int = 1) -> NDArray[np.bool_]:
    """Pixels just outside the region of coverage >= 0.5.

    Parameters
    ----------
    silhouette : (h, w) array_like
    thickness : int
        In pixels.

    Returns
    -------
    (h, w) bool

    Examples
    --------
    >>> outline([[0, 0, 1, 1]]).tolist()
    [[False, True, False, False]]
    """
    covered = np.asarray(silhouette) >= 0.5
    return binary_dilation(covered, iterations=thickness) & ~covered


def silhouettes_overlay(
    background: ArrayLike, silhouette: ArrayLike, hull_silhouette: ArrayLike
) -> Encoded:
    """Photograph with both outlines, and the area where they disagree filled.

    Blue line: silhouette. Orange line: hull. Red: object that the hull misses.
    Yellow: hull outside of the silhouette.

    Parameters
    ----------
    background : (h, w, 3) uint8
    silhouette, hull_silhouette : (h, w) float
        Coverage.

    Returns
    -------
    (h, w, 3) uint8
    """
    seen, hull = np.asarray(silhouette) >= 0.5, np.asarray(hull_silhouette) >= 0.5
    painted = np.array(background, dtype=np.uint8)
    check_shape("silhouette", seen, painted.shape[:2])
    check_shape("hull_silhouette", hull, painted.shape[:2])
    thickness = max(1, round(max(painted.shape[:2]) / 500))
    for region, colour in (
        (outline(hull, thickness), HULL_COLOUR),
        (outline(seen, thickness), SILHOUETTE_COLOUR),
        (seen & ~hull, MISSING_COLOUR),
        (hull & ~seen, EXCESS_COLOUR),
    ):
        painted[region] = colour
    return painted


def with_alpha(picture: Encoded, shown: ArrayLike) -> Encoded:
    """The picture with a fourth channel, transparent where not `shown`.

    Examples
    --------
    >>> with_alpha(np.full((1, 2, 3), 7, np.uint8), [[True, False]])[0].tolist()
    [[7, 7, 7, 255], [0, 0, 0, 0]]
    """
    opaque = np.asarray(shown, dtype=bool)
    alpha = np.where(opaque, 255, 0).astype(np.uint8)
    return np.dstack([np.where(opaque[..., None], picture, 0).astype(np.uint8), alpha])


def fitted(picture: Encoded, max_side: int) -> Encoded:
    """Shrink a picture so that its longer side is at most `max_side` pixels."""
    height, width = picture.shape[:2]
    scale = max_side / max(height, width)
    if scale >= 1.0:
        return picture
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(PillowImage.fromarray(picture).resize(size, PillowImage.Resampling.BOX))


def block_means(values: ArrayLike, max_side: int) -> NDArray[np.float32]:
    """Means over square blocks, so that the longer side is at most `max_side`.

    Parameters
    ----------
    values : (h, w) array_like
        What is not finite does not count.
    max_side : int

    Returns
    -------
    (rows, columns) float32
        NaN where nothing counts.

    Examples
    --------
    >>> block_means([[1, 3, 5], [np.nan, 8, np.nan]], max_side=2)
    array([[4., 5.]], dtype=float32)
    """
    numbers = np.asarray(values, np.float32)
    step = -(-max(numbers.shape) // max_side)
    if step <= 1:
        return numbers
    finite = np.isfinite(numbers)
    starts = [np.arange(0, n, step) for n in numbers.shape]
    total, count = (
        np.add.reduceat(np.add.reduceat(array, starts[0], axis=0), starts[1], axis=1)
        for array in (np.where(finite, numbers, 0), finite.astype(np.float32))
    )
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)


def enlarged(picture: NDArray[Any], factor: int) -> NDArray[Any]:
    """Every pixel repeated `factor` times in both directions.

    Examples
    --------
    >>> enlarged(np.array([[1, 2]]), 2).tolist()
    [[1, 1, 2, 2], [1, 1, 2, 2]]
    """
    return np.repeat(np.repeat(picture, factor, axis=0), factor, axis=1)


def _eight_bit(values: ArrayLike) -> Encoded:
    return (np.clip(np.asarray(values), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
