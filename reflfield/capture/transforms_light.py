"""Lights of ``transforms.json``: point lights, environment maps, or one unknown light."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.described_items import described_light
from reflfield.capture.documents import number_array
from reflfield.capture.lights import Light
from reflfield.capture.paths import NamedFiles
from reflfield.capture.transforms_frame import Frame
from reflfield.capture.unique_items import leading_digits
from reflfield.errors import CaptureError

LIGHT_KEYS = ("pl_pos", "pl_intensity", "environment", "environment_convention")

# Members of one frame's light: a dome has hundreds of lamps.
MOST_LIGHTS_AT_ONCE = 10_000


def check_lights(frames: Sequence[Frame]) -> None:
    """Demand that all frames say what lights them, or none does.

    Parameters
    ----------
    frames : sequence of Frame

    Raises
    ------
    CaptureError
        Naming the first frame that lacks what others have, or has what needs another key.
    """
    lit = [frame.get("pl_pos") is not None or frame.get("environment") is not None
           for frame in frames]  # fmt: skip
    if any(lit) and not all(lit):
        raise CaptureError(
            f"{frames[lit.index(False)].what}: expected a light ('pl_pos' or 'environment') as "
            f"{sum(lit)} of {len(frames)} frames have, received none; give the light of every "
            "frame, or of none where all are under one constant, unknown lighting"
        )
    points = [frame for frame in frames if frame.get("pl_pos") is not None]
    bright = [frame.get("pl_intensity") is not None for frame in points]
    if any(bright) and not all(bright):
        raise CaptureError(
            f"{points[bright.index(False)].what}: expected 'pl_intensity' as {sum(bright)} of "
            f"{len(points)} frames have, received none; give it in every frame or in none"
        )
    for frame in frames:
        _check_companions(frame)


def _check_companions(frame: Frame) -> None:
    """Refuse keys of a light without the key that they belong to."""
    if frame.get("pl_pos") is not None and frame.get("environment") is not None:
        raise CaptureError(
            f"{frame.what}: expected 'pl_pos' or 'environment', received both; a photograph "
            "is taken under one of them"
        )
    for name, needed in (("pl_intensity", "pl_pos"), ("environment_convention", "environment")):
        if frame.own.get(name) is not None and frame.get(needed) is None:
            raise CaptureError(
                f"{frame.what}: {name}: expected with {needed!r}, received without; "
                f"give {needed!r} too"
            )


def frame_light(frame: Frame, files: NamedFiles) -> tuple[Hashable, Light]:
    """Light of a frame, and a key that is equal for equal lights.

    Parameters
    ----------
    frame : Frame
    files : NamedFiles
        Finds the environment map.

    Raises
    ------
    CaptureError
        Naming the frame.
    """
    if frame.get("environment") is not None:
        file = files.path(frame.get("environment"))
        convention = frame.get("environment_convention") or "mitsuba"
        light = described_light(frame.what, "environment", file=file, convention=convention)
        return (str(file), convention), light
    if frame.get("pl_pos") is None:
        return "unknown", Light("l", "unknown")
    positions = np.atleast_2d(
        number_array(frame.get("pl_pos"), [(3,), (None, 3)], f"{frame.what}: pl_pos")
    )
    intensities = _intensities(frame, len(positions))
    key = (*leading_digits(positions), *leading_digits(intensities))
    points = tuple(
        described_light(frame.what, "point", position=p, intensity=i)
        for p, i in zip(positions, intensities, strict=True)
    )
    return key, points[0] if len(points) == 1 else Light("l", "group", members=points)


def _intensities(frame: Frame, n_lights: int) -> NDArray[np.float64]:
    """One row for each light; one number counts for all three channels."""
    what = f"{frame.what}: pl_intensity"
    if n_lights > MOST_LIGHTS_AT_ONCE:
        raise CaptureError(
            f"{frame.what}: pl_pos: expected at most {MOST_LIGHTS_AT_ONCE} lights at once, "
            f"received {n_lights}; give them as an environment map"
        )
    value = frame.get("pl_intensity")
    array = np.ones(3) if value is None else number_array(value, [(), (3,), (None, 3)], what)
    if array.ndim == 2 and len(array) not in (1, n_lights):
        raise CaptureError(
            f"{what}: expected {n_lights} rows like pl_pos, received {len(array)}"
        )
    return np.broadcast_to(array, (n_lights, 3))
