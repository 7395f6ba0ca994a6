"""Stage "atlas": mesh to UV charts, as fine as the photographs see it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from reflfield.capture.capture import Capture
from reflfield.errors import GeometryError
from reflfield.geometry.mesh import Mesh
from reflfield.geometry.plane import image_plane
from reflfield.geometry.uv_atlas import Atlas, built_atlas, fallback_words
from reflfield.pipeline import results
from reflfield.pipeline.cache import WARNINGS
from reflfield.pipeline.context import Context
from reflfield.pipeline.pipeline_options import SMALLEST_TEXTURE

# Among the counts of the atlas: who made the charts.
METHOD = "charts made by"
# Share of a texture that charts usually cover.
TYPICAL_USE = 0.6


def write_atlas(context: Context, folder: Path) -> dict[str, Any]:
    """UV charts of the base surface, as fine as the photographs see it."""
    if context.is_plane:
        atlas = image_plane(context.training.cameras[0], results.silhouettes(context)[0])
        method = "plane"
        warnings: list[str] = []
    else:
        options = context.options.atlas
        mesh = results.base_mesh(context)
        resolution = options.resolution or derived_resolution(context, mesh)
        built = built_atlas(mesh, replace(options, resolution=resolution))
        atlas, method = built.atlas, built.method
        warnings = [fallback_words(built.reason)] if built.reason else []
    write_atlas_arrays(folder / "atlas.npz", atlas)
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


def derived_resolution(context: Context, mesh: Mesh) -> int:
    """Side of a texture whose texels are a little finer than the cameras' pixels."""
    texel = pixel_width(context.training, mesh) / context.options.texture.texels_per_pixel
    if not texel > 0:
        raise GeometryError("cameras: expected the object in front of most, found it behind")
    side = np.sqrt(mesh.area / TYPICAL_USE) / texel
    side = np.clip(np.ceil(side / 16) * 16, SMALLEST_TEXTURE, context.options.texture.largest)
    return int(side)
