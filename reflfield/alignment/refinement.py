r"""Frames refined on the samples themselves.

The aligned texels sample one reflectance far more densely than any of them, so
a sharp target exists (see `reflfield.alignment.spline_targets`), fitted to the samples of all
texels. Frames and brightness of each texel then follow by Gauss-Newton steps on the same
weighted squares (see `reflfield.alignment.gauss_newton`). Both are repeated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.gauss_newton import FramePrior, improve
from reflfield.alignment.rotation_search import map_blocks
from reflfield.alignment.sample_sources import SampleSet
from reflfield.alignment.spline_targets import SplineTargets, Texels, back_project
from reflfield.errors import InputError

Array = NDArray[np.float64]
Labels = NDArray[np.int32]

SMALLEST_SIDE = 5
BLOCK = 128
# Parts that the samples are summed in: their sums are held together.
FIT_PARTS = 8
# Weight of the mean node in the preconditioner: nodes that hardly any sample touches stay.
LEAST_TOUCH = 1e-3
# Relative error of sums that are taken in single precision, over some ten products each.
SUM_ERROR = 16 * float(np.finfo(np.float32).eps)


@dataclass(frozen=True)
class RefinementOptions:
    """How frames are refined on the samples.

    Parameters
    ----------
    side : int
        Nodes along the side of each square of directions, 5 at least. Two of them stand
        outside the hemisphere.
    rounds : int
        Rounds of target and frames.
    fit_steps : int
        Steps of conjugate gradients of the target fit per round. More let the target
        follow the wrong frames.
    steps : int
        Gauss-Newton steps per round, at most.
    last_steps : int
        Gauss-Newton steps of all texels against the finished targets, at most.
    floor : float
        Added to |sample| in the weight 1 / (floor + |sample|), relative to the
        texel's root mean square.
    texels_per_cluster : int
        Texels that the target is fitted to.
    spread : float
        Standard deviation of the harmonic frames about the true ones, radians: a Gaussian
        prior holds texels there that few or noisy samples say little about. Infinite: none.
    samples_per_pair : float
        Samples that a pair of nodes of a target has on average, at least: with fewer samples
        the side is smaller. 0: never.
    """

    side: int = 25
    rounds: int = 4
    fit_steps: int = 6
    steps: int = 2
    last_steps: int = 6
    floor: float = 0.3
    texels_per_cluster: int = 1024
    spread: float = math.inf
    samples_per_pair: float = 0.0

    def __post_init__(self) -> None:
        if self.side < SMALLEST_SIDE:
            raise InputError(f"side: expected at least 5 nodes, received {self.side}")
        if not self.spread > 0:
            raise InputError(f"spread: expected radians > 0, received {self.spread}")

    def supported_by(self, data: SampleSet, n_clusters: int = 1) -> RefinementOptions:
        """These options with the side that the samples support.

        Examples
        --------
        Ten thousand samples of 40 views under one light: 12 x 12 nodes.

        >>> views = np.tile([0.0, 0.0, 1.0], (250, 40, 1))
        >>> data = SampleSet(np.ones((250, 40, 1), np.float32), views, views[:, :1])
        >>> RefinementOptions(samples_per_pair=64.0).supported_by(data).side
        12
        """
        if not self.samples_per_pair > 0:
            return self
        varying = sum(count > 1 for count in data.samples.shape[1:])
        pairs = np.isfinite(data.samples).sum() / n_clusters / self.samples_per_pair
        side = max(SMALLEST_SIDE, int(pairs ** (0.5 / max(varying, 1))))
        return replace(self, side=min(self.side, side))


@dataclass(frozen=True, eq=False)
class SharpAlignment:
    """Sharp targets of all clusters, and how each texel is aligned with its own.

    Parameters
    ----------
    targets : SplineTargets
        One a cluster; zero for those that no texel belongs to.
    frames : (n, 3, 3) float64
        `local_from_base`.
    brightness : (n,) float64
        Factor of the target; 0 where nothing is observed.
    cluster : (n,) int32
    prior : (n, 3, 3) float64
        Frames that the prior, if there is one, holds to.
    """

    targets: SplineTargets
    frames: Array
    brightness: Array
    cluster: Labels
    prior: Array

    @classmethod
    def begin(
        cls, data: SampleSet, frames: Array, cluster: Labels, targets: SplineTargets
    ) -> SharpAlignment:
        """Texels in the frames of the harmonic search."""
        return cls(targets, frames, data.brightness(), cluster, frames)

    def part(self, rows: NDArray[np.int64]) -> SharpAlignment:
        """Some of the texels, with all targets."""
        return SharpAlignment(
            self.targets,
            self.frames[rows],
            self.brightness[rows],
            self.cluster[rows],
            self.prior[rows],
        )

    def with_part(self, rows: NDArray[np.int64], part: SharpAlignment) -> SharpAlignment:
        """Some of the texels replaced; the targets stay."""
        names = ("frames", "brightness", "cluster", "prior")
        arrays = {name: getattr(self, name).copy() for name in names}
        for name, array in arrays.items():
            array[rows] = getattr(part, name)
        return replace(self, **arrays)

    def rotated(self, rotations: Array) -> SharpAlignment:
        """Frames, and those that the prior holds to, rotated from the left."""
        return replace(self, frames=rotations @ self.frames, prior=rotations @ self.prior)

    def texels(self, data: SampleSet, rows: NDArray[np.int64], floor: float) -> Texels:
        """Copies of some texels for the kernels."""
        part = data.part(rows)
        views, lights = part.directions()
        sides = self.targets.sides
        frames, brightness = self.frames[rows], self.brightness[rows]
        return Texels(part.samples, views, lights, frames, brightness, sides, floor)


def fit_sharp_targets(
    data: SampleSet, state: SharpAlignment, options: RefinementOptions, n_threads: int
) -> SharpAlignment:
    """Targets after some steps of conjugate gradients towards the samples.

    Parameters
    ----------
    data : SampleSet
        n texels.
    state : SharpAlignment
        Of the n texels; its targets are where the steps begin.
    options : RefinementOptions
    n_threads : int

    Returns
    -------
    SharpAlignment
        With other targets.
    """
    values = state.targets.values.copy()
    for k in range(len(values)):
        mine = np.flatnonzero((state.cluster == k) & (state.brightness > 0))
        if len(mine):
            fit = _TargetFit(data, state, mine, options.floor, n_threads)
            values[k] = fit.solve(values[k], options.fit_steps)
    return replace(state, targets=state.targets.replaced(values))


@dataclass(frozen=True, eq=False)
class _TargetFit:
    """The normal equations of one cluster's nodes, by sums over its texels `rows`."""

    data: SampleSet
    state: SharpAlignment
    rows: NDArray[np.int64]
    floor: float
    n_threads: int

    def solve(self, values: NDArray[np.float32], n_steps: int) -> NDArray[np.float32]:
        """Nodes after some steps of preconditioned conjugate gradients from `values`."""
        nodes = values.astype(np.float64)
        rest, touched = self.sums(values, with_samples=True)
        scale = 1.0 / (touched + LEAST_TOUCH * touched.mean() + 1e-300)
        direction = scale * rest
        first = power = np.vdot(rest, direction)
        for _ in range(n_steps):
            product, _ = self.sums(direction.astype(np.float32), with_samples=False)
            curvature = -np.vdot(direction, product)
            # A direction that no sample determines: its curvature is rounding.
            if not curvature > SUM_ERROR * np.vdot(direction, direction / scale):
                break
            nodes += (power / curvature) * direction
            rest += (power / curvature) * product
            before, power = power, np.vdot(rest, scale * rest)
            # What is left is rounding, which further steps would only amplify.
            if not power > SUM_ERROR**2 * first:
                break
            direction = scale * rest + (power / before) * direction
        return nodes.astype(np.float32)

    def sums(self, values: NDArray[np.float32], with_samples: bool) -> tuple[Array, Array]:
        """Backprojected residuals and, with samples, the weight on each node."""

        def block(rows: slice) -> tuple[Array, Array]:
            texels = self.state.texels(self.data, self.rows[rows], self.floor)
            sums, touched = np.zeros(values.shape), np.zeros(values.shape)
            back_project(texels, values, with_samples, sums, touched)
            return sums, touched

        size = max(BLOCK // 2, -(-len(self.rows) // FIT_PARTS))
        parts = map_blocks(block, len(self.rows), size, self.n_threads)
        return np.sum([p[0] for p in parts], axis=0), np.sum([p[1] for p in parts], axis=0)


def improve_frames(
    data: SampleSet,
    state: SharpAlignment,
    options: RefinementOptions,
    n_steps: int,
    n_threads: int,
) -> SharpAlignment:
    """Gauss-Newton steps of frames and brightness against the targets.

    Parameters
    ----------
    data : SampleSet
        n texels.
    state : SharpAlignment
    options : RefinementOptions
    n_steps : int
        At most.
    n_threads : int

    Returns
    -------
    SharpAlignment
        With other frames and brightness.
    """
    frames, brightness = state.frames.copy(), state.brightness.copy()

    def block(rows: slice) -> None:
        for k in np.unique(state.cluster[rows]):
            own = np.flatnonzero(state.cluster[rows] == k) + rows.start
            texels = state.texels(data, own, options.floor)
            prior = FramePrior(state.prior[own], options.spread)
            improve(texels, state.targets.values[k], prior, n_steps)
            frames[own], brightness[own] = texels.frames, texels.brightness

    map_blocks(block, len(frames), BLOCK, n_threads)
    return replace(state, frames=frames, brightness=brightness)


def refine(
    data: SampleSet, state: SharpAlignment, options: RefinementOptions, n_threads: int
) -> SharpAlignment:
    """Targets and frames in alternation, `options.rounds` times; parameters as above."""
    for _ in range(options.rounds):
        state = fit_sharp_targets(data, state, options, n_threads)
        state = improve_frames(data, state, options, options.steps, n_threads)
    return state
