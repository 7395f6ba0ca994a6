"""Headers of OpenEXR files: parts, channels and windows, with limits, before any decoder."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple

from reflfield.errors import CaptureError

LARGEST_HEADER = 1 << 22
USUAL_HEADER = 1 << 13
MOST_PARTS = 256
MOST_CHANNELS = 1024
LONGEST_NAME = 255

MULTIPART = 1 << 12


class Window(NamedTuple):
    """A rectangle of pixels, both ends included."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.right - self.left + 1, self.bottom - self.top + 1


@dataclass(frozen=True)
class ExrPart:
    """One part of an OpenEXR file.

    Parameters
    ----------
    index : int
        Number of the part.
    name : str
        Empty where there is one part without a name.
    channels : tuple of str
        Names.
    data_window, display_window : Window
    deep : bool
        Whether its pixels are lists of samples.
    chromaticities : tuple of 8 float or None
        x and y of red, green, blue and white.
    """

    index: int
    name: str
    channels: tuple[str, ...]
    data_window: Window
    display_window: Window
    deep: bool
    chromaticities: tuple[float, ...] | None

    @property
    def luminance_chroma(self) -> bool:
        """Whether colour is stored as Y and two differences at half the resolution."""
        return {"Y", "RY", "BY"} <= set(self.channels)


def read_exr_parts(path: Path, file: IO[bytes]) -> tuple[ExrPart, ...]:
    """The parts of an OpenEXR file.

    Parameters
    ----------
    path : Path
        Named in messages.
    file : binary file
        Open, anywhere.

    Returns
    -------
    tuple of ExrPart

    Raises
    ------
    CaptureError
        If the header is damaged, or has more than `MOST_PARTS` parts or `MOST_CHANNELS`
        channels.
    """
    file.seek(4)
    (flags,) = struct.unpack("<I", file.read(4))
    content = file.read(USUAL_HEADER)
    try:
        return _parts(path, content, flags)
    except CaptureError:
        rest = file.read(LARGEST_HEADER)
        if not rest:
            raise
        return _parts(path, content + rest, flags)


def _parts(path: Path, content: bytes, flags: int) -> tuple[ExrPart, ...]:
    """Parts whose headers are in the content; one after the other, a zero byte at the end."""
    position = 0
    parts: list[ExrPart] = []
    while True:
        attributes, position = _attributes(path, content, position)
        if attributes:
            parts.append(_part(path, len(parts), attributes))
        if not flags & MULTIPART or not attributes:
            break
        if len(parts) > MOST_PARTS:
            raise CaptureError(f"{path}: expected at most {MOST_PARTS} parts, received more")
    if not parts:
        raise _damaged(path, "no part")
    return tuple(parts)


def _attributes(path: Path, content: bytes, position: int) -> tuple[dict[str, bytes], int]:
    """Attributes up to the zero byte that ends a header, and where that is passed."""
    attributes: dict[str, bytes] = {}
    while content[position : position + 1] != b"\0":
        name, position = _text(path, content, position)
        _, position = _text(path, content, position)
        if position + 4 > len(content):
            raise _damaged(path, "a header that ends early")
        (size,) = struct.unpack_from("<i", content, position)
        position += 4
        if size < 0 or position + size > len(content):
            raise _damaged(path, f"an attribute {name!r} of {size:,} bytes")
        attributes[name] = content[position : position + size]
        position += size
    return attributes, position + 1


def _text(path: Path, content: bytes, position: int) -> tuple[str, int]:
    end = content.find(b"\0", position, position + LONGEST_NAME + 1)
    if end < 0:
        raise _damaged(path, "a name that does not end")
    return content[position:end].decode("utf-8", errors="replace"), end + 1


def _part(path: Path, index: int, attributes: dict[str, bytes]) -> ExrPart:
    try:
        chromaticities = attributes.get("chromaticities")
        return ExrPart(
            index,
            attributes.get("name", b"").decode("utf-8", errors="replace"),
            _channels(path, attributes["channels"]),
            Window(*struct.unpack("<4i", attributes["dataWindow"])),
            Window(*struct.unpack("<4i", attributes["displayWindow"])),
            deep=attributes.get("type", b"").startswith(b"deep"),
            chromaticities=struct.unpack("<8f", chromaticities) if chromaticities else None,
        )
    except (KeyError, struct.error) as error:
        raise _damaged(path, f"part {index} without a usable {error}") from error


def _channels(path: Path, content: bytes) -> tuple[str, ...]:
    """Names in a list of channels, each followed by 16 bytes of type and sampling."""
    channels: list[str] = []
    position = 0
    while content[position : position + 1] not in (b"\0", b""):
        name, position = _text(path, content, position)
        channels.append(name)
        position += 16
        if len(channels) > MOST_CHANNELS:
            raise CaptureError(
                f"{path}: expected at most {MOST_CHANNELS} channels, received more"
            )
    return tuple(channels)


def _damaged(path: Path, what: str) -> CaptureError:
    return CaptureError(
        f"{path}: expected an OpenEXR image, received a damaged, truncated or different file "
        f"({what}); copy or export it again"
    )
