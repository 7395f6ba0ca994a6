r"""Lens distortion beyond what the cameras of the scene already have.

Brown-Conrady: a point at :math:`(x, y)` on the plane at distance 1, with
:math:`r^2 = x^2 + y^2`, appears at

.. math::

    x (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + 2 p_1 x y + p_2 (r^2 + 2 x^2)

and likewise in y. It bends the rays of the pixels and costs nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from capture_sim.effects import Cost, Decision, Rig, Stage, Workload
from capture_sim.effects.bounds import camera_distances, shift_bound
from capture_sim.model import Scene, Table
from capture_sim.tables import bounded

NAME = "lens_distortion"
STAGE = Stage.RIG

_TERMS = ("k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class Options:
    """Coefficients of the Brown-Conrady model, as OpenCV names them.

    Attributes
    ----------
    k1, k2, k3 : float
        Radial.
    p1, p2 : float
        Tangential.
    calibrated : bool
        True if the capture's calibration has them too; False for a lens that was
        taken for a perfect one.
    """

    k1: float = bounded(-0.05, low=-10.0, high=10.0)
    k2: float = bounded(0.01, low=-10.0, high=10.0)
    k3: float = bounded(0.0, low=-10.0, high=10.0)
    p1: float = bounded(0.0, low=-10.0, high=10.0)
    p2: float = bounded(0.0, low=-10.0, high=10.0)
    calibrated: bool = True


def needed(scene: Scene) -> Decision:
    """Bound the change by how far the outline of the object moves."""
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("lenses as in [cameras]: no [effects.lens_distortion]", 0.0)
    pixels = largest_shift(scene, options)
    return Decision(
        f"moves the object's image by up to {pixels:.2g} px", shift_bound(scene, pixels)
    )


def largest_shift(scene: Scene, options: Options) -> float:
    """Displacement at the rim of the sphere that holds the object, pixels.

    Parameters
    ----------
    scene : Scene
    options : Options

    Returns
    -------
    float
    """
    turn = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    rim = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    shifts = [0.0]
    for camera, distance in zip(scene.cameras, camera_distances(scene), strict=True):
        parallel = camera["model"] == "orthographic"
        depth = 1.0 if parallel else max(distance - scene.mesh.radius, 1e-9)
        plane = rim * scene.mesh.radius / depth + _centre_offset(scene, camera, depth)
        bent = _distorted(plane, options)
        shifts.append(float(camera["fl_x"] * np.linalg.norm(bent - plane, axis=1).max()))
    return max(shifts)


def _centre_offset(scene: Scene, camera: Table, depth: float) -> np.ndarray[Any, Any]:
    pose = np.asarray(camera["camera_from_world"], np.float64)
    return (pose[:2, :3] @ scene.mesh.centre + pose[:2, 3]) / depth


def _distorted(plane: np.ndarray[Any, Any], options: Options) -> np.ndarray[Any, Any]:
    terms = np.array([getattr(options, term) for term in _TERMS])
    points = np.hstack([plane, np.ones((len(plane), 1))])
    moved = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), terms)[0]
    return np.asarray(moved.reshape(-1, 2))


def cost(scene: Scene, work: Workload) -> Cost:
    """The rays of the pixels are the same in number."""
    del scene
    return Cost(operations=work.n_pixels)


def apply(rig: Rig, scene: Scene) -> Rig:
    """Bend the lenses of all cameras.

    References
    ----------
    D. C. Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8), 1971.
    """
    options = scene.effects.get(Options)
    reported = rig.reported_cameras
    return replace(
        rig,
        cameras=tuple(_bent(camera, options) for camera in rig.cameras),
        reported_cameras=tuple(_bent(camera, options) for camera in reported)
        if options.calibrated
        else reported,
    )


def _bent(camera: Table, options: Options) -> dict[str, Any]:
    added = {term: getattr(options, term) + camera.get(term, 0.0) for term in _TERMS}
    return {**camera, **{term: value for term, value in added.items() if value != 0.0}}
