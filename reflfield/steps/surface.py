"""Stages that find the base surface: silhouettes, hull, atlas, visibility."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from reflfield.errors import GeometryError, InputError
from reflfield.geometry.atlas import Atlas, build_atlas
from reflfield.geometry.hull import visual_hull
from reflfield.geometry.mesh import Mesh, write_ply
from reflfield.geometry.plane import image_plane
from reflfield.geometry.visibility import (
    RayScene,
    check_light_outside,
    light_visibility,
    view_visibility,
)
from reflfield.progress import track
from reflfield.stages import plain
from reflfield.steps.job import Job
from reflfield.steps.options import SMALLEST_TEXTURE


def write_silhouettes(job: Job, folder: Path) -> dict[str, Any]:
    """Coverage of every training view, read or made, as 8-bit arrays."""
    capture = job.training
    views: dict[str, Any] = {}
    for i in track(range(capture.n_views), capture.n_views, "silhouettes"):
        views[f"view{i}"] = np.rint(capture.read_silhouette(i) * 255).astype(np.uint8)
    np.savez_compressed(folder / "silhouettes.npz", **views)
    given = sum(path is not None for path in capture.silhouettes)
    return {"views": capture.n_views, "silhouettes given": given}


def write_hull(job: Job, folder: Path) -> dict[str, Any]:
    """Base surface: the visual hull, or the image plane of a single view."""
    if job.is_plane:
        mesh = image_plane(job.training.cameras[0], job.view_silhouettes[0]).mesh
        details: dict[str, Any] = {}
    else:
        mesh, found = visual_hull(job.training.cameras, job.view_silhouettes, job.options.hull)
        details = {k: _listed(v) for k, v in asdict(found).items()}
    scene = RayScene(mesh)
    for light in job.training.lights:
        check_light_outside(scene, light)
    write_ply(folder / "hull.ply", mesh)
    (folder / "hull.json").write_text(json.dumps(plain(details)))
    return {"triangles": len(mesh.faces), "watertight": mesh.watertight}


def _listed(value: Any) -> Any:
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


def write_atlas(job: Job, folder: Path) -> dict[str, Any]:
    """UV charts of the base surface, as fine as the photographs see it."""
    if job.is_plane:
        atlas = image_plane(job.training.cameras[0], job.view_silhouettes[0])
    else:
        options = job.options.atlas
        resolution = options.resolution or derived_resolution(job, job.hull_mesh)
        atlas = build_atlas(job.hull_mesh, replace(options, resolution=resolution))
    write_atlas_arrays(folder / "atlas.npz", atlas)
    job.__dict__.pop("surface_atlas", None)
    return {"charts": int(atlas.chart.max()) + 1, "texture": [atlas.height, atlas.width]}


def write_atlas_arrays(path: Path, atlas: Atlas) -> None:
    """Store an atlas without pickling."""
    np.savez(
        path,
        positions=atlas.positions,
        faces=atlas.faces,
        uv=atlas.uv,
        chart=atlas.chart,
        normals=atlas.normals,
        size=np.array([atlas.height, atlas.width]),
    )


# Share of a texture that charts usually cover.
TYPICAL_USE = 0.6


def derived_resolution(job: Job, mesh: Mesh) -> int:
    """Side of a texture whose texels are a little finer than the nearest camera's pixels."""
    centre = mesh.bounds.mean(axis=0)[None]
    footprints = []
    for camera in job.training.cameras:
        _, depth = camera.project(centre)
        scale = 1.0 if camera.kind == "orthographic" else float(depth[0])
        footprints.append(scale / max(camera.fl_x, camera.fl_y))
    texel = float(np.median(footprints)) / job.options.texture.texels_per_pixel
    if not texel > 0:
        raise GeometryError("cameras: expected the object in front of most, found it behind")
    side = np.sqrt(mesh.area / TYPICAL_USE) / texel
    side = np.clip(np.ceil(side / 16) * 16, SMALLEST_TEXTURE, job.options.texture.largest)
    return int(side)


def write_visibility(job: Job, folder: Path) -> dict[str, Any]:
    """Which camera and which light each texel sees."""
    capture, texels = job.training, job.texels
    scene = RayScene(job.surface_atlas.mesh, threads=job.resources.workers)
    options = job.options.visibility
    total = capture.n_views + capture.n_lights
    views = np.zeros((len(texels), capture.n_views), bool)
    lights = np.zeros((len(texels), capture.n_lights), bool)
    for i in track(range(total), total, "visibility"):
        if i < capture.n_views:
            silhouette = None if job.is_plane else job.view_silhouettes[i]
            views[:, i] = view_visibility(
                texels, scene, capture.cameras[i], options, silhouette=silhouette
            )
        else:
            light = capture.lights[i - capture.n_views]
            lights[:, i - capture.n_views] = light_visibility(texels, scene, light, options)
    if not views.any():
        raise InputError(
            "cameras: expected at least one that sees the surface, found none; check the "
            "calibration against the silhouettes"
        )
    np.savez_compressed(folder / "visibility.npz", views=views, lights=lights)
    return {
        "texels": len(texels),
        "texels that no camera sees": int((~views.any(axis=1)).sum()),
        "views per texel": float(views.sum(axis=1).mean()),
        "lights per texel": float(lights.sum(axis=1).mean()),
    }
