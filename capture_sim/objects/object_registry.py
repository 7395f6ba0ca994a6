"""Objects from TOML tables, and ready-made tables by name."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from capture_sim.errors import scene_error
from capture_sim.objects.convexity import is_convex
from capture_sim.objects.mesh import SurfaceMesh
from capture_sim.objects.mesh_files import mesh_from_file
from capture_sim.objects.plates import plane, relief
from capture_sim.objects.revolution import bowl, sphere, vase
from capture_sim.tables import Table, TableReader

PRESETS: dict[str, dict[str, Any]] = {
    "vase": {"type": "vase"},
    "amphora": {"type": "vase", "handles": 2},
    "bowl": {"type": "bowl"},
    "sphere": {"type": "sphere"},
    "relief": {"type": "relief"},
    "wavy_plate": {"type": "relief", "pattern": "waves", "height": 0.004},
    "flat_sample": {"type": "plane", "size": [0.1, 0.1]},
}


def object_presets() -> dict[str, dict[str, Any]]:
    """Ready-made object tables by name; a scene names one as ``preset = "vase"``.

    Returns
    -------
    dict of str to table
        Fresh copies that the caller may change.

    Examples
    --------
    >>> object_presets()["amphora"]
    {'type': 'vase', 'handles': 2}
    """
    return copy.deepcopy(PRESETS)


def make_object(table: Table, folder: Path = Path()) -> SurfaceMesh:
    """Build an object from a TOML table.

    Parameters
    ----------
    table : mapping
        ``type`` and its keys (below), or ``preset`` and keys that override it.
    folder : Path
        Folder of the scene, which file names are relative to.

    Returns
    -------
    SurfaceMesh

    Raises
    ------
    SceneError
        For unknown types, keys and presets, values out of range and unusable files.

    Notes
    -----
    ========  ==============================================================
    type      keys (metres unless they say otherwise)
    ========  ==============================================================
    vase      height, handles (0 to 2), open, around, along (facets)
    bowl      radius, around, along (facets)
    sphere    radius, around
    relief    size [x, y], pattern (logo, waves, bumps, image), file, height,
              thickness (0: the relief alone), facets
    plane     size [x, y]
    mesh      file, scale or size (largest extent), centre, rotation_deg
              [x, y, z] applied in that order, position, smooth
    ========  ==============================================================

    Examples
    --------
    >>> round(make_object({"preset": "sphere", "radius": 0.05}).radius, 9)
    0.05
    """
    if not isinstance(table, Mapping):
        raise scene_error("object", "a table", table)
    entries = dict(table)
    if (name := entries.pop("preset", None)) is not None:
        if not isinstance(name, str) or name not in PRESETS:
            raise scene_error("object.preset", "one of " + ", ".join(sorted(PRESETS)), name)
        entries = {**object_presets()[name], **entries}
    reader = TableReader("object", entries)
    kind = reader.choice("type", "", sorted(_MAKERS))
    mesh = _MAKERS[kind](reader, folder)
    reader.finish()
    return replace(mesh, convex=is_convex(mesh))


_MAKERS: dict[str, Callable[[TableReader, Path], SurfaceMesh]] = {
    "bowl": bowl,
    "mesh": mesh_from_file,
    "plane": plane,
    "relief": relief,
    "sphere": sphere,
    "vase": vase,
}
