"""Local frames of all texels from their samples: the room's public entry."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from reflfield.alignment.alignment_samples import (
    SampleSource,
    as_source,
    blocks_of,
    mean_samples,
    read_unit,
)
from reflfield.alignment.expectation_maximisation import TargetFit, fit_targets, mean_targets
from reflfield.alignment.frame_ambiguity import (
    Gauged,
    fix_gauge,
    fold,
    mean_rotation,
    turn_targets,
    turns_are_open,
)
from reflfield.alignment.horizon import Horizon, extend_targets, settle
from reflfield.alignment.in_plane_rotation import best_turns, find_turns, turn_margin
from reflfield.alignment.materials import (
    Materials,
    choose,
    one_round,
    spread_rows,
    tell_apart,
)
from reflfield.alignment.refinement import (
    RefinementOptions,
    SampleSet,
    improve_frames,
    refine_targets,
)
from reflfield.alignment.rotation_search import (
    SearchOptions,
    SearchResult,
    map_blocks,
    search,
)
from reflfield.alignment.splines import NodeTargets
from reflfield.errors import InputError, ShapeError
from reflfield.sphere.coupling import Coupled, couple, join_coupled
from reflfield.sphere.harmonic_projection import Projector
from reflfield.sphere.harmonics import check_band_limit
from reflfield.sphere.rotations import rotation_angle
from reflfield.util.blas_threads import one_core_blas
from reflfield.util.progress import track
from reflfield.util.validation import unit_directions

# Texels whose coefficients are kept for the iterations: enough that their mean
# has converged far below the error of one frame.
TRAINING_TEXELS = 2048
TRAINING_TEXELS_PER_CLUSTER = 256
TRAINING_BYTES = 256 * 2**20
# Texels projected at once.
PROJECTION_BLOCK = 128
# Rounds of filling in what lies below the base horizon: each leaves about a third of the error.
EXTENSIONS = 3
# Turns about the normal and normals of a texel are improved in turn so often.
TURN_PASSES = 3
# The axis of symmetry on the samples lies this near to that of the band-limited target, or the
# refinement has gone astray.
LARGEST_AXIS_CORRECTION = np.deg2rad(2.0)
# Samples kept for the targets of the refinement.
REFINING_BYTES = 256 * 2**20


@dataclass(frozen=True, eq=False)
class Alignment:
    """One local frame per texel, and how well it is determined.

    Parameters
    ----------
    local_from_base : (n, 3, 3) float64
        Rows tangent, binormal, normal of the texel in base coordinates. The identity for texels
        without a usable sample.
    cluster : (n,) int32
        Material found to fit best; 0 .. n_clusters - 1.
    score : (n,) float64
        Normalised correlation with the cluster's target, -1 .. 1; 0 where nothing is observed.
    margin : (n,) float64
        Score gap to the best rotation at least 15 degrees away. Near 0: the frame is not
        determined (a round lobe, a constant). Where only the samples tell the turn about the
        normal, the gap to the best other turn, on the samples.
    history : (k,) float64
        Accumulated correlation of the training texels per iteration, over the largest
        possible. Never falls.
    targets : Coupled
        Unit target of each cluster, in the local frame.
    symmetries : tuple of str
        Turns about the normal that leave each target unchanged: "none", "half", "all".
    """

    local_from_base: NDArray[np.float64]
    cluster: NDArray[np.int32]
    score: NDArray[np.float64]
    margin: NDArray[np.float64]
    history: NDArray[np.float64]
    targets: Coupled
    symmetries: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Task:
    """What every step of one alignment needs."""

    source: SampleSource
    projector: Projector
    horizon: Horizon
    prior: NDArray[np.float32]
    max_tilt: float | None
    n_threads: int

    @property
    def search_options(self) -> SearchOptions:
        """Those that all steps share."""
        return {"max_tilt": self.max_tilt, "n_threads": self.n_threads}


def align(
    samples: ArrayLike | SampleSource,
    views: ArrayLike,
    lights: ArrayLike,
    band_limit: int | tuple[int, int] = 8,
    iterations: int = 4,
    n_clusters: int = 1,
    *,
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
    refine : bool or RefinementOptions
        True: refine the frames on the samples themselves after the harmonic search, with the
        default options; or the options to refine with.
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
    more), whose coefficients stay in memory; all others are then read, searched and refined
    once, block by block. Memory does not depend on n. With fewer texels all of them take part.

    Examples
    --------
    >>> from reflfield.sphere.hemisphere import HemisphereGrid
    >>> directions = HemisphereGrid(7).directions[8:-8]
    >>> lobe = np.exp(-8 * (1 - directions @ directions.T)).astype(np.float32)
    >>> result = align(lobe[None], directions, directions, band_limit=4, refine=False)
    >>> result.local_from_base.shape, result.cluster
    ((1, 3, 3), array([0], dtype=int32))
    """
    # Check the input and build the operators that all texels share.
    source = as_source(samples)
    projector = _projector(source, views, lights, band_limit)
    _check_options(iterations, n_clusters, max_tilt, n_threads)
    rng = np.random.default_rng(seed)
    rows = _training_rows(source.shape[0], projector, n_clusters, rng)
    prior = mean_samples(source, rows)
    task = _Task(source, projector, Horizon.of(projector), prior, max_tilt, n_threads)
    with one_core_blas():
        # Keep the coefficients of some texels, and find targets and their frames.
        training = join_coupled([_coupled(task, part) for part in blocks_of(source, rows)])
        refinement = RefinementOptions() if refine is True else refine
        # With samples at hand, they tell materials apart better than harmonics.
        n_targets = 1 if refinement else n_clusters
        fit, aims = _harmonic_fit(task, training, n_targets, iterations, rng)
        sharp = None
        if refinement:
            view = _RefiningView.of(task, rows, training, refinement, n_clusters)
            if n_clusters > 1:
                fit, aims = _divide(task, view, training, fit, n_clusters, iterations, rng)
            sharp = _sharpen(task, view, fit, aims)
        # Find the frames of all texels, block by block.
        return _finish(task, rows, fit, aims, sharp)


@dataclass(frozen=True, eq=False)
class _Aims:
    """Targets in one gauge: of the functions as they are, and as extended below the horizon.

    The plain ones tell materials apart, since no target has had a hand in what they are
    compared with; the extended ones give the frames.
    """

    plain: Coupled
    extended: Gauged

    def only(self, k: int) -> _Aims:
        """Those of one cluster."""
        every = self.extended
        one = Gauged(
            every.targets[k : k + 1],
            every.rotations[:0],
            every.symmetries[k : k + 1],
            every.turns[k : k + 1],
        )
        return _Aims(self.plain[k : k + 1], one)

    @classmethod
    def joined(cls, parts: list[_Aims]) -> _Aims:
        """Those of several clusters, in their order."""
        every = Gauged(
            join_coupled([part.extended.targets for part in parts]),
            parts[0].extended.rotations[:0],
            tuple(s for part in parts for s in part.extended.symmetries),
            np.concatenate([part.extended.turns for part in parts]),
        )
        return cls(join_coupled([part.plain for part in parts]), every)


@dataclass(frozen=True, eq=False)
class _RefiningView:
    """The training texels whose samples the sharp targets are fitted to.

    Parameters
    ----------
    some : (k,) int64
        Places among the training texels.
    data : SampleSet
    training : Coupled
        Their coefficients.
    options : RefinementOptions
    """

    some: NDArray[np.int64]
    data: SampleSet
    training: Coupled
    options: RefinementOptions

    @classmethod
    def of(
        cls,
        task: _Task,
        rows: NDArray[np.int64],
        training: Coupled,
        options: RefinementOptions,
        n_clusters: int,
    ) -> _RefiningView:
        """As many as the options ask for and the memory holds, evenly spread."""
        each = 4 * task.source.shape[1] * task.source.shape[2]
        most = min(options.texels_per_cluster * n_clusters, max(REFINING_BYTES // each, 64))
        some = spread_rows(len(rows), most)
        parts = [read_unit(task.source, part) for part in blocks_of(task.source, rows[some])]
        data = SampleSet(np.concatenate(parts), task.projector.views, task.projector.lights)
        return cls(some, data, training[some], options)


def _harmonic_fit(
    task: _Task,
    training: Coupled,
    n_clusters: int,
    iterations: int,
    rng: np.random.Generator,
) -> tuple[TargetFit, _Aims]:
    """Targets and frames from the coefficients alone, in the gauge of the base frames."""
    fit = fit_targets(
        training, n_clusters=n_clusters, iterations=iterations, rng=rng, **task.search_options
    )
    # What no direction of the dome shows of a tilted texel is taken from the targets.
    extended = extend_targets(training, fit, task.horizon, EXTENSIONS, task.search_options)
    start = extended.found
    weights = np.where(training.norms() > 0, np.maximum(start.score, 0.0), 0.0)
    gauged = fix_gauge(extended.targets, start.rotations, start.cluster, weights)
    aims = _Aims(turn_targets(fit.targets, gauged.turns), gauged)
    found = _search(task, training, aims, gauged.rotations)
    return replace(extended, targets=gauged.targets, found=found), aims


def _divide(
    task: _Task,
    view: _RefiningView,
    training: Coupled,
    common: TargetFit,
    n_clusters: int,
    iterations: int,
    rng: np.random.Generator,
) -> tuple[TargetFit, _Aims]:
    """Materials told apart on samples, from the frames by one target; then each by itself."""
    frames = np.ascontiguousarray(np.swapaxes(common.found.rotations[view.some], 1, 2))
    label = tell_apart(view.data, frames, n_clusters, view.options, rng, task.n_threads).cluster
    used = np.unique(label)
    found = SearchResult(
        rotations=common.found.rotations.copy(),
        score=common.found.score.copy(),
        margin=common.found.margin.copy(),
        cluster=np.zeros(len(training), np.int32),
    )
    parts = []
    for k, old in enumerate(used):
        mine = np.flatnonzero(label == old)
        fit, aims = _harmonic_fit(task, view.training[mine], 1, iterations, rng)
        _put(
            found, view.some[mine], replace(fit.found, cluster=fit.found.cluster + np.int32(k))
        )
        parts.append(aims)
    every = _Aims.joined(parts)
    rest = np.setdiff1d(np.arange(len(training)), view.some)
    if len(rest) > 0:
        _put(found, rest, _search(task, training[rest], every))
    return replace(common, targets=every.extended.targets, found=found), every


@dataclass(frozen=True, eq=False)
class _Sharp:
    """Targets on samples, in the gauge of the harmonic targets; `regauged` follows both.

    `turned` is True for clusters whose turns about the normal were found on the samples.
    """

    targets: NodeTargets
    options: RefinementOptions
    regauged: Gauged
    turned: NDArray[np.bool_]


def _sharpen(task: _Task, view: _RefiningView, fit: TargetFit, aims: _Aims) -> _Sharp:
    """Refine some training texels, and fix the gauge again from their better frames."""
    data, options, n_clusters = view.data, view.options, len(fit.targets)
    frames = np.ascontiguousarray(np.swapaxes(fit.found.rotations[view.some], 1, 2))
    cluster, score = fit.found.cluster[view.some], fit.found.score[view.some]
    targets, frames = refine_targets(data, frames, cluster, n_clusters, options, task.n_threads)
    state = Materials(targets, frames, data.brightness(), cluster)
    if n_clusters > 1:
        chosen = choose(data, state, options, options.steps, task.n_threads)
        if not np.array_equal(chosen.cluster, state.cluster):
            # Some texels changed their material: both targets are sharper without them.
            targets, frames = refine_targets(
                data, chosen.frames, chosen.cluster, n_clusters, options, task.n_threads
            )
            state = Materials(targets, frames, data.brightness(), chosen.cluster)
    turned = np.array([_turn_cluster(task, view, state, aims, k) for k in range(n_clusters)])
    if turned.any():
        # Frames half way to their turns lean: the gauge is that of frames as all will end.
        state = _settled(task, data, state, turned, options)
    rotations = np.ascontiguousarray(np.swapaxes(state.frames, 1, 2))
    better = SearchResult(rotations, score, np.zeros(len(score)), state.cluster)
    weights = np.where(data.brightness() > 0, np.maximum(score, 0.0), 0.0)
    means = mean_targets(view.training, weights, better, n_clusters)
    regauged = fix_gauge(means, rotations, state.cluster, weights, turned.tolist())
    turns = regauged.turns.copy()
    for k in np.flatnonzero([symmetry.kind != "none" for symmetry in regauged.symmetries]):
        mine = np.flatnonzero((state.cluster == k) & (weights > 0))
        own = (data.part(mine), state.part(mine), weights[mine])
        turns[k] = _about_symmetry_axis(turns[k], *own, options, task.n_threads)
    regauged = replace(
        regauged,
        targets=turn_targets(means, turns),
        rotations=_fold_all(rotations @ turns[state.cluster], state.cluster, regauged),
        turns=turns,
    )
    return _Sharp(state.targets, options, regauged, turned)


def _about_symmetry_axis(
    turn: NDArray[np.float64],
    data: SampleSet,
    state: Materials,
    weights: NDArray[np.float64],
    options: RefinementOptions,
    n_threads: int,
) -> NDArray[np.float64]:
    """Turn of a gauge whose normal is the axis of half-turn symmetry on the samples.

    Frames half turned about the normal are refined again; what they have turned by in the
    mean is the half turn that leaves the sharp target unchanged. Band-limited targets, cut at
    the horizon, know its axis to some hundredths of a degree.
    """
    half_turn = turn @ np.diag([-1.0, -1.0, 1.0]) @ turn.T
    frames, brightness = half_turn @ state.frames, state.brightness.copy()
    improve_frames(
        *(data, frames, brightness, state.cluster, state.targets, options),
        *(options.steps, n_threads),
    )
    turned_by = frames @ np.swapaxes(state.frames, 1, 2)
    near = rotation_angle(half_turn.T @ turned_by) < LARGEST_AXIS_CORRECTION
    if not near.any():
        return turn
    found = mean_rotation(turned_by[near], weights[near])
    axis = np.linalg.eigh(found + found.T)[1][:, 2]
    axis *= np.sign(axis @ turn[:, 2]) or 1.0
    across = np.cross(turn[:, 2], axis)
    return Rotation.from_rotvec(across).as_matrix() @ turn


def _turn_cluster(
    task: _Task, view: _RefiningView, state: Materials, aims: _Aims, k: int
) -> bool:
    """Find the turns of one cluster on the samples if harmonics leave them open, in place."""
    mine = np.flatnonzero((state.cluster == k) & (state.brightness > 0))
    rotations = np.swapaxes(state.frames[mine], 1, 2)
    is_round = aims.extended.symmetries[k].kind == "all"
    if not (is_round or turns_are_open(rotations, np.ones(len(mine)))) or len(mine) < 2:
        return False
    t = state.targets
    own = Materials(
        NodeTargets(t.values[k : k + 1].copy(), t.view_side, t.light_side),
        state.frames[mine],
        state.brightness[mine],
        np.zeros(len(mine), np.int32),
    )
    data, options = view.data.part(mine), view.options
    found, known = find_turns(data, own, options, task.n_threads)
    # Only its own target is fitted anew: with more steps others would follow their noise.
    for _ in range(options.rounds if known else 0):
        found = one_round(data, found, options, task.n_threads)
    t.values[k] = found.targets.values[0]
    state.frames[mine], state.brightness[mine] = found.frames, found.brightness
    return known


def _projector(
    source: SampleSource,
    views: ArrayLike,
    lights: ArrayLike,
    band_limit: int | tuple[int, int],
) -> Projector:
    """Check shapes and directions; operators of the common directions."""
    view, light = unit_directions("views", views), unit_directions("lights", lights)
    if len(source.shape) != 3 or tuple(source.shape[1:]) != (len(view), len(light)):
        raise ShapeError(
            f"samples: expected shape (n, {len(view)}, {len(light)}) for {len(view)} views and "
            f"{len(light)} lights, received {tuple(source.shape)}"
        )
    if source.shape[0] == 0:
        raise ShapeError("samples: expected at least one texel, received 0")
    limits = tuple(band_limit) if isinstance(band_limit, tuple) else (band_limit, band_limit)
    if len(limits) != 2:
        raise InputError(f"band_limit: expected one or two integers, received {band_limit}")
    for limit in limits:
        check_band_limit("band_limit", limit)
    view_limit, light_limit = (
        1 if len(d) == 1 else limit for d, limit in zip((view, light), limits, strict=True)
    )
    return Projector(view, light, (view_limit, light_limit))


def _check_options(
    iterations: int, n_clusters: int, max_tilt: float | None, n_threads: int
) -> None:
    counts = (("iterations", iterations), ("n_clusters", n_clusters), ("n_threads", n_threads))
    for name, count in counts:
        if count < 1:
            raise InputError(f"{name}: expected at least 1, received {count}")
    if max_tilt is not None and not 0.0 < max_tilt <= np.pi:
        raise InputError(f"max_tilt: expected radians in (0, pi], received {max_tilt}")


def _training_rows(
    n: int, projector: Projector, n_clusters: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Texels that take part in finding the targets, ascending."""
    limits = projector.band_limits
    size = 4 * limits[0] ** 2 * limits[1] ** 2
    wanted = max(TRAINING_TEXELS, TRAINING_TEXELS_PER_CLUSTER * n_clusters)
    most = min(n, wanted, max(TRAINING_BYTES // size, 256))
    return np.sort(rng.choice(n, most, replace=False)) if most < n else np.arange(n)


def _coupled(task: _Task, rows: NDArray[np.int64]) -> Coupled:
    """Coupled coefficients of some texels, each scaled by a power of two or more to order 1."""
    return couple_samples(task, read_unit(task.source, rows))


def couple_samples(task: _Task, block: NDArray[np.float32]) -> Coupled:
    """Fill, project and couple."""

    def work(rows: slice) -> Coupled:
        filled = task.projector.fill(block[rows], task.prior)
        return couple(task.projector.project(filled))

    return join_coupled(map_blocks(work, len(block), PROJECTION_BLOCK, task.n_threads))


def _finish(
    task: _Task,
    rows: NDArray[np.int64],
    fit: TargetFit,
    aims: _Aims,
    sharp: _Sharp | None,
) -> Alignment:
    """Frames of all texels: search those not in the training, refine all."""
    n = task.source.shape[0]
    found = SearchResult(
        rotations=np.tile(np.eye(3), (n, 1, 1)),
        score=np.zeros(n),
        margin=np.zeros(n),
        cluster=np.zeros(n, np.int32),
    )
    _put(found, rows, fit.found)
    trained = np.zeros(n, bool)
    trained[rows] = True
    blocks = blocks_of(task.source, np.arange(n) if sharp else np.flatnonzero(~trained))
    for part in track(blocks, len(blocks), "frames of all texels"):
        samples = read_unit(task.source, part)
        new = ~trained[part]
        if new.any():
            _put(found, part[new], _search(task, couple_samples(task, samples[new]), aims))
        if sharp:
            _refine_block(task, part, samples, found, aims, sharp)
    last = sharp.regauged if sharp else aims.extended
    base_from_local = _fold_all(found.rotations, found.cluster, last)
    base_from_local[found.score == 0.0] = np.eye(3)
    return Alignment(
        local_from_base=np.ascontiguousarray(np.swapaxes(base_from_local, 1, 2)),
        cluster=found.cluster,
        score=found.score,
        margin=found.margin,
        history=fit.history,
        targets=last.targets,
        symmetries=tuple(symmetry.kind for symmetry in last.symmetries),
    )


def _search(
    task: _Task, source: Coupled, aims: _Aims, start: NDArray[np.float64] | None = None
) -> SearchResult:
    """Search and settle against the gauged targets, with margins; folded to the base frame."""
    gauged, options = aims.extended, task.search_options
    found = search(
        source,
        aims.plain,
        start=start,
        half_turns=[symmetry.kind == "half" for symmetry in gauged.symmetries],
        **options,
    )
    found = settle(source, gauged.targets, found, task.horizon, EXTENSIONS, options)
    folded = _fold_all(found.rotations, found.cluster, gauged)
    return replace(found, rotations=folded)


def _put(into: SearchResult, rows: NDArray[np.int64], part: SearchResult) -> None:
    into.rotations[rows], into.score[rows] = part.rotations, part.score
    into.margin[rows], into.cluster[rows] = part.margin, part.cluster


def _refine_block(
    task: _Task,
    part: NDArray[np.int64],
    samples: NDArray[np.float32],
    found: SearchResult,
    aims: _Aims,
    sharp: _Sharp,
) -> None:
    """Refine the frames of one block against the finished targets, in place."""
    data = SampleSet(samples, task.projector.views, task.projector.lights)
    frames = np.ascontiguousarray(np.swapaxes(found.rotations[part], 1, 2))
    before = found.cluster[part]
    state = Materials(sharp.targets, frames, data.brightness(), before)
    state = _settled(task, data, state, sharp.turned, sharp.options)
    found.cluster[part] = state.cluster
    turns = sharp.regauged.turns[state.cluster]
    found.rotations[part] = np.swapaxes(state.frames, 1, 2) @ turns
    # Scores are those of the cluster that each texel ended in.
    for k in np.unique(state.cluster[state.cluster != before]):
        mine = (state.cluster == k) & (before != k)
        again = _search(task, couple_samples(task, samples[mine]), aims.only(int(k)))
        found.score[part[mine]], found.margin[part[mine]] = again.score, again.margin
    for k in np.flatnonzero(sharp.turned):
        mine = np.flatnonzero(state.cluster == k)
        half_turn = sharp.regauged.symmetries[k].kind == "half"
        found.margin[part[mine]] = turn_margin(
            data.part(mine), state.part(mine), sharp.options.floor, half_turn, task.n_threads
        )


def _settled(
    task: _Task,
    data: SampleSet,
    state: Materials,
    turned: NDArray[np.bool_],
    options: RefinementOptions,
) -> Materials:
    """Frames against finished targets, after the best turns where these tell (`turned`).

    Normals that are some degrees off hide the right turn, so both are found in turn.
    """
    rows = np.flatnonzero(turned[state.cluster])
    if len(rows) > 0:
        few, own = data.part(rows), state.part(rows)
        for _ in range(TURN_PASSES):
            own = best_turns(few, own, options.floor, task.n_threads)
            own = choose(few, own, options, options.steps, task.n_threads)
        state.frames[rows], state.brightness[rows] = own.frames, own.brightness
    return choose(data, state, options, options.last_steps, task.n_threads)


def _fold_all(
    rotations: NDArray[np.float64], cluster: NDArray[np.int32], gauged: Gauged
) -> NDArray[np.float64]:
    folded = rotations.copy()
    for k, symmetry in enumerate(gauged.symmetries):
        folded[cluster == k] = fold(rotations[cluster == k], symmetry)
    return folded
