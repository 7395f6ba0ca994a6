"""Cameras and lights whose errors name the place in a description that they come from."""

from __future__ import annotations

from typing import Any

from reflfield.capture.cameras import Camera
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
