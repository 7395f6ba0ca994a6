"""Scores of a finished run against the truth of a simulated capture."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from reflfield.errors import InputError
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.metrics.completion_error import CompletionError, completion_error
from reflfield.metrics.frame_errors import (
    FrameErrors,
    frame_errors,
    surface_points,
    true_frames,
)
from reflfield.metrics.hull_distance import HullDistance, hull_distance
from reflfield.metrics.truth_files import Truth, open_truth
from reflfield.observations.frame_resampling import apply_both
from reflfield.observations.texel_samples import (
    direction_taps,
    interpolation_matrices,
    inverse_transform,
    local_directions,
)
from reflfield.pipeline import results
from reflfield.pipeline.context import Context
from reflfield.sphere.hemisphere import softened_cosine

# Texels farther from a true surface point than this many texel spacings see another part.
MATCH_SPACINGS = 2.0


@dataclass(frozen=True, eq=False)
class TruthScores:
    """Scores against the truth of a simulated capture; None where there is none.

    Parameters
    ----------
    surfaces : mapping of str to HullDistance
        Of the hull, and of the surface from normals where there is one.
    frames, base_frames : FrameErrors, optional
    completion : CompletionError, optional
    problems : tuple of str
        Files of the truth that could not be used, and why.
    """

    surfaces: Mapping[str, HullDistance] = field(default_factory=dict)
    frames: FrameErrors | None = None
    base_frames: FrameErrors | None = None
    completion: CompletionError | None = None
    problems: tuple[str, ...] = ()

    def counts(self) -> dict[str, float]:
        """Mean distances of the surfaces and median angles of the frames, with their units."""
        counts = {
            f"{name} to the truth, mm": surface.summary()["mean_mm"]
            for name, surface in self.surfaces.items()
        }
        if self.frames is not None and len(self.frames.texel):
            angles = self.frames.summary()
            for name in ("normal", "tangent"):
                counts[f"{name}s to the truth, degrees"] = angles[f"{name}_median_deg"]
        return counts


def truth_scores(context: Context, field: ReflectanceField) -> TruthScores | None:
    """All scores against the truth; without what of it is damaged. None without a truth."""
    try:
        truth = open_truth(context.capture.root)
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

    surfaces = {} if context.is_plane else score(lambda: surface_scores(context, truth))
    frames, base = score(lambda: frame_scores(context, truth, field)) or (None, None)
    completion = score(lambda: completion_score(context, truth))
    return TruthScores(surfaces or {}, frames, base, completion, tuple(problems))


def surface_scores(context: Context, truth: Truth) -> dict[str, HullDistance]:
    """Distances of hull and surface to the true one, also in voxels of the hull's grid."""
    details = json.loads((context.stages.root / "hull" / "hull.json").read_text())
    meshes = {"hull": results.hull_mesh(context)}
    if (base := results.base_mesh(context)) is not meshes["hull"]:
        meshes["hull without hollows"] = base
    if context.refined.on_surface:
        meshes["surface from normals"] = results.surface_mesh(context)
    return {
        name: hull_distance(
            (mesh.vertices, mesh.faces), truth.mesh(), voxel=details.get("spacing")
        )
        for name, mesh in meshes.items()
    }


def frame_scores(
    context: Context, truth: Truth, field: ReflectanceField
) -> tuple[FrameErrors, FrameErrors] | None:
    """Angles of the recovered and of the base frames to the true shading frames.

    One rotation about the normal is undetermined for each target and material; of the base
    frames, which have no target, for each material.
    """
    cameras = [c for c in context.training.cameras if truth.has_view(c.id)]
    if not cameras:
        return None
    surface = surface_points(truth.view(c.id, (c.width, c.height)) for c in cameras)
    seen = results.measured_texels(context)
    reach = MATCH_SPACINGS * results.texels(context).spacing
    position = results.texels(context).position[seen]
    target = np.zeros(len(seen), np.int32)
    if context.options.aligns:
        target = results.arrays(context, "alignment", "alignment.npz")["cluster"][seen]
    true = true_frames(position, surface, reach)
    base = results.texels(context).local_from_world[seen]
    return (
        frame_errors(true, field.local_from_world[seen], target),
        frame_errors(true, base, 0 * target),
    )


def completion_score(context: Context, truth: Truth) -> CompletionError | None:
    """Error of the completed nodes against true apparent BRDFs, seen and unseen.

    At every surface point whose full apparent BRDF the truth holds, the nearest texel's
    completed function is evaluated for all its directions.
    """
    points = truth.samples()
    known = context.training.lights_known
    completes = context.options.aligns and not context.photometric
    if points is None or not known or not completes:
        return None
    counts, expected = (
        points["samples"].shape[1:3],
        (context.capture.n_views, context.capture.n_lights),
    )
    if counts != expected:
        raise InputError(
            f"{truth.path('abrdf', '')}: samples: expected the capture's {expected[0]} views "
            f"and {expected[1]} lights, received {counts[0]} and {counts[1]}"
        )
    return _completion_at(context, points)


def _completion_at(context: Context, points: dict[str, NDArray[Any]]) -> CompletionError | None:
    seen = results.measured_texels(context)
    distance, nearest = cKDTree(results.texels(context).position[seen]).query(
        points["position"]
    )
    close = np.flatnonzero(distance < MATCH_SPACINGS * results.texels(context).spacing)
    if not len(close):
        return None
    texels = seen[nearest[close]]
    completed = completed_samples(
        context, texels, points["views"][close], points["lights"][close]
    )
    # Shadows are traced when rendering; what a shadowed sample would be is not asked.
    lit = points["light_visible"][close][:, None, :]
    above = (points["views"][close] * points["frame"][close][:, None, 2]).sum(axis=2) > 0
    asked = np.broadcast_to(lit & above[:, :, None], completed.shape[:3])
    used = np.zeros(asked.shape, bool)
    training = np.ix_(
        np.arange(len(close)),
        context.split.training_views,
        context.split.training_lights,
    )
    measured = results.observed(context)
    used[training] = (
        measured.views[texels][:, :, None]
        & measured.lights[texels][:, None, :]
        & measured.pairs.table[None]
    )
    return completion_error(completed[asked], points["samples"][close][asked], used[asked])


def completed_samples(
    context: Context, texels: NDArray[np.intp], views: NDArray[Any], lights: NDArray[Any]
) -> NDArray[np.float32]:
    """Samples of completed texels for directions of the world.

    Parameters
    ----------
    context : Context
        With its completion stage done.
    texels : (n,) int
    views, lights : (n, k, 3) float
        Unit vectors.

    Returns
    -------
    (n, n_views, n_lights, 3) float32
        1/sr, cosine included, without cast shadows.
    """
    stored = results.arrays(context, "completion", "completion.npz")
    sides, domain = context.grid_sides, context.options.resampling.domain
    columns = stored["mean"] + stored["coefficients"][texels] @ stored["basis"].T
    nodes = columns.reshape(len(texels), sides[0] ** 2, sides[1] ** 2, 3)
    frames = results.texels(context).local_from_world[texels]
    local = [local_directions(frames, d.astype(np.float32)) for d in (views, lights)]
    at_views, at_lights = (
        interpolation_matrices(direction_taps(d, side), side)
        for d, side in zip(local, sides, strict=True)
    )
    values = np.maximum(inverse_transform(apply_both(at_views, at_lights, nodes), domain), 0)
    cosine = softened_cosine(local[1][..., 2]) if sides[1] > 1 else np.ones(lights.shape[:2])
    return (values * cosine[:, None, :, None]).astype(np.float32)
