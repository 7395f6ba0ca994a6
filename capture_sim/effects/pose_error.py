r"""Cameras that do not stand quite where the calibration says.

The true camera is :math:`[e^{[\omega]_\times} \mid t]` after the reported one, in the
camera's own frame, with normal :math:`\omega` and `t`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from capture_sim.effects import Cost, Decision, Rig, Stage, Workload, normal_errors
from capture_sim.effects.bounds import camera_distances, pixels_per_metre, shift_bound
from capture_sim.model import Scene, Table
from capture_sim.tables import bounded

NAME = "pose_error"
STAGE = Stage.RIG

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Options:
    """Standard deviations of the error of a camera's pose, per axis.

    Attributes
    ----------
    rotation_deg : float
        Degrees.
    translation : float
        Metres.
    """

    rotation_deg: float = bounded(0.02, low=0.0, high=90.0)
    translation: float = bounded(2e-4, low=0.0)


def needed(scene: Scene) -> Decision:
    """Bound the change by how far the images move: the errors drawn are known."""
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("poses are exact: no [effects.pose_error]", 0.0)
    turns, moves = _errors(scene, options)
    reach = np.abs(camera_distances(scene)).max() + scene.mesh.radius
    metres = np.linalg.norm(turns, axis=1) * reach + np.linalg.norm(moves, axis=1)
    pixels = float(metres.max()) * pixels_per_metre(scene)
    reason = f"{options.rotation_deg:g} degrees, {1e3 * options.translation:g} mm: "
    return Decision(reason + f"up to {pixels:.2g} px", shift_bound(scene, pixels))


def _errors(scene: Scene, options: Options) -> tuple[Array, Array]:
    """Rotation vectors (radians) and translations (metres), both (n_views, 3)."""
    numbers = normal_errors(scene, NAME, 2, len(scene.cameras), 3)
    return np.radians(options.rotation_deg) * numbers[0], options.translation * numbers[1]


def cost(scene: Scene, work: Workload) -> Cost:
    """One change of pose a view."""
    del scene
    return Cost(operations=work.n_views)


def apply(rig: Rig, scene: Scene) -> Rig:
    """Move the true cameras; the reported ones stay."""
    turns, moves = _errors(scene, scene.effects.get(Options))
    moved = zip(rig.cameras, turns, moves, strict=True)
    return replace(rig, cameras=tuple(_moved(*entry) for entry in moved))


def _moved(camera: Table, turn: Array, move: Array) -> dict[str, Any]:
    error = np.eye(4)
    error[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    error[:3, 3] = move
    pose = error @ np.asarray(camera["camera_from_world"], np.float64)
    return {**camera, "camera_from_world": pose.tolist()}
