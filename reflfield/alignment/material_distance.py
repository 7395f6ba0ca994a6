r"""Distance of texels to sharp targets, and residuals that tell materials apart.

The distance is that of Eq. 12 of Müller, Sarlette and Klein (Eurographics 2006) on the
observed samples: with :math:`y` the samples of a texel and :math:`m_k` the target of cluster k
at its sample directions in its frame,

.. math::

    e_k = 1 - \frac{(\sum w\, y\, m_k)^2}{\sum w\, y^2\, \sum w\, m_k^2},
    \qquad w = 1 / (\mathrm{floor} + |y|) .
"""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.refinement import BLOCK, SharpAlignment
from reflfield.alignment.rotation_search import map_blocks
from reflfield.alignment.sample_sources import SampleSet
from reflfield.alignment.spline_targets import (
    Placement,
    Texels,
    empty_placement,
    expect,
    place_texel,
    scatter_row,
    scatter_view,
)

# Nodes along each side of the grids on which residuals are compared.
RESIDUAL_SIDE = 9
# Distance that is no evidence of a wrong material: 2 % of noise, or frames not yet exact.
NOISE_DISTANCE = 4e-4


@numba.njit(cache=True, nogil=True)
def _moments(
    samples: NDArray[np.float32], expected: NDArray[np.float32], floor: float
) -> tuple[float, float, float]:
    """Weighted sums of y y, y m and m m over the observed samples above both horizons."""
    yy, ym, mm = 0.0, 0.0, 0.0
    for v in range(samples.shape[0]):
        for k in range(samples.shape[1]):
            y, m = float(samples[v, k]), float(expected[v, k])
            if np.isfinite(y) and np.isfinite(m):
                weight = 1.0 / (floor + abs(y))
                yy += weight * y * y
                ym += weight * y * m
                mm += weight * m * m
    return yy, ym, mm


@numba.njit(cache=True, nogil=True)
def _distances(texels: Texels, targets: NDArray[np.float32], out: NDArray[np.float64]) -> None:
    """Distance of each texel to each target; 1 where either is zero."""
    n_views, n_lights = texels.samples.shape[1:]
    views = empty_placement(n_views, texels.sides[0])
    lights = empty_placement(n_lights, texels.sides[1])
    line = np.zeros(targets.shape[2], np.float32)
    expected = np.zeros((n_views, n_lights), np.float32)
    for i in range(texels.samples.shape[0]):
        out[i] = 1.0
        floor = texels.floor * texels.brightness[i]
        if floor <= 0.0:
            continue
        place_texel(texels, i, views, lights)
        for k in range(targets.shape[0]):
            expect(targets[k], views, lights, line, expected)
            yy, ym, mm = _moments(texels.samples[i], expected, floor)
            if ym > 0.0:
                out[i, k] = max(1.0 - (ym / yy) * (ym / mm), 0.0)


@numba.njit(cache=True, nogil=True)
def _scatter_residual(
    samples: NDArray[np.float32],
    expected: NDArray[np.float32],
    scale_and_floor: tuple[float, float],
    placements: tuple[Placement, Placement],
    sums: NDArray[np.float64],
) -> None:
    """Weighted residuals (first) and weights (second) of one texel on the nodes."""
    scale, floor = scale_and_floor
    views, lights = placements
    rows = np.zeros((2, samples.shape[1]), np.float32)
    line = np.zeros(sums.shape[2], np.float32)
    sums[:] = 0.0
    for v in range(samples.shape[0]):
        if views.first[v] < 0:
            continue
        for k in range(samples.shape[1]):
            rest = samples[v, k] - scale * expected[v, k]
            # Unobserved samples are infinite or NaN; so is the residual.
            weight = 1.0 / (floor + abs(samples[v, k])) if np.isfinite(rest) else np.nan
            rows[0, k], rows[1, k] = weight * rest, weight
        for n in range(2):
            scatter_row(rows[n], lights, line)
            scatter_view(line, views, v, sums[n])


@numba.njit(cache=True, nogil=True)
def _features(
    texels: Texels,
    targets: NDArray[np.float32],
    cluster: NDArray[np.int32],
    distance: NDArray[np.float64],
    out: NDArray[np.float32],
) -> None:
    """Distance to the own target, and the residual on coarse nodes, a part of it."""
    n_views, n_lights = texels.samples.shape[1:]
    sides = (min(RESIDUAL_SIDE, texels.sides[0]), min(RESIDUAL_SIDE, texels.sides[1]))
    fine = (
        empty_placement(n_views, texels.sides[0]),
        empty_placement(n_lights, texels.sides[1]),
    )
    coarse = (empty_placement(n_views, sides[0]), empty_placement(n_lights, sides[1]))
    line = np.zeros(targets.shape[2], np.float32)
    expected = np.zeros((n_views, n_lights), np.float32)
    sums = np.zeros((2, sides[0] ** 2, sides[1] ** 2))
    for i in range(texels.samples.shape[0]):
        distance[i] = 1.0
        floor = texels.floor * texels.brightness[i]
        if floor <= 0.0:
            continue
        place_texel(texels, i, *fine)
        expect(targets[cluster[i]], *fine, line, expected)
        yy, ym, mm = _moments(texels.samples[i], expected, floor)
        if not ym > 0.0:
            continue
        distance[i] = max(1.0 - (ym / yy) * (ym / mm), 0.0)
        place_texel(texels, i, *coarse)
        _scatter_residual(texels.samples[i], expected, (ym / mm, floor), coarse, sums)
        for a in range(sums.shape[1]):
            for b in range(sums.shape[2]):
                weight = sums[1, a, b]
                if weight > 0.0:
                    out[i, a * sums.shape[2] + b] = sums[0, a, b] / np.sqrt(weight * yy)


def distances(
    data: SampleSet, state: SharpAlignment, floor: float, n_threads: int
) -> NDArray[np.float64]:
    """Distance of each texel to each target in its present frame.

    Parameters
    ----------
    data : SampleSet
        n texels.
    state : SharpAlignment
    floor : float
        See `RefinementOptions`.
    n_threads : int

    Returns
    -------
    (n, n_targets) float64
        0 .. 1; 1 where nothing is observed or the target is zero.
    """
    measured = replace(state, brightness=data.brightness())

    def block(rows: slice) -> NDArray[np.float64]:
        texels = measured.texels(data, np.arange(rows.start, rows.stop), floor)
        out = np.zeros((len(texels.samples), len(state.targets.values)))
        _distances(texels, state.targets.values, out)
        return out

    return np.concatenate(map_blocks(block, len(state.frames), BLOCK, n_threads))


def own_distance(
    data: SampleSet, state: SharpAlignment, floor: float, n_threads: int
) -> NDArray[np.float64]:
    """Distance of each texel to its own target, (n,); parameters as `distances`."""
    out = np.zeros(len(state.frames))
    for k in np.unique(state.cluster):
        mine = np.flatnonzero(state.cluster == k)
        one = replace(state.part(mine), targets=state.targets.of_cluster(k))
        out[mine] = distances(data.part(mine), one, floor, n_threads)[:, 0]
    return out


def residual_features(
    data: SampleSet, state: SharpAlignment, floor: float, n_threads: int
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """How far each texel is from its own target, and in which way.

    Parameters
    ----------
    data : SampleSet
        n texels.
    state : SharpAlignment
    floor : float
        See `RefinementOptions`.
    n_threads : int

    Returns
    -------
    distance : (n,) float64
        See `distances`.
    features : (n, n_nodes) float32
        Residual on coarse nodes of the texel's frame; the squares add up to the part of the
        distance that the nodes resolve.
    """
    measured = replace(state, brightness=data.brightness())
    n_nodes = [min(RESIDUAL_SIDE, side) ** 2 for side in state.targets.sides]
    distance = np.zeros(len(state.frames))
    features = np.zeros((len(distance), n_nodes[0] * n_nodes[1]), np.float32)

    def block(rows: slice) -> None:
        texels = measured.texels(data, np.arange(rows.start, rows.stop), floor)
        cluster = state.cluster[rows]
        _features(texels, state.targets.values, cluster, distance[rows], features[rows])

    map_blocks(block, len(distance), BLOCK, n_threads)
    return distance, features


def log_improvement(
    before: NDArray[np.float64], after: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Fall of the log distance of each texel: rough fits and close ones count alike."""
    return np.log((before + NOISE_DISTANCE) / (after + NOISE_DISTANCE))
