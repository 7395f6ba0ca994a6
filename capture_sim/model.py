"""What a scene is once its file has been read: everything that decides a capture.

Effects, renderer and writer depend on these classes; `capture_sim.scene` reads
them from TOML.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from capture_sim.errors import scene_error
from capture_sim.materials import Material
from capture_sim.objects import SurfaceMesh
from capture_sim.stopwatch import Stopwatch

MOST_PHOTOGRAPHS = 1_000_000
Table = Mapping[str, Any]
Options = TypeVar("Options")


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
class EffectOptions:
    """Which effects may be simulated, and the parameters that the scene gives them.

    Attributes
    ----------
    simulate : str or tuple of str
        ``"auto"`` for those that change a photograph by more than `tolerance`,
        ``"all"``, ``"none"``, or the names of those wanted.
    tolerance : float
        Largest change of a photograph that does not matter, as a part of its
        99th percentile.
    forced : dict of str to bool
        Effects switched on or off by name, whatever `simulate` says.
    parameters : tuple of dataclass
        Options of the effects that have a table in the scene.
    active : frozenset of str, optional
        Names of the effects that are on, once that has been decided.
    """

    simulate: str | tuple[str, ...] = "auto"
    tolerance: float = 1e-3
    forced: Mapping[str, bool] = field(default_factory=dict)
    parameters: tuple[object, ...] = ()
    active: frozenset[str] | None = None

    def declared(self, kind: type[Options]) -> Options | None:
        """Options of one effect if the scene has a table of them."""
        return next((item for item in self.parameters if isinstance(item, kind)), None)

    def get(self, kind: type[Options]) -> Options:
        """Options of one effect, its defaults where the scene has no table."""
        options = self.declared(kind)
        return kind() if options is None else options


@dataclass(frozen=True)
class Brightness:
    """How bright the photographs of a scene are; bounds on effects are parts of it.

    Attributes
    ----------
    percentile99 : float
        Lower bound on a photograph's 99th percentile of its values that are
        not black. Where nobody has measured it, that of a white surface that
        faces a light of the default irradiance.
    headroom : float
        Upper bound on the ratio of a photograph's brightest value to its 99th
        percentile; above 1 for highlights.
    brightest : float
        Upper bound on all values.
    noise : float
        Standard deviation of the sensor in the dark, as a part of the
        brightest photograph's 99th percentile.
    """

    percentile99: float = 1.0
    headroom: float = 1.0
    brightest: float = 1.0
    noise: float = 0.0


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
class Blocks:
    """How much is worked on at once; no result depends on it.

    Attributes
    ----------
    block : int
        Bytes of temporaries of one piece of work: rays, pairs of point and light, paths.
    images : int
        Bytes of the photographs of one view that are held before they are written.
    tables : int
        Bytes of what is kept for all views: light below the surface.
    lights : int
        Lamps that are worked on at once, with what is kept of each for all views.
    """

    block: int = 50 << 20
    images: int = 1 << 28
    tables: int = 1 << 30
    lights: int = 1 << 24

    def items(self, each: int) -> int:
        """How many items of so many bytes make a block.

        Examples
        --------
        >>> Blocks(block=1000).items(30), Blocks(block=1000).items(3000)
        (33, 1)
        """
        return max(1, self.block // each)


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
    heldout_photographs : int
        Photographs of unseen views under unseen lights.
    truth : TruthOptions
    seed : int
        Of noise, held-out photographs and truth points.
    brightness : Brightness
        Of its photographs, for decisions about effects.
    costs : Stopwatch
        Collects the time that each effect takes.
    blocks : Blocks
        How much is worked on at once.
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
    heldout_photographs: int = 0
    truth: TruthOptions = field(default_factory=TruthOptions)
    seed: int = 1
    brightness: Brightness = field(default_factory=Brightness)
    costs: Stopwatch = field(default_factory=Stopwatch, compare=False)
    blocks: Blocks = field(default_factory=Blocks, compare=False)

    def __post_init__(self) -> None:
        for what, items in (("cameras", self.cameras), ("lights", self.lights)):
            ids = [item["id"] for item in items]
            if not ids or len(set(ids)) != len(ids):
                raise scene_error(what, "one or more entries with unique ids", ids)
        if len(self.cameras) * len(self.lights) > MOST_PHOTOGRAPHS:
            raise scene_error(
                "cameras, lights",
                f"at most {MOST_PHOTOGRAPHS:,} photographs",
                f"{len(self.cameras)} views x {len(self.lights)} lights",
            )
        if self.heldout_photographs and any(c["model"] != "opencv" for c in self.cameras):
            raise scene_error(
                "heldout.photographs",
                "0 for cameras other than opencv, which transforms.json cannot describe",
                self.heldout_photographs,
                "remove [heldout]",
            )
        if self.heldout_photographs and any(light["type"] == "spot" for light in self.lights):
            raise scene_error(
                "heldout.photographs",
                "0 for spot lights",
                self.heldout_photographs,
                "remove [heldout]",
            )
