"""Stages "surface": a surface from fitted normals, and what is seen, read and lit on it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from threading import BoundedSemaphore
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import GeometryError
from reflfield.fitting.normal_integration import (
    FittedNormals,
    confidence_of,
    integrated_displacements,
    moved_vertices,
    silhouette_anchors,
)
from reflfield.geometry.mesh import Mesh, write_ply
from reflfield.geometry.silhouette_distance import SignedDistance, signed_distance
from reflfield.geometry.uv_atlas import Atlas
from reflfield.pipeline import results
from reflfield.pipeline.atlas import write_atlas_arrays
from reflfield.pipeline.context import Context
from reflfield.pipeline.half_vector_fit import (
    MODEL,
    HalfVectorFit,
    fitted_on_hull,
    write_model,
)
from reflfield.pipeline.indirect import write_indirect
from reflfield.pipeline.memory import readers_at_once
from reflfield.pipeline.observations import lost_observations, write_observations
from reflfield.pipeline.visibility import write_visibility


def write_surface(context: Context, folder: Path) -> dict[str, Any]:
    """Fit on the hull, and move the hull so that it has the fitted normals."""
    fit = HalfVectorFit(context)
    fitted_to_images = fitted_on_hull(fit, folder)
    model, texels = fitted_to_images.model, results.texels(context)
    normals = model.frames[:, 2].astype(np.float64)
    fitted = FittedNormals(
        positions=texels.position,
        base=texels.normal.astype(np.float64),
        normals=normals,
        confidence=confidence_of(fitted_to_images.information),
    )
    silhouettes = results.silhouettes(context)
    # As many at a time as the ceiling of memory allows: those of all views may not fit.
    readers = BoundedSemaphore(readers_at_once(context))

    def distance_of(view: int) -> SignedDistance | None:
        with readers:
            return _distance(silhouettes[view])

    anchors = silhouette_anchors(
        *(context.training.cameras, distance_of, texels.position, normals),
        workers=context.resources.workers,
    )
    height = integrated_displacements(fitted, fit.graph, anchors)
    atlas = moved_atlas(results.atlas(context), texels.position, height[:, None] * fitted.base)
    write_atlas_arrays(folder / "atlas.npz", atlas)
    write_ply(folder / "surface.ply", welded(atlas)[0])
    write_model(folder / MODEL, model, fit.white)
    return {
        "mean displacement": float(np.abs(height).mean()),
        "texels at anchors": int((anchors > 0.5).sum()),
    }


def _distance(silhouette: NDArray[np.floating]) -> SignedDistance | None:
    try:
        return signed_distance(silhouette)
    except GeometryError:  # nothing, or everything, is covered
        return None


def welded(atlas: Atlas) -> tuple[Mesh, NDArray[np.intp]]:
    """Mesh whose vertices at one place are one, and the number of each of the atlas's."""
    places, number = np.unique(atlas.positions, axis=0, return_inverse=True)
    return Mesh(places, number.ravel()[atlas.faces].astype(np.int32)), number.ravel()


def moved_atlas(
    atlas: Atlas, positions: NDArray[np.float64], moves: NDArray[np.float64]
) -> Atlas:
    """Atlas whose vertices move as the texels (n, 3) around them do, with new normals."""
    moved = moved_vertices(atlas.positions, positions, moves)
    mesh, number = welded(replace(atlas, positions=moved))
    return replace(atlas, positions=moved, normals=mesh.vertex_normals[number])


def write_surface_visibility(context: Context, folder: Path) -> dict[str, Any]:
    """Which camera and which light each texel of the new surface sees."""
    return write_visibility(context.refined, folder)


def write_surface_observations(context: Context, folder: Path) -> dict[str, Any]:
    """Samples of the texels of the new surface."""
    return write_observations(context.refined, folder)


def lost_surface_observations(context: Context, folder: Path) -> str:
    """What is wrong with those samples in a store elsewhere; empty if nothing is."""
    return lost_observations(context.refined, folder)


def write_surface_indirect(context: Context, folder: Path) -> dict[str, Any]:
    """Indirect light on the new surface."""
    return write_indirect(context.refined, folder)
