"""Bracketed exposures of one scene, merged to linear radiance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.encoding import SRGB, Encoding
from reflfield.errors import InputError

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

# Bracketed exposures: a stored value this close to 0 or 1 is no measurement of radiance.
BRACKET_MARGIN = 0.02


def merge_exposures(
    encoded: Sequence[Float32],
    seconds: Sequence[float],
    encodings: Sequence[Encoding] | None = None,
) -> Float32:
    r"""Merge encoded exposures of one scene to linear radiance.

    :math:`L = \sum_i w(z_i)\, g(z_i) \,/\, \sum_i w(z_i)\, t_i` with the hat
    :math:`w(z) = \min(z, 1 - z)` less a margin, `g` the decoding and `t` the exposure
    time: the maximum-likelihood estimate under photon noise. Where every exposure is
    saturated the shortest one counts, where every one is black the longest.

    Parameters
    ----------
    encoded : sequence of (h, w, 3) float32
        Values in [0, 1] as stored in the files.
    seconds : sequence of float
        Exposure times, > 0.
    encodings : sequence of Encoding, optional
        Of each exposure; sRGB by default.

    Returns
    -------
    (h, w, 3) float32
        Radiance per second of exposure.

    Raises
    ------
    InputError
        If there are no exposures, a time is not positive, or the sizes differ.

    References
    ----------
    .. [1] P. Debevec, J. Malik, "Recovering high dynamic range radiance maps from
       photographs", SIGGRAPH 1997.

    Examples
    --------
    Half a second at encoded .5 (linear .214) is radiance .428; the saturated one is ignored:

    >>> grey, white = np.full((1, 1, 3), 0.5), np.ones((1, 1, 3))
    >>> merge_exposures([grey, white], [0.5, 4.0]).round(3)
    array([[[0.428, 0.428, 0.428]]], dtype=float32)
    """
    order = _exposure_order(encoded, seconds)
    curves = encodings or [Encoding(SRGB)] * len(encoded)
    total, time = np.zeros_like(encoded[0], np.float64), np.zeros_like(encoded[0], np.float64)
    for i in order:
        weight = np.clip(np.minimum(encoded[i], 1 - encoded[i]) - BRACKET_MARGIN, 0, None)
        total += weight * curves[i].decode(encoded[i])
        time += weight * seconds[i]
    shortest, longest = order[0], order[-1]
    fallback = np.where(
        (encoded[shortest] > 0.5) | (encoded[longest] >= 1),
        curves[shortest].decode(encoded[shortest]) / seconds[shortest],
        curves[longest].decode(encoded[longest]) / seconds[longest],
    )
    weighted = total / np.where(time > 0, time, 1)
    return np.where(time > 0, weighted, fallback).astype(np.float32)


def _exposure_order(encoded: Sequence[Float32], seconds: Sequence[float]) -> list[int]:
    """Indices from the shortest to the longest exposure, after checking them."""
    if not encoded or len(encoded) != len(seconds):
        raise InputError(
            f"exposures: expected one time per image and at least one image, "
            f"received {len(encoded)} images and {len(seconds)} times"
        )
    if not all(np.isfinite(t) and t > 0 for t in seconds):
        raise InputError(f"exposures: expected seconds > 0, received {list(seconds)}")
    shapes = {image.shape for image in encoded}
    if len(shapes) > 1:
        raise InputError(f"exposures: expected images of one size, received {sorted(shapes)}")
    return sorted(range(len(seconds)), key=lambda i: seconds[i])
