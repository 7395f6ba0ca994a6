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

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

PLATEAU_PIXELS = 16
PLATEAU_SHARE = 1e-4
PILE = 8
OCTAVE_VALUES = 16
USUAL_CODES = tuple(
    code / 65535 for k in (10, 12, 14) for code in (2**k - 1, (2**k - 1) << (16 - k))
)


def measured_values(
    stored: Float32, *, integer: bool, white_level: float | None = None
) -> Bool:
    """Tell which stored values are measurements of radiance.

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
    (h, w, channels) bool
        False where a value is at the upper limit, or at code 0 of an integer file.

    Examples
    --------
    >>> photograph = np.array([[[0.0], [0.5], [1.0]]], np.float32)
    >>> measured_values(photograph, integer=True)[0, :, 0].tolist()
    [False, True, False]
    """
    limits = [
        _upper_limit(stored[..., i], integer) if white_level is None else white_level
        for i in range(stored.shape[2])
    ]
    measured: Bool = stored < np.array(limits, np.float32)
    if integer:
        measured &= stored > 0
    return measured


def _upper_limit(channel: Float32, integer: bool) -> float:
    """The value at which a channel is saturated; infinity where none is."""
    top = channel.max(initial=0.0)
    if top <= 0:
        return np.inf
    if integer and top >= 1:
        return float(top)
    count = int((channel == top).sum())
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
