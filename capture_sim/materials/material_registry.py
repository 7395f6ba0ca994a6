"""Materials from TOML tables, and ready-made tables by name."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from capture_sim.errors import scene_error
from capture_sim.materials.analytic import GGX, AshikhminShirley, Lambert
from capture_sim.materials.base import Material
from capture_sim.materials.rgl import read_rgl
from capture_sim.materials.spatial import Mixed, SpatiallyVarying
from capture_sim.materials.textures import Texture, make_texture
from capture_sim.materials.translucent import Translucent
from capture_sim.tables import Table, TableReader

DEEPEST = 8  # materials within materials
SMOOTHEST, ROUGHEST = 1e-4, 1.0
LARGEST_EXPONENT = 1e6
SHORTEST_LENGTH, LONGEST_LENGTH = 1e-7, 1e3  # metres

# Refraction index and extinction coefficient at about 630, 530 and 465 nm, from
# the tables of P. B. Johnson and R. W. Christy (1972) and A. D. Rakic (1995).
METALS = {
    "gold": ((0.18, 0.54, 1.30), (3.07, 2.27, 1.89)),
    "copper": ((0.27, 1.10, 1.16), (3.61, 2.59, 2.44)),
    "silver": ((0.13, 0.13, 0.13), (4.05, 3.23, 2.72)),
    "aluminium": ((1.45, 0.94, 0.68), (7.54, 6.41, 5.62)),
}

PRESETS: dict[str, dict[str, Any]] = {
    "matte_clay": {"type": "lambert", "albedo": [0.50, 0.26, 0.16]},
    "grey_card": {"type": "lambert", "albedo": 0.18},
    "glazed_ceramic": {
        "type": "ggx",
        "diffuse": [0.09, 0.22, 0.36],
        "specular": 0.05,
        "alpha": 0.12,
    },
    "satin": {
        "type": "textured",
        "base": {
            "type": "ashikhmin_shirley",
            "diffuse": [0.28, 0.04, 0.09],
            "specular": [0.25, 0.16, 0.18],
            "exponent_u": 8.0,
            "exponent_v": 120.0,
        },
        "tangent_angle": {
            "type": "stripes",
            "columns": 2,
            "rows": 3,
            "softness": 1.0,
            "values": [-0.5, 0.5],
        },
    },
    "brushed_metal": {
        "type": "ggx",
        "metal": "aluminium",
        "alpha_x": 0.45,
        "alpha_y": 0.12,
    },
    "gold": {"type": "ggx", "metal": "gold", "alpha": 0.2},
    "gold_leaf": {
        "type": "textured",
        "base": {"type": "ggx", "metal": "gold", "alpha": 0.22},
        "height": {"type": "noise", "frequency": 24, "octaves": 3, "seed": 7},
        "height_scale": 0.01,
    },
    "painted_vase": {
        "type": "mixed",
        "labels": {
            "type": "bands",
            "edges": [[0.25, 0.29], [0.55, 0.59], [0.80, 1.0]],
        },
        "materials": [
            {
                "type": "ggx",
                "specular": 0.05,
                "alpha": 0.15,
                "diffuse": {
                    "type": "noise",
                    "frequency": 6,
                    "octaves": 4,
                    "seed": 3,
                    "values": [[0.50, 0.16, 0.06], [0.68, 0.34, 0.14]],
                },
            },
            {
                "type": "textured",
                "base": {"type": "ggx", "metal": "gold", "alpha_x": 0.4, "alpha_y": 0.15},
                "tangent_angle": {
                    "type": "stripes",
                    "columns": 3,
                    "rows": 0,
                    "softness": 1.0,
                    "values": [-0.6, 0.6],
                },
            },
        ],
    },
    "marble": {
        "type": "translucent",
        "albedo": [0.82, 0.78, 0.72],
        "length": [0.006, 0.004, 0.003],
        "refraction": 1.5,
        "coat": {"type": "ggx", "specular": 0.04, "diffuse": 0.0, "alpha": 0.25},
    },
    "greek_key": {
        "type": "mixed",
        "labels": {"type": "meander", "columns": 12, "rows": 8},
        "materials": [
            {"type": "lambert", "albedo": [0.58, 0.25, 0.10]},
            {"type": "ggx", "diffuse": 0.02, "specular": 0.05, "alpha": 0.1},
        ],
    },
}


def material_presets() -> dict[str, dict[str, Any]]:
    """Ready-made material tables by name; a scene names one as ``preset = "satin"``.

    Returns
    -------
    dict of str to table
        Fresh copies that the caller may change.

    Examples
    --------
    >>> material_presets()["grey_card"]
    {'type': 'lambert', 'albedo': 0.18}
    """
    return copy.deepcopy(PRESETS)


def make_material(
    table: Table, folder: Path = Path(), *, what: str = "material", depth: int = 0
) -> Material:
    """Build a material from a TOML table.

    Parameters
    ----------
    table : mapping
        ``type`` and its keys (below), or ``preset`` and keys that override it.
        Wherever a number or colour stands, a texture table may stand.
    folder : Path
        Folder of the scene, which file names are relative to.
    what : str
        Name used in messages.
    depth : int
        Level of nesting, counted by this function itself.

    Returns
    -------
    Material

    Raises
    ------
    SceneError
        For unknown types, keys and presets, and values out of range.

    Notes
    -----
    ====================  =====================================================
    type                  keys
    ====================  =====================================================
    lambert               albedo
    ashikhmin_shirley     specular, diffuse, exponent_u, exponent_v
    ggx                   specular, diffuse, alpha or alpha_x and alpha_y,
                          metal or eta and kappa, correlated
    rgl                   file
    textured              base (a material), tint, tangent_angle (radians),
                          normal_map, height, height_scale
    mixed                 materials (a list), labels
    translucent           albedo, length (diffusion length, metres), refraction,
                          coat (a material); the whole object, not part of another
    ====================  =====================================================

    Examples
    --------
    >>> make_material({"type": "lambert", "albedo": 0.5})
    Lambert(albedo=Constant(value=(0.5,)))
    >>> make_material({"type": "ggx", "alpha": 2.0})
    Traceback (most recent call last):
    ...
    capture_sim.errors.SceneError: material.alpha: expected values in [0.0001, 1], received 2
    """
    if depth > DEEPEST:
        raise scene_error(what, f"at most {DEEPEST} levels of materials", "more")
    entries = _with_preset(table, what)
    reader = _MaterialReader(what, entries, folder, depth)
    kind = reader.choice("type", "", sorted(_MAKERS))
    material = _MAKERS[kind](reader)
    reader.finish()
    return material


def _with_preset(table: Table, what: str) -> dict[str, Any]:
    """Entries of the table over those of the preset that it names."""
    if not isinstance(table, Mapping):
        raise scene_error(what, "a table of a material", table)
    entries = dict(table)
    if (name := entries.pop("preset", None)) is None:
        return entries
    if not isinstance(name, str) or name not in PRESETS:
        raise scene_error(f"{what}.preset", "one of " + ", ".join(sorted(PRESETS)), name)
    return {**material_presets()[name], **entries}


class _MaterialReader(TableReader):
    """Table reader that also makes textures and nested materials."""

    def __init__(self, what: str, table: Table, folder: Path, depth: int) -> None:
        super().__init__(what, table)
        self.folder, self.depth = folder, depth

    def texture(
        self,
        key: str,
        default: Any,
        *,
        low: float = 0.0,
        high: float = 1.0,
        encoding: str = "srgb",
    ) -> Texture:
        return make_texture(
            self.take(key, default),
            self.name(key),
            low=low,
            high=high,
            folder=self.folder,
            encoding=encoding,
        )

    def optional_texture(self, key: str) -> Texture | None:
        value = self.take(key)
        if value is None:
            return None
        return make_texture(
            value, self.name(key), low=0.0, high=1.0, folder=self.folder, encoding="linear"
        )

    def material(self, key: str, table: Any) -> Material:
        return make_material(
            table, folder=self.folder, what=self.name(key), depth=self.depth + 1
        )


def _lambert(reader: _MaterialReader) -> Material:
    return Lambert(reader.texture("albedo", 0.5))


def _ashikhmin_shirley(reader: _MaterialReader) -> Material:
    exponents = {
        key: reader.texture(key, 100.0, high=LARGEST_EXPONENT, encoding="linear")
        for key in ("exponent_u", "exponent_v")
    }
    return AshikhminShirley(
        reader.texture("specular", 0.05), reader.texture("diffuse", 0.5), **exponents
    )


def _ggx(reader: _MaterialReader) -> Material:
    conductor = _conductor(reader)
    both = reader.take("alpha", 0.2)
    alphas = {}
    for key in ("alpha_x", "alpha_y"):
        value = reader.take(key)
        name = reader.name("alpha" if value is None else key)
        alphas[key] = make_texture(
            both if value is None else value,
            name,
            low=SMOOTHEST,
            high=ROUGHEST,
            folder=reader.folder,
            encoding="linear",
        )
    return GGX(
        reader.texture("specular", 0.04 if conductor is None else 1.0),
        reader.texture("diffuse", 0.5 if conductor is None else 0.0),
        **alphas,
        conductor=conductor,
        correlated=reader.flag("correlated", True),
    )


def _conductor(
    reader: _MaterialReader,
) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    metal, eta, kappa = (reader.take(key) for key in ("metal", "eta", "kappa"))
    if metal is not None:
        if not isinstance(metal, str) or metal not in METALS:
            raise scene_error(reader.name("metal"), "one of " + ", ".join(METALS), metal)
        return METALS[metal]
    if eta is None and kappa is None:
        return None
    pair = []
    for key, value in (("eta", eta), ("kappa", kappa)):
        texture = make_texture(value, reader.name(key), low=0.0, high=100.0)
        pair.append(tuple(float(v) for v in texture.rgb(np.zeros((1, 2)))[0]))
    return pair[0], pair[1]


def _rgl(reader: _MaterialReader) -> Material:
    return read_rgl(reader.file("file", reader.folder))


def _textured(reader: _MaterialReader) -> Material:
    turn = 2.0 * np.pi
    return SpatiallyVarying(
        reader.material("base", reader.require("base")),
        tint=reader.texture("tint", 1.0),
        tangent_angle=reader.texture(
            "tangent_angle", 0.0, low=-turn, high=turn, encoding="linear"
        ),
        normal_map=reader.optional_texture("normal_map"),
        height=reader.optional_texture("height"),
        height_scale=reader.number("height_scale", 0.0, low=-10.0, high=10.0),
    )


def _translucent(reader: _MaterialReader) -> Material:
    if reader.depth > 0:
        raise scene_error(
            reader.what, "a material of a surface", "translucent",
            "make the whole object translucent: light crosses from one part to another",
        )  # fmt: skip
    albedo, length = reader.vector("albedo", (0.8,) * 3), reader.vector("length", (0.005,) * 3)
    if not ((albedo >= 0.0) & (albedo < 1.0)).all():
        raise scene_error(reader.name("albedo"), "values in [0, 1)", albedo.tolist())
    if not ((length >= SHORTEST_LENGTH) & (length <= LONGEST_LENGTH)).all():
        expected = f"values in [{SHORTEST_LENGTH:g}, {LONGEST_LENGTH:g}]"
        raise scene_error(reader.name("length"), expected, length.tolist())
    coat = reader.take("coat", {"type": "lambert", "albedo": 0.0})
    return Translucent(
        reader.material("coat", coat),
        tuple(albedo.tolist()),
        tuple(length.tolist()),
        reader.number("refraction", 1.3, low=1.0, high=4.0),
    )


def _mixed(reader: _MaterialReader) -> Material:
    tables = reader.require("materials")
    if not isinstance(tables, list) or not 1 <= len(tables) <= 256:
        raise scene_error(reader.name("materials"), "a list of 1 to 256 materials", tables)
    materials = tuple(
        reader.material(f"materials[{i}]", table) for i, table in enumerate(tables)
    )
    labels = reader.texture("labels", 0.0, high=len(tables) - 1, encoding="linear")
    return Mixed(materials, labels)


_MAKERS: dict[str, Callable[[_MaterialReader], Material]] = {
    "ashikhmin_shirley": _ashikhmin_shirley,
    "ggx": _ggx,
    "lambert": _lambert,
    "mixed": _mixed,
    "rgl": _rgl,
    "textured": _textured,
    "translucent": _translucent,
}
