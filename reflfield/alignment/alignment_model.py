"""What an alignment has learnt of its materials, and frames of any texels by it.

The model is fitted once (`reflfield.alignment.model_fit`); then each block of texels gets its
frames independently of all others: `align` loops over blocks, and so does the pipeline, on
threads or on a cluster.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.frame_ambiguity import (
    Symmetry,
    reduce_by_cluster,
    with_view_over_tangent,
)
from reflfield.alignment.horizon_imputation import Horizon, impute_and_ascend
from reflfield.alignment.in_plane_rotation import angle_margin, improve_with_angles
from reflfield.alignment.refinement import RefinementOptions, SharpAlignment
from reflfield.alignment.rotation_search import (
    SearchOptions,
    SearchResult,
    map_blocks,
    search,
)
from reflfield.alignment.sample_sources import SampleSet
from reflfield.alignment.spline_targets import SplineTargets
from reflfield.sphere.coupling import Coupled, couple, join_coupled
from reflfield.sphere.harmonic_projection import Projector

# Texels projected at once.
PROJECTION_BLOCK = 128
# Rounds of imputation below the base horizon: each leaves about a third of the error.
IMPUTATIONS = 3


@dataclass(frozen=True, eq=False)
class Projection:
    """From samples on the common directions to coupled coefficients, and search options.

    Parameters
    ----------
    projector : Projector
    prior : (n_views, n_lights) float32
        First guess of samples that are missing, up to scale.
    max_tilt : float or None
        Largest tilt of a normal from its base normal, radians. None: any.
    """

    projector: Projector
    prior: NDArray[np.float32]
    max_tilt: float | None

    @property
    def constant_view(self) -> NDArray[np.float64] | None:
        """The view (3,) in the base frames, where it alone does not vary; else None."""
        views, lights = self.projector.views, self.projector.lights
        return views[0] if len(views) == 1 < len(lights) else None

    def options(self, n_threads: int) -> SearchOptions:
        """Options of all searches."""
        return {"max_tilt": self.max_tilt, "n_threads": n_threads}

    def coupled(self, samples: NDArray[np.float32], n_threads: int) -> Coupled:
        """Fill, project and couple normalised samples (n, n_views, n_lights)."""

        def work(rows: slice) -> Coupled:
            filled = self.projector.fill(samples[rows], self.prior)
            return couple(self.projector.project(filled))

        return join_coupled(map_blocks(work, len(samples), PROJECTION_BLOCK, n_threads))


@dataclass(frozen=True, eq=False)
class HarmonicTargets:
    """Targets by their coefficients, one a cluster, in the frames of the result.

    Parameters
    ----------
    plain : Coupled
        Means of the functions as they are. They tell materials apart, since no target has had
        a hand in what they are compared with.
    imputed : Coupled
        Means of the functions imputed below the horizon. They give the frames.
    symmetries : tuple of Symmetry
    """

    plain: Coupled
    imputed: Coupled
    symmetries: tuple[Symmetry, ...]

    def of_cluster(self, k: int) -> HarmonicTargets:
        """Target of one cluster."""
        one = slice(k, k + 1)
        return HarmonicTargets(self.plain[one], self.imputed[one], self.symmetries[one])

    @classmethod
    def joined(cls, parts: list[HarmonicTargets]) -> HarmonicTargets:
        """Targets of several clusters, in their order."""
        return cls(
            join_coupled([part.plain for part in parts]),
            join_coupled([part.imputed for part in parts]),
            tuple(symmetry for part in parts for symmetry in part.symmetries),
        )

    def search(
        self,
        projection: Projection,
        coupled: Coupled,
        n_threads: int,
        start: NDArray[np.float64] | None = None,
    ) -> SearchResult:
        """Best cluster and frame of some functions, in the fundamental zone of the symmetry.

        Parameters
        ----------
        projection : Projection
        coupled : Coupled
            n functions.
        n_threads : int
        start : (n, 3, 3) float64, optional
            Rotations to try as well.

        Returns
        -------
        SearchResult
        """
        options = projection.options(n_threads)
        half_turns = [symmetry.kind == "half" for symmetry in self.symmetries]
        result = search(coupled, self.plain, start=start, half_turns=half_turns, **options)
        horizon = Horizon.of(projection.projector)
        result = impute_and_ascend(coupled, self.imputed, result, horizon, IMPUTATIONS, options)
        reduced = reduce_by_cluster(result.rotations, result.cluster, self.symmetries)
        return replace(result, rotations=reduced)


@dataclass(frozen=True, eq=False)
class SampleTargets:
    """Sharp targets on the samples.

    Parameters
    ----------
    targets : SplineTargets
    options : RefinementOptions
    in_plane : (n_clusters,) bool
        True for clusters whose in-plane angles only the samples tell.
    common : (n_clusters, 3, 3) float64
        What is multiplied to refined `base_from_local` from the right: the rotation from the
        frames of the targets to those of the result.
    symmetries : tuple of Symmetry
        Of the targets in the frames of the result.
    """

    targets: SplineTargets
    options: RefinementOptions
    in_plane: NDArray[np.bool_]
    common: NDArray[np.float64]
    symmetries: tuple[Symmetry, ...]


@dataclass(frozen=True, eq=False)
class BlockFrames:
    """Frames of some texels; entries as in `Alignment`."""

    local_from_base: NDArray[np.float64]
    cluster: NDArray[np.int32]
    score: NDArray[np.float64]
    margin: NDArray[np.float64]

    @classmethod
    def joined(cls, parts: list[BlockFrames]) -> BlockFrames:
        """Frames of several blocks, in their order."""
        names = [entry.name for entry in fields(cls)]
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


@dataclass(frozen=True, eq=False)
class AlignmentModel:
    """Targets of all clusters: what gives any texel its frame.

    Parameters
    ----------
    projection : Projection
    harmonic : HarmonicTargets
    sharp : SampleTargets or None
        None: frames are not refined.
    targets : Coupled
        Unit target of each cluster, in the frames of the result.
    history : (k,) float64
        See `Alignment`.
    """

    projection: Projection
    harmonic: HarmonicTargets
    sharp: SampleTargets | None
    targets: Coupled
    history: NDArray[np.float64]

    @property
    def symmetries(self) -> tuple[Symmetry, ...]:
        """Symmetry of each cluster's target about the normal."""
        return self.harmonic.symmetries if self.sharp is None else self.sharp.symmetries

    def frames(self, gridded: SampleSet, raw: SampleSet, n_threads: int = 1) -> BlockFrames:
        """Frames of some texels, which depend on no other texel.

        Parameters
        ----------
        gridded : SampleSet
            n texels on the common directions, normalised.
        raw : SampleSet
            Samples of the same texels that the frames are refined on; `gridded` itself where
            there are no others. Not read if the model has no sharp targets.
        n_threads : int

        Returns
        -------
        BlockFrames
        """
        coupled = self.projection.coupled(gridded.samples, n_threads)
        result = self.harmonic.search(self.projection, coupled, n_threads)
        if self.sharp is not None:
            result = self._refined(self.sharp, result, coupled, raw, n_threads)
        rotations = reduce_by_cluster(result.rotations, result.cluster, self.symmetries)
        view = self.projection.constant_view
        if view is not None:
            rotations = with_view_over_tangent(rotations, result.cluster, self.symmetries, view)
        rotations[result.score == 0.0] = np.eye(3)
        frames = np.ascontiguousarray(np.swapaxes(rotations, 1, 2))
        return BlockFrames(frames, result.cluster, result.score, result.margin)

    def _refined(
        self,
        sharp: SampleTargets,
        result: SearchResult,
        coupled: Coupled,
        raw: SampleSet,
        n_threads: int,
    ) -> SearchResult:
        """Frames and materials on the samples; scores of the cluster that each ends in."""
        data, options = raw.normalised(), sharp.options
        frames = np.ascontiguousarray(np.swapaxes(result.rotations, 1, 2))
        state = SharpAlignment.begin(data, frames, result.cluster, sharp.targets)
        state = improve_with_angles(data, state, options, sharp.in_plane, n_threads)
        score, margin = result.score.copy(), result.margin.copy()
        changed = state.cluster != result.cluster
        for k in np.unique(state.cluster[changed]):
            mine = np.flatnonzero((state.cluster == k) & changed)
            one = self.harmonic.of_cluster(int(k))
            again = one.search(self.projection, coupled[mine], n_threads)
            score[mine], margin[mine] = again.score, again.margin
        for k in np.flatnonzero(sharp.in_plane):
            mine = np.flatnonzero(state.cluster == k)
            half_turn = sharp.symmetries[k].kind == "half"
            own = (data.part(mine), state.part(mine))
            margin[mine] = angle_margin(*own, options.floor, half_turn, n_threads)
        rotations = np.swapaxes(state.frames, 1, 2) @ sharp.common[state.cluster]
        return SearchResult(rotations, score, margin, state.cluster)
