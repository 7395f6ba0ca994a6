r"""Which values of a photograph are measurements, and which say "too bright" or "too dark".

A sensor has an upper limit, and so has a file: what is brighter is stored as the limit. The
limit of one channel of one file is, in this order:

1. the white level that the capture states, where it states one;
2. in integer files the largest code (255, 65535) if a pixel has it;
3. else the largest value of that channel, if at least `PLATEAU_PIXELS` pixels and the share
   `PLATEAU_SHARE` of the image have exactly that value, and

   * it is a usual limit: 1 in a file of floats, :math:`2^k - 1` with k = 10, 12 or 14, also
     shifted to the top, in a file of 16 bits; or
   * it is a pile: `PILE` times as frequent as any other value of the upper octave (half the
     largest value to the largest), in which `OCTAVE_VALUES` other values occur.

An image of one value is no plateau: it says nothing about a limit. The second part of rule 3
is there because a surface of one colour under one distant light gives equal values without
being saturated; it then has few other values near by, or is as frequent as they are.

At the lower end, code 0 of an integer file is "too dark". Floats have no lower limit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Kinds = NDArray[np.uint8]

# What a value is: measured; at the upper limit of sensor or file, so at least that; at code 0;
# under alpha 0.
MEASURED, SATURATED, BLACK, TRANSPARENT = range(4)
PLATEAU_PIXELS = 16
PLATEAU_SHARE = 1e-4
PILE = 8
OCTAVE_VALUES = 16
USUAL_CODES = tuple(
    code / 65535 for k in (10, 12, 14) for code in (2**k - 1, (2**k - 1) << (16 - k))
)

# Code 0 is a measurement: it says that the value is less than half of the least code. Numbers
# spread evenly up to there have cube roots of three quarters of the largest on average, known
# to a fifth: with the smallest value of the photograph for the least code, this share of it.
BLACK_SHARE = 0.75**3 / 2


def kinds_of_stored(
    stored: Float32, *, integer: bool, white_level: float | None = None
) -> Kinds:
    """Tell which stored values are measurements of radiance, and what the others are.

    Parameters
    ----------
    stored : (h, w, channels) float32
        As the file has them: integers divided by their largest code, floats as they are.
    integer : bool
        Whether the file holds integers.
    white_level : float, optional
        Stored value from which on the sensor is saturated; None looks for a limit.

    Returns
    -------
    (h, w, channels) uint8
        `SATURATED` at the upper limit, `BLACK` at code 0 of an integer file, else `MEASURED`.

    Examples
    --------
    >>> photograph = np.array([[[0.0], [0.5], [1.0]]], np.float32)
    >>> kinds_of_stored(photograph, integer=True)[0, :, 0].tolist()
    [2, 0, 1]
    """
    _, width, n_channels = stored.shape
    # Whole rows at once: loops over the few channels of each pixel are slow.
    rows = stored.reshape(len(stored), width * n_channels)
    if white_level is None:
        tops = rows.max(axis=0, initial=0.0).reshape(width, n_channels).max(axis=0, initial=0.0)
        limits = [_upper_limit(stored[..., i], top, integer) for i, top in enumerate(tops)]
    else:
        limits = [white_level] * n_channels
    # A byte each, as photographs are large.
    saturated = ~(rows < np.tile(np.array(limits, np.float32), width))
    kinds = np.where(saturated, np.uint8(SATURATED), np.uint8(MEASURED))
    if integer:
        kinds[rows <= 0] = BLACK
    return kinds.reshape(stored.shape)


def kinds_of_bracket(shots: Sequence[Kinds], seconds: Sequence[float]) -> Kinds:
    """Kinds of values of bracketed exposures together: one that measures is enough.

    Else what the shortest says of a value that even it cannot hold counts, or else the longest.

    Examples
    --------
    >>> short, long = np.array([0, 1, 2, 2], np.uint8), np.array([1, 1, 2, 0], np.uint8)
    >>> kinds_of_bracket([long, short], [4.0, 0.5]).tolist()
    [0, 1, 2, 0]
    """
    shortest, longest = shots[int(np.argmin(seconds))], shots[int(np.argmax(seconds))]
    unmeasured = np.where(shortest == SATURATED, shortest, longest)
    # Black in the shortest, white in the next: between the two, so no bound from below.
    unmeasured[(unmeasured == SATURATED) & (shortest != SATURATED)] = BLACK
    measured = np.logical_or.reduce([kinds == MEASURED for kinds in shots])
    return np.where(measured, np.uint8(MEASURED), unmeasured)


def with_bounded_black(image: Float32, kinds: Kinds) -> Float32:
    """Photograph (h, w, 3) with `BLACK_SHARE` of its darkest values where it is at code 0.

    Examples
    --------
    >>> image = np.array([[[0.0, 0.0, 0.0], [0.5, 0.1, 1.0]]], np.float32)
    >>> kinds = np.where(image > 0, 0, BLACK)
    >>> with_bounded_black(image, kinds)[0, 0].round(3)
    array([0.105, 0.021, 0.211], dtype=float32)
    """
    black = kinds == BLACK
    if not black.any():
        return image
    height, width, n_channels = image.shape
    # Whole rows at once: loops over the few channels of each pixel are slow.
    rows = np.where(image > 0, image, np.float32(np.inf)).reshape(height, width * n_channels)
    positive = rows.min(axis=0, initial=np.inf).reshape(width, n_channels).min(axis=0)
    darkest = np.where(np.isfinite(positive), positive, 0.0)
    return np.where(black, BLACK_SHARE * darkest, image).astype(np.float32)


def _upper_limit(channel: Float32, top: np.float32, integer: bool) -> float:
    """The value at which a channel is saturated; infinity where none is."""
    if top <= 0:
        return np.inf
    if integer and top >= 1:
        return float(top)
    count = int(np.count_nonzero(channel == top))
    enough = count >= max(PLATEAU_PIXELS, PLATEAU_SHARE * channel.size)
    if enough and count < channel.size and (_usual(top, integer) or _pile(channel, top, count)):
        return float(top)
    return np.inf


def _usual(top: np.float32, integer: bool) -> bool:
    usual = USUAL_CODES if integer else (1.0,)
    return any(top == np.float32(level) for level in usual)


def _pile(channel: Float32, top: np.float32, count: int) -> bool:
    """Whether the largest value stands out from the values of the octave below it."""
    octave = channel[(channel >= top / 2) & (channel < top)]
    _, counts = np.unique(octave, return_counts=True)
    return len(counts) >= OCTAVE_VALUES and count >= PILE * int(counts.max())
