"""Which way is up, where a capture does not say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera

# Calibrated rigs stand on an axis of their world; a mean this close to one means that axis.
SNAP_ANGLE = np.radians(20.0)

# Below this mean length the cameras' up directions cancel: they agree on nothing.
LEAST_AGREEMENT = 0.2


def estimated_up(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """Mean of the cameras' up directions, snapped to a world axis it nearly is.

    Parameters
    ----------
    cameras : sequence of Camera
        Cameras of one capture.

    Returns
    -------
    (3,) float64
        Unit world direction; +Z where the cameras disagree.

    Examples
    --------
    Images whose up is the world's -Y (OpenCV axes in a world of the same axes):

    >>> estimated_up([Camera("v0", "opencv", 1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4))])
    array([ 0., -1.,  0.])
    """
    mean = np.mean([camera.up for camera in cameras], axis=0)
    length = float(np.linalg.norm(mean))
    if length < LEAST_AGREEMENT:
        return np.array([0.0, 0.0, 1.0])
    mean = mean / length
    axis = int(np.argmax(np.abs(mean)))
    if abs(mean[axis]) < np.cos(SNAP_ANGLE):
        return mean
    snapped = np.zeros(3)
    snapped[axis] = np.sign(mean[axis])
    return snapped
