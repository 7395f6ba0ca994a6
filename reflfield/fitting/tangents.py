r"""Tangents from the shape of highlights.

What the model leaves of a texel's samples is fitted by the strongest lobe times
:math:`u\,(\cos 2\phi, \sin 2\phi)`, :math:`\phi` the azimuth of the half vector and
:math:`u = q / (q + .02)`, :math:`q = \sin^2\theta_h`. The two numbers are a symmetric tensor on
the tangent plane, which is summed over neighbours; its long axis becomes the tangent.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array

from reflfield.field.half_vector import HalfVectorModel
from reflfield.field.half_vector_batches import (
    BATCH,
    COSINE,
    LIGHT,
    VIEW,
    diffuse_at,
    empty_batch,
    lobes_into,
)
from reflfield.fitting.robust_weights import HUBER, squared_weight
from reflfield.fitting.texel_graph import TexelGraph
from reflfield.fitting.texel_sample_fit import (
    Indices,
    SampleBlock,
    SampleBlocks,
    place_samples,
)
from reflfield.util.single_precision import FAST

Floats = NDArray[np.float32]

# Square of the sine of the half vector's angle at which a lobe's azimuth counts by half.
FULL_AZIMUTH = np.float32(0.02)
# Times that the tensors are summed over neighbours.
SMOOTHING = 6
# Of the mean information, what a texel has at least: keeps tensors of unlit texels finite.
LEAST_INFORMATION = 1e-6


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _azimuth(i: Any, batch: Any) -> Any:
    """Cosine and sine, times u, of twice the azimuth of the half vector of pair i."""
    numbers = batch[0]
    x = numbers[LIGHT + i] + numbers[VIEW + i]
    y = numbers[LIGHT + BATCH + i] + numbers[VIEW + BATCH + i]
    z = numbers[LIGHT + 2 * BATCH + i] + numbers[VIEW + 2 * BATCH + i]
    square = x * x + y * y + z * z
    sine2 = (x * x + y * y) / square + np.float32(1e-9)
    scale = np.float32(1.0) / (square * (sine2 + FULL_AZIMUTH))
    return (x * x - y * y) * scale, np.float32(2.0) * x * y * scale


@numba.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _add_sample(
    row: Any, t: Any, value: Any, c: Any, base: Any, lobes: Any, of_model: Any, out: Any
) -> None:
    """Add one channel of a sample; `lobes` are what it shows of each, and the azimuth."""
    part, (cos2, sin2) = lobes
    diffuse, weights, best = of_model
    shown = diffuse[t, c] * base
    for k in range(weights.shape[1]):
        shown += weights[t, k] * part[k, c]
    lobe = weights[t, best] * part[best, c]
    factor = squared_weight(value, shown, HUBER) * lobe
    out[row, 0] += factor * lobe * cos2 * cos2
    out[row, 1] += factor * lobe * cos2 * sin2
    out[row, 2] += factor * lobe * sin2 * sin2
    out[row, 3] += factor * cos2 * (value - shown)
    out[row, 4] += factor * sin2 * (value - shown)


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _moments(block: Any, texels: Any, model: Any, best: int, out: Any) -> None:
    """Normal equations (3 of the matrix, 2 of the right side) of each texel's two numbers."""
    first, values = block[0], block[3]
    frames, diffuse, weights, lobes, table = model
    batch, part = empty_batch(), np.zeros((weights.shape[1], 3), np.float32)
    of_model = (diffuse, weights, best)
    for row in range(len(texels)):
        t = texels[row]
        for begin in range(first[row], first[row + 1], BATCH):
            n = min(BATCH, first[row + 1] - begin)
            place_samples(begin, n, row, t, block, frames, batch)
            for i in range(n):
                base = batch[0][COSINE + i] * diffuse_at(i, batch, table)
                lobes_into(part, i, batch, lobes)
                shown = (part, _azimuth(i, batch))
                for c in range(3):
                    value = values[begin + i, c]
                    if not np.isnan(value):
                        _add_sample(row, t, value, c, base, shown, of_model, out)


def with_tangents_along_highlights(
    blocks: SampleBlocks,
    model: HalfVectorModel,
    graph: TexelGraph,
    pool: ThreadPoolExecutor,
    smoothing: int = SMOOTHING,
) -> HalfVectorModel:
    """Model whose frames are turned about their normals, so that x is the long axis.

    Parameters
    ----------
    blocks : SampleBlocks
    model : HalfVectorModel
    graph : TexelGraph
    pool : ThreadPoolExecutor
    smoothing : int
        Times that the tensors are summed over neighbours; 0 where every texel has a tangent
        of its own.

    Returns
    -------
    HalfVectorModel
    """
    strength = model.weights.mean(axis=0) * model.lobes.max(axis=(1, 2))
    best = int(np.argmax(strength))

    def one(block: SampleBlock) -> tuple[Indices, NDArray[np.float64]]:
        out = np.zeros((len(block.texels), 5))
        kernel = (block.first, block.view, block.light, block.values, block.views, block.lights)
        _moments(kernel, block.texels, model.arrays, best, out)
        return block.texels, out

    moments = np.zeros((model.n_texels, 5))
    for texels, part in blocks.map(one, pool):
        moments[texels] = part
    return replace(model, frames=turned_to_long_axes(model.frames, moments, graph, smoothing))


def turned_to_long_axes(
    frames: Floats, moments: NDArray[np.float64], graph: TexelGraph, smoothing: int
) -> Floats:
    """Frames (n, 3, 3) with the tangent along the long axis of the tensors of `_moments`."""
    x, y = frames[:, 0].astype(np.float64), frames[:, 1].astype(np.float64)
    along = x[:, :, None] * x[:, None] - y[:, :, None] * y[:, None]
    across = x[:, :, None] * y[:, None] + y[:, :, None] * x[:, None]
    tensor = moments[:, 3, None, None] * along + moments[:, 4, None, None] * across
    summed = np.concatenate(
        [tensor.reshape(-1, 9), 0.5 * (moments[:, [0]] + moments[:, [2]])], axis=1
    )
    around = csr_array(eye_array(graph.n_texels) + graph.adjacency)
    for _ in range(smoothing):
        summed = around @ summed
        summed /= max(float(summed[:, 9].max()), np.finfo(np.float64).tiny)
    information = np.maximum(summed[:, 9], LEAST_INFORMATION * summed[:, 9].mean())
    tensor = summed[:, :9].reshape(-1, 3, 3) / np.maximum(information, 1e-300)[:, None, None]
    cos2 = np.einsum("ni,nij,nj->n", x, tensor, x) - np.einsum("ni,nij,nj->n", y, tensor, y)
    sin2 = 2.0 * np.einsum("ni,nij,nj->n", x, tensor, y)
    angle = 0.5 * np.arctan2(sin2, cos2)[:, None]
    tangent = np.cos(angle) * x + np.sin(angle) * y
    normal = frames[:, 2].astype(np.float64)
    return np.stack([tangent, np.cross(normal, tangent), normal], axis=1).astype(np.float32)
