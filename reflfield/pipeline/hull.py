"""Stage "hull": silhouettes to the watertight mesh that encloses the object."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from reflfield.errors import GeometryError
from reflfield.geometry.mesh import Mesh, write_ply
from reflfield.geometry.occlusion import cameras_inside, check_light_outside
from reflfield.geometry.plane import image_plane
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.visual_hull import HullReport, visual_hull
from reflfield.pipeline import results
from reflfield.pipeline.cache import WARNINGS, plain
from reflfield.pipeline.context import Context
from reflfield.pipeline.memory import keeps_distances, readers_at_once
from reflfield.util.quoting import listed

# Among the counts of the hull: names of the views that it is made without.
LEFT_OUT = "views left out"


def write_hull(context: Context, folder: Path) -> dict[str, Any]:
    """Base surface: the visual hull, or the image plane of a single view."""
    details: dict[str, Any] = {}
    counts: dict[str, Any] = {}
    if context.is_plane:
        mesh = image_plane(context.training.cameras[0], results.silhouettes(context)[0]).mesh
    else:
        mesh, hull = _carved(context, folder)
        details = {k: _listed(v) for k, v in asdict(hull).items()}
        counts = {
            "views that contradict the others": [c.view for c in hull.contradictions],
            LEFT_OUT: list(hull.left_out),
            "small parts left out": sum(hull.specks.values()),
            "median overlap with the silhouettes": float(np.median(hull.overlap)),
            "least overlap with a silhouette": float(hull.overlap.min()),
            WARNINGS: [*hull.warnings, *_made_among(context, hull)],
        }
    scene = RayScene(mesh)
    for light in context.training.lights:
        check_light_outside(scene, light)
    if inside := cameras_inside(scene, context.training.cameras):
        counts.setdefault(WARNINGS, []).append(
            f"cameras that stand inside the hull: {listed(inside)}; check their poses, and the "
            "silhouettes of the others"
        )
    write_ply(folder / "hull.ply", mesh)
    (folder / "hull.json").write_text(json.dumps(plain(details)))
    return {"triangles": len(mesh.faces), "watertight": mesh.watertight, **counts}


def _carved(context: Context, folder: Path) -> tuple[Mesh, HullReport]:
    """Visual hull; what does not fit into memory is kept in the folder meanwhile."""
    cameras, options = context.training.cameras, context.options.hull
    silhouettes = results.silhouettes(context)
    made = _is_made(context, 0)

    def carved(scratch: Path | None) -> tuple[Mesh, HullReport]:
        # Distances of an image take what reading a photograph does.
        workers = min(context.resources.workers, readers_at_once(context))
        return visual_hull(
            cameras, silhouettes, options, scratch=scratch, made=made, workers=workers
        )

    try:
        if keeps_distances(context):
            return carved(None)
        with TemporaryDirectory(dir=folder) as scratch:
            return carved(Path(scratch))
    except GeometryError as error:
        if made:
            raise GeometryError(f"{error}; {_MADE}") from error
        raise


# What to do about silhouettes that nobody gave.
_MADE = (
    "no masks were given, and those made from the photographs may miss dark parts or hold "
    "some of the backdrop; give masks (`reflfield masks` makes them by the hull of all views)"
)


def _made_among(context: Context, hull: HullReport) -> list[str]:
    """A warning where views that contradict the others were given no masks."""
    said = {contradiction.view for contradiction in hull.contradictions}
    views = [i for i, camera in enumerate(context.training.cameras) if camera.id in said]
    made = [context.training.cameras[i].id for i in views if _is_made(context, i)]
    return [f"{listed(made)}: {_MADE}"] if made else []


def _is_made(context: Context, view: int) -> bool:
    """Whether the silhouette of a view is made from its photographs."""
    return context.training.silhouette_origin(view) == "photographs"


def _listed(value: Any) -> Any:
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
