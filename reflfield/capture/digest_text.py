"""Text that stands for cameras, lights and files in the digest of a capture."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from reflfield.capture.cameras import Camera
from reflfield.capture.lights import Light
from reflfield.capture.photographs import Photograph
from reflfield.errors import CaptureError


def camera_text(camera: Camera) -> str:
    """Return all that a camera says."""
    numbers: list[Any] = [camera.width, camera.height, camera.fl_x, camera.fl_y]
    numbers += [camera.cx, camera.cy, camera.distortion, camera.camera_from_world.tolist()]
    numbers += [camera.skew] if camera.skew else []
    return f"{camera.id} {camera.kind} {numbers}"


def light_text(light: Light) -> str:
    """Return all that a light says, files apart."""
    numbers: list[Any] = [light.position.tolist(), light.direction.tolist()]
    numbers += [light.intensity.tolist(), light.exponent, light.cone_angle, light.falloff_angle]
    numbers += [light.convention, light.world_from_environment.tolist()]
    numbers += [light_text(member) for member in light.members]
    numbers += [] if light.falls_off else ["constant"]
    return f"{light.id} {light.kind} {numbers}"


def correction_pieces(
    photograph: Photograph, of_file: Callable[[Path, type[CaptureError]], bytes]
) -> Iterator[bytes]:
    """Bytes that stand for dark frame and gain; none where there is neither."""
    dark, gain = photograph.dark, photograph.gain
    if dark is not None:
        yield f"dark {dark.seconds} {dark.reading}".encode()
        yield of_file(dark.path, CaptureError)
    if gain is not None:
        yield repr(gain).encode()
