"""What bounds on effects have in common: sizes in pixels, steepness of highlights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture_sim.materials import Material
from capture_sim.model import Scene

Array = NDArray[np.float64]

# Directions and places at which the steepness of a material is measured.
_ARC = np.linspace(-1.2, 1.2, 97)
_INCLINATIONS = np.radians([0.0, 30.0, 60.0])
_N_PLACES = 24
# Rays and BRDFs are float32: what a shift of nothing at all may change.
RAY_ROUNDING = 16.0 * float(np.finfo(np.float32).eps)
# Shifts below this, pixels, turn no ray from one side of an edge to the other.
SMALLEST_SHIFT = 1e-5


def camera_distances(scene: Scene) -> Array:
    """Distance of each camera from the object's centre along its axis, metres; (n_views,)."""
    poses = np.array([camera["camera_from_world"] for camera in scene.cameras], np.float64)
    return poses[:, 2, :3] @ scene.mesh.centre + poses[:, 2, 3]


def light_distances(scene: Scene) -> Array:
    """Distances of the lights from the object's centre, metres; infinite if directional."""
    return np.array([_distance(light, scene.mesh.centre) for light in scene.lights])


def _distance(light: Mapping[str, Any], centre: Array) -> float:
    if light["type"] == "directional":
        return float("inf")
    return float(np.linalg.norm(np.asarray(light["position"], np.float64) - centre))


def pixels_per_metre(scene: Scene) -> float:
    """Largest magnification of any camera on the near side of the object, pixels per metre."""
    focal = np.array([camera["fl_x"] for camera in scene.cameras], np.float64)
    parallel = np.array([camera["model"] == "orthographic" for camera in scene.cameras])
    near = np.maximum(camera_distances(scene) - scene.mesh.radius, 1e-3 * scene.mesh.radius)
    return float(np.where(parallel, focal, focal / near).max())


def shift_bound(scene: Scene, pixels: float) -> float:
    """Bound on the change when the image moves by some pixels.

    An edge of full contrast that moves by part of a pixel changes that pixel by
    the same part; as a pixel's rays are a regular grid, a row of them may turn at once.

    Parameters
    ----------
    scene : Scene
    pixels : float

    Returns
    -------
    float
        Part of the photograph's 99th percentile.
    """
    row = 1.0 / scene.image.samples_per_side if pixels > SMALLEST_SHIFT else 0.0
    return scene.brightness.headroom * min(1.0, float(pixels) + row + RAY_ROUNDING)


def steepness(material: Material) -> float:
    r"""Largest slope of the reflected radiance with the direction of the light, 1/rad.

    :math:`\max |\mathrm{d}(f \cos\theta_l) / \mathrm{d}\theta_l| / \max f \cos\theta_l`
    along arcs through the mirror direction, at random places of the surface.

    Parameters
    ----------
    material : Material

    Returns
    -------
    float
        At least 1, the slope of the cosine itself.

    Examples
    --------
    >>> from capture_sim.materials import make_material
    >>> round(steepness(make_material({"type": "lambert", "albedo": 0.5})), 2)
    1.0
    """
    uv = np.random.default_rng(0).random((_N_PLACES, 2))
    largest = 1.0
    for inclination in _INCLINATIONS:
        for azimuth in (0.0, 0.5 * np.pi):
            values = _along_arc(material, uv, float(inclination), azimuth)
            peak = values.max(axis=1, keepdims=True)
            slope = np.abs(np.diff(values, axis=1)) / (_ARC[1] - _ARC[0])
            largest = max(largest, float((slope / np.maximum(peak, 1e-12)).max()))
    return largest


def _along_arc(material: Material, uv: Array, inclination: float, azimuth: float) -> Array:
    """Brightest channel of BRDF times cosine along an arc; (n_places, n_arc)."""
    view = np.array([np.sin(inclination), 0.0, np.cos(inclination)])
    angle = _ARC - inclination if azimuth == 0.0 else _ARC
    plane = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=1)
    if azimuth != 0.0:  # across the plane of incidence, through the mirror direction
        tilt = np.array([-np.sin(inclination), 0.0, np.cos(inclination)])
        plane = np.cos(angle)[:, None] * tilt + np.sin(angle)[:, None] * [0.0, 1.0, 0.0]
    lights = np.tile(plane, (len(uv), 1))
    views = np.broadcast_to(view, lights.shape)
    values = material.evaluate(views, lights, np.repeat(uv, len(_ARC), axis=0))
    weighted = values.max(axis=1) * np.maximum(lights[:, 2], 0.0)
    return np.asarray(weighted.reshape(len(uv), -1))
