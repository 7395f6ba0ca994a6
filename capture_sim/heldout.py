"""Views and lights that no photograph of the capture has.

Each is a random mixture of three neighbours of the rig, so that it lies
within what the rig covers but on none of its positions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture_sim.dome import look_at
from capture_sim.model import Scene
from capture_sim.rays import world_from_camera

Table = Mapping[str, Any]
Array = NDArray[np.float64]

# Mixture weights concentrate around equal parts: mixtures keep away from the corners.
_CONCENTRATION = 3.0
# transforms.json knows point lights only; a light at infinity is put this far away, metres.
_FAR = 1e3

_INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def heldout_pairs(scene: Scene) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Unseen cameras, each with an unseen point light.

    Parameters
    ----------
    scene : Scene
        Gives the rig, how many photographs, and the seed.

    Returns
    -------
    list of (camera, light)
        In the native capture format, ids ``h000``, ``h001``, ... With a single
        camera every photograph keeps it: only the light is unseen then.
    """
    rng = np.random.default_rng((scene.seed, 1))
    return [_pair(scene, f"h{index:03d}", rng) for index in range(scene.heldout_photographs)]


def _pair(
    scene: Scene, name: str, rng: np.random.Generator
) -> tuple[dict[str, Any], dict[str, Any]]:
    centre = scene.mesh.centre
    camera = _unseen_camera(scene.cameras, centre, rng)
    viewer = world_from_camera(camera)[:3, 3]
    light = _unseen_light(scene.lights, centre, viewer, rng)
    return {**camera, "id": name}, {**light, "id": name}


def _unseen_camera(
    cameras: Sequence[Table], centre: Array, rng: np.random.Generator
) -> dict[str, Any]:
    worlds = np.stack([world_from_camera(camera) for camera in cameras])
    position, chosen, weights = _mixture(worlds[:, :3, 3], centre, rng)
    if len(cameras) == 1:
        return dict(cameras[0])
    # Where each camera looks: the point of its axis closest to the object's centre.
    offsets = centre - worlds[:, :3, 3]
    depth = np.einsum("nc,nc->n", offsets, worlds[:, :3, 2])
    aims = worlds[:, :3, 3] + depth[:, None] * worlds[:, :3, 2]
    pose = look_at(position[None], weights @ aims[chosen])[0]
    return {**cameras[int(chosen[0])], "camera_from_world": pose.tolist()}


def _unseen_light(
    lights: Sequence[Table], centre: Array, viewer: Array, rng: np.random.Generator
) -> dict[str, Any]:
    """Light on the viewer's side if there is one: the dark side carries little information."""
    positions = np.stack([_light_position(light, centre) for light in lights])
    intensities = np.stack([_light_intensity(light) for light in lights])
    frontal = np.flatnonzero((positions - centre) @ (viewer - centre) > 0.0)
    position, chosen, weights = _mixture(positions, centre, rng, first_of=frontal)
    intensity = weights @ intensities[chosen]
    return {"type": "point", "position": position.tolist(), "intensity": intensity.tolist()}


def _light_position(light: Table, centre: Array) -> Array:
    if light["type"] != "directional":
        return np.asarray(light["position"], dtype=np.float64)
    direction = np.asarray(light["direction"], dtype=np.float64)
    return centre + _FAR * direction / np.linalg.norm(direction)


def _light_intensity(light: Table) -> Array:
    if light["type"] != "directional":
        return np.asarray(light["intensity"], dtype=np.float64)
    return _FAR**2 * np.asarray(light["irradiance"], dtype=np.float64)


def point_light(light: Table, centre: Array) -> dict[str, Any]:
    """Point light that stands for a light; one at infinity is put far away.

    Parameters
    ----------
    light : dict
        Point or directional light of the native capture format.
    centre : (3,) float64
        Of the object, metres.
    """
    position, intensity = _light_position(light, centre), _light_intensity(light)
    return {"type": "point", "position": position.tolist(), "intensity": intensity.tolist()}


def _mixture(
    positions: Array,
    centre: Array,
    rng: np.random.Generator,
    first_of: NDArray[np.intp] | None = None,
) -> tuple[Array, NDArray[np.intp], Array]:
    """Position between neighbours, seen from the centre; the neighbours; their weights.

    The first neighbour is drawn from `first_of` (indices; all if none are given), the
    others are the nearest to it. Directions and distances are mixed separately: the
    mixture of points of a dome lies on the dome, not under it.
    """
    offsets = positions - centre
    distances = np.linalg.norm(offsets, axis=1)
    directions = offsets / distances[:, None]
    candidates = first_of if first_of is not None and len(first_of) else len(positions)
    first = rng.choice(candidates)
    nearness = directions @ directions[first]
    chosen = np.argsort(-nearness, kind="stable")[:3]
    weights = rng.dirichlet(np.full(len(chosen), _CONCENTRATION))
    direction = weights @ directions[chosen]
    direction /= np.linalg.norm(direction)
    return centre + weights @ distances[chosen] * direction, chosen, weights


def transforms_frame(
    camera: Table, light: Table, image: str, silhouette: str
) -> dict[str, Any]:
    """One frame of a transforms.json.

    Parameters
    ----------
    camera : dict
        Camera of the native capture format, OpenCV axes.
    light : dict
        Point light.
    image, silhouette : str
        Paths relative to the transforms.json.

    Returns
    -------
    dict
        ``transform_matrix`` is camera to world with OpenGL axes (+X right,
        +Y up, +Z back).
    """
    opencv_from_opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    world_from_opengl = world_from_camera(camera) @ opencv_from_opengl
    return {
        "file_path": image,
        "mask_path": silhouette,
        "transform_matrix": world_from_opengl.tolist(),
        **{key: camera[key] for key in _INTRINSICS},
        **{key: camera.get(key, 0.0) for key in _DISTORTION},
        "pl_pos": light["position"],
        "pl_intensity": light["intensity"],
    }
