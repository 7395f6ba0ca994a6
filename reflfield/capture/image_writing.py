"""OpenEXR and PNG files, written whole or not at all."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from reflfield.errors import InputError, ShapeError
from reflfield.util.files import replacing, utf8_name
from reflfield.util.late_import import LateImport

cv2: Any = LateImport("cv2")


def write_exr(
    path: Path | str, image: NDArray[Any], names: Sequence[str] | None = None
) -> None:
    """Write an OpenEXR image, ZIP-compressed, atomically.

    Parameters
    ----------
    path : Path or str
        Target; replaced only when the new file is complete.
    image : (height, width) or (height, width, channels) float16 or float32
        float16 is stored as half, everything else as float.
    names : sequence of str, optional
        Channel names; by default ``R G B`` for three channels, ``R G B A`` for four and
        ``Y`` for one.

    Raises
    ------
    ShapeError
        If the names do not match the channels.
    OSError
        If the disk is full or the folder cannot be written. The error names the file.
    """
    stack = image[..., None] if image.ndim == 2 else image
    if stack.dtype != np.float16:
        stack = stack.astype(np.float32, copy=False)
    names = list(names) if names is not None else _default_names(stack.shape[-1])
    if stack.ndim != 3 or len(names) != stack.shape[2]:
        raise ShapeError(
            f"image: expected (height, width, {len(names)}) for channels {names}, "
            f"received {image.shape}"
        )
    height, width, n_channels = stack.shape
    spec = oiio.ImageSpec(
        width, height, n_channels, "half" if stack.dtype == np.float16 else "float"
    )
    spec.channelnames = tuple(names)
    spec["compression"] = "zip"
    spec["DateTime"] = ""  # else the time of writing, and no two files would be the same
    with replacing(Path(path)) as partial:
        _write(Path(path), partial, spec, np.ascontiguousarray(stack))


def _write(path: Path, partial: Path, spec: Any, pixels: NDArray[Any]) -> None:
    partial.touch()  # where that is impossible, it says why
    file: Any = oiio.ImageOutput.create("openexr")
    try:
        written = file.open(utf8_name(partial), spec, "Create") and file.write_image(pixels)
    finally:
        closed = file.close()
    error = file.geterror() + oiio.geterror()
    if not (written and closed) or error:
        text = " ".join(error.replace(f'to image file "{partial}"', "").split())
        reason = f"the image could not be written ({text}); is the disk full?"
        raise OSError(errno.EIO, reason, str(path))


def write_png(path: Path | str, encoded: NDArray[Any]) -> None:
    """Write an 8- or 16-bit PNG, atomically.

    Parameters
    ----------
    path : Path or str
        Target; replaced only when the new file is complete.
    encoded : (h, w), (h, w, 1), (h, w, 3) or (h, w, 4) uint8 or uint16
        Grey, RGB or RGBA, already encoded.

    Raises
    ------
    ShapeError
        If shape or dtype is another.
    OSError
        If the disk is full or the folder cannot be written. The error names the file.
    """
    channels = 1 if encoded.ndim == 2 else encoded.shape[-1]
    if encoded.dtype not in (np.uint8, np.uint16) or channels not in (1, 3, 4):
        raise ShapeError(
            "encoded: expected uint8 or uint16 of shape (h, w), (h, w, 3) or (h, w, 4), "
            f"received {encoded.dtype} {encoded.shape}; encode with encode_srgb first"
        )
    blue_first = [2, 1, 0, 3][:channels]
    stored = np.ascontiguousarray(encoded if channels == 1 else encoded[..., blue_first])
    ok, buffer = cv2.imencode(".png", stored)
    if not ok:
        raise InputError(f"{path}: OpenCV could not encode this image as PNG")
    with replacing(Path(path)) as partial:
        partial.write_bytes(buffer.tobytes())


def _default_names(n_channels: int) -> list[str]:
    names = {1: ["Y"], 3: ["R", "G", "B"], 4: ["R", "G", "B", "A"]}.get(n_channels)
    if names is None:
        raise ShapeError(
            f"names: expected channel names for {n_channels} channels, received None"
        )
    return names
