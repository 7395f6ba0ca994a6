"""Scenes: what stands in the dome, read from TOML and checked at once.

A scene file holds the tables below; only `object`, `material`, `cameras` and
`lights` are required, each naming a preset (see ``capture-sim presets``)::

    name = "vase"                    # default: the file's stem
    description = "one line"
    seed = 1                         # of noise, held-out frames and truth points
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

    [effects]
    shadows = "auto"                 # "on", "off"
    exposure_seconds = [0.1, 1.0]    # bracketed 8-bit PNGs; linear EXR if left out
    [effects.sensor_noise]
    electrons_per_radiance = 1e5
    read_noise = 2.0                 # electrons

    [heldout]
    frames = 4                       # each with an unseen view and an unseen light
    [truth]
    per_view = true                  # depth, position, frames, label, visibility
    points = 400                     # surface points with full apparent BRDFs
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from capture_sim.dome import make_cameras, make_lights
from capture_sim.errors import SceneError, scene_error
from capture_sim.materials import Material, make_material
from capture_sim.objects import SurfaceMesh, make_object
from capture_sim.tables import TableReader, check_number

Table = Mapping[str, Any]

SHIPPED = Path(__file__).parent / "scenes"


@dataclass(frozen=True)
class ImageOptions:
    """Rays per pixel.

    Attributes
    ----------
    samples_per_side : int
        Rays along each side of a pixel inside the object.
    edge_samples_per_side : int
        The same where an outline crosses the pixel; also the precision of
        the silhouettes, 1 / edge_samples_per_side**2.
    """

    samples_per_side: int = 2
    edge_samples_per_side: int = 4


@dataclass(frozen=True)
class NoiseOptions:
    """Sensor noise.

    Attributes
    ----------
    electrons_per_radiance : float
        Expected electrons for radiance 1.
    read_noise : float
        Standard deviation in electrons.
    """

    electrons_per_radiance: float
    read_noise: float = 0.0


@dataclass(frozen=True)
class EffectOptions:
    """Which effects may be simulated; each decides for itself if it is called for.

    Attributes
    ----------
    shadows : str
        ``"auto"``, ``"on"`` or ``"off"``.
    sensor_noise : NoiseOptions or None
        None for a perfect sensor.
    exposure_seconds : tuple of float
        Exposure times of bracketed 8-bit photographs; none for linear ones.
    """

    shadows: str = "auto"
    sensor_noise: NoiseOptions | None = None
    exposure_seconds: tuple[float, ...] = ()


@dataclass(frozen=True)
class TruthOptions:
    """Which truth is written beside the photographs.

    Attributes
    ----------
    per_view : bool
        True for depth, position, frames, label and light visibility per view.
    points : int
        Surface points whose full apparent BRDF is written; 0 for none.
    """

    per_view: bool = True
    points: int = 400


@dataclass(frozen=True)
class Scene:
    """Everything that determines a simulated capture.

    Attributes
    ----------
    name, description : str
    mesh : SurfaceMesh
        The true surface.
    material : Material
    cameras, lights : tuple of dict
        In the native capture format.
    base_geometry : str
        ``"hull"`` or ``"plane"``, a hint for those who process the capture.
    image : ImageOptions
    effects : EffectOptions
    heldout_frames : int
        Photographs of unseen views under unseen lights.
    truth : TruthOptions
    seed : int
        Of noise, held-out frames and truth points.
    """

    name: str
    mesh: SurfaceMesh
    material: Material
    cameras: tuple[Table, ...]
    lights: tuple[Table, ...]
    description: str = ""
    base_geometry: str = "hull"
    image: ImageOptions = field(default_factory=ImageOptions)
    effects: EffectOptions = field(default_factory=EffectOptions)
    heldout_frames: int = 0
    truth: TruthOptions = field(default_factory=TruthOptions)
    seed: int = 1

    def __post_init__(self) -> None:
        for what, items in (("cameras", self.cameras), ("lights", self.lights)):
            ids = [item["id"] for item in items]
            if not ids or len(set(ids)) != len(ids):
                raise scene_error(what, "one or more entries with unique ids", ids)
        if self.heldout_frames and any(c["model"] != "opencv" for c in self.cameras):
            raise scene_error(
                "heldout.frames",
                "0 for cameras other than opencv, which transforms.json cannot describe",
                self.heldout_frames,
                "remove [heldout]",
            )
        if self.heldout_frames and any(light["type"] == "spot" for light in self.lights):
            raise scene_error(
                "heldout.frames", "0 for spot lights", self.heldout_frames, "remove [heldout]"
            )


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
    if path.is_file():
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
    table = _read_toml(path)
    try:
        return parse_scene(table, default_name=path.stem, folder=path.parent)
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error


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
        effects=_effect_options(reader.take("effects", {})),
        heldout_frames=_heldout_frames(reader.take("heldout", {})),
        truth=_truth_options(reader.take("truth", {})),
    )
    reader.finish()
    return scene


def _read_toml(path: Path) -> Table:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise scene_error(str(path), "a TOML file", str(error), "correct the syntax") from error


def _text(reader: TableReader, key: str, default: str) -> str:
    value = reader.take(key, default)
    if not isinstance(value, str) or "\n" in value:
        raise scene_error(reader.name(key), "one line of text", value)
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


def _effect_options(table: Table) -> EffectOptions:
    reader = TableReader("effects", table)
    shadows = reader.choice("shadows", "auto", ("auto", "on", "off"))
    noise = reader.take("sensor_noise")
    seconds = reader.take("exposure_seconds")
    reader.finish()
    return EffectOptions(
        shadows=shadows,
        sensor_noise=None if noise is None else _noise_options(noise),
        exposure_seconds=() if seconds is None else _exposure_seconds(seconds),
    )


def _exposure_seconds(value: Any) -> tuple[float, ...]:
    what = "effects.exposure_seconds"
    if not isinstance(value, list) or not 1 <= len(value) <= 64:
        raise scene_error(what, "a list of 1 to 64 exposure times", value)
    return tuple(check_number(what, time, low=1e-9, high=1e9) for time in value)


def _noise_options(table: Table) -> NoiseOptions:
    reader = TableReader("effects.sensor_noise", table)
    reader.require("electrons_per_radiance")
    reader = TableReader("effects.sensor_noise", table)
    options = NoiseOptions(
        electrons_per_radiance=reader.number("electrons_per_radiance", 0.0, low=1e-12),
        read_noise=reader.number("read_noise", 0.0, low=0.0),
    )
    reader.finish()
    return options


def _heldout_frames(table: Table) -> int:
    reader = TableReader("heldout", table)
    frames = reader.count("frames", 0, low=0, high=4096)
    reader.finish()
    return frames


def _truth_options(table: Table) -> TruthOptions:
    reader = TableReader("truth", table)
    options = TruthOptions(
        per_view=reader.flag("per_view", True),
        points=reader.count("points", 400, low=0),
    )
    reader.finish()
    return options
