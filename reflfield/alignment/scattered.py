"""Frames refined on raw samples, where each texel has its own directions.

The harmonic search works on completed samples on common directions, which hold what
many texels have in common; what tells a texel's frame to a degree is in its own samples. They
are few on sparse rigs, so the turn away from the harmonic frame has a Gaussian prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.frame_ambiguity import mean_rotation
from reflfield.alignment.refinement import (
    RefinementOptions,
    SampleSet,
    improve_frames,
    refine_targets,
)
from reflfield.alignment.splines import NodeTargets
from reflfield.util.progress import track
from reflfield.util.validation import check_shape

Array = NDArray[np.float64]

# Samples that a pair of nodes of the target should have on average.
SAMPLES_PER_PAIR = 64
SMALLEST_SIDE = 5
# Samples kept for the targets, and of the texels whose frames are improved together.
TARGET_BYTES = 256 * 2**20
BLOCK_BYTES = 64 * 2**20


class ScatteredSource(Protocol):
    """Samples of texels, each at its own directions, read block by block."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """(n_texels, n_views, n_lights)."""

    def read(self, rows: NDArray[np.int64]) -> SampleSet:
        """Samples of some texels, rows ascending."""


def refine_scattered(
    source: ScatteredSource,
    local_from_base: Array,
    cluster: NDArray[np.int32],
    options: RefinementOptions,
    *,
    seed: int = 0,
    n_threads: int = 1,
) -> Array:
    """Refine frames of the harmonic search on raw samples.

    Parameters
    ----------
    source : ScatteredSource
        n texels.
    local_from_base : (n, 3, 3) float64
        Frames of the search.
    cluster : (n,) int32
        Target of each texel.
    options : RefinementOptions
        ``side`` is the largest that is used; see Notes.
    seed : int
        Chooses the texels that the targets are fitted to.
    n_threads : int
        The result does not depend on it.

    Returns
    -------
    (n, 3, 3) float64
        Frames in the gauge of those given: on average over each cluster they are not turned.

    Raises
    ------
    ShapeError
        If there is not one frame and one cluster for each texel.

    Notes
    -----
    The targets' grids are no finer than gives each pair of nodes `SAMPLES_PER_PAIR` samples.
    Brightness is free for each texel, its scale in the file does not matter.
    """
    n = source.shape[0]
    check_shape("local_from_base", local_from_base, (n, 3, 3))
    check_shape("cluster", cluster, (n,))
    frames = np.ascontiguousarray(local_from_base, np.float64)
    sharp = sharp_targets(source, frames, cluster, options, seed=seed, n_threads=n_threads)
    step = _texels_in(BLOCK_BYTES, source)
    blocks = [np.arange(first, min(first + step, n)) for first in range(0, n, step)]
    parts = [
        improved_block(source.read(rows), frames[rows], cluster[rows], sharp, n_threads)
        for rows in track(blocks, len(blocks), "frames on the samples")
    ]
    return in_gauge_of(frames, np.concatenate(parts), cluster)


@dataclass(frozen=True, eq=False)
class SharpTargets:
    """Targets that frames are refined against, and how.

    Parameters
    ----------
    targets : NodeTargets
    options : RefinementOptions
        ``side`` is that of the targets.
    """

    targets: NodeTargets
    options: RefinementOptions


def improved_block(
    data: SampleSet,
    frames: Array,
    cluster: NDArray[np.int32],
    sharp: SharpTargets,
    n_threads: int = 1,
) -> Array:
    """Frames of some texels, improved on their samples; parameters as `refine_scattered`."""
    improved = frames.copy()
    data = _of_unit_size(data)
    improve_frames(
        data,
        improved,
        data.brightness(),
        cluster,
        sharp.targets,
        sharp.options,
        sharp.options.last_steps,
        n_threads,
    )
    return improved


def sharp_targets(
    source: ScatteredSource,
    frames: Array,
    cluster: NDArray[np.int32],
    options: RefinementOptions,
    *,
    seed: int = 0,
    n_threads: int = 1,
) -> SharpTargets:
    """Sharp targets fitted to some texels, with the side that their samples allow.

    Parameters as `refine_scattered`.
    """
    n_clusters = int(cluster.max(initial=0)) + 1
    n = source.shape[0]
    most = min(options.texels_per_cluster * n_clusters, _texels_in(TARGET_BYTES, source), n)
    some = np.sort(np.random.default_rng(seed).choice(n, most, replace=False))
    data = _of_unit_size(source.read(some))
    used = replace(options, side=min(options.side, supported_side(data, n_clusters)))
    targets, _ = refine_targets(data, frames[some], cluster[some], n_clusters, used, n_threads)
    return SharpTargets(targets, used)


def _texels_in(size: int, source: ScatteredSource) -> int:
    """Texels whose samples and directions take so many bytes."""
    n_views, n_lights = source.shape[1:]
    return max(1, size // (4 * n_views * n_lights + 24 * (n_views + n_lights)))


def supported_side(data: SampleSet, n_clusters: int = 1) -> int:
    """Side of the grids whose pairs of nodes have `SAMPLES_PER_PAIR` samples on average.

    Examples
    --------
    Ten thousand samples of 40 views under one light: 12 x 12 nodes.

    >>> views = np.tile([0.0, 0.0, 1.0], (250, 40, 1))
    >>> supported_side(SampleSet(np.ones((250, 40, 1), np.float32), views, views[:, :1]))
    12
    """
    varying = sum(count > 1 for count in data.samples.shape[1:])
    pairs = np.isfinite(data.samples).sum() / n_clusters / SAMPLES_PER_PAIR
    return max(SMALLEST_SIDE, int(pairs ** (0.5 / max(varying, 1))))


def _of_unit_size(data: SampleSet) -> SampleSet:
    """Samples over the largest of each texel: float32 holds any scale; NaN if not finite."""
    observed = np.where(np.isfinite(data.samples), data.samples, np.nan)
    size = np.nanmax(np.abs(observed), axis=(1, 2), initial=0.0, keepdims=True)
    samples = observed / np.where(size > 0, size, 1)
    return replace(data, samples=samples.astype(np.float32))


def in_gauge_of(starts: Array, frames: Array, cluster: NDArray[np.int32]) -> Array:
    """Undo the mean turn of each cluster from its frames before."""
    result = frames.copy()
    for k in np.unique(cluster):
        mine = cluster == k
        turns = frames[mine] @ np.swapaxes(starts[mine], 1, 2)
        result[mine] = mean_rotation(turns, np.ones(len(turns))).T @ frames[mine]
    return result
