"""Stage that compares the field with photographs, and with the truth where there is one."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from reflfield.capture.capture import Capture
from reflfield.capture.readers import open_capture
from reflfield.errors import InputError
from reflfield.field.file import open_field
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.metrics.comparison_silhouettes import (
    FrameSilhouettes,
    open_frame_silhouettes,
    write_frame_silhouettes,
)
from reflfield.metrics.completion_error import CompletionError, completion_error
from reflfield.metrics.frame_errors import FrameErrors, frame_errors, surface_points
from reflfield.metrics.held_out_photographs import RelitPairs, compare_with_photographs
from reflfield.metrics.hull_distance import HullDistance, hull_distance
from reflfield.metrics.image_metrics import Comparison, NothingToMeasure, metrics_text
from reflfield.metrics.truth_files import Truth, open_truth
from reflfield.observations.frame_resampling import apply_both
from reflfield.observations.texel_samples import (
    direction_taps,
    interpolation_matrices,
    local_directions,
    unroot,
)
from reflfield.pipeline.context import Job
from reflfield.pipeline.hold_out import held_out_counts
from reflfield.pipeline.memory import within_memory
from reflfield.sphere.hemisphere import softened_cosine

# Texels farther from a true surface point than this many texel spacings see another part.
MATCH_SPACINGS = 2.0
# Folders of the comparison: of the field itself, and of the one that it is compared with.
MAIN, WITHOUT = "field", "without_alignment"
# Stage of the frames' silhouettes, and what a record says of what was left out.
SILHOUETTES, PROBLEMS = "frame_silhouettes", "problems"


def write_silhouettes_of_frames(job: Job, folder: Path) -> dict[str, Any]:
    """Silhouettes of all views that are compared, once for all fields."""
    origins: list[str] = []
    for name, frames in frame_sets(job).items():
        made = write_frame_silhouettes(
            frames, around(job, name), job.hull_mesh, folder / name, job.resources.workers
        )
        origins += made.origins
    return {"views": len(origins), **{o: origins.count(o) for o in sorted(set(origins))}}


def write_comparison(job: Job, folder: Path) -> dict[str, Any]:
    """Relight held-out frames and measure them; without any, say so."""
    counts: dict[str, Any] = {}
    problems = [problem for _, problem in [truth_frames(job)] if problem]
    for variant, stage in variants(job).items():
        field = open_field(job.stages.root / stage / "field.rfld")
        measured, failed = _compare(job, field, folder / variant, variant)
        counts |= measured
        problems += failed if variant == MAIN else []
    compared = [folder / MAIN / f"{name}.json" for name in ("heldout", "truth")]
    main = next((json.loads(path.read_text()) for path in compared if path.is_file()), None)
    (folder / "metrics.json").write_text(
        metrics_text(main, held_out=held_out_counts(job.split))
    )
    n_frames = sum(len(f.photographs) for f in frame_sets(job).values())
    return {"frames": n_frames, **counts, PROBLEMS: problems}


def _compare(
    job: Job, field: ReflectanceField, folder: Path, variant: str
) -> tuple[dict[str, float], list[str]]:
    """Compare one field on all sets of frames; counts, and why a set was not compared."""
    folder.mkdir(exist_ok=True)
    options = within_memory(job.options.relighting, job.resources)
    counts, problems = {}, []
    for name, frames in frame_sets(job).items():
        silhouettes = silhouettes_of_frames(job, name, frames)
        try:
            comparison = compare_with_photographs(
                field, frames, silhouettes, folder / name, options
            )
        except InputError as error:
            # Without the truth, or where nothing can be measured, the run goes on.
            if name == "heldout" and not isinstance(error, NothingToMeasure):
                raise
            problems.append(f"{name}: not compared: {error}")
            continue
        (folder / f"{name}.json").write_text(comparison.to_json())
        words = f"{name} PSNR, dB" if variant == MAIN else f"{name} PSNR {variant}, dB"
        counts[words.replace("_", " ")] = comparison.mean["psnr_ldr"]
    return counts, problems


def variants(job: Job) -> dict[str, str]:
    """Stage that makes the field of each variant that is compared."""
    stages = {MAIN: "compression"}
    if job.options.compares_without_alignment:
        stages[WITHOUT] = "without_alignment"
    return stages


def frame_sets(job: Job) -> dict[str, Capture]:
    """Held-out photographs, and the unseen frames that a simulated capture brings."""
    sets: dict[str, Capture] = {}
    if job.held_frames.photographs:
        sets["heldout"] = job.held_frames
    frames, _ = truth_frames(job)
    if frames is not None:
        sets["truth"] = frames
    return sets


def truth_frames(job: Job) -> tuple[Capture | None, str]:
    """Unseen frames of a simulated capture; if they cannot be used, why not."""
    try:
        truth = open_truth(job.capture.root)
        path = truth.heldout() if truth else None
        return (None if path is None else open_capture(path)), ""
    except InputError as error:
        return None, f"truth: not compared: {error}"


def around(job: Job, name: str) -> Capture:
    """What a set of frames is part of: all photographs of their cameras."""
    return job.capture if name == "heldout" else frame_sets(job)[name]


def silhouettes_digests(job: Job) -> dict[str, str]:
    """Digests of what the silhouettes of the frames are made from."""
    digests = {}
    for name, frames in frame_sets(job).items():
        whole = around(job, name)
        ids = {camera.id for camera in frames.cameras}
        views = [i for i, camera in enumerate(whole.cameras) if camera.id in ids]
        digests[name] = job.digest_of(whole.subset(views), "cameras", "silhouettes")
    return digests


def silhouettes_of_frames(job: Job, name: str, frames: Capture) -> FrameSilhouettes:
    """Silhouettes of a set of frames, as their stage has made them."""
    return open_frame_silhouettes(job.stages.root / SILHOUETTES / name, frames)


def relit_pairs(job: Job, variant: str = MAIN) -> dict[str, RelitPairs]:
    """What the comparison stage has relit and measured."""
    root = job.stages.root / "comparison" / variant
    pairs = {}
    for name, frames in frame_sets(job).items():
        comparison = comparison_of(job, name, variant)
        if comparison is not None:
            silhouettes = silhouettes_of_frames(job, name, frames)
            relit = RelitPairs(frames, root / name, silhouettes)
            pairs[name] = relit.measured_in(comparison)
    return pairs


def comparison_of(job: Job, name: str, variant: str = MAIN) -> Comparison | None:
    """Metrics of one set of frames that the comparison stage has measured."""
    return read_comparison(job.stages.root / "comparison" / variant / f"{name}.json")


def read_comparison(path: Path) -> Comparison | None:
    """Metrics as the comparison stage writes them; None where it has not."""
    return Comparison.from_dict(json.loads(path.read_text())) if path.is_file() else None


# --- truth of simulated captures ----------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TruthScores:
    """Scores against the truth of a simulated capture; None where there is none.

    Parameters
    ----------
    hull : HullDistance, optional
    frames, base_frames : FrameErrors, optional
    completion : CompletionError, optional
    problems : tuple of str
        Files of the truth that could not be used, and why.
    """

    hull: HullDistance | None = None
    frames: FrameErrors | None = None
    base_frames: FrameErrors | None = None
    completion: CompletionError | None = None
    problems: tuple[str, ...] = ()


def truth_scores(job: Job, field: ReflectanceField) -> TruthScores | None:
    """All scores against the truth; without what of it is damaged. None without a truth."""
    try:
        truth = open_truth(job.capture.root)
    except InputError as error:
        return TruthScores(problems=(f"truth: not compared: {error}",))
    if truth is None:
        return None
    problems: list[str] = []

    def score(of: Callable[[], Any]) -> Any:
        try:
            return of()
        except InputError as error:
            problems.append(f"truth: not compared: {error}")
            return None

    hull = None if job.is_plane else score(lambda: hull_score(job, truth))
    frames, base = score(lambda: frame_scores(job, truth, field)) or (None, None)
    completion = score(lambda: completion_score(job, truth))
    return TruthScores(hull, frames, base, completion, tuple(problems))


def hull_score(job: Job, truth: Truth) -> HullDistance:
    """Distance of the hull to the true surface, also in voxels of the hull's grid."""
    details = json.loads((job.stages.root / "hull" / "hull.json").read_text())
    mesh = job.hull_mesh
    return hull_distance(
        (mesh.vertices, mesh.faces), truth.mesh(), voxel=details.get("spacing")
    )


def frame_scores(
    job: Job, truth: Truth, field: ReflectanceField
) -> tuple[FrameErrors, FrameErrors] | None:
    """Angles of the recovered and of the base frames to the true shading frames.

    One turn about the normal is free for each target and material; of the base frames, which
    have no target, for each material.
    """
    cameras = [c for c in job.training.cameras if truth.has_view(c.id)]
    if not cameras:
        return None
    surface = surface_points(truth.view(c.id, (c.width, c.height)) for c in cameras)
    seen = job.seen_texels
    reach = MATCH_SPACINGS * job.texels.spacing
    position = job.texels.position[seen]
    target = job.result("alignment", "alignment.npz")["cluster"][seen]
    return (
        frame_errors(position, field.local_from_world[seen], surface, reach, target),
        frame_errors(position, job.texels.local_from_world[seen], surface, reach, 0 * target),
    )


def completion_score(job: Job, truth: Truth) -> CompletionError | None:
    """Error of the completed nodes against true apparent BRDFs, seen and unseen.

    At every surface point whose full apparent BRDF the truth holds, the nearest texel's
    completed function is evaluated for all its directions.
    """
    points = truth.samples()
    if points is None or not job.training.lights_known:
        return None
    counts, expected = points["samples"].shape[1:3], (job.capture.n_views, job.capture.n_lights)
    if counts != expected:
        raise InputError(
            f"{truth.path('abrdf', '')}: samples: expected the capture's {expected[0]} views "
            f"and {expected[1]} lights, received {counts[0]} and {counts[1]}"
        )
    return _completion_at(job, points)


def _completion_at(job: Job, points: dict[str, NDArray[Any]]) -> CompletionError | None:
    seen = job.seen_texels
    distance, nearest = cKDTree(job.texels.position[seen]).query(points["position"])
    close = np.flatnonzero(distance < MATCH_SPACINGS * job.texels.spacing)
    if not len(close):
        return None
    texels = seen[nearest[close]]
    completed = completed_samples(job, texels, points["views"][close], points["lights"][close])
    # Shadows are traced when rendering; what a shadowed sample would be is not asked.
    lit = points["light_visible"][close][:, None, :]
    above = (points["views"][close] * points["frame"][close][:, None, 2]).sum(axis=2) > 0
    asked = np.broadcast_to(lit & above[:, :, None], completed.shape[:3])
    used = np.zeros(asked.shape, bool)
    training = np.ix_(
        np.arange(len(close)),
        job.split.training_views,
        job.split.training_lights,
    )
    measured = job.observed
    used[training] = (
        measured.views[texels][:, :, None]
        & measured.lights[texels][:, None, :]
        & measured.pairs[None]
    )
    return completion_error(completed[asked], points["samples"][close][asked], used[asked])


def completed_samples(
    job: Job, texels: NDArray[np.intp], views: NDArray[Any], lights: NDArray[Any]
) -> NDArray[np.float32]:
    """Samples of completed texels for directions of the world.

    Parameters
    ----------
    job : Job
        With its completion stage done.
    texels : (n,) int
    views, lights : (n, k, 3) float
        Unit vectors.

    Returns
    -------
    (n, n_views, n_lights, 3) float32
        1/sr, cosine included, without cast shadows.
    """
    stored = job.result("completion", "completion.npz")
    sides, domain = job.sides, job.options.resampling.domain
    columns = stored["mean"] + stored["coefficients"][texels] @ stored["basis"].T
    nodes = columns.reshape(len(texels), sides[0] ** 2, sides[1] ** 2, 3)
    frames = job.texels.local_from_world[texels]
    local = [local_directions(frames, d.astype(np.float32)) for d in (views, lights)]
    at_views, at_lights = (
        interpolation_matrices(direction_taps(d, side), side)
        for d, side in zip(local, sides, strict=True)
    )
    values = np.maximum(unroot(apply_both(at_views, at_lights, nodes), domain), 0)
    cosine = softened_cosine(local[1][..., 2]) if sides[1] > 1 else np.ones(lights.shape[:2])
    return (values * cosine[:, None, :, None]).astype(np.float32)
