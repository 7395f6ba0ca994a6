"""Search of the quantisation step for the file size or the quality that is asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, log2
from typing import TypeVar

from reflfield.errors import InputError
from reflfield.field.file import PackedSizes
from reflfield.field.reflectance_field import ReflectanceField

Field = TypeVar("Field", bound=ReflectanceField)

# Steps are searched within this factor of where the search begins.
WIDEST = 2.0**12
# A file this share below the size that is asked for is close enough.
CLOSE = 0.005
MAX_CANDIDATES = 14
# Where a search begins without a residual: this share of the root mean square of the means.
START_SHARE = 2.0**-10


def field_as_asked(
    build: Callable[[float], Field],
    measure: Callable[[Field], float],
    step: float,
    *,
    size: int = 0,
    least: float = 0.0,
) -> Field:
    """Field of a size, else of at least a quality, else of the step itself.

    Parameters
    ----------
    build, measure : callable
        As of `field_of_quality`.
    step : float
        Quantisation step, or where the search for one begins.
    size : int
        Bytes of the file, at most; 0 asks for none.
    least : float
        Quality; 0 asks for none.

    Returns
    -------
    ReflectanceField

    Raises
    ------
    InputError
        As `field_of_size`.
    """
    if size:
        return field_of_size(build, step, size)
    if least:
        return field_of_quality(build, measure, step, least)
    return build(step)


def field_of_size(build: Callable[[float], Field], step: float, size: int) -> Field:
    """Field whose file comes close to a size, from below.

    Parameters
    ----------
    build : callable
        From a quantisation step to the field.
    step : float
        Where the search begins; 0, of a model without a residual, is replaced by a share of
        what the field holds.
    size : int
        Bytes of the file, at most.

    Returns
    -------
    ReflectanceField

    Raises
    ------
    InputError
        If even the coarsest field is larger, or the step is no number.
    """
    sizes = PackedSizes()
    step = _first_step(build, step)
    bracket = _Bracket(log2(step / WIDEST), log2(step * WIDEST))
    best, at = None, log2(step)
    for _ in range(MAX_CANDIDATES):
        field = build(2.0**at)
        n_bytes = sizes.of(field)
        bracket.tighten(at, n_bytes, size)
        if n_bytes <= size:
            best = field
            if n_bytes >= (1.0 - CLOSE) * size:
                break
        if bracket.width < 1e-3:
            break
        at = bracket.next(size)
    if best is None:
        raise InputError(
            f"size: expected at least {n_bytes:,} bytes, which surface, texture map and frames "
            f"take at the coarsest, received {size:,}; fewer texels make it smaller "
            "(texture.texels_per_pixel, hull.n_triangles)"
        )
    return best


@dataclass
class _Bracket:
    """Logarithms of a step between which a size is passed; sizes fall as the step grows."""

    low: float
    high: float
    bytes_low: int | None = None
    bytes_high: int | None = None
    stride: float = 1.0

    @property
    def width(self) -> float:
        """Of what is left."""
        return self.high - self.low

    def tighten(self, at: float, n_bytes: int, size: int) -> None:
        """Move the end on whose side a candidate fell."""
        if n_bytes > size:
            self.low, self.bytes_low = at, n_bytes
        else:
            self.high, self.bytes_high = at, n_bytes

    def next(self, size: int) -> float:
        """Where the size is expected, by interpolation between two ends that are known.

        Kept off the ends, so that a bend in the curve cannot stall the search. While one end is
        not measured, strides beyond the other that double.
        """
        if self.bytes_low is None or self.bytes_high is None:
            self.stride *= 2.0
            towards = self.high - self.stride, self.low + self.stride
            if self.bytes_low is None:
                return max(towards[0], self.low)
            return min(towards[1], self.high)
        share = (self.bytes_low - size) / max(self.bytes_low - self.bytes_high, 1)
        return self.low + min(max(share, 0.1), 0.9) * self.width


def _first_step(build: Callable[[float], Field], step: float) -> float:
    """Step that a search can begin with: a model that fits exactly gives none."""
    if not 0 <= step < inf:
        raise InputError(f"step: expected a number >= 0, received {step}")
    if step > 0:
        return step
    return START_SHARE * build(0.0).usual_root or 1.0


def field_of_quality(
    build: Callable[[float], Field],
    measure: Callable[[Field], float],
    step: float,
    least: float,
) -> Field:
    """Smallest field of at least a quality; the finest if none reaches it.

    Parameters
    ----------
    build : callable
        From a quantisation step to the field.
    measure : callable
        Quality of a field; falls as the step grows.
    step : float
        Where the search begins; 0 as in `field_of_size`.
    least : float

    Returns
    -------
    ReflectanceField
        Within a tenth of the step at which the quality is just reached.

    Raises
    ------
    InputError
        If the step is no number.
    """
    step = _first_step(build, step)
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
