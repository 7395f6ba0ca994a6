r"""Flat samples (BTF): cameras whose photographs were rectified to the sample.

Each photograph shows the sample as seen from above, whatever the direction that it was
photographed from: pixel (u, v) is the point (x, y) of the plane z = 0 with x right and y up.
That is an orthographic camera at a slant with a skew: with the axes right, down and forward of
a camera that looks along :math:`-\omega`, the plane's points have camera coordinates
:math:`A (x, y)`, and :math:`K = s\,\mathrm{diag}(1, -1) A^{-1}` is upper triangular if down has
no part along x.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.described_items import described_camera
from reflfield.capture.fixed_view import CAMERA_HEIGHT, IMAGE_WIDTH
from reflfield.errors import CaptureError

# A view closer to the plane sees nothing of it: 89.9 degrees off the normal.
LEAST_COSINE = 2e-3


def rectified_camera(direction: ArrayLike, size: tuple[int, int], what: str) -> Camera:
    """Camera of a rectified photograph of the plane z = 0.

    Parameters
    ----------
    direction : (3,) array_like
        Unit vector from the sample to the camera.
    size : (width, height) int
        Pixels; the image is `IMAGE_WIDTH` wide.
    what : str
        Named in messages.

    Raises
    ------
    CaptureError
        If the camera is not above the plane.

    Examples
    --------
    From the side, the corner of the sample stays the corner of the image:

    >>> camera = rectified_camera([0.6, 0.48, 0.64], (100, 50), "example")
    >>> camera.project([[0.5, -0.25, 0.0]])[0].round(9)
    array([[100.,  50.]])
    """
    view = np.asarray(direction, dtype=np.float64)
    if not view[2] > LEAST_COSINE:
        raise CaptureError(
            f"{what}: expected a view above the sample, received the direction "
            f"{view.round(4).tolist()} (z is its normal)"
        )
    down = np.array([0.0, -view[2], view[1]])
    down /= np.linalg.norm(down)
    pose = np.eye(4)
    pose[:3, :3] = np.cross(down, -view), down, -view
    pose[2, 3] = CAMERA_HEIGHT
    scale = size[0] / IMAGE_WIDTH
    matrix = scale * np.diag([1.0, -1.0]) @ np.linalg.solve(pose[:2, :2], np.eye(2))
    return described_camera(
        what,
        kind="orthographic",
        width=size[0],
        height=size[1],
        fl_x=matrix[0, 0],
        fl_y=matrix[1, 1],
        skew=matrix[0, 1],
        cx=size[0] / 2,
        cy=size[1] / 2,
        camera_from_world=pose,
    )


def directions_of_angles(angles: ArrayLike) -> NDArray[np.float64]:
    """Unit vectors (n, 3) of angles (n, 2): from the normal, and azimuth; radians.

    Examples
    --------
    >>> directions_of_angles([[0.0, 1.0], [np.pi / 2, np.pi / 2]]).round(6) + 0.0
    array([[0., 0., 1.],
           [0., 1., 0.]])
    """
    theta, phi = np.asarray(angles, dtype=np.float64).reshape(-1, 2).T
    ring = np.sin(theta)
    return np.stack([ring * np.cos(phi), ring * np.sin(phi), np.cos(theta)], axis=1)
