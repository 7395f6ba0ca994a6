"""As many bits as a size or a quality asks for: the step of the quantisation, searched."""

from __future__ import annotations

from collections.abc import Callable
from math import log2

from reflfield.errors import InputError
from reflfield.field.file import PackedSizes
from reflfield.field.model import ReflectanceField

Build = Callable[[float], ReflectanceField]

# Steps are searched within this factor of where the search begins.
WIDEST = 2.0**12
# A file this share below the size that is asked for is close enough.
CLOSE = 0.005
MOST_TRIALS = 14


def field_of_size(build: Build, step: float, size: int) -> ReflectanceField:
    """Field whose file comes close to a size, from below.

    Parameters
    ----------
    build : callable
        From a quantisation step to the field.
    step : float
        Where the search begins.
    size : int
        Bytes of the file, at most.

    Returns
    -------
    ReflectanceField

    Raises
    ------
    InputError
        If even the coarsest field is larger.
    """
    sizes = PackedSizes()
    low, high = log2(step / WIDEST), log2(step * WIDEST)
    best, at = None, log2(step)
    bytes_low, bytes_high = None, None
    for _ in range(MOST_TRIALS):
        field = build(2.0**at)
        found = sizes.of(field)
        if found <= size:
            best, high, bytes_high = field, at, found
            if found >= (1.0 - CLOSE) * size or high - low < 1e-3:
                return field
        else:
            low, bytes_low = at, found
        at = _next_trial(low, high, bytes_low, bytes_high, size)
        if best is None and log2(step * WIDEST) - low < 0.1:
            break
    if best is None:
        raise InputError(
            f"size: expected at least {found:,} bytes, which surface, texture map and frames "
            f"take at the coarsest, received {size:,}; fewer texels make it smaller "
            "(texture.texels_per_pixel, hull.n_triangles)"
        )
    return best


def _next_trial(
    low: float, high: float, bytes_low: int | None, bytes_high: int | None, size: int
) -> float:
    """Where sizes that fall as the logarithm of the step grows are expected to pass `size`.

    Kept off the ends, so that a bend in the curve cannot stall the search; while one end is
    not measured, a factor of four beyond the other.
    """
    if bytes_low is None:
        return max(high - 2.0, 0.5 * (low + high)) if high - 2.0 > low else 0.5 * (low + high)
    if bytes_high is None:
        return min(low + 2.0, 0.5 * (low + high)) if low + 2.0 < high else 0.5 * (low + high)
    share = (bytes_low - size) / max(bytes_low - bytes_high, 1)
    return low + min(max(share, 0.1), 0.9) * (high - low)


def field_of_quality(
    build: Build, measure: Callable[[ReflectanceField], float], step: float, least: float
) -> ReflectanceField:
    """Smallest field that is at least so good; the finest if none is.

    Parameters
    ----------
    build : callable
        From a quantisation step to the field.
    measure : callable
        Quality of a field; falls as the step grows.
    step : float
        Where the search begins.
    least : float

    Returns
    -------
    ReflectanceField
        Within a tenth of the step at which the quality is just reached.
    """
    finest = build(step / 64.0)
    if measure(finest) < least:
        return finest
    best, low, high = finest, log2(step / 64.0), log2(step * 64.0)
    while high - low > 0.14:
        middle = 0.5 * (low + high)
        field = build(2.0**middle)
        if measure(field) >= least:
            best, low = field, middle
        else:
            high = middle
    return best
