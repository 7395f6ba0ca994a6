"""Scenes: what stands in the dome, read from TOML and checked at once.

A scene file holds the tables below; only `object`, `material`, `cameras` and
`lights` are required, each naming a preset (see ``capture-sim presets``)::

    name = "vase"                    # default: the file's stem
    description = "one line"
    seed = 1                         # of noise, held-out photographs and truth points
    base_geometry = "hull"           # "plane": a flat sample, first camera facing it

    [object]
    preset = "vase"
    [material]
    preset = "gold"
    [cameras]
    preset = "rings"
    [lights]
    preset = "rings"

    [image]
    samples_per_side = 2             # rays along each side of a pixel, inside
    edge_samples_per_side = 4        # the same where an outline crosses it

    [effects]                        # or: effects = "auto"
    simulate = "auto"                # "all", "none", or a list of names
    tolerance = 1e-3                 # changes below this part of a photograph's 99th percentile
    shadows = "off"                  # any effect: "on", "off", "auto"; or its parameters:
    [effects.sensor_noise]
    electrons_per_radiance = 1e5
    read_noise = 2.0                 # electrons

    [heldout]
    photographs = 4                  # each with an unseen view and an unseen light
    [truth]
    per_view = true                  # depth, position, frames, label, visibility
    points = 400                     # surface points with full apparent BRDFs
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from capture_sim.dome import make_cameras, make_lights
from capture_sim.effects.effect_registry import read_effects
from capture_sim.errors import SceneError, scene_error
from capture_sim.inputs import read_bytes
from capture_sim.materials import make_material
from capture_sim.model import EffectOptions, ImageOptions, Scene, TruthOptions
from capture_sim.objects import make_object
from capture_sim.placement import check_outside
from capture_sim.tables import TableReader

Table = Mapping[str, Any]

__all__ = [
    "EffectOptions",
    "ImageOptions",
    "Scene",
    "TruthOptions",
    "find_scene",
    "load_scene",
    "parse_scene",
    "shipped_scenes",
]

LARGEST_FILE = 4 << 20
LONGEST_TEXT = 1000
SHIPPED = Path(__file__).parent / "scenes"


def shipped_scenes() -> dict[str, str]:
    """Names and one-line descriptions of the scenes in the package.

    Returns
    -------
    dict
        Sorted by name.

    Examples
    --------
    >>> "demo_vase" in shipped_scenes()
    True
    """
    files = sorted(SHIPPED.glob("*.toml"))
    return {file.stem: str(_read_toml(file).get("description", "")) for file in files}


def find_scene(name_or_path: str) -> Path:
    """File of a scene given by path or by the name of a shipped one.

    Parameters
    ----------
    name_or_path : str
        Path of a TOML file, or a name from `shipped_scenes`.

    Returns
    -------
    Path

    Raises
    ------
    SceneError
        If there is neither.
    """
    path = Path(name_or_path)
    if os.path.lexists(path) and not path.is_dir():
        return path
    shipped = SHIPPED / f"{name_or_path}.toml"
    if path.name == name_or_path and shipped.is_file():
        return shipped
    raise scene_error(
        "scene",
        "a TOML file or one of " + ", ".join(shipped_scenes()),
        repr(name_or_path),
        "check the path, or see `capture-sim presets`",
    )


def load_scene(name_or_path: str) -> Scene:
    """Read a scene file, or a shipped scene by name.

    Parameters
    ----------
    name_or_path : str
        As in `find_scene`.

    Returns
    -------
    Scene

    Raises
    ------
    SceneError
        If the file is missing, is not TOML, or holds an unknown key or a bad
        value; the message names the file and the key.
    """
    path = find_scene(name_or_path)
    try:
        return parse_scene(_read_toml(path), default_name=path.stem, folder=path.parent)
    except SceneError as error:
        text = str(error)
        raise SceneError(text if text.startswith(str(path)) else f"{path}: {text}") from error
    except RecursionError as error:
        raise scene_error(
            str(path), "tables in some levels", "tables in each other without end"
        ) from error


def parse_scene(table: Table, *, default_name: str = "scene", folder: Path = Path()) -> Scene:
    """Build a scene from the tables of a scene file.

    Parameters
    ----------
    table : mapping
        Contents of the file.
    default_name : str
        Name of the scene if the file gives none.
    folder : Path
        Where relative paths inside start.

    Returns
    -------
    Scene

    Raises
    ------
    SceneError
        On an unknown key or a bad value; names the key, what was expected and
        what to do.
    """
    reader = TableReader("scene", table)
    mesh = make_object(_required_table(reader, "object"), folder)
    material = make_material(_required_table(reader, "material"), folder=folder)
    if material.uses_uv:
        mesh.require_uv("the material")
    scene = Scene(
        name=_text(reader, "name", default_name),
        description=_text(reader, "description", ""),
        seed=reader.count("seed", 1, low=0, high=2**32 - 1),
        base_geometry=reader.choice("base_geometry", "hull", ("hull", "plane")),
        mesh=mesh,
        material=material,
        cameras=tuple(make_cameras(_required_table(reader, "cameras"))),
        lights=tuple(make_lights(_required_table(reader, "lights"))),
        image=_image_options(reader.take("image", {})),
        effects=read_effects(reader.take("effects", {})),
        heldout_photographs=_heldout_photographs(reader.take("heldout", {})),
        truth=_truth_options(reader.take("truth", {})),
    )
    reader.finish()
    check_outside(scene.mesh, scene.cameras, scene.lights)
    return scene


def _read_toml(path: Path) -> Table:
    content = read_bytes(path, LARGEST_FILE)
    try:
        return tomllib.loads(content.decode("utf-8"))
    except ValueError as error:  # of syntax, of encoding, of integers of too many digits
        reason = " ".join(str(error).split())
        raise scene_error(str(path), "a TOML file", reason, "correct the syntax") from error


def _text(reader: TableReader, key: str, default: str) -> str:
    value = reader.take(key, default)
    if not isinstance(value, str):
        raise scene_error(reader.name(key), "one line of text", value)
    if not value.isprintable() or len(value) > LONGEST_TEXT:
        expected = f"one line of up to {LONGEST_TEXT} printable characters"
        raise scene_error(reader.name(key), expected, repr(value[:80]))
    return value


def _required_table(reader: TableReader, key: str) -> Table:
    value = reader.require(key)
    if not isinstance(value, Mapping):
        raise scene_error(reader.name(key), "a table", value, f"write a [{key}] table")
    return value


def _image_options(table: Table) -> ImageOptions:
    reader = TableReader("image", table)
    options = ImageOptions(
        samples_per_side=reader.count("samples_per_side", 2, high=64),
        edge_samples_per_side=reader.count("edge_samples_per_side", 4, high=64),
    )
    reader.finish()
    return options


def _heldout_photographs(table: Table) -> int:
    reader = TableReader("heldout", table)
    reader.accept_renamed("frames", "photographs")
    photographs = reader.count("photographs", 0, low=0, high=4096)
    reader.finish()
    return photographs


def _truth_options(table: Table) -> TruthOptions:
    reader = TableReader("truth", table)
    options = TruthOptions(
        per_view=reader.flag("per_view", True),
        points=reader.count("points", 400, low=0),
    )
    reader.finish()
    return options
