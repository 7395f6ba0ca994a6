"""Stages that find the base surface: silhouettes, hull, atlas, visibility."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.capture import Capture
from reflfield.errors import GeometryError, InputError
from reflfield.geometry.mesh import Mesh, write_ply
from reflfield.geometry.occlusion import (
    VisibilityOptions,
    check_light_outside,
    light_visibility,
    view_visibility,
)
from reflfield.geometry.plane import image_plane
from reflfield.geometry.ray_scene import RayScene
from reflfield.geometry.texels import TexelTable
from reflfield.geometry.uv_atlas import Atlas, built_atlas, fallback_words
from reflfield.geometry.visual_hull import HullReport, visual_hull
from reflfield.pipeline.cache import WARNINGS, plain
from reflfield.pipeline.context import Job
from reflfield.pipeline.memory import keeps_distances, silhouettes_at_once
from reflfield.pipeline.pipeline_options import SMALLEST_TEXTURE
from reflfield.pipeline.silhouette_store import SILHOUETTES, store_silhouettes
from reflfield.util.dask_cluster import threads_here

# Among the counts of the hull: names of the views that it is made without.
LEFT_OUT = "views left out"
# Among the counts of the atlas: who made the charts.
METHOD = "charts made by"
# Views, or lights, of one block.
DIRECTIONS_AT_ONCE = 8
# Pixels of the silhouettes of one block.
PIXELS_AT_ONCE = 16 << 20


def write_silhouettes(job: Job, folder: Path) -> dict[str, Any]:
    """Coverage of every training view, read or made, as 8-bit arrays."""
    capture = job.training
    found = job.blocks(folder).map(
        "silhouettes",
        silhouettes_block,
        capture,
        silhouette_runs(capture),
        at_once=silhouettes_at_once(job),
    )
    views = (named for arrays in found for named in arrays.items())
    store_silhouettes(folder / SILHOUETTES, views)
    given = sum(path is not None for path in capture.silhouettes)
    return {"views": capture.n_views, "silhouettes given": given}


def silhouettes_block(capture: Capture, views: range) -> dict[str, Any]:
    """Coverage of some views, 8 bits."""
    return {
        f"view{i}": np.rint(capture.read_silhouette(i) * 255).astype(np.uint8) for i in views
    }


def silhouette_runs(capture: Capture) -> list[range]:
    """Views whose silhouettes are made together: of large images, few."""
    pixels = max(camera.width * camera.height for camera in capture.cameras)
    step = int(np.clip(PIXELS_AT_ONCE // pixels, 1, DIRECTIONS_AT_ONCE))
    n = capture.n_views
    return [range(i, min(i + step, n)) for i in range(0, n, step)]


def runs(n: int) -> list[range]:
    """Views or lights that are handled together.

    Examples
    --------
    >>> runs(20)
    [range(0, 8), range(8, 16), range(16, 20)]
    """
    return [range(i, min(i + DIRECTIONS_AT_ONCE, n)) for i in range(0, n, DIRECTIONS_AT_ONCE)]


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


def write_atlas(job: Job, folder: Path) -> dict[str, Any]:
    """UV charts of the base surface, as fine as the photographs see it."""
    if job.is_plane:
        atlas, method = image_plane(job.training.cameras[0], job.view_silhouettes[0]), "plane"
        warnings: list[str] = []
    else:
        options = job.options.atlas
        resolution = options.resolution or derived_resolution(job, job.hull_mesh)
        built = built_atlas(job.hull_mesh, replace(options, resolution=resolution))
        atlas, method = built.atlas, built.method
        warnings = [fallback_words(built.reason)] if built.reason else []
    write_atlas_arrays(folder / "atlas.npz", atlas)
    job.__dict__.pop("surface_atlas", None)
    return {
        "charts": int(atlas.chart.max()) + 1,
        "texture": [atlas.height, atlas.width],
        METHOD: method,
        WARNINGS: warnings,
    }


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


def pixel_width(capture: Capture, mesh: Mesh) -> float:
    """Width of a pixel on the object, metres; the median of the cameras."""
    centre = mesh.bounds.mean(axis=0)[None]
    footprints = []
    for camera in capture.cameras:
        _, depth = camera.project(centre)
        scale = 1.0 if camera.kind == "orthographic" else float(depth[0])
        footprints.append(scale / max(camera.fl_x, camera.fl_y))
    return float(np.median(footprints))


# Share of a texture that charts usually cover.
TYPICAL_USE = 0.6


def derived_resolution(job: Job, mesh: Mesh) -> int:
    """Side of a texture whose texels are a little finer than the cameras' pixels."""
    texel = pixel_width(job.training, mesh) / job.options.texture.texels_per_pixel
    if not texel > 0:
        raise GeometryError("cameras: expected the object in front of most, found it behind")
    side = np.sqrt(mesh.area / TYPICAL_USE) / texel
    side = np.clip(np.ceil(side / 16) * 16, SMALLEST_TEXTURE, job.options.texture.largest)
    return int(side)


@dataclass(frozen=True, eq=False)
class Sight:
    """What all blocks of views and lights share whose visibility is traced.

    Parameters
    ----------
    capture : Capture
    texels : TexelTable
    mesh : Mesh
    options : VisibilityOptions
    covered : sequence of (n,) uint8 or None
        Pixels of the views that the object covers, row by row, eight in a byte.
    threads : int
        For rays; a cluster's worker uses its own number.
    """

    capture: Capture
    texels: TexelTable
    mesh: Mesh
    options: VisibilityOptions
    covered: Sequence[NDArray[np.uint8] | None]
    threads: int

    def silhouette(self, view: int) -> NDArray[np.bool_] | None:
        """Pixels (h, w) of a view that the object covers."""
        bits, camera = self.covered[view], self.capture.cameras[view]
        if bits is None:
            return None
        pixels = np.unpackbits(bits, count=camera.width * camera.height)
        return pixels.reshape(camera.height, camera.width).astype(np.bool_)


def sight_block(context: Sight, block: tuple[str, range]) -> dict[str, Any]:
    """Which texels some views or lights see, (n_texels, k)."""
    kind, some = block
    scene = RayScene(context.mesh, threads=threads_here(context.threads))
    capture, texels, options = context.capture, context.texels, context.options
    if kind == "views":
        columns = [
            view_visibility(
                texels, scene, capture.cameras[i], options, silhouette=context.silhouette(i)
            )
            for i in some
        ]
    else:
        columns = [light_visibility(texels, scene, capture.lights[i], options) for i in some]
    return {"seen": np.stack(columns, axis=1)}


def covered_pixels(job: Job) -> list[NDArray[np.uint8]]:
    """Pixels of each view that count as covered by the object, eight in a byte."""
    least = job.options.visibility.coverage
    return [np.packbits(silhouette >= least) for silhouette in job.view_silhouettes]


def write_visibility(job: Job, folder: Path) -> dict[str, Any]:
    """Which camera and which light each texel sees."""
    capture, texels = job.training, job.texels
    context = Sight(
        capture,
        texels,
        job.surface_atlas.mesh,
        job.options.visibility,
        [None] * capture.n_views if job.is_plane else covered_pixels(job),
        job.resources.workers,
    )
    view_runs, light_runs = runs(capture.n_views), runs(capture.n_lights)
    named = [("views", run) for run in view_runs] + [("lights", run) for run in light_runs]
    # The rays have threads of their own.
    found = job.blocks(folder).map("visibility", sight_block, context, named, at_once=1)
    columns = [arrays["seen"] for arrays in found]
    views = np.concatenate(columns[: len(view_runs)], axis=1)
    lights = np.concatenate(columns[len(view_runs) :], axis=1)
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
