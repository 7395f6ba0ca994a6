"""Which way is up, where a capture does not say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera

# Calibrated rigs stand on an axis of their world; a mean this close to one means that axis.
SNAP_ANGLE = np.radians(20.0)

# Mean length of the cameras' up directions below which they do not tell (cameras that lie on
# their side or hang upside down). Over a whole upper hemisphere it is pi / 4.
LEAST_AGREEMENT = 0.5


def estimated_up(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """Mean of the cameras' up directions, snapped to a world axis it nearly is.

    Where the cameras lie on their side or hang upside down, so that their up directions
    cancel, it is the axis of the ring they stand on, on the side they look down from.

    Parameters
    ----------
    cameras : sequence of Camera
        Cameras of one capture.

    Returns
    -------
    (3,) float64
        Unit world direction; +Z where nothing tells.

    Examples
    --------
    Images whose up is the world's -Y (OpenCV axes in a world of the same axes):

    >>> estimated_up([Camera("v0", "opencv", 1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4))])
    array([ 0., -1.,  0.])
    """
    mean = np.mean([camera.up for camera in cameras], axis=0)
    length = float(np.linalg.norm(mean))
    if length >= LEAST_AGREEMENT:
        return _snapped(mean / length)
    return _snapped(_ring_axis(cameras))


def _ring_axis(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """Direction in which the camera positions vary least, against the cameras' gaze."""
    centres = np.array([camera.centre for camera in cameras])
    centred = centres - centres.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=False)
    gaze = np.mean([camera.forward for camera in cameras], axis=0)
    if len(spread) < 3 or not spread[1] > 0:  # fewer than three cameras, or all in a line
        return np.array([0.0, 0.0, 1.0])
    axis: NDArray[np.float64] = axes[2]
    return -axis if axis @ gaze > 0 else axis


def _snapped(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest world axis if it is near."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < np.cos(SNAP_ANGLE):
        return direction
    snapped = np.zeros(3)
    snapped[axis] = np.sign(direction[axis])
    return snapped
