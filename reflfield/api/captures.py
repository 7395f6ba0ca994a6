"""Captures as they are opened from Python and by the commands."""

from __future__ import annotations

from pathlib import Path

from reflfield.capture import inspect, readers
from reflfield.capture.capture import Capture
from reflfield.capture.encoding import parse_encoding
from reflfield.capture.image_files import ImageReading


def open_capture(
    path: Path | str,
    format: str | None = None,
    *,
    encoding: str | None = None,
    layer: str | None = None,
    test_split: bool = False,
    require_photographs: bool = True,
    follow_links: bool = False,
) -> Capture:
    """Open a capture: photographs, each with its camera and its light.

    Parameters
    ----------
    path : Path or str
        A folder with exactly one description in it, or a description file.
    format : str, optional
        Of the description, such as ``"colmap"``; told by content if absent.
    encoding : str, optional
        Of the photographs, instead of what the files say: ``linear``, ``srgb``, ``gamma=2.2``
        or a CSV file of pairs.
    layer : str, optional
        Layer, part or page of the photographs' files.
    test_split : bool
        Add the photographs that the capture's maker keeps for comparison.
    require_photographs : bool
        False for cameras and lights that are only to be rendered.
    follow_links : bool
        Read files that symbolic links lead to outside of the capture's folder.

    Returns
    -------
    Capture

    Raises
    ------
    CaptureError
        If there is no description or several, or what it describes cannot be used.
    InputError
        If the encoding is unknown.
    """
    curve = parse_encoding(encoding) if encoding is not None else None
    return readers.open_capture(
        path,
        format,
        require_photographs=require_photographs,
        follow_links=follow_links,
        test_split=test_split,
        reading=ImageReading(encoding=curve, layer=layer),
    )


def describe_capture(capture: Capture) -> list[str]:
    """Return lines on what a capture holds; some of its photographs are read."""
    return inspect.describe(capture).lines()
