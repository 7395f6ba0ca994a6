"""Cameras and lights whose errors name the place in a description that they come from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import OPENCV, Camera
from reflfield.capture.lights import Light
from reflfield.errors import CaptureError


def described_camera(what: str, **fields: Any) -> Camera:
    """A camera without a name yet.

    Parameters
    ----------
    what : str
        File and entry, named in messages.
    **fields
        Of `Camera`, but for `id`.

    Raises
    ------
    CaptureError
        As `Camera`.

    Examples
    --------
    >>> described_camera("a.txt: line 3", kind="opencv", width=0, height=1, fl_x=1, fl_y=1,
    ...                  cx=0, cy=0, camera_from_world=None)
    Traceback (most recent call last):
    reflfield.errors.CaptureError: a.txt: line 3: expected an image size of at least 1 x 1 ...
    """
    try:
        return Camera(id="v", **fields)
    except CaptureError as error:
        raise CaptureError(
            f"{what}: {str(error).removeprefix(_begin('camera', 'v'))}"
        ) from error


def camera_of_matrix(
    what: str,
    matrix: NDArray[np.float64],
    size: Sequence[float] | NDArray[np.float64],
    camera_from_world: NDArray[np.floating[Any]],
    *,
    counts_from: int = 0,
    distortion: tuple[float, ...] = (),
) -> Camera:
    """A pinhole camera of a camera matrix without skew.

    Parameters
    ----------
    what : str
        File and entry, named in messages.
    matrix : (3, 3) float64
        Focal lengths and principal point, pixels.
    size : (2,) array_like of whole numbers
        Width and height, pixels.
    camera_from_world : (4, 4) float64
        OpenCV axes.
    counts_from : int
        Coordinate of the centre of the first pixel, which is .5 here: 0 for OpenCV, 1 for
        MATLAB.
    distortion : tuple of float
        Of OpenCV.

    Raises
    ------
    CaptureError
        As `Camera`.

    Examples
    --------
    >>> matrix = np.array([[8.0, 0.0, 2.5], [0.0, 8.0, 1.5], [0.0, 0.0, 1.0]])
    >>> camera = camera_of_matrix("a.mat: K", matrix, (6, 4), np.eye(4), counts_from=0)
    >>> float(camera.cx), float(camera.cy)
    (3.0, 2.0)
    """
    return described_camera(
        what,
        kind=OPENCV,
        width=size[0],
        height=size[1],
        fl_x=matrix[0, 0],
        fl_y=matrix[1, 1],
        cx=matrix[0, 2] + 0.5 - counts_from,
        cy=matrix[1, 2] + 0.5 - counts_from,
        camera_from_world=camera_from_world,
        distortion=distortion,
    )


def described_light(what: str, kind: str, **fields: Any) -> Light:
    """A light without a name yet.

    Parameters
    ----------
    what : str
        File and entry, named in messages.
    kind : str
        Of `Light`.
    **fields
        Of `Light`, but for `id` and `kind`.

    Raises
    ------
    CaptureError
        As `Light`.
    """
    try:
        return Light("l", kind, **fields)
    except CaptureError as error:
        text = str(error).removeprefix(_begin("light", "l"))
        raise CaptureError(f"{what}: light: {text}") from error


def _begin(what: str, id_: str) -> str:
    return f"{what} {id_!r}: "
