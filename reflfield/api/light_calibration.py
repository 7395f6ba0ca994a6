"""Calibrating lights, from Python and by the command."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from reflfield.calibration.circles import parse_circle
from reflfield.calibration.reference_lights import (
    CalibratedLight,
    References,
    calibrate_lights,
    photographs_in,
)
from reflfield.capture.encoding import parse_encoding
from reflfield.capture.image_files import ImageReading
from reflfield.errors import InputError

AUTO = "auto"


def light_references(
    spheres: Sequence[str],
    matt_sphere: str | None = None,
    grey_card: str | None = None,
    *,
    radius: float = 1.0,
    focal: float | None = None,
) -> References:
    """What photographs show, from text.

    Parameters
    ----------
    spheres : sequence of str
        ``x,y,r`` of mirror or glossy spheres, pixels; or ``auto``, once for each sphere.
    matt_sphere : str, optional
        ``x,y,r``.
    grey_card : str, optional
        ``x0,y0,x1,y1``.
    radius : float
        Of the spheres, in the unit that positions shall have.
    focal : float, optional
        Pixels; parallel rays if absent.

    Raises
    ------
    InputError
        If a text has another form, a number is not positive, or no sphere is named.
    """
    for name, value, least in (("radius", radius, 1e-9), ("focal", focal, 1.0)):
        if value is not None and not least <= value <= 1e9:
            raise InputError(
                f"{name}: expected a number of {least:g} to 1e+09, received {value}"
            )
    n_sought = sum(text == AUTO for text in spheres)
    if 0 < n_sought < len(spheres):
        raise InputError("sphere: expected x,y,r of all spheres, or 'auto' for all")
    if not spheres and matt_sphere is None:
        raise InputError("sphere: expected x,y,r of a sphere, or 'auto', received none")
    return References(
        spheres=tuple(parse_circle(text) for text in spheres if text != AUTO),
        n_sought=n_sought,
        matt_sphere=None if matt_sphere is None else parse_circle(matt_sphere),
        grey_card=None if grey_card is None else _box(grey_card),
        focal=focal,
        radius=radius,
    )


def lights_of_photographs(
    photographs: Sequence[Path | str],
    references: References,
    *,
    encoding: str | None = None,
    layer: str | None = None,
) -> tuple[list[CalibratedLight], References]:
    """Lights of photographs, one lamp each, and the references with the spheres found.

    Raises
    ------
    InputError
        If a photograph cannot be used, or shows no sphere or highlight.
    """
    curve = parse_encoding(encoding) if encoding is not None else None
    files = photographs_in([Path(path) for path in photographs])
    return calibrate_lights(files, references, ImageReading(encoding=curve, layer=layer))


def _box(text: str) -> tuple[int, int, int, int]:
    try:
        left, top, right, bottom = (int(word) for word in text.split(","))
    except ValueError:
        raise InputError(
            f"grey_card: expected x0,y0,x1,y1 in whole pixels, received {text!r}"
        ) from None
    if not (0 <= left < right and 0 <= top < bottom):
        raise InputError(f"grey_card: expected x0 < x1 and y0 < y1, received {text!r}")
    return left, top, right, bottom
