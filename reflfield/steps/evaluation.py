"""Stage that compares the field with photographs, and with the truth where there is one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from reflfield.capture.model import Capture
from reflfield.capture.readers import open_capture
from reflfield.comparison.heldout import RelitPairs, compare_with_photographs
from reflfield.comparison.metrics import Comparison, compare_frames, metrics_text
from reflfield.comparison.truth import (
    CompletionError,
    FrameErrors,
    HullDistance,
    Truth,
    completion_error,
    frame_errors,
    hull_distance,
    open_truth,
    surface_points,
)
from reflfield.config import Resources
from reflfield.field.file import open_field
from reflfield.field.model import ReflectanceField
from reflfield.observations.resampling import (
    apply_both,
    direction_taps,
    interpolation_matrices,
    local_directions,
    unroot,
)
from reflfield.relighting.renderer import RenderOptions
from reflfield.sphere.hemisphere import softened_cosine
from reflfield.steps.job import Job

# Texels farther from a true surface point than this many texel spacings see another part.
MATCH_SPACINGS = 2.0
# Folders of the comparison: of the field itself, and of the one that it is compared with.
MAIN, WITHOUT = "field", "without_alignment"


def write_comparison(job: Job, folder: Path) -> dict[str, Any]:
    """Relight held-out frames and measure them; without any, say so."""
    counts: dict[str, Any] = {}
    for variant, stage in variants(job).items():
        field = open_field(job.stages.root / stage / "field.rfld")
        counts |= _compare(job, field, folder / variant, variant)
    compared = [folder / MAIN / f"{name}.json" for name in ("heldout", "truth")]
    main = next((json.loads(path.read_text()) for path in compared if path.is_file()), None)
    (folder / "metrics.json").write_text(metrics_text(main))
    return {"frames": sum(len(f.photographs) for f in frame_sets(job).values()), **counts}


def _compare(job: Job, field: ReflectanceField, folder: Path, variant: str) -> dict[str, float]:
    folder.mkdir(exist_ok=True)
    options = within_memory(job.options.relighting, job.resources)
    counts = {}
    for name, frames in frame_sets(job).items():
        comparison, _ = compare_with_photographs(field, frames, folder / name, options)
        (folder / f"{name}.json").write_text(comparison.to_json())
        words = f"{name} PSNR, dB" if variant == MAIN else f"{name} PSNR {variant}, dB"
        counts[words.replace("_", " ")] = comparison.mean["psnr_ldr"]
    return counts


def variants(job: Job) -> dict[str, str]:
    """Stage that makes the field of each variant that is compared."""
    stages = {MAIN: "compression"}
    if job.options.compares_without_alignment:
        stages[WITHOUT] = "without_alignment"
    return stages


# Memory of one ray through a pixel: hits, footprints of up to twelve texels, radiance.
RAY_BYTES = 4096


def within_memory(options: RenderOptions, resources: Resources) -> RenderOptions:
    """Blocks of pixels that all threads together can work on; the pictures stay the same."""
    each = RAY_BYTES * options.samples_per_pixel
    workers = options.workers or resources.workers
    fits = max(4 * resources.block_bytes // (workers * each), 64)
    return replace(options, workers=workers, block_pixels=min(options.block_pixels, fits))


def frame_sets(job: Job) -> dict[str, Capture]:
    """Held-out photographs, and the unseen frames that a simulated capture brings."""
    sets: dict[str, Capture] = {}
    if job.held_frames.photographs:
        sets["heldout"] = job.held_frames
    truth = open_truth(job.capture.root)
    frames = truth.heldout() if truth else None
    if frames is not None:
        sets["truth"] = open_capture(frames)
    return sets


def relit_pairs(job: Job, variant: str = MAIN) -> dict[str, RelitPairs]:
    """What the comparison stage has relit."""
    root = job.stages.root / "comparison" / variant
    return {name: RelitPairs(frames, root / name) for name, frames in frame_sets(job).items()}


def metrics_path(job: Job, name: str) -> Path:
    """File of the metrics of one set of frames, relit from the field."""
    return job.stages.root / "comparison" / MAIN / f"{name}.json"


# --- truth of simulated captures ----------------------------------------------------------


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
    cameras = [c.id for c in job.training.cameras if truth.has_view(c.id)]
    if not cameras:
        return None
    surface = surface_points([truth.view(c) for c in cameras])
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


def comparison_of(job: Job, name: str, variant: str = MAIN) -> Comparison | None:
    """Metrics of one set, measured again from the stored pictures."""
    pairs = relit_pairs(job, variant).get(name)
    return compare_frames(pairs) if pairs is not None and len(pairs) else None
