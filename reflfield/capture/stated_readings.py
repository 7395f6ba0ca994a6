"""What a description says of how its image files are to be read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from reflfield.capture.documents import number
from reflfield.capture.encoding import parse_encoding
from reflfield.capture.image_files import AS_STATED, ImageReading
from reflfield.capture.paths import NamedFiles
from reflfield.errors import CaptureError, InputError
from reflfield.util.quoting import quoted

READING_KEYS = ("encoding", "layer", "white_level")


def stated_reading(
    values: Mapping[str, Any],
    files: NamedFiles,
    what: str,
    outer: ImageReading = AS_STATED,
) -> ImageReading:
    """The reading that some values of a description state.

    Parameters
    ----------
    values : mapping
        ``encoding``: linear, srgb, gamma=NUMBER or a file of pairs; ``layer``: a name;
        ``white_level``: a number. Others do not matter.
    files : NamedFiles
        Finds the file of pairs.
    what : str
        Named in messages.
    outer : ImageReading, optional
        What holds for all, where these values do not say otherwise.

    Returns
    -------
    ImageReading

    Raises
    ------
    CaptureError
        If a value cannot be used.
    """
    stated = {key: values[key] for key in READING_KEYS if values.get(key) is not None}
    for key in ("encoding", "layer"):
        if not isinstance(stated.get(key, ""), str):
            raise CaptureError(f"{what}: {key}: expected text, received {quoted(stated[key])}")
    if "white_level" in stated:
        level = number(stated["white_level"], f"{what}: white_level")
        if not level > 0:
            raise CaptureError(f"{what}: white_level: expected more than 0, received {level}")
        stated["white_level"] = level
    if "encoding" in stated:
        try:
            stated["encoding"] = parse_encoding(stated["encoding"], files.path)
        except CaptureError:
            raise
        except InputError as error:
            raise CaptureError(f"{what}: {error}") from error
    return replace(outer, **stated) if stated else outer
