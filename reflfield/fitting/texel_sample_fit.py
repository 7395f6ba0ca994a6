"""The half-vector model fitted to the samples of texels, block by block."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.field.half_vector import (
    DIFFUSE_NODES,
    N_DIFFERENCE,
    SKEW_NODES,
    HalfVectorModel,
    half_angles,
)
from reflfield.field.half_vector_batches import (
    BATCH,
    COSINE,
    LIGHT,
    VIEW,
    diffuse_at,
    empty_batch,
    lobes_into,
    place_batch,
    put_direction,
)
from reflfield.fitting.robust_weights import HUBER, squared_weight
from reflfield.fitting.table_fit import TableRows, fit_tables
from reflfield.observations.texel_samples import TexelSamples
from reflfield.util.cholesky import cholesky_factor, solve_vector
from reflfield.util.single_precision import FAST

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

# Where lobes begin: Gaussians of these widths in the half vector's angle, degrees, and their
# height in units of white for the first.
START_WIDTHS, START_HEIGHT = (12.0, 5.0, 30.0, 20.0), 0.05
# Quantile of a texel's samples over the cosine that its diffuse colour begins with, and the
# least cosine of those samples.
START_QUANTILE, LEAST_START_COSINE = 0.3, 0.2
# Tie of coefficients to their mean and median, in units of weighted squared samples.
TIE = 1e-3
# Rows that tables are fitted to.
TABLE_ROWS = 300_000
# Samples of a texel that are fitted to; of more the others hardly change its few coefficients.
MOST_SAMPLES = 1024
# Odd numbers that scatter those of texels and photographs over 64 bits (splitmix64).
_MIXERS = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)


@dataclass(frozen=True, eq=False)
class SampleBlock:
    """Samples of some texels in units of white, one list for each texel.

    Parameters
    ----------
    texels : (n,) int
    first : (n + 1,) int64
        First sample of each texel.
    view, light : (n_samples,) int16
        Places in `views` and `lights`.
    values : (n_samples, 3) float32
        NaN where not measured.
    views, lights : (n, k, 3) float32
        Unit directions of each texel, world frame.
    camera : (n_samples,) int16
        View of the capture.
    """

    texels: Indices
    first: NDArray[np.int64]
    view: NDArray[np.int16]
    light: NDArray[np.int16]
    values: Floats
    views: Floats
    lights: Floats
    camera: NDArray[np.int16]

    @property
    def n_bytes(self) -> int:
        """Memory."""
        arrays = (self.view, self.light, self.values, self.views, self.lights, self.camera)
        return sum(array.nbytes for array in arrays)

    def light_angles(self) -> Floats:
        """Angle (n_samples,) between view and light of each sample, radians."""
        row = np.repeat(np.arange(len(self.texels)), np.diff(self.first))
        views, lights = self.views[row, self.view], self.lights[row, self.light]
        return np.arccos(np.clip(np.einsum("nd,nd->n", views, lights), -1.0, 1.0))


def sample_block(
    texels: Indices, samples: TexelSamples, reliable: NDArray[np.bool_], white: float
) -> SampleBlock:
    """Samples that count of some texels, of each `MOST_SAMPLES` or little more at most.

    Parameters
    ----------
    texels : (n,) int
        Their numbers.
    samples : TexelSamples
    reliable : (n, n_lights) bool
        Lights that reach the texel and its surroundings.
    white : float
        What 1 stands for, 1/sr.
    """
    pairs, lit = samples.pairs, samples.light_seen & reliable
    t, photograph = np.nonzero(_some(pairs.both(samples.view_seen, lit), texels))
    factor = np.float32(samples.unit / white)
    first = np.searchsorted(t, np.arange(len(texels) + 1)).astype(np.int64)
    view, light = pairs.view[photograph], pairs.light[photograph]
    place = np.arange(len(t)) - first[t]
    n_most = int(place.max(initial=-1)) + 1
    if 2 * n_most < pairs.n_views + pairs.n_lights:
        # Of few photographs of many each sample has directions of its own.
        places, views, lights = (
            (place, place),
            *np.zeros((2, len(texels), n_most, 3), np.float32),
        )
        views[t, place], lights[t, place] = samples.views[t, view], samples.lights[t, light]
    else:
        places, views, lights = (view, light), samples.views, samples.lights
    return SampleBlock(
        texels=texels,
        first=first,
        view=places[0].astype(np.int16),
        light=places[1].astype(np.int16),
        values=samples.samples[t, photograph].astype(np.float32) * factor,
        views=views,
        lights=lights,
        camera=view.astype(np.int16),
    )


def _some(counted: NDArray[np.bool_], texels: Indices) -> NDArray[np.bool_]:
    """Photographs (n, n_photographs) that count, thinned out evenly where they are many.

    Which ones depends on the numbers of texel and photograph alone.
    """
    share = MOST_SAMPLES / np.maximum(counted.sum(axis=1), 1)
    if (share >= 1).all():
        return counted
    of_photograph = np.arange(counted.shape[1], dtype=np.uint64) * np.uint64(_MIXERS[0])
    mixed = (texels.astype(np.uint64) * np.uint64(_MIXERS[1]))[:, None] ^ of_photograph
    mixed = (mixed ^ (mixed >> np.uint64(31))) * np.uint64(_MIXERS[2])
    return counted & ((mixed >> np.uint64(32)) < (share * 2.0**32)[:, None])


@dataclass(frozen=True, eq=False)
class SampleBlocks:
    """Blocks of samples, kept in memory as far as they may.

    Parameters
    ----------
    read : callable
        Block of a number.
    n_blocks : int
    budget : int
        Bytes that may be kept; the others are read again. No result depends on it.
    """

    read: Callable[[int], SampleBlock]
    n_blocks: int
    budget: int
    _kept: dict[int, SampleBlock] = field(default_factory=dict)

    def __getitem__(self, number: int) -> SampleBlock:
        if number in self._kept:
            return self._kept[number]
        block = self.read(number)
        held = sum(kept.n_bytes for kept in list(self._kept.values()))
        if held + block.n_bytes < self.budget:
            self._kept[number] = block
        return block

    def map(
        self, function: Callable[[SampleBlock], Any], pool: ThreadPoolExecutor
    ) -> list[Any]:
        """Result of a function for every block, in their order."""
        return list(pool.map(lambda n: function(self[n]), range(self.n_blocks)))


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def place_samples(
    first: Any, n: Any, row: Any, texel: Any, block: Any, frames: Any, batch: Any
) -> None:
    """Place samples `first` to `first + n` of a block, all of one texel, in the tables."""
    _, view, light, _, views, lights = block
    numbers = batch[0]
    for i in range(n):
        v, w = view[first + i], light[first + i]
        towards = (lights[row, w, 0], lights[row, w, 1], lights[row, w, 2])
        put_direction(numbers, LIGHT + i, frames, texel, towards)
        towards = (views[row, v, 0], views[row, v, 1], views[row, v, 2])
        put_direction(numbers, VIEW + i, frames, texel, towards)
    place_batch(batch)


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _add_channel(
    c: Any, y: Any, texel: Any, base: Any, part: Any, of_texels: Any, system: Any
) -> Any:
    """Add one channel of a sample to normal equations; its weighted squared error."""
    diffuse, weights = of_texels
    normal, right = system
    n_lobes = weights.shape[1]
    shown = diffuse[texel, c] * base
    for k in range(n_lobes):
        shown += weights[texel, k] * part[k, c]
    w = squared_weight(y, shown, HUBER)
    right[c] += w * base * y
    normal[c, c] += w * base * base
    for k in range(n_lobes):
        right[3 + k] += w * part[k, c] * y
        normal[c, 3 + k] += w * base * part[k, c]
        for other in range(k, n_lobes):
            normal[3 + k, 3 + other] += w * part[k, c] * part[other, c]
    return w * (y - shown) ** 2


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _sums_of_texel(
    block: Any, row: Any, texel: Any, model: Any, system: Any, scratch: Any
) -> Any:
    """Normal equations of one texel's coefficients; weighted squares and their number."""
    first, values = block[0], block[3]
    frames, diffuse, weights, lobes, table = model
    batch, part = scratch
    error, count = 0.0, 0
    for begin in range(first[row], first[row + 1], BATCH):
        n = min(BATCH, first[row + 1] - begin)
        place_samples(begin, n, row, texel, block, frames, batch)
        for i in range(n):
            base = batch[0][COSINE + i] * diffuse_at(i, batch, table)
            lobes_into(part, i, batch, lobes)
            for c in range(3):
                y = values[begin + i, c]
                if not np.isnan(y):
                    of_texels = (diffuse, weights)
                    error += _add_channel(c, y, texel, base, part, of_texels, system)
                    count += 1
    return error, count


@numba.njit(cache=True, nogil=True)
def _solve(system: Any, target: Any) -> Any:
    """Solution of a positive system; both are kept."""
    factor, solution = system.copy(), target.copy()
    cholesky_factor(factor, len(factor))
    solve_vector(factor, solution)
    return solution


@numba.njit(cache=True, nogil=True)
def _solve_non_negative(normal: Any, right: Any) -> Any:
    """Minimum of a quadratic over non-negative numbers, by an active set that only grows."""
    n = len(right)
    for x in range(n):
        for y in range(x):
            normal[x, y] = normal[y, x]
        normal[x, x] = normal[x, x] * 1.0001 + 1e-9
    system, target = normal.copy(), right.copy()
    solution = _solve(system, target)
    for _ in range(n):
        if solution.min() >= 0.0:
            break
        for x in range(n):
            if solution[x] < 0.0:
                system[x, :] = 0.0
                system[:, x] = 0.0
                system[x, x] = 1.0
                target[x] = 0.0
        solution = _solve(system, target)
    return np.maximum(solution, 0.0)


@numba.njit(cache=True, nogil=True, fastmath=FAST)
def _solve_texels(
    block: Any, texels: Any, model: Any, centre: Any, tie: float, out: Any
) -> Any:
    """Coefficients (n, 3 + K) of texels; the weighted squared error before, and its count."""
    n_lobes = model[2].shape[1]
    scratch = empty_batch(), np.zeros((n_lobes, 3), np.float32)
    normal, right = np.zeros((3 + n_lobes, 3 + n_lobes)), np.zeros(3 + n_lobes)
    error, count = 0.0, 0
    for row in range(len(texels)):
        normal[:] = 0.0
        right[:] = 0.0
        of_texel = _sums_of_texel(block, row, texels[row], model, (normal, right), scratch)
        error += of_texel[0]
        count += of_texel[1]
        for x in range(len(right)):
            normal[x, x] += tie
            right[x] += tie * centre[x]
        solution = _solve_non_negative(normal, right)
        for x in range(len(right)):
            out[row, x] = solution[x]
    return error, count


def _kernel_block(block: SampleBlock) -> tuple[Any, ...]:
    return block.first, block.view, block.light, block.values, block.views, block.lights


def solve_coefficients(
    blocks: SampleBlocks, model: HalfVectorModel, pool: ThreadPoolExecutor, tie: float = TIE
) -> tuple[HalfVectorModel, float]:
    """Non-negative ridge of the coefficients of every texel of the blocks.

    Parameters
    ----------
    blocks : SampleBlocks
    model : HalfVectorModel
    pool : ThreadPoolExecutor
    tie : float
        To the mean colour and the median weights.

    Returns
    -------
    model : HalfVectorModel
    residual : float
        Root mean square of the weighted residuals before.
    """
    centre = np.concatenate([model.diffuse.mean(axis=0), np.median(model.weights, axis=0)])

    def one(block: SampleBlock) -> tuple[Indices, NDArray[Any], float, int]:
        out = np.zeros((len(block.texels), len(centre)))
        error, count = _solve_texels(
            *(_kernel_block(block), block.texels, model.arrays, centre.astype(np.float64)),
            *(tie, out),
        )
        return block.texels, out, error, count

    of_blocks = blocks.map(one, pool)
    diffuse, weights = model.diffuse.copy(), model.weights.copy()
    for texels, coefficients, _, _ in of_blocks:
        diffuse[texels], weights[texels] = coefficients[:, :3], coefficients[:, 3:]
    error, count = (sum(part[i] for part in of_blocks) for i in (2, 3))
    solved = replace(model, diffuse=diffuse, weights=weights)
    return solved, float(np.sqrt(error / max(count, 1)))


def start_model(frames: Floats, n_lobes: int) -> HalfVectorModel:
    """Model with Gaussian lobes, black diffuse colours and weights of 1."""
    n = len(frames)
    angle = np.degrees(half_angles())
    layers = [
        START_HEIGHT * START_WIDTHS[0] / width * np.exp(-((angle / width) ** 2))
        for width in START_WIDTHS[:n_lobes]
    ]
    lobes = np.stack([np.tile(layer.ravel(), N_DIFFERENCE) for layer in layers])
    return HalfVectorModel(
        frames=np.ascontiguousarray(frames, np.float32),
        diffuse=np.zeros((n, 3), np.float32),
        weights=np.ones((n, n_lobes), np.float32),
        lobes=np.repeat(lobes[..., None], 3, axis=2).astype(np.float32),
        skews=np.zeros((n_lobes, SKEW_NODES, 3), np.float32),
        diffuse_table=np.ones(DIFFUSE_NODES, np.float32),
    )


def with_start_colors(
    blocks: SampleBlocks, model: HalfVectorModel, pool: ThreadPoolExecutor
) -> HalfVectorModel:
    """Model with diffuse colours from a low quantile of the samples over the cosine."""

    def one(block: SampleBlock) -> tuple[Indices, Floats]:
        colors = np.full((len(block.texels), 3), np.nan, np.float32)
        _quantiles(_kernel_block(block), block.texels, model.frames, colors)
        return block.texels, colors

    colors_of_blocks = blocks.map(one, pool)
    diffuse = np.full_like(model.diffuse, np.nan)
    for texels, colors in colors_of_blocks:
        diffuse[texels] = colors
    known = np.isfinite(diffuse)
    usual = float(np.median(diffuse[known])) if known.any() else 0.0
    return replace(model, diffuse=np.where(known, diffuse, np.float32(usual)))


@numba.njit(cache=True, nogil=True)
def _quantiles(block: Any, texels: Any, frames: Any, colors: Any) -> None:
    """Quantile of each channel of each texel's samples over the cosine; few give none."""
    first, _, light, values, _, lights = block
    for row in range(len(texels)):
        normal = frames[texels[row], 2]
        ratios = np.zeros((3, first[row + 1] - first[row]), np.float32)
        n = 0
        for s in range(first[row], first[row + 1]):
            towards = lights[row, light[s]]
            cosine = normal[0] * towards[0] + normal[1] * towards[1] + normal[2] * towards[2]
            total = values[s, 0] + values[s, 1] + values[s, 2]
            if cosine >= LEAST_START_COSINE and not np.isnan(total):
                for c in range(3):
                    ratios[c, n] = values[s, c] / cosine
                n += 1
        if n > 2:
            for c in range(3):
                colors[row, c] = max(_quantile(ratios[c, :n], START_QUANTILE), 0.0)


@numba.njit(cache=True, nogil=True)
def _quantile(values: Any, share: float) -> float:
    """``numpy.quantile``, which takes long to compile."""
    ordered = np.sort(values)
    place = share * (len(ordered) - 1)
    lower = min(int(place), len(ordered) - 2)
    return float(ordered[lower] + (place - lower) * (ordered[lower + 1] - ordered[lower]))


def sample_rows(blocks: SampleBlocks, most: int, seed: int) -> TableRows:
    """Rows for the fit of tables: at most about so many samples, drawn at random."""
    total = sum(blocks.map(lambda block: len(block.view), ThreadPoolExecutor(1)))
    share = min(1.0, most / max(total, 1))
    parts = list(_drawn(blocks, share, np.random.default_rng(seed)))
    texel, views, lights, values = (
        np.concatenate(arrays) for arrays in zip(*parts, strict=True)
    )
    n = len(texel)
    return TableRows(
        first=np.arange(n + 1),
        texel=texel.astype(np.int32),
        share=np.ones(n, np.float32),
        views=views,
        lights=lights,
        values=values,
        at_least=np.zeros(values.shape, np.bool_),
    )


def _drawn(
    blocks: SampleBlocks, share: float, rng: np.random.Generator
) -> Iterator[tuple[Indices, Floats, Floats, Floats]]:
    for number in range(blocks.n_blocks):
        block = blocks[number]
        chosen = np.flatnonzero(rng.random(len(block.view)) < share)
        row = np.searchsorted(block.first, chosen, side="right") - 1
        yield (
            block.texels[row],
            block.views[row, block.view[chosen]],
            block.lights[row, block.light[chosen]],
            block.values[chosen],
        )


def fit_to_samples(
    blocks: SampleBlocks,
    model: HalfVectorModel,
    pool: ThreadPoolExecutor,
    rounds: int,
    smoothness: float,
    seed: int = 0,
    most_rows: int = TABLE_ROWS,
) -> tuple[HalfVectorModel, Sequence[float]]:
    """Rounds of tables and coefficients.

    Parameters
    ----------
    blocks : SampleBlocks
    model : HalfVectorModel
        Where the rounds begin.
    pool : ThreadPoolExecutor
    rounds : int
    smoothness : float
        Of the lobes.
    seed : int
        Of the samples that are drawn.
    most_rows : int
        Samples that the tables are fitted to, about.

    Returns
    -------
    model : HalfVectorModel
    residuals : sequence of float
        Weighted, before the coefficients of each round.
    """
    rows = sample_rows(blocks, most_rows, seed)
    residuals = []
    for _ in range(rounds):
        model = fit_tables(rows, model, pool, smoothness)
        model, residual = solve_coefficients(blocks, model, pool)
        residuals.append(residual)
    return model, residuals
