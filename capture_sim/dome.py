"""Rigs of the dome: directions of cameras and lights, and what stands in them.

The dome's centre is `target`, its axis the world's +Z. Rig directions are unit
vectors from the target outwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture_sim.errors import scene_error
from capture_sim.tables import Table, TableReader, check_number, check_vector

Array = NDArray[np.float64]
MOST_DIRECTIONS = 100_000
# Metres from the world's origin, and irradiances that leave room for any BRDF in a single.
FARTHEST = 1e9
DARKEST, BRIGHTEST = 1e-18, 1e18
# Within this sine of the pole, +Z cannot be an image's up direction; +Y is.
POLE_SINE = 1e-6

# Inclinations from the zenith, counts and first azimuths of the rings, degrees.
BONN_RINGS = (
    (0.0, 11.0, 23.5, 30.0, 37.5, 45.0, 52.5, 60.0, 67.5, 75.0),
    (1, 6, 12, 12, 12, 18, 18, 24, 24, 24),
    (0.0, 15.0, 0.0, 15.0, 0.0, 0.0, 7.5, 0.0, 7.5, 0.0),
)
UBO_RINGS = (
    (0.0, 15.0, 30.0, 45.0, 60.0, 75.0),
    (1, 6, 12, 18, 20, 24),
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
)

RIGS = {
    "bonn151": "151 directions of the Bonn dome: ten rings, inclination 0 to 75 degrees",
    "ubo81": "81 directions of the UBO2003 textures: six rings, inclination 0 to 75 degrees",
    "rti": "cameras: one from above; lights: n over the upper hemisphere (n = 64)",
    "rings": "rings of elevations_deg above the horizon with counts each",
    "fibonacci": "n spread evenly over max_inclination_deg around the zenith (n = 32)",
    "list": "the vectors `directions`, made unit",
}


def rig_presets() -> dict[str, str]:
    """One-line descriptions of the rigs by name.

    Examples
    --------
    >>> rig_presets()["list"]
    'the vectors `directions`, made unit'
    """
    return dict(RIGS)


def spherical(inclination: ArrayLike, azimuth: ArrayLike) -> Array:
    """Unit directions from the inclination to +Z and the azimuth from +X to +Y.

    Parameters
    ----------
    inclination, azimuth : (n,) array_like
        Radians.

    Returns
    -------
    (n, 3) float64

    Examples
    --------
    >>> spherical([np.pi / 2], [np.pi / 2]).round(12)
    array([[0., 1., 0.]])
    """
    theta, phi = np.asarray(inclination, float), np.asarray(azimuth, float)
    return np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    )


def rings(
    elevations: ArrayLike, counts: Sequence[int], offsets: Sequence[float] | None = None
) -> Array:
    """Rings of directions about the zenith.

    Parameters
    ----------
    elevations : array_like of float
        Angle above the horizon of each ring, radians; negative below it.
    counts : sequence of int
        Directions on each ring, at equal azimuths.
    offsets : sequence of float, optional
        Azimuth of the first direction of each ring, radians; 0 if not given.

    Returns
    -------
    (sum(counts), 3) float64
        Ring by ring.

    Examples
    --------
    >>> rings([np.pi / 2, 0.0], [1, 4]).round(12)[:, 0]
    array([ 0.,  1.,  0., -1., -0.])
    """
    offsets = [0.0] * len(counts) if offsets is None else offsets
    azimuths = [
        o + 2.0 * np.pi / n * np.arange(n) for n, o in zip(counts, offsets, strict=True)
    ]
    inclinations = np.pi / 2.0 - np.asarray(elevations, float)
    return spherical(np.repeat(inclinations, counts), np.concatenate(azimuths))


def _classic(table: tuple[Any, Any, Any]) -> Array:
    inclinations, counts, offsets = table
    return rings(np.radians(90.0 - np.array(inclinations)), counts, np.radians(offsets))


def bonn151() -> Array:
    """The 151 directions of the Bonn dome, (151, 3) float64.

    Examples
    --------
    >>> bonn151().shape, bonn151()[0]
    ((151, 3), array([0., 0., 1.]))
    """
    return _classic(BONN_RINGS)


def ubo81() -> Array:
    """The 81 directions of the UBO2003 measurements, (81, 3) float64.

    Examples
    --------
    >>> ubo81().shape
    (81, 3)
    """
    return _classic(UBO_RINGS)


def fibonacci(n: int, max_inclination: float = np.pi / 2.0) -> Array:
    """Evenly spread directions on a cap around the zenith, on a golden spiral.

    Parameters
    ----------
    n : int
        Number of directions.
    max_inclination : float
        Half angle of the cap, radians; pi for the whole sphere.

    Returns
    -------
    (n, 3) float64
        From the zenith outwards; each stands for the same solid angle.

    Examples
    --------
    >>> fibonacci(2).round(3)[:, 2]
    array([0.75, 0.25])
    """
    index = np.arange(n)
    height = 1.0 - (1.0 - np.cos(max_inclination)) * (index + 0.5) / n
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * index
    return spherical(np.arccos(height), azimuth)


# ------------------------------------------------------------------------- tables


def _rings_of(reader: TableReader) -> Array:
    elevations = reader.numbers("elevations_deg", [15.0, 40.0, 65.0])
    counts = reader.numbers("counts", [16, 12, 6])
    offsets = reader.numbers("offsets_deg", [0.0] * len(counts))
    if not len(elevations) == len(counts) == len(offsets):
        lengths = (len(elevations), len(counts), len(offsets))
        raise scene_error(f"{reader.what}", "as many elevations as counts and offsets", lengths)
    whole = (counts == np.round(counts)) & (counts >= 1) & (counts <= MOST_DIRECTIONS)
    if not whole.all() or (np.abs(elevations) > 90.0).any():
        raise scene_error(
            reader.what, "whole counts >= 1, elevations in [-90, 90]", "other values"
        )
    if counts.sum() > MOST_DIRECTIONS:
        raise scene_error(
            reader.name("counts"), f"at most {MOST_DIRECTIONS} together", int(counts.sum())
        )
    return rings(np.radians(elevations), [int(c) for c in counts], list(np.radians(offsets)))


def _fibonacci_of(reader: TableReader, n: int = 32, widest: float = 75.0) -> Array:
    count = reader.count("n", n, high=MOST_DIRECTIONS)
    cap = reader.number("max_inclination_deg", widest, low=0.0, high=180.0)
    return fibonacci(count, np.radians(cap))


def _list_of(reader: TableReader) -> Array:
    rows = reader.require("directions")
    if not isinstance(rows, list) or not 1 <= len(rows) <= MOST_DIRECTIONS:
        expected = f"a list of 1 to {MOST_DIRECTIONS} vectors"
        raise scene_error(reader.name("directions"), expected, rows)
    vectors = np.array([check_vector(reader.name("directions"), row, 3) for row in rows])
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    if (lengths < 1e-100).any():
        raise scene_error(reader.name("directions"), "vectors that are not zero", "a zero one")
    return np.asarray(vectors / lengths)


def _rti_cameras(reader: TableReader) -> Array:
    return np.array([[0.0, 0.0, 1.0]])


_DIRECTIONS: dict[str, Callable[[TableReader], Array]] = {
    "bonn151": lambda reader: bonn151(),
    "ubo81": lambda reader: ubo81(),
    "rti": _rti_cameras,
    "rings": _rings_of,
    "fibonacci": _fibonacci_of,
    "list": _list_of,
}


def _rig(reader: TableReader, *, lights: bool) -> Array:
    """Directions of the rig that `preset` names."""
    kind = reader.choice("preset", "", list(RIGS))
    if kind == "rti" and lights:
        return _fibonacci_of(reader, 64)
    return _DIRECTIONS[kind](reader)


# ------------------------------------------------------------------------ cameras


def make_cameras(table: Table) -> list[dict[str, Any]]:
    """Cameras of a rig, in the native capture format.

    Parameters
    ----------
    table : mapping
        ``preset`` and its keys, and: ``target`` [x, y, z], ``distance`` (default
        1 m), ``width``, ``height`` (pixels, default 256), ``field_of_view_deg``
        across the larger side of the image, or ``extent``, the metres it shows at
        the target (default 0.3), ``model`` ("opencv" or "orthographic"), ``cx``,
        ``cy`` (pixels), ``k1``, ``k2``, ``k3``, ``p1``, ``p2``.

    Returns
    -------
    list of dict
        Ids v000, v001, ...; every camera looks at the target, with +Z up in the
        image (+Y seen from straight above or below).

    Raises
    ------
    SceneError
        For unknown keys and rigs and values out of range.

    Examples
    --------
    >>> camera = make_cameras({"preset": "rti", "distance": 2.0, "extent": 1.0})[0]
    >>> camera["id"], camera["fl_x"], camera["camera_from_world"][2]
    ('v000', 512.0, [0.0, 0.0, -1.0, 2.0])
    """
    reader = TableReader("cameras", table)
    directions = _rig(reader, lights=False)
    target = reader.vector("target", (0.0, 0.0, 0.0), low=-FARTHEST, high=FARTHEST)
    distance = reader.number("distance", 1.0, low=1e-4, high=1e6)
    lens = _lens(reader, distance)
    reader.finish()
    return [
        {"id": f"v{i:03d}", **lens, "camera_from_world": pose.tolist()}
        for i, pose in enumerate(look_at(target + distance * directions, target))
    ]


def _lens(reader: TableReader, distance: float) -> dict[str, Any]:
    """Entries that all cameras of a rig share."""
    model = reader.choice("model", "opencv", ["opencv", "orthographic"])
    width, height = (reader.count(key, 256, high=2**15) for key in ("width", "height"))
    focal = _focal_length(reader, distance, max(width, height), model)
    centre = {
        "cx": reader.number("cx", width / 2.0, low=-width, high=2.0 * width),
        "cy": reader.number("cy", height / 2.0, low=-height, high=2.0 * height),
    }
    terms = ("k1", "k2", "k3", "p1", "p2")
    distortion = {key: reader.number(key, 0.0, low=-10.0, high=10.0) for key in terms}
    bent = {key: value for key, value in distortion.items() if value != 0.0}
    return (
        {"model": model, "w": width, "h": height, "fl_x": focal, "fl_y": focal} | centre | bent
    )


def _focal_length(reader: TableReader, distance: float, side: int, model: str) -> float:
    """Pixels per unit slope, or per metre for orthographic cameras."""
    angle = reader.take("field_of_view_deg")
    extent = reader.number("extent", 0.3, low=1e-6, high=1e6)
    if model == "orthographic":
        if angle is not None:
            raise scene_error(
                reader.name("field_of_view_deg"),
                "none with an orthographic model",
                angle,
                "give extent",
            )
        return side / extent
    if angle is None:
        return side * distance / extent
    checked = check_number(reader.name("field_of_view_deg"), angle, low=0.01, high=170.0)
    return side / 2.0 / float(np.tan(np.radians(checked) / 2.0))


def look_at(positions: Array, target: Array) -> Array:
    """Poses of cameras that look at one point with +Z up.

    Parameters
    ----------
    positions : (n, 3) float64
        Centres of the cameras, none at the target.
    target : (3,) float64
        What they look at.

    Returns
    -------
    (n, 4, 4) float64
        ``camera_from_world``, OpenCV axes (+X right, +Y down, +Z forward).

    Examples
    --------
    >>> look_at(np.array([[2.0, 0.0, 0.0]]), np.zeros(3))[0]
    array([[ 0.,  1.,  0.,  0.],
           [ 0.,  0., -1.,  0.],
           [-1.,  0.,  0.,  2.],
           [ 0.,  0.,  0.,  1.]])
    """
    forward = target - positions
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    at_pole = np.hypot(forward[:, 0], forward[:, 1]) < POLE_SINE
    up = np.where(at_pole[:, None], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3] = axes
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", axes, positions)
    return poses + 0.0  # no negative zeros in the files


# ------------------------------------------------------------------------- lights


def make_lights(table: Table) -> list[dict[str, Any]]:
    """Lights of a rig, in the native capture format.

    Parameters
    ----------
    table : mapping
        ``preset`` and its keys, and: ``kind`` ("point" or "directional"),
        ``target`` [x, y, z], ``distance`` of point lights (default 1 m), and
        ``irradiance`` of a surface at the target that faces the light, or
        ``intensity`` of point lights (W/sr); each a number or RGB. The default
        irradiance is pi: a white diffuse surface facing the light has radiance 1.

    Returns
    -------
    list of dict
        Ids l000, l001, ...

    Raises
    ------
    SceneError
        For unknown keys and rigs and values out of range.

    Examples
    --------
    >>> lamp = make_lights({"preset": "rti", "n": 1, "max_inclination_deg": 0.0,
    ...                     "distance": 2.0, "irradiance": 1.0})[0]
    >>> lamp["id"], lamp["position"], lamp["intensity"]
    ('l000', [0.0, 0.0, 2.0], [4.0, 4.0, 4.0])
    """
    reader = TableReader("lights", table)
    directions = _rig(reader, lights=True)
    kind = reader.choice("kind", "point", ["point", "directional"])
    target = reader.vector("target", (0.0, 0.0, 0.0), low=-FARTHEST, high=FARTHEST)
    distance = reader.number("distance", 1.0, low=1e-4, high=1e6)
    irradiance = _irradiance(reader, kind, distance)
    reader.finish()
    return [
        {"id": f"l{i:03d}", "type": kind, **_placed(kind, d, target, distance, irradiance)}
        for i, d in enumerate(directions)
    ]


def _irradiance(reader: TableReader, kind: str, distance: float) -> Array:
    """Irradiance at the target, (3,) W/m2 per channel."""
    intensity = reader.take("intensity")
    irradiance = reader.vector("irradiance", (np.pi,) * 3, low=-BRIGHTEST, high=BRIGHTEST)
    if intensity is not None:
        if kind != "point":
            raise scene_error(
                reader.name("intensity"), "irradiance for directional lights", intensity
            )
        entries = [intensity] * 3 if isinstance(intensity, int | float) else intensity
        irradiance = check_vector(reader.name("intensity"), entries, 3) / distance**2
    if irradiance.min() < 0.0 or not DARKEST <= irradiance.max() <= BRIGHTEST:
        expected = f"a light that shines: {DARKEST:g} to {BRIGHTEST:g} W/m2 at the target"
        raise scene_error(reader.what, expected, irradiance.tolist())
    return irradiance


def _placed(
    kind: str, direction: Array, target: Array, distance: float, irradiance: Array
) -> dict[str, Any]:
    if kind == "directional":
        return {
            "direction": (direction + 0.0).tolist(),
            "irradiance": irradiance.tolist(),
        }
    return {
        "position": (target + distance * direction + 0.0).tolist(),
        "intensity": (irradiance * distance**2).tolist(),
    }
