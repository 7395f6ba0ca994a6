"""Objects to simulate: triangle meshes with normals, tangents and coordinates.

All lengths are metres; objects stand on or around the world's origin, +Z up.
Normals are those of the smooth surface that the triangles stand for, tangents
its derivative dP/du.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from capture_sim.errors import scene_error
from capture_sim.materials.textures import read_image
from capture_sim.tables import Table, TableReader

Array = NDArray[np.float64]
Faces = NDArray[np.int32]
HeightField = Callable[[Array], Array]

# Relative to the size of the object: corners closer than this are one corner.
SAME_CORNER = 1e-9
MOST_FACES = 20_000_000


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """The true surface of a simulated object.

    Vertices are repeated along seams of the texture coordinates and along creases,
    so that all arrays have one row per vertex.

    Parameters
    ----------
    vertices : (n, 3) float64
        Metres, world frame.
    faces : (m, 3) int32
        Counter-clockwise seen from outside.
    uv : (n, 2) float64
        Texture coordinates, v up; zeros if the object has none.
    normals : (n, 3) float64
        Unit smooth normals, outward.
    tangents : (n, 3) float64
        Unit directions of dP/du, orthogonal to the normals.
    convex : bool
        True if no point of the surface can shadow or hide another.
    has_uv : bool
        True if `uv` means anything.
    name : str
        Kind or file the mesh was made from.
    """

    vertices: Array
    faces: Faces
    uv: Array
    normals: Array
    tangents: Array
    convex: bool = False
    has_uv: bool = True
    name: str = "object"

    @property
    def centre(self) -> Array:
        """Centre of the bounding box, (3,) float64."""
        return np.asarray((self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2.0)

    @property
    def radius(self) -> float:
        """Radius of the sphere about `centre` that holds the object, metres."""
        return float(np.linalg.norm(self.vertices - self.centre, axis=1).max())

    def require_uv(self, reason: str) -> None:
        """Refuse the object if something needs texture coordinates it lacks.

        Parameters
        ----------
        reason : str
            Who needs them, for the message.

        Raises
        ------
        SceneError
            If `has_uv` is False.
        """
        if not self.has_uv:
            raise scene_error(
                f"object ({self.name})",
                f"texture coordinates, which {reason} needs",
                "a mesh without",
                "unwrap the mesh, or choose a material that is the same everywhere",
            )


PRESETS: dict[str, dict[str, Any]] = {
    "vase": {"type": "vase"},
    "amphora": {"type": "vase", "handles": 2},
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
    sphere    radius, around
    relief    size [x, y], pattern (logo, waves, bumps, image), file, height,
              thickness (0: the relief alone), facets
    plane     size [x, y]
    mesh      file, scale or size (largest extent), centre, rotation_deg
              [x, y, z] applied in that order, position
    ========  ==============================================================

    Examples
    --------
    >>> round(make_object({"preset": "sphere", "radius": 0.05}).radius, 9)
    0.05
    """
    entries = dict(table)
    if (name := entries.pop("preset", None)) is not None:
        if name not in PRESETS:
            raise scene_error("object.preset", "one of " + ", ".join(sorted(PRESETS)), name)
        entries = {**object_presets()[name], **entries}
    reader = TableReader("object", entries)
    kind = reader.choice("type", "", sorted(_MAKERS))
    mesh = _MAKERS[kind](reader, folder)
    reader.finish()
    return mesh


# ---------------------------------------------------------------- grids of points


def _grid_faces(n_rows: int, n_columns: int) -> Faces:
    """Two triangles per cell of a grid of vertices, counter-clockwise in (u, v)."""
    row, column = np.mgrid[: n_rows - 1, : n_columns - 1]
    corner = (row * n_columns + column).ravel()
    right, above = corner + 1, corner + n_columns
    lower = np.stack([corner, right, above + 1], axis=1)
    upper = np.stack([corner, above + 1, above], axis=1)
    return np.concatenate([lower, upper]).astype(np.int32)


def _without_slivers(vertices: Array, faces: Faces) -> Faces:
    """Faces whose three corners are apart; poles of grids leave others."""
    corners = vertices[faces]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return faces[sides.min(axis=1) > SAME_CORNER * np.ptp(vertices, axis=0).max()]


def _joined(parts: list[SurfaceMesh], name: str) -> SurfaceMesh:
    """Several surfaces as one, not merged where they touch."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return SurfaceMesh(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)]).astype(
            np.int32
        ),
        uv=np.concatenate([part.uv for part in parts]),
        normals=np.concatenate([part.normals for part in parts]),
        tangents=np.concatenate([part.tangents for part in parts]),
        name=name,
    )


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, np.finfo(np.float64).tiny))


# ------------------------------------------------------------- surfaces of revolution


def revolve(profile: Array, slopes: Array, around: int, name: str) -> SurfaceMesh:
    """Surface of revolution about +Z.

    Parameters
    ----------
    profile : (n, 2) float64
        Radius and height from the bottom to the top, outside to the right.
    slopes : (n, 2) float64
        Direction of the profile at each of its points.
    around : int
        Facets around the axis.
    name : str
        Name of the mesh.

    Returns
    -------
    SurfaceMesh
        u runs once around (a seam at the +X side), v along the profile by length.
        At the axis, tangents are kept per facet and normals follow the profile.

    Examples
    --------
    An open cylinder of height 1:

    >>> sides = np.array([[1.0, 0.0], [1.0, 1.0]])
    >>> up = np.array([[0.0, 1.0], [0.0, 1.0]])
    >>> revolve(sides, up, 4, "cylinder").normals[0]
    array([1., 0., 0.])
    """
    azimuth = np.linspace(0.0, 2.0 * np.pi, around + 1)
    c, s = np.cos(azimuth), np.sin(azimuth)
    c[-1], s[-1] = c[0], s[0]  # the seam closes exactly
    radius, height = profile[:, :1], profile[:, 1:]
    vertices = np.stack([radius * c, radius * s, height + 0.0 * c], axis=-1)
    across = _unit(slopes)
    normal_out, normal_up = across[:, 1:], -across[:, :1]
    normals = np.stack([normal_out * c, normal_out * s, normal_up + 0.0 * c], axis=-1)
    tangents = np.stack(np.broadcast_arrays(-s, c, np.zeros_like(height)), axis=-1)
    steps = np.linalg.norm(np.diff(profile, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    u, v = np.meshgrid(azimuth / (2.0 * np.pi), length)
    flat = vertices.reshape(-1, 3)
    return SurfaceMesh(
        vertices=flat,
        faces=_without_slivers(flat, _grid_faces(len(profile), around + 1)),
        uv=np.stack([u.ravel(), v.ravel()], axis=1),
        normals=normals.reshape(-1, 3),
        tangents=tangents.reshape(-1, 3).copy(),
        name=name,
    )


def _sphere(reader: TableReader, folder: Path) -> SurfaceMesh:
    radius = reader.number("radius", 0.1, low=1e-6, high=1e3)
    around = reader.count("around", 192, low=8, high=4096)
    angle = np.linspace(-np.pi / 2.0, np.pi / 2.0, around // 2 + 1)
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    directions[[0, -1], 0] = 0.0  # exactly on the axis
    slopes = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    ball = revolve(radius * directions, slopes, around, "sphere")
    return SurfaceMesh(
        ball.vertices, ball.faces, ball.uv, ball.normals, ball.tangents, True, name="sphere"
    )


# Radius and height of a vase of height 1: foot, belly, shoulder, neck, lip.
VASE_OUTSIDE = np.array(
    [
        [0.000, 0.000],
        [0.120, 0.000],
        [0.165, 0.000],
        [0.178, 0.012],
        [0.160, 0.040],
        [0.170, 0.070],
        [0.245, 0.200],
        [0.310, 0.360],
        [0.325, 0.480],
        [0.290, 0.610],
        [0.200, 0.720],
        [0.135, 0.800],
        [0.120, 0.860],
        [0.140, 0.925],
        [0.185, 0.975],
        [0.190, 0.992],
        [0.180, 1.000],
    ]
)
# A lid that closes the mouth in one gentle dome, so that a visual hull can hold it.
VASE_LID = np.array([[0.140, 1.006], [0.080, 1.020], [0.000, 1.026]])
# The inside of an open vase, down to its floor.
VASE_INSIDE = np.array(
    [
        [0.170, 0.990],
        [0.125, 0.920],
        [0.105, 0.860],
        [0.120, 0.800],
        [0.185, 0.710],
        [0.270, 0.600],
        [0.305, 0.480],
        [0.290, 0.360],
        [0.225, 0.200],
        [0.140, 0.080],
        [0.070, 0.050],
        [0.000, 0.045],
    ]
)


def _vase(reader: TableReader, folder: Path) -> SurfaceMesh:
    height = reader.number("height", 0.2, low=1e-4, high=1e3)
    n_handles = reader.count("handles", 0, low=0, high=2)
    is_open = reader.flag("open", False)
    around = reader.count("around", 192, low=8, high=4096)
    along = reader.count("along", 160, low=16, high=4096)
    corners = np.concatenate([VASE_OUTSIDE, VASE_INSIDE if is_open else VASE_LID])
    profile, slopes = _smooth_curve(corners, along)
    body = revolve(height * profile, slopes, around, "vase")
    sides = [np.array([1.0, 0.0]), np.array([-1.0, 0.0])][:n_handles]
    return _joined([body] + [_handle(height, side, around // 4) for side in sides], "vase")


def _smooth_curve(corners: Array, n_steps: int) -> tuple[Array, Array]:
    """Points and directions along a curve through `corners` that never overshoots."""
    knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    curve = PchipInterpolator(knots, corners)
    # The corners themselves are kept: that is where the profile turns.
    places = np.union1d(np.linspace(0.0, knots[-1], n_steps + 1), knots)
    points = curve(places)
    points[[0, -1], 0] = 0.0
    return points, _unit(_directions(curve, places))


def _directions(curve: PchipInterpolator, places: Array) -> Array:
    """Derivative; where it vanishes (a turn in both coordinates) the chord about."""
    derivative = np.asarray(curve(places, 1))
    step = 1e-3 * places[-1]
    low, high = np.maximum(places - step, 0.0), np.minimum(places + step, places[-1])
    chord = (curve(high) - curve(low)) / (high - low)[:, None]
    stuck = np.linalg.norm(derivative, axis=1) < 0.2
    derivative[stuck] = chord[stuck]
    return derivative


def _handle(height: float, side: Array, around: int) -> SurfaceMesh:
    """Handle from shoulder to lip: a round tube whose ends lie inside the body."""
    corners = np.array(
        [[0.26, 0.55], [0.40, 0.60], [0.42, 0.74], [0.36, 0.86], [0.24, 0.90], [0.13, 0.88]]
    )
    points, slopes = _smooth_curve_open(corners, 64)
    zeros = np.zeros(len(points))
    spine = height * np.stack([points[:, 0] * side[0], zeros, points[:, 1]], axis=1)
    along = np.stack([slopes[:, 0] * side[0], zeros, slopes[:, 1]], axis=1)
    return sweep(spine, along, 0.022 * height, max(around, 12))


def _smooth_curve_open(corners: Array, n_steps: int) -> tuple[Array, Array]:
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    knots = np.concatenate([[0.0], np.cumsum(lengths)])
    curve = PchipInterpolator(knots, corners)
    places = np.linspace(0.0, knots[-1], n_steps + 1)
    return np.asarray(curve(places)), _unit(_directions(curve, places))


def sweep(spine: Array, along: Array, radius: float, around: int) -> SurfaceMesh:
    """Round tube about a curve in a plane that holds +Z and is orthogonal to +Y.

    Parameters
    ----------
    spine, along : (n, 3) float64
        Points of the curve and its unit directions, y = 0.
    radius : float
        Metres.
    around : int
        Facets around the tube.

    Returns
    -------
    SurfaceMesh
        u along the curve, v around it; both ends are closed by flat discs.

    Examples
    --------
    >>> straight = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    >>> tube = sweep(straight, np.array([[0.0, 0.0, 1.0]] * 2), 0.5, 16)
    >>> np.ptp(tube.vertices, axis=0)
    array([1., 1., 1.])
    """
    angle = np.linspace(0.0, 2.0 * np.pi, around + 1)
    sideways = np.array([0.0, 1.0, 0.0])
    outward = np.cross(sideways, along)
    rim = np.cos(angle)[:, None, None] * outward + np.sin(angle)[:, None, None] * sideways
    rim[-1] = rim[0]
    u, v = np.meshgrid(np.linspace(0.0, 1.0, len(spine)), angle / (2.0 * np.pi))
    tube = SurfaceMesh(
        vertices=(spine + radius * rim).reshape(-1, 3),
        faces=_grid_faces(around + 1, len(spine)),
        uv=np.stack([u.ravel(), v.ravel()], axis=1),
        normals=rim.reshape(-1, 3).copy(),
        tangents=np.tile(along, (around + 1, 1)),
    )
    ends = [
        _disc(spine[end] + radius * rim[:-1, end], sign * along[end], outward[end])
        for end, sign in ((0, -1.0), (-1, 1.0))
    ]
    return _joined([tube, *ends], "tube")


def _disc(rim: Array, normal: Array, tangent: Array) -> SurfaceMesh:
    """Flat end of a tube: a fan about its centre."""
    n = len(rim)
    first = np.arange(n)
    fan = np.stack([np.full(n, n), first, (first + 1) % n], axis=1)
    if np.dot(np.cross(rim[0] - rim.mean(axis=0), rim[1] - rim[0]), normal) < 0.0:
        fan = fan[:, ::-1]
    return SurfaceMesh(
        vertices=np.vstack([rim, rim.mean(axis=0)]),
        faces=fan.astype(np.int32),
        uv=np.zeros((n + 1, 2)),
        normals=np.tile(normal, (n + 1, 1)),
        tangents=np.tile(tangent, (n + 1, 1)),
    )


# ------------------------------------------------------------------ plates and planes


def _plane(reader: TableReader, folder: Path) -> SurfaceMesh:
    size = _plate_size(reader, (0.2, 0.2))
    flat = _height_field_mesh(size, (2, 2), lambda uv: np.zeros(len(uv)), "plane")
    return SurfaceMesh(
        flat.vertices, flat.faces, flat.uv, flat.normals, flat.tangents, True, name="plane"
    )


def _relief(reader: TableReader, folder: Path) -> SurfaceMesh:
    size = _plate_size(reader, (0.16, 0.16))
    depth = reader.number("height", 0.006, low=0.0, high=1e3)
    thickness = reader.number("thickness", 0.01, low=0.0, high=1e3)
    facets = reader.count("facets", 256, low=2, high=2048)
    pattern = reader.choice("pattern", "logo", [*_RELIEFS, "image"])
    shape = _image_relief(reader, folder) if pattern == "image" else _RELIEFS[pattern]
    counts = (facets + 1, facets + 1)
    top = _height_field_mesh(size, counts, lambda uv: thickness + depth * shape(uv), "relief")
    return top if thickness == 0.0 else _joined([top, *_box(top)], "relief")


def _plate_size(reader: TableReader, default: tuple[float, float]) -> Array:
    size = reader.vector("size", default, length=2)
    if (size <= 0.0).any():
        raise scene_error(reader.name("size"), "two lengths > 0", size.tolist(), "metres")
    return size


def _height_field_mesh(
    size: Array, counts: tuple[int, int], height: HeightField, name: str
) -> SurfaceMesh:
    """Rectangle in the xy plane about the origin, lifted by ``height(uv)``."""
    v, u = np.meshgrid(
        np.linspace(0, 1, counts[0]), np.linspace(0, 1, counts[1]), indexing="ij"
    )
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    vertices = np.column_stack([(uv - 0.5) * size, height(uv)])
    step = 0.25 / max(counts)
    slope = np.stack(
        [
            (height(np.clip(uv + e, 0, 1)) - height(np.clip(uv - e, 0, 1)))
            / ((np.clip(uv + e, 0, 1) - np.clip(uv - e, 0, 1)).sum(axis=1) * length)
            for e, length in zip(step * np.eye(2), size, strict=True)
        ],
        axis=1,
    )
    ones, zeros = np.ones(len(uv)), np.zeros(len(uv))
    return SurfaceMesh(
        vertices=vertices,
        faces=_grid_faces(*counts),
        uv=uv,
        normals=_unit(np.column_stack([-slope, ones])),
        tangents=_unit(np.column_stack([ones, zeros, slope[:, 0]])),
        name=name,
    )


def _box(top: SurfaceMesh) -> list[SurfaceMesh]:
    """Four walls from the border of the top down to z = 0, and the bottom."""
    side = round(len(top.vertices) ** 0.5)
    index = np.arange(side * side).reshape(side, side)
    walls = [
        (index[0], [0.0, -1.0, 0.0]),
        (index[:, -1], [1.0, 0.0, 0.0]),
        (index[-1, ::-1], [0.0, 1.0, 0.0]),
        (index[::-1, 0], [-1.0, 0.0, 0.0]),
    ]
    parts = [_wall(top, border, np.array(normal)) for border, normal in walls]
    corners = top.vertices[index[[0, 0, -1, -1], [0, -1, -1, 0]]] * [1.0, 1.0, 0.0]
    bottom = SurfaceMesh(
        vertices=corners,
        faces=np.array([[0, 2, 1], [0, 3, 2]], np.int32),
        uv=np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        normals=np.tile([0.0, 0.0, -1.0], (4, 1)),
        tangents=np.tile([1.0, 0.0, 0.0], (4, 1)),
    )
    return [*parts, bottom]


def _wall(top: SurfaceMesh, border: NDArray[np.intp], normal: Array) -> SurfaceMesh:
    upper = top.vertices[border]
    n = len(border)
    tangent = _unit(upper[-1] * [1.0, 1.0, 0.0] - upper[0] * [1.0, 1.0, 0.0])
    return SurfaceMesh(
        vertices=np.concatenate([upper * [1.0, 1.0, 0.0], upper]),
        faces=_grid_faces(2, n),
        uv=np.tile(top.uv[border], (2, 1)),
        normals=np.tile(normal, (2 * n, 1)),
        tangents=np.tile(tangent, (2 * n, 1)),
    )


def _bevel(distance: Array, width: float = 0.02) -> Array:
    """1 inside (negative distance), 0 outside, smooth over `width`."""
    t = np.clip(0.5 - distance / width, 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def logo_relief(uv: Array) -> Array:
    """Emblem: a ring around an eight-pointed star with a raised boss.

    Examples
    --------
    >>> logo_relief(np.array([[0.5, 0.5], [0.02, 0.02]])).round(2)
    array([1., 0.])
    """
    x, y = (uv - 0.5).T
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    ring = _bevel(np.abs(radius - 0.40) - 0.035)
    star = _bevel(radius - (0.23 + 0.07 * np.cos(8.0 * angle)))
    boss = np.sqrt(np.maximum(1.0 - (radius / 0.12) ** 2, 0.0))
    rays = _bevel(np.abs(np.mod(angle / np.pi * 12, 1.0) - 0.5) - 0.2, 0.3)
    rays *= _bevel(np.abs(radius - 0.40) - 0.02)
    return np.maximum.reduce([0.55 * ring + 0.25 * rays, 0.6 * star, 0.6 * star + 0.4 * boss])


def wave_relief(uv: Array) -> Array:
    """Crossed cosine waves in [0, 1].

    Examples
    --------
    >>> wave_relief(np.array([[0.0, 0.0], [0.125, 0.125]])).round(2)
    array([1., 0.])
    """
    x, y = np.cos(2.0 * np.pi * 4.0 * uv).T
    return np.asarray(0.5 + 0.25 * (x + y))


def bump_relief(uv: Array) -> Array:
    """Round bumps on a grid of 5 x 5, in [0, 1].

    Examples
    --------
    >>> bump_relief(np.array([[0.5, 0.5], [0.6, 0.6]])).round(2)
    array([1., 0.])
    """
    cell = np.mod(5.0 * uv, 1.0) - 0.5
    distance2 = np.sum((cell / 0.42) ** 2, axis=1)
    return np.asarray(np.maximum(1.0 - distance2, 0.0) ** 1.5)


_RELIEFS: dict[str, HeightField] = {
    "logo": logo_relief,
    "waves": wave_relief,
    "bumps": bump_relief,
}


def _image_relief(reader: TableReader, folder: Path) -> HeightField:
    """Height field from the brightness of an image, v up."""
    pixels = read_image(reader.file("file", folder)).mean(axis=2)
    height, width = pixels.shape

    def relief(uv: Array) -> Array:
        x = np.clip(uv[:, 0] * width - 0.5, 0.0, width - 1.0)
        y = np.clip((1.0 - uv[:, 1]) * height - 0.5, 0.0, height - 1.0)
        left, top = x.astype(np.int64), y.astype(np.int64)
        right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
        fx, fy = x - left, y - top
        upper = pixels[top, left] * (1 - fx) + pixels[top, right] * fx
        lower = pixels[bottom, left] * (1 - fx) + pixels[bottom, right] * fx
        return np.asarray(upper * (1 - fy) + lower * fy)

    return relief


# --------------------------------------------------------------------- mesh files


def _mesh(reader: TableReader, folder: Path) -> SurfaceMesh:
    path = reader.file("file", folder)
    vertices, faces, uv, normals = read_mesh(path)
    rotation = Rotation.from_euler(
        "xyz", reader.vector("rotation_deg", (0, 0, 0)), degrees=True
    )
    vertices = rotation.apply(vertices)
    if reader.flag("centre", True):
        vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    extent = float(np.ptp(vertices, axis=0).max())
    scale = reader.number("scale", 1.0, low=1e-9, high=1e9)
    size = reader.number("size", extent * scale, low=1e-9, high=1e9)
    vertices = vertices * (size / extent) + reader.vector("position", (0, 0, 0))
    turned = None if normals is None else rotation.apply(normals)
    return finish_mesh(vertices, faces, uv, turned, path.name)


def read_mesh(path: Path) -> tuple[Array, Faces, Array | None, Array | None]:
    """Vertices, faces, texture coordinates and normals of a mesh file.

    Parameters
    ----------
    path : Path
        OBJ, PLY, STL, OFF or glTF file.

    Returns
    -------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    uv : (n, 2) float64 or None
    normals : (n, 3) float64 or None
        None where the file holds none.

    Raises
    ------
    SceneError
        If the file cannot be read, is empty, or holds values that are not finite.
    """
    try:
        mesh = trimesh.load(path, force="mesh", process=False, skip_materials=True)
    except Exception as error:  # trimesh raises whatever its parsers meet
        raise scene_error(
            str(path), "a mesh file", f"{type(error).__name__}: {error}"
        ) from error
    vertices = np.array(mesh.vertices, np.float64).reshape(-1, 3)
    faces = np.array(mesh.faces, np.int64).reshape(-1, 3)
    if not 0 < len(faces) <= MOST_FACES:
        raise scene_error(str(path), f"1 to {MOST_FACES} triangles", len(faces))
    inside = (faces >= 0).all() and (faces < len(vertices)).all()
    if not inside or not np.isfinite(vertices).all() or not np.ptp(vertices):
        raise scene_error(str(path), "finite vertices and faces among them", "others")
    uv = getattr(mesh.visual, "uv", None)
    normals = mesh.vertex_normals if "vertex_normals" in mesh._cache.cache else None
    return (
        vertices,
        faces.astype(np.int32),
        _rows_or_none(uv, len(vertices), 2),
        _rows_or_none(normals, len(vertices), 3),
    )


def _rows_or_none(values: Any, n_rows: int, n_columns: int) -> Array | None:
    if values is None:
        return None
    array = np.array(values, np.float64)
    usable = array.shape == (n_rows, n_columns) and np.isfinite(array).all()
    return array if usable else None


def finish_mesh(
    vertices: Array, faces: Faces, uv: Array | None, normals: Array | None, name: str
) -> SurfaceMesh:
    """Mesh with the smooth normals and tangents it lacks.

    Parameters
    ----------
    vertices : (n, 3) float64
        Metres.
    faces : (m, 3) int32
        Counter-clockwise seen from outside.
    uv : (n, 2) float64, optional
        Texture coordinates.
    normals : (n, 3) float64, optional
        Smooth normals; by angle-weighted mean of the faces if not given, over all
        vertices in one place (seams of the coordinates stay smooth).
    name : str
        Name of the mesh.

    Returns
    -------
    SurfaceMesh

    Examples
    --------
    >>> corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    >>> flat = finish_mesh(corners, np.array([[0, 1, 2]], np.int32), corners[:, :2], None, "a")
    >>> flat.normals[0], flat.tangents[0]
    (array([0., 0., 1.]), array([1., 0., 0.]))
    """
    faces = _without_slivers(vertices, faces)
    smooth = _unit(_smooth_normals(vertices, faces) if normals is None else normals)
    smooth[np.linalg.norm(smooth, axis=1) < 0.5] = [0.0, 0.0, 1.0]  # vertices of no face
    has_uv = uv is not None
    coordinates = np.zeros((len(vertices), 2)) if uv is None else uv
    return SurfaceMesh(
        vertices=vertices,
        faces=faces,
        uv=coordinates,
        normals=smooth,
        tangents=_tangents(vertices, faces, coordinates, smooth),
        has_uv=has_uv,
        name=name,
    )


def _smooth_normals(vertices: Array, faces: Faces) -> Array:
    """Angle-weighted normals, shared by vertices in one place; (n, 3)."""
    size = np.ptp(vertices, axis=0).max()
    _, place = np.unique(np.round(vertices / (1e-7 * size)), axis=0, return_inverse=True)
    corners = vertices[faces]
    ahead = _unit(np.roll(corners, -1, axis=1) - corners)
    back = _unit(np.roll(corners, 1, axis=1) - corners)
    angle = np.arccos(np.clip(np.sum(ahead * back, axis=2), -1.0, 1.0))
    normal = _unit(np.cross(ahead[:, 0], back[:, 0]))
    return _scatter(place.ravel()[faces], normal[:, None] * angle[..., None])[place.ravel()]


def _tangents(vertices: Array, faces: Faces, uv: Array, normals: Array) -> Array:
    """Area-weighted dP/du made orthogonal to the normals; any direction without it."""
    edges = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    steps = uv[faces[:, 1:]] - uv[faces[:, :1]]
    determinant = steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 1, 0] * steps[:, 0, 1]
    rise = edges[:, 0] * steps[:, 1, 1:] - edges[:, 1] * steps[:, 0, 1:]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1, keepdims=True)
    per_face = _unit(rise) * np.sign(determinant)[:, None] * area
    total = _scatter(faces, np.repeat(per_face[:, None], 3, axis=1), len(vertices))
    tangents = total - np.sum(total * normals, axis=1, keepdims=True) * normals
    lost = np.linalg.norm(tangents, axis=1) <= 1e-6 * np.linalg.norm(total, axis=1)
    away = np.eye(3)[np.argmin(np.abs(normals[lost]), axis=1)]
    tangents[lost] = np.cross(away, normals[lost])
    return _unit(tangents)


def _scatter(index: NDArray[np.int_] | Faces, values: Array, n_rows: int = 0) -> Array:
    """Sum of `values` (m, 3, 3) over equal entries of `index` (m, 3)."""
    flat, n_rows = index.ravel(), max(n_rows, int(index.max()) + 1)
    columns = values.reshape(-1, 3).T
    return np.stack([np.bincount(flat, c, n_rows) for c in columns], axis=1)


_MAKERS: dict[str, Callable[[TableReader, Path], SurfaceMesh]] = {
    "mesh": _mesh,
    "plane": _plane,
    "relief": _relief,
    "sphere": _sphere,
    "vase": _vase,
}
