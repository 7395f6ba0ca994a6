"""Every photograph of a capture, decoded once and kept at reduced size, with a few numbers."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.capture.clipping import BLACK, SATURATED, TRANSPARENT
from reflfield.capture.color_spaces import LUMINANCE
from reflfield.capture.image_files import read_small_kinds
from reflfield.errors import InputError
from reflfield.options import available_cores
from reflfield.util.blas_threads import thread_pool
from reflfield.util.progress import track

Float32 = NDArray[np.float32]

# Longer side of a photograph as it is kept, pixels, and of the mean of a view's photographs.
KEPT_PIXELS, MEAN_PIXELS = 128, 512
# Photographs of a view of which the brightest at a pixel does not count in the mean.
FEWEST_TRIMMED = 4


@dataclass(frozen=True, eq=False)
class PhotographStatistics:
    """One photograph at reduced size.

    Parameters
    ----------
    image : (rows, columns, 3) float16
        Block means of linear radiance, divided by `scale`.
    scale : float
        Largest value.
    saturated, black : (rows, columns) uint8
        Share, of 255, of the pixels of a block that are saturated (code 0) in a channel.
    sharpness : float
        Variance of the difference of neighbouring pixels over that of pixels two apart, in
        the square root of luminance: 1 for white noise, 1/4 for a slope.
    digest : bytes
        Of the pixels as they are read.
    """

    image: NDArray[np.float16]
    scale: float
    saturated: NDArray[np.uint8]
    black: NDArray[np.uint8]
    sharpness: float
    digest: bytes

    @property
    def luminance(self) -> Float32:
        """Luminance (rows, columns)."""
        return (self.image.astype(np.float32) @ LUMINANCE) * np.float32(self.scale)

    @property
    def colour(self) -> Float32:
        """Radiance (rows, columns, 3)."""
        return self.image.astype(np.float32) * np.float32(self.scale)


@dataclass(frozen=True, eq=False)
class PhotographSet:
    """The photographs of a capture that could be read.

    Parameters
    ----------
    of : dict of int to PhotographStatistics
        By index of the photograph.
    means : dict of int to (rows, columns, 3) float32
        Mean of the photographs of each view, but for the brightest at each pixel; at most
        `MEAN_PIXELS` along a side.
    failures : dict of int to str
        Why a photograph cannot be read.
    """

    of: dict[int, PhotographStatistics]
    means: dict[int, Float32]
    failures: dict[int, str]


def read_photographs(capture: Capture, chosen: Sequence[int]) -> PhotographSet:
    """Decode photographs once each, in all cores.

    Parameters
    ----------
    capture : Capture
    chosen : sequence of int
        Indices of photographs.
    """
    statistics: dict[int, PhotographStatistics] = {}
    failures: dict[int, str] = {}
    sums: dict[int, _Sum] = {}
    for index, outcome in track(_outcomes(capture, chosen), len(chosen), "photographs"):
        if isinstance(outcome, str):
            failures[index] = outcome
            continue
        statistics[index], for_mean = outcome
        sums.setdefault(capture.photographs[index].camera, _Sum()).add(for_mean)
    means = {view: total.mean() for view, total in sums.items()}
    return PhotographSet(statistics, means, failures)


class _Sum:
    """Sum of a view's photographs, and the largest value of each pixel."""

    def __init__(self) -> None:
        self._total: Float32 | None = None
        self._largest: Float32 | None = None
        self._count = 0

    def add(self, image: Float32) -> None:
        """Add one."""
        if self._total is None or self._largest is None:
            self._total, self._largest = image.copy(), image
        else:
            self._total += image
            self._largest = np.maximum(self._largest, image)
        self._count += 1

    def mean(self) -> Float32:
        """Mean, of many photographs without the brightest: one may belong elsewhere."""
        assert self._total is not None
        assert self._largest is not None
        if self._count < FEWEST_TRIMMED:
            return self._total / np.float32(self._count)
        rest = np.maximum(self._total - self._largest, 0)
        return np.asarray(rest / np.float32(self._count - 1))


def _outcomes(
    capture: Capture, chosen: Sequence[int]
) -> Iterator[tuple[int, tuple[PhotographStatistics, Float32] | str]]:
    """What each photograph says, some ahead of who asks; why not, of one that is damaged."""
    n_threads = available_cores()
    with thread_pool(n_threads) as pool:
        for first in range(0, len(chosen), 4 * n_threads):
            some = chosen[first : first + 4 * n_threads]
            yield from zip(some, pool.map(lambda i: _read(capture, i), some), strict=True)


def _read(capture: Capture, index: int) -> tuple[PhotographStatistics, Float32] | str:
    try:
        image, kinds = _decoded(capture, index)
    except InputError as error:
        return str(error)
    kept = reduced(image, KEPT_PIXELS)
    scale = float(kept.max(initial=0.0)) or 1.0
    statistics = PhotographStatistics(
        (np.maximum(kept, 0) / np.float32(scale)).astype(np.float16),
        scale,
        _share(kinds == SATURATED),
        _share((kinds == BLACK) | (kinds == TRANSPARENT)),
        sharpness(image),
        hashlib.sha256(image.tobytes()).digest(),
    )
    return statistics, reduced(image, MEAN_PIXELS)


def _decoded(capture: Capture, index: int) -> tuple[Float32, NDArray[np.uint8]]:
    """Radiance and kinds of values, of a large JPEG at reduced size."""
    photograph = capture.photographs[index]
    if not photograph.is_one_file:
        return capture.read_kinds(index)
    first = photograph.exposures[0]
    image, kinds = read_small_kinds(first.path, first.reading, longest=2 * MEAN_PIXELS)
    return image / np.float32(first.seconds), kinds


def reduced(image: Float32, longest: int) -> Float32:
    """Means over blocks, so that the longer side is at most `longest`; smaller ones as is.

    Examples
    --------
    >>> reduced(np.array([[1, 3], [5, 7]], np.float32), 1)
    array([[4.]], dtype=float32)
    """
    height, width = image.shape[:2]
    factor = longest / max(height, width)
    if factor >= 1:
        return image
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _share(kinds: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Share of the pixels of a block that are of a kind in some channel, of 255, upwards."""
    of_pixels: Float32 = np.asarray(kinds.any(axis=2), np.float32)
    share = reduced(of_pixels, KEPT_PIXELS)
    return np.ceil(255 * share).astype(np.uint8)


def sharpness(image: Float32) -> float:
    r"""Ratio of the variances of differences of pixels one and two apart.

    A blurred image changes twice as much over two pixels as over one, so the ratio of
    variances is near 1/4; it is larger the finer the details are.

    Examples
    --------
    >>> ramp = np.tile(np.linspace(0, 1, 64, dtype=np.float32)[:, None] ** 2, (1, 64))
    >>> round(sharpness(np.dstack([ramp] * 3)), 2)
    0.25
    """
    bright = np.sqrt(np.maximum(image @ LUMINANCE, 0))
    one = np.square(np.diff(bright, axis=0)).sum() + np.square(np.diff(bright, axis=1)).sum()
    two = (
        np.square(bright[2:] - bright[:-2]).sum()
        + np.square(bright[:, 2:] - bright[:, :-2]).sum()
    )
    return float(one / two) if two > 0 else 0.0
