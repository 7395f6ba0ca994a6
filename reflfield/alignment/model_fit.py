"""Fit of an alignment model: correlation, EM, materials, refinement, in this order."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from reflfield.alignment.alignment_model import (
    IMPUTATIONS,
    AlignmentModel,
    HarmonicTargets,
    Projection,
    SampleTargets,
)
from reflfield.alignment.expectation_maximisation import fit_targets, mean_targets
from reflfield.alignment.frame_ambiguity import (
    in_plane_undetermined,
    mean_rotation,
    resolve_ambiguity,
    rotate_targets,
)
from reflfield.alignment.horizon_imputation import Horizon, impute_targets
from reflfield.alignment.in_plane_rotation import find_angles, improve_with_angles
from reflfield.alignment.material_clusters import choose, tell_apart
from reflfield.alignment.refinement import (
    RefinementOptions,
    SharpAlignment,
    improve_frames,
    refine,
)
from reflfield.alignment.rotation_search import SearchResult
from reflfield.alignment.sample_sources import (
    GriddedSamples,
    SampleSet,
    ScatteredSource,
    blocks_of,
    bytes_per_texel,
    mean_samples,
)
from reflfield.alignment.spline_targets import SplineTargets
from reflfield.sphere.coupling import Coupled, join_coupled
from reflfield.sphere.harmonic_projection import Projector
from reflfield.sphere.rotations import rotation_angle
from reflfield.util.blas_threads import one_core_blas

# Texels whose coefficients are kept for the iterations: enough that their mean
# has converged far below the error of one frame.
TRAINING_TEXELS = 2048
TRAINING_TEXELS_PER_CLUSTER = 256
TRAINING_BYTES = 256 * 2**20
LEAST_TRAINING_TEXELS = 256
# Samples kept for the sharp targets.
REFINING_BYTES = 256 * 2**20
LEAST_REFINING_TEXELS = 64
# The axis of symmetry on the samples lies this near to that of the band-limited target, or the
# refinement has gone astray.
LARGEST_AXIS_CORRECTION = np.deg2rad(2.0)


@dataclass(frozen=True)
class FitOptions:
    """How a model is fitted; entries as in `align`."""

    band_limits: tuple[int, int]
    iterations: int
    n_clusters: int
    refinement: RefinementOptions | None
    seed: int
    max_tilt: float | None
    n_threads: int


def fit_model(
    gridded: GriddedSamples, raw: ScatteredSource, options: FitOptions
) -> AlignmentModel:
    """Targets of all clusters from some of the texels.

    Parameters
    ----------
    gridded : GriddedSamples
        Samples on common directions, complete or not: what is correlated.
    raw : ScatteredSource
        Samples of the same texels that frames are refined and materials told apart on;
        `gridded` itself where there are no others.
    options : FitOptions

    Returns
    -------
    AlignmentModel
    """
    with one_core_blas():
        return _fitted(gridded, raw, options, np.random.default_rng(options.seed))


def _fitted(
    gridded: GriddedSamples,
    raw: ScatteredSource,
    options: FitOptions,
    rng: np.random.Generator,
) -> AlignmentModel:
    """All steps of the fit, in their order."""
    # Keep the coefficients of some texels.
    rows = _training_rows(gridded.shape[0], options, rng)
    prior = mean_samples(gridded, rows)
    projector = Projector(gridded.views, gridded.lights, options.band_limits)
    fit = _Fit(gridded, Projection(projector, prior, options.max_tilt), options, rng)
    # Targets and frames by correlation. Samples tell materials apart better than harmonics.
    n_targets = 1 if options.refinement else options.n_clusters
    harmonic, _, history = fit.harmonic(fit.coupled(rows), n_targets)
    if options.refinement is None:
        return AlignmentModel(fit.projection, harmonic, None, harmonic.imputed, history)
    # Samples of some texels, with their coefficients and frames.
    view = fit.refining_texels(raw, options.refinement, harmonic)
    # Materials told apart on the samples, then each material by itself.
    if options.n_clusters > 1:
        harmonic, view = fit.divided(view)
    # Sharp targets, and which of their equivalent frames are meant.
    state, in_plane = fit.refined(view, harmonic)
    sharp, targets = fit.resolved(view, state, in_plane)
    return AlignmentModel(fit.projection, harmonic, sharp, targets, history)


def _training_rows(n: int, options: FitOptions, rng: np.random.Generator) -> NDArray[np.int64]:
    """Texels that take part in finding the targets, ascending."""
    size = 4 * options.band_limits[0] ** 2 * options.band_limits[1] ** 2
    wanted = max(TRAINING_TEXELS, TRAINING_TEXELS_PER_CLUSTER * options.n_clusters)
    most = min(n, wanted, max(TRAINING_BYTES // size, LEAST_TRAINING_TEXELS))
    return np.sort(rng.choice(n, most, replace=False)) if most < n else np.arange(n)


@dataclass(frozen=True, eq=False)
class _RefiningTexels:
    """The texels that the sharp targets are fitted to.

    Parameters
    ----------
    data : SampleSet
        Normalised.
    coupled : Coupled
        Their coefficients.
    result : SearchResult
        Their frames and clusters by the harmonic search.
    options : RefinementOptions
        With the side that the samples support.
    """

    data: SampleSet
    coupled: Coupled
    result: SearchResult
    options: RefinementOptions

    def frames(self) -> NDArray[np.float64]:
        """`local_from_base` of the search."""
        return np.ascontiguousarray(np.swapaxes(self.result.rotations, 1, 2))

    def weights(self) -> NDArray[np.float64]:
        """Of the frames in averages."""
        return np.where(self.data.brightness() > 0, np.maximum(self.result.score, 0.0), 0.0)


@dataclass(frozen=True, eq=False)
class _Fit:
    """What every step of the fit needs."""

    gridded: GriddedSamples
    projection: Projection
    options: FitOptions
    rng: np.random.Generator

    @property
    def n_threads(self) -> int:
        """Blocks worked on at once."""
        return self.options.n_threads

    def coupled(self, rows: NDArray[np.int64]) -> Coupled:
        """Coefficients of some texels, read block by block."""
        parts = [
            self.projection.coupled(self.gridded.read(part).samples, self.n_threads)
            for part in blocks_of(self.gridded.shape, rows)
        ]
        return join_coupled(parts)

    def harmonic(
        self, training: Coupled, n_clusters: int
    ) -> tuple[HarmonicTargets, SearchResult, NDArray[np.float64]]:
        """Targets and frames from the coefficients alone; on average the base frames."""
        shared = self.projection.options(self.n_threads)
        fit = fit_targets(
            training,
            n_clusters=n_clusters,
            iterations=self.options.iterations,
            rng=self.rng,
            **shared,
        )
        # What no direction of the dome shows of a tilted texel is taken from the targets.
        horizon = Horizon.of(self.projection.projector)
        imputed = impute_targets(training, fit, horizon, IMPUTATIONS, shared)
        matches = imputed.matches
        weights = np.where(training.norms() > 0, np.maximum(matches.score, 0.0), 0.0)
        resolved = resolve_ambiguity(
            imputed.targets, matches.rotations, matches.cluster, weights
        )
        plain = rotate_targets(fit.targets, resolved.common)
        targets = HarmonicTargets(plain, resolved.targets, resolved.symmetries)
        start = resolved.rotations
        result = targets.search(self.projection, training, self.n_threads, start)
        return targets, result, imputed.history

    def refining_texels(
        self, raw: ScatteredSource, options: RefinementOptions, harmonic: HarmonicTargets
    ) -> _RefiningTexels:
        """As many as the options ask for and the memory holds, drawn at random."""
        n, n_clusters = raw.shape[0], self.options.n_clusters
        fits = max(REFINING_BYTES // bytes_per_texel(raw.shape), LEAST_REFINING_TEXELS)
        most = min(options.texels_per_cluster * n_clusters, fits, n)
        rows = np.sort(self.rng.choice(n, most, replace=False))
        data = raw.read(rows).normalised()
        coupled = self.coupled(rows)
        result = harmonic.search(self.projection, coupled, self.n_threads)
        return _RefiningTexels(data, coupled, result, options.supported_by(data, n_clusters))

    def divided(self, view: _RefiningTexels) -> tuple[HarmonicTargets, _RefiningTexels]:
        """Materials told apart on samples, from the frames by one target; then each alone."""
        n_clusters = self.options.n_clusters
        label = tell_apart(
            *(view.data, view.frames(), n_clusters, view.options, self.rng, self.n_threads)
        ).cluster
        result, parts = _copy(view.result), []
        for k, old in enumerate(np.unique(label)):
            mine = np.flatnonzero(label == old)
            targets, own, _ = self.harmonic(view.coupled[mine], 1)
            for name in ("rotations", "score", "margin"):
                getattr(result, name)[mine] = getattr(own, name)
            result.cluster[mine] = k
            parts.append(targets)
        return HarmonicTargets.joined(parts), replace(view, result=result)

    def refined(
        self, view: _RefiningTexels, harmonic: HarmonicTargets
    ) -> tuple[SharpAlignment, NDArray[np.bool_]]:
        """Sharp targets with frames, and whose in-plane angles were found on the samples."""
        data, options, n_threads = view.data, view.options, self.n_threads
        n_clusters = len(harmonic.symmetries)
        empty = SplineTargets.zeros(n_clusters, data.samples.shape[1:], options.side)
        state = SharpAlignment.begin(data, view.frames(), view.result.cluster, empty)
        state = refine(data, state, options, n_threads)
        if n_clusters > 1:
            chosen = choose(data, state, options, options.steps, n_threads)
            if not np.array_equal(chosen.cluster, state.cluster):
                # Some texels changed their material: both targets are sharper without them.
                state = refine(data, replace(chosen, targets=empty), options, n_threads)
        in_plane = np.zeros(n_clusters, bool)
        for k, symmetry in enumerate(harmonic.symmetries):
            isotropic = symmetry.kind == "all"
            state, in_plane[k] = _with_angles(view, state, k, isotropic, n_threads)
        if in_plane.any():
            # Frames half way to their angles lean: averages are of frames as all will end.
            state = improve_with_angles(data, state, options, in_plane, n_threads)
        return state, in_plane

    def resolved(
        self, view: _RefiningTexels, state: SharpAlignment, in_plane: NDArray[np.bool_]
    ) -> tuple[SampleTargets, Coupled]:
        """Sharp targets with the rotation to the frames of the result; their coefficients."""
        rotations = np.ascontiguousarray(np.swapaxes(state.frames, 1, 2))
        weights, n_clusters = view.weights(), len(in_plane)
        zeros = np.zeros(len(weights))
        better = SearchResult(rotations, view.result.score, zeros, state.cluster)
        means = mean_targets(view.coupled, weights, better, n_clusters)
        resolved = resolve_ambiguity(
            means, rotations, state.cluster, weights, in_plane.tolist()
        )
        common = resolved.common.copy()
        for k, symmetry in enumerate(resolved.symmetries):
            mine = np.flatnonzero((state.cluster == k) & (weights > 0))
            if symmetry.kind != "none":
                own = (view.data.part(mine), state.part(mine), weights[mine])
                common[k] = _at_symmetry_axis(common[k], *own, view.options, self.n_threads)
        sharp = SampleTargets(
            state.targets, view.options, in_plane, common, resolved.symmetries
        )
        return sharp, rotate_targets(means, common)


def _copy(result: SearchResult) -> SearchResult:
    return SearchResult(
        result.rotations.copy(),
        result.score.copy(),
        result.margin.copy(),
        result.cluster.copy(),
    )


def _with_angles(
    view: _RefiningTexels, state: SharpAlignment, k: int, isotropic: bool, n_threads: int
) -> tuple[SharpAlignment, bool]:
    """Angles of one cluster found on the samples if harmonics leave them undetermined."""
    mine = np.flatnonzero((state.cluster == k) & (state.brightness > 0))
    rotations = np.swapaxes(state.frames[mine], 1, 2)
    undetermined = isotropic or in_plane_undetermined(rotations, np.ones(len(mine)))
    if not undetermined or len(mine) < 2:
        return state, False
    alone = replace(
        state.part(mine),
        targets=state.targets.of_cluster(k),
        cluster=np.zeros(len(mine), np.int32),
    )
    # Only its own target is fitted anew: with more steps others would follow their noise.
    alone, known = find_angles(view.data.part(mine), alone, view.options, n_threads)
    values = state.targets.values.copy()
    values[k] = alone.targets.values[0]
    state = state.with_part(mine, replace(alone, cluster=state.cluster[mine]))
    return replace(state, targets=state.targets.replaced(values)), known


def _at_symmetry_axis(
    common: NDArray[np.float64],
    data: SampleSet,
    state: SharpAlignment,
    weights: NDArray[np.float64],
    options: RefinementOptions,
    n_threads: int,
) -> NDArray[np.float64]:
    """Common rotation whose normal is the axis of half-turn symmetry on the samples.

    Frames half turned about the normal are refined again; what they have rotated by in the
    mean is the half turn that leaves the sharp target unchanged. Band-limited targets, cut at
    the horizon, know its axis to some hundredths of a degree.
    """
    half_turn = common @ np.diag([-1.0, -1.0, 1.0]) @ common.T
    frames = half_turn @ state.frames
    begun = replace(state, frames=frames, prior=frames)
    moved = improve_frames(data, begun, options, options.steps, n_threads).frames
    rotated_by = moved @ np.swapaxes(state.frames, 1, 2)
    near = rotation_angle(half_turn.T @ rotated_by) < LARGEST_AXIS_CORRECTION
    if not near.any():
        return common
    mean = mean_rotation(rotated_by[near], weights[near])
    axis = np.linalg.eigh(mean + mean.T)[1][:, 2]
    axis *= np.sign(axis @ common[:, 2]) or 1.0
    across = np.cross(common[:, 2], axis)
    return Rotation.from_rotvec(across).as_matrix() @ common
