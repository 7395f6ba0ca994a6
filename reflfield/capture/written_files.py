"""Files of a capture that is written: names that no other file has, and what is copied."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from reflfield.capture.capture import Capture
from reflfield.capture.encoding import LINEAR, SRGB, Encoding
from reflfield.capture.image_files import ImageReading
from reflfield.capture.lights import ENVIRONMENT, Light
from reflfield.capture.photographs import Photograph
from reflfield.errors import InputError

TABLE_NAME = "encoding"


class WrittenFiles:
    """Copies files into a folder and remembers them.

    Parameters
    ----------
    folder : Path
    copy : callable
        ``copy(source, target)``.
    """

    def __init__(self, folder: Path, copy: Callable[[Path, Path], Any]) -> None:
        self.folder, self.copy = folder, copy
        self.written: list[Path] = []
        self._tables: dict[Encoding, str] = {}
        self._copies: dict[tuple[Path, str], str] = {}
        self._dark: dict[Path, int] = {}

    def text(self, name: str, content: str) -> None:
        """Write a text file."""
        path = self.path(name)
        path.write_text(content, encoding="utf-8")

    def add(self, source: Path, name: str) -> str:
        """Copy a file once; its name within the folder, with the source's suffix."""
        key = (source, name)
        if key not in self._copies:
            target = f"{name}{source.suffix}"
            self.copy(source, self.path(target))
            self._copies[key] = target
        return self._copies[key]

    def photographs(self, capture: Capture, folder: str) -> list[list[str]]:
        """Copy all photographs; names of each one's files."""
        return [self._files_of(photograph, folder) for photograph in capture.photographs]

    def _files_of(self, photograph: Photograph, folder: str) -> list[str]:
        """Copy the exposures of a photograph; several are numbered."""
        exposures, name = photograph.exposures, f"{folder}/{photograph.name}"
        if len(exposures) == 1:
            return [self.add(exposures[0].path, name)]
        return [self.add(exposure.path, f"{name}_{i}") for i, exposure in enumerate(exposures)]

    def dark_frame(self, path: Path) -> str:
        """Copy a dark frame once; they are numbered."""
        number = self._dark.setdefault(path, len(self._dark))
        return self.add(path, f"dark/d{number:04d}")

    def silhouettes(self, capture: Capture, folder: str) -> list[str | None]:
        """Copy the silhouettes that are files, under the names of their cameras."""
        return [
            None if path is None else self.add(path, f"{folder}/v{view:04d}")
            for view, path in enumerate(capture.silhouettes)
        ]

    def environment(self, light: Light) -> str:
        """Copy the map of a light."""
        if light.file is None:
            raise InputError(f"light {light.id!r}: expected the file of its map")
        return self.add(light.file, f"environments/{light.file.stem}")

    def reading(self, reading: ImageReading) -> dict[str, Any]:
        """What a description says of a reading, in the keys of all descriptions."""
        values: dict[str, Any] = {}
        if reading.encoding is not None:
            values["encoding"] = self._encoding(reading.encoding)
        if reading.layer is not None:
            values["layer"] = reading.layer
        if reading.white_level is not None:
            values["white_level"] = reading.white_level
        return values

    def _encoding(self, encoding: Encoding) -> str:
        """Name of an encoding, or of the table that holds its pairs."""
        if encoding.name in (LINEAR, SRGB):
            return encoding.name
        if encoding.name == "gamma":
            return f"gamma={encoding.gamma!r}"
        if encoding not in self._tables:
            name = f"{TABLE_NAME}{len(self._tables) or ''}.csv"
            rows = "".join(f"{stored!r},{linear!r}\n" for stored, linear in encoding.pairs)
            self.text(name, f"encoded,linear\n{rows}")
            self._tables[encoding] = name
        return self._tables[encoding]

    def path(self, name: str) -> Path:
        """Path of a file that is to be written."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self.written.append(path)
        return path


def first_reading(photograph: Photograph, target: str) -> ImageReading:
    """Reading of a photograph of one exposure.

    Raises
    ------
    InputError
        If there are several exposures, a dark frame or a gain, of which the target knows
        nothing.
    """
    if photograph.gain is not None:
        raise InputError(
            f"photograph {photograph.name!r}: expected no gain, which {target} cannot say; "
            "write it with `to='native'`"
        )
    if photograph.dark is not None:
        raise InputError(
            f"photograph {photograph.name!r}: expected no dark frame, which {target} cannot "
            f"say, received {photograph.dark.path}; write it with `to='native'`"
        )
    if len(photograph.exposures) > 1 or photograph.exposures[0].seconds != 1:
        raise InputError(
            f"photograph {photograph.name!r}: expected one exposure, which is all that "
            f"{target} can say, received {len(photograph.exposures)} with exposure times; "
            "write it with `to='native'`"
        )
    return photograph.exposures[0].reading


def refuse_light(light: Light, target: str) -> InputError:
    """The error of a light that the target cannot say."""
    words = "an environment map" if light.kind == ENVIRONMENT else f"one of kind {light.kind!r}"
    words += "" if light.falls_off else " that does not fall off"
    return InputError(
        f"light {light.id!r}: expected a light that {target} can say, received {words}; write "
        "it with `to='native'`"
    )
