"""A half-vector field for Mitsuba 3: plug-in, arrays, mesh and a script that renders.

The folder needs Mitsuba and NumPy, not this package. The plug-in evaluates the field as
`field.half_vector` does; see ``mitsuba_scene/reflfield_bsdf.py``.
"""

from __future__ import annotations

import json
import math
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.errors import InputError
from reflfield.export.material_maps import export_atlas
from reflfield.field.half_vector import (
    HALF_SIDE,
    N_DIFFERENCE,
    N_LIGHT,
    N_PHASE,
    N_VIEW,
    SKEW_RINGS,
)
from reflfield.field.reflectance_field import HalfVectorField, ReflectanceField
from reflfield.geometry.mesh import Mesh, ply_bytes
from reflfield.geometry.texels import frames
from reflfield.geometry.uv_atlas import Atlas
from reflfield.render.turntable import OrbitOptions, orbit_cameras
from reflfield.util.files import filling

FILES = ("reflfield_bsdf.py", "render.py")
# Texels are numbered in single precision.
_MOST_TEXELS = 1 << 24


def write_mitsuba(path: Path, field: ReflectanceField) -> list[str]:
    """Write the folder.

    Parameters
    ----------
    path : Path
        Folder.
    field : ReflectanceField
        A half-vector field.

    Returns
    -------
    list of str
        What to know of the result.

    Raises
    ------
    InputError
        If the field is of another model.
    """
    if not isinstance(field, HalfVectorField) or field.n_texels > _MOST_TEXELS:
        raise InputError(
            f"field: expected a half-vector field of at most {_MOST_TEXELS} texels, received "
            f"one of model {field.model!r} with {field.n_texels}; make one with "
            "`settings=compression.model=half_vector`, or export it with `to='gltf'`"
        )
    options = OrbitOptions(n_images=1, up=tuple(field.up))
    camera = orbit_cameras(field.positions, options)[0]
    centre = 0.5 * (field.positions.min(axis=0) + field.positions.max(axis=0))
    offset = camera.centre - centre
    x_axis, _, y_axis = frames(field.up[None], np.array([[1.0, 0.0, 0.0]]))[0]
    to_world = np.eye(4)
    to_world[:3, :3] = np.stack([x_axis, y_axis, np.cross(x_axis, y_axis)], axis=1)
    about = {
        "up": field.up.tolist(),
        "camera": (offset / np.linalg.norm(offset)).tolist(),
        "distance": float(np.linalg.norm(offset)),
        "fov": options.field_of_view_deg,
        "centre": centre.tolist(),
        "texel_width": math.sqrt(Mesh(field.positions, field.faces).area / field.n_texels),
        "world_from_environment": to_world.tolist(),
    }
    with filling(path) as partial:
        for name in FILES:
            source = resources.files(__package__) / "mitsuba_scene" / name
            (partial / name).write_text(source.read_text(encoding="utf-8"), encoding="utf-8")
        (partial / "scene.json").write_text(json.dumps(about, indent=1), encoding="utf-8")
        (partial / "object.ply").write_bytes(_ply(export_atlas(field), centre))
        np.savez_compressed(partial / "model.npz", allow_pickle=False, **_arrays(field))
    said = [f"render it: python {path / 'render.py'} --out image.exr (pip install mitsuba)"]
    if field.visibility == "kept":
        said.append("shadows are in the field, and Mitsuba traces them once more")
    return said


def _arrays(field: HalfVectorField) -> dict[str, NDArray[np.generic]]:
    model = field.half_vector
    return {
        "texel_of_pixel": field.texel_of_pixel,
        "frames": model.frames,
        "diffuse": model.diffuse,
        "weights": model.weights,
        "lobes": model.lobes.reshape(-1, N_DIFFERENCE, HALF_SIDE, HALF_SIDE, 3),
        "skews": model.skews.reshape(-1, N_DIFFERENCE, SKEW_RINGS, 3),
        "diffuse_table": model.diffuse_table.reshape(N_PHASE, N_VIEW, N_LIGHT),
    }


def _ply(atlas: Atlas, centre: NDArray[np.float64]) -> bytes:
    """Mesh with texture coordinates, around the origin: it is stored in single precision."""
    columns = np.hstack([atlas.positions - centre, atlas.uv]).astype(np.float32).T
    return ply_bytes(dict(zip("xyzuv", columns, strict=True)), atlas.faces)
