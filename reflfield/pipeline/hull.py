"""Stage "hull": silhouettes to the watertight mesh that encloses the object."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from reflfield.geometry.mesh import Mesh, write_ply
from reflfield.geometry.occlusion import check_light_outside
from reflfield.geometry.plane import image_plane
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.visual_hull import HullReport, visual_hull
from reflfield.pipeline.cache import WARNINGS, plain
from reflfield.pipeline.context import Job
from reflfield.pipeline.memory import keeps_distances

# Among the counts of the hull: names of the views that it is made without.
LEFT_OUT = "views left out"


def write_hull(job: Job, folder: Path) -> dict[str, Any]:
    """Base surface: the visual hull, or the image plane of a single view."""
    details: dict[str, Any] = {}
    counts: dict[str, Any] = {}
    if job.is_plane:
        mesh = image_plane(job.training.cameras[0], job.view_silhouettes[0]).mesh
    else:
        mesh, made = _carved(job, folder)
        details = {k: _listed(v) for k, v in asdict(made).items()}
        counts = {
            "views that contradict the others": [c.view for c in made.contradictions],
            LEFT_OUT: list(made.left_out),
            "small parts left out": sum(made.specks.values()),
            WARNINGS: list(made.warnings),
        }
    scene = RayScene(mesh)
    for light in job.training.lights:
        check_light_outside(scene, light)
    write_ply(folder / "hull.ply", mesh)
    (folder / "hull.json").write_text(json.dumps(plain(details)))
    return {"triangles": len(mesh.faces), "watertight": mesh.watertight, **counts}


def _carved(job: Job, folder: Path) -> tuple[Mesh, HullReport]:
    """Visual hull; what does not fit into memory is kept in the folder meanwhile."""
    cameras, options = job.training.cameras, job.options.hull
    if keeps_distances(job):
        return visual_hull(cameras, job.view_silhouettes, options)
    with TemporaryDirectory(dir=folder) as scratch:
        return visual_hull(cameras, job.view_silhouettes, options, scratch=Path(scratch))


def _listed(value: Any) -> Any:
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
