"""Poses in another convention than the format's, told by where the cameras look.

Cameras around an object look at it. If most of those described do not look at the point that
their optical axes have in common, but all do once the poses are inverted or their axes
turned, the description was written in that other convention.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from reflfield.capture.cameras import ORTHOGRAPHIC, Camera
from reflfield.errors import CaptureError

Array = NDArray[np.float64]

# Fewer cameras have a common point by chance.
FEWEST_CAMERAS = 4
# Angle to the common point within which a camera looks at it.
LOOKS_AT = np.radians(30.0)
# Share of the cameras' distance to the world's origin below which the common point lies in a
# camera itself.
NEAREST = 0.05
# Share of that distance within which two cameras stand at one place. Inverted poses of cameras
# on rings do, those of each ring in one point, and a few points always look at each other.
SAME_PLACE = 0.01
# Shares of the cameras that look at it: as described, and in the other convention.
MOST_IF_MISTAKEN, LEAST_IF_MEANT = 0.5, 0.95

_OTHER_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # between OpenCV's and OpenGL's


def check_poses(cameras: Sequence[Camera], description: object) -> None:
    """Refuse poses that are plainly in another convention.

    Parameters
    ----------
    cameras : sequence of Camera
    description : Path
        Named in the message.

    Raises
    ------
    CaptureError
        Naming the convention that fits.
    """
    poses = np.array([c.camera_from_world for c in cameras if c.kind != ORTHOGRAPHIC])
    if len(poses) < FEWEST_CAMERAS or share_looking_inwards(poses) > MOST_IF_MISTAKEN:
        return
    inverse = np.linalg.solve(poses, np.broadcast_to(np.eye(4), poses.shape))
    other_way = "world-to-camera and camera-to-world are exchanged"
    readings = {
        f"{other_way} in OpenCV axes (+Y down, +Z forward)": inverse,
        "the camera axes are the other ones of OpenCV's (+Y down, +Z forward) and OpenGL's "
        "(+Y up, +Z back)": _OTHER_AXES @ poses,
        f"{other_way} in OpenGL axes (+Y up, +Z back)": _OTHER_AXES @ inverse,
    }
    for words, reading in readings.items():
        if share_looking_inwards(reading) >= LEAST_IF_MEANT:
            raise CaptureError(
                f"{description}: expected cameras that look at the object, received "
                f"{len(poses)} cameras that look away from their common centre; they all look "
                f"at it if {words}: correct the matrices"
            )


def share_looking_inwards(camera_from_world: Array) -> float:
    """Share of cameras that look at the point nearest to all optical axes.

    Cameras at the place of another one do not count: they say nothing of where an object is.

    Parameters
    ----------
    camera_from_world : (n, 4, 4) float64
        Rigid motions to OpenCV axes.

    Examples
    --------
    Two cameras that face each other along x, two along y, and the same turned back:

    >>> from reflfield.capture.cameras import looking_at
    >>> around = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)]
    >>> poses = np.array([looking_at(p, (0, 0, 0), (0, 0, 1)) for p in around])
    >>> share_looking_inwards(poses), share_looking_inwards(_OTHER_AXES @ poses)
    (1.0, 0.0)
    """
    rotation, shift = camera_from_world[:, :3, :3], camera_from_world[:, :3, 3]
    forward = rotation[:, 2]
    centres = -np.einsum("nij,ni->nj", rotation, shift)
    scale = float(np.median(np.linalg.norm(shift, axis=1))) or 1.0
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    right = np.einsum("nij,nj->i", across, centres)
    common = np.linalg.lstsq(across.sum(axis=0), right, rcond=1e-9)[0]
    towards = common - centres
    distance = np.linalg.norm(towards, axis=1)
    cosine = np.einsum("nj,nj->n", towards, forward) / np.maximum(distance, 1e-300)
    apart = cKDTree(centres - common).query(centres - common, k=2)[0][:, 1]
    alone = apart > SAME_PLACE * scale
    return float(np.mean(alone & (distance > NEAREST * scale) & (cosine > np.cos(LOOKS_AT))))
