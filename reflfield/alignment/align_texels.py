"""Local frames of all texels from their samples: the public entry."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.alignment.alignment_model import AlignmentModel, BlockFrames
from reflfield.alignment.model_fit import FitOptions, fit_model
from reflfield.alignment.refinement import RefinementOptions
from reflfield.alignment.sample_sources import (
    GriddedSamples,
    SampleSource,
    ScatteredSource,
    blocks_of,
)
from reflfield.errors import InputError, ShapeError
from reflfield.sphere.coupling import Coupled
from reflfield.sphere.harmonics import check_band_limit
from reflfield.util.blas_threads import one_core_blas
from reflfield.util.progress import track


@dataclass(frozen=True, eq=False)
class Alignment:
    """One local frame per texel, and how well it is determined.

    Parameters
    ----------
    local_from_base : (n, 3, 3) float64
        Rows tangent, binormal, normal of the texel in base coordinates. The identity for texels
        without a usable sample.
    cluster : (n,) int32
        Material that fits best; 0 .. n_clusters - 1.
    score : (n,) float64
        Normalised correlation with the cluster's target, -1 .. 1; 0 where nothing is observed.
    margin : (n,) float64
        Score gap to the best rotation at least 15 degrees away. Near 0: the frame is not
        determined (an isotropic lobe, a constant). Where only the samples tell the in-plane
        angle, the gap to the best other angle, on the samples.
    history : (k,) float64
        Accumulated correlation of the training texels per iteration, over the largest
        possible. Never falls.
    targets : Coupled
        Unit target of each cluster, in the local frame.
    symmetries : tuple of str
        Rotations about the normal that leave each target unchanged: "none", "half", "all".
    """

    local_from_base: NDArray[np.float64]
    cluster: NDArray[np.int32]
    score: NDArray[np.float64]
    margin: NDArray[np.float64]
    history: NDArray[np.float64]
    targets: Coupled
    symmetries: tuple[str, ...]


def align(
    samples: ArrayLike | SampleSource,
    views: ArrayLike,
    lights: ArrayLike,
    band_limit: int | tuple[int, int] = 8,
    iterations: int = 4,
    n_clusters: int = 1,
    *,
    raw: ScatteredSource | None = None,
    refine: bool | RefinementOptions = True,
    seed: int = 0,
    max_tilt: float | None = None,
    n_threads: int = 1,
) -> Alignment:
    """Find one local frame per texel from its reflectance alone.

    Parameters
    ----------
    samples : (n, n_views, n_lights) array_like or SampleSource
        Apparent BRDFs, any scale, not finite where unobserved. A source has ``shape`` and
        ``read(rows)``; its texels are read in blocks.
    views, lights : (n_views, 3), (n_lights, 3) array_like
        Unit vectors in the texels' base frames, z up. Directions with z <= 0 are not used.
    band_limit : int or (int, int)
        Degrees below it are used, for views and lights alike or each its own. A
        direction that does not vary (one view, one light) has 1 in any case.
    iterations : int
        Rounds of expectation maximisation at most; at least 1.
    n_clusters : int
        Materials to tell apart.
    raw : ScatteredSource, optional
        Samples of the same texels, each at its own directions, where `samples` were completed
        from them: frames are refined, and materials told apart, on these. Without it, on
        `samples`.
    refine : bool or RefinementOptions
        True: refine the frames on the samples themselves after the harmonic search, with the
        default options; or the options to refine with. False: frames and materials of the
        harmonic search.
    seed : int
        Of the seeding and of the choice of training texels.
    max_tilt : float, optional
        Largest tilt of a normal from its base normal, radians. None: any.
    n_threads : int
        Blocks worked on at once. The result does not depend on it.

    Returns
    -------
    Alignment

    Raises
    ------
    ShapeError
        If shapes do not fit together.
    InputError
        If directions are not unit vectors, an option is out of range, or the band limit is
        higher than the directions support (the message says which is safe).

    Notes
    -----
    Targets are found on at most 2,048 texels drawn at random (256 a cluster, if that is
    more), whose coefficients stay in memory, and refined on those that the options ask for;
    all texels are then read, searched and refined once, block by block. Memory does not depend
    on n.

    Examples
    --------
    >>> from reflfield.sphere.hemisphere import HemisphereGrid
    >>> directions = HemisphereGrid(7).directions[8:-8]
    >>> lobe = np.exp(-8 * (1 - directions @ directions.T)).astype(np.float32)
    >>> result = align(lobe[None], directions, directions, band_limit=4, refine=False)
    >>> result.local_from_base.shape, result.cluster
    ((1, 3, 3), array([0], dtype=int32))
    """
    gridded = GriddedSamples.checked(samples, views, lights)
    scattered = gridded if raw is None else raw
    options = checked_options(
        gridded,
        FitOptions(
            _limits(band_limit),
            iterations,
            n_clusters,
            RefinementOptions() if refine is True else refine or None,
            seed,
            max_tilt,
            n_threads,
        ),
    )
    n = gridded.shape[0]
    if scattered.shape[0] != n:
        raise ShapeError(
            f"raw: expected {n} texels like samples, received {scattered.shape[0]}"
        )
    with one_core_blas():
        model = fit_model(gridded, scattered, options)
        blocks = blocks_of(gridded.shape, np.arange(n))
        frames = BlockFrames.joined(
            [
                frames_of(model, gridded, scattered, rows, n_threads)
                for rows in track(blocks, len(blocks), "frames of all texels")
            ]
        )
    return Alignment(
        frames.local_from_base,
        frames.cluster,
        frames.score,
        frames.margin,
        history=model.history,
        targets=model.targets,
        symmetries=tuple(symmetry.kind for symmetry in model.symmetries),
    )


def frames_of(
    model: AlignmentModel,
    gridded: GriddedSamples,
    raw: ScatteredSource,
    rows: NDArray[np.int64],
    n_threads: int = 1,
) -> BlockFrames:
    """Frames of some texels by a fitted model, which depend on no other texel.

    Parameters
    ----------
    model : AlignmentModel
    gridded, raw
        As in `fit_model`.
    rows : (k,) int64
        Ascending. They are read some at a time.
    n_threads : int

    Returns
    -------
    BlockFrames
    """
    parts = []
    for some in blocks_of(gridded.shape, rows):
        own = gridded.read(some)
        same = raw is gridded or model.sharp is None
        parts.append(model.frames(own, own if same else raw.read(some), n_threads))
    return BlockFrames.joined(parts)


def _limits(band_limit: int | tuple[int, int]) -> tuple[int, int]:
    limits = tuple(band_limit) if isinstance(band_limit, tuple) else (band_limit, band_limit)
    if len(limits) != 2:
        raise InputError(f"band_limit: expected one or two integers, received {band_limit}")
    for limit in limits:
        check_band_limit("band_limit", limit)
    return limits[0], limits[1]


def checked_options(gridded: GriddedSamples, options: FitOptions) -> FitOptions:
    """Options within their ranges; the band limit of a direction that does not vary is 1.

    Raises
    ------
    InputError
        If one is out of range.
    """
    for name in ("iterations", "n_clusters", "n_threads"):
        if getattr(options, name) < 1:
            raise InputError(f"{name}: expected at least 1, received {getattr(options, name)}")
    max_tilt = options.max_tilt
    if max_tilt is not None and not 0.0 < max_tilt <= np.pi:
        raise InputError(f"max_tilt: expected radians in (0, pi], received {max_tilt}")
    counts = (len(gridded.views), len(gridded.lights))
    view, light = (
        1 if n == 1 else limit for n, limit in zip(counts, options.band_limits, strict=True)
    )
    return replace(options, band_limits=(view, light))
