"""A turntable of a field, under a map or one distant light that were named in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.image_files import image_size
from reflfield.capture.lights import Light
from reflfield.errors import InputError
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.options import Resources
from reflfield.pipeline.memory import check_picture_memory
from reflfield.render.environment_map import EnvironmentMap
from reflfield.render.renderer import RenderOptions
from reflfield.render.turntable import OrbitOptions, render_orbit
from reflfield.util.files import filling
from reflfield.util.validation import unit_direction

AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class TurntableLighting:
    """What lights a turntable: a map or a distant light, one of them.

    Parameters
    ----------
    environment : Path, optional
        Map.
    light : str, optional
        Direction to a distant light, ``x,y,z``.
    convention : str, optional
        Of the map; "openexr" by default.
    environment_up : str, optional
        World direction of the map's zenith: an axis such as ``-Y``, or ``x,y,z``. The field's
        up by default.
    environment_rotation : float, optional
        Turn of the map about its zenith, degrees, counter-clockwise seen from above.

    Raises
    ------
    InputError
        If there is neither map nor light, or both.
    """

    environment: Path | None = None
    light: str | None = None
    convention: str | None = None
    environment_up: str | None = None
    environment_rotation: float | None = None

    def __post_init__(self) -> None:
        if (self.environment is None) == (self.light is None):
            raise InputError(
                "environment, light: expected one of the two for a turntable, received "
                f"{'both' if self.light else 'neither'}"
            )

    @property
    def map_pixels(self) -> int:
        """Pixels of the map, by its header; 0 without one."""
        if self.environment is None:
            return 0
        width, height = image_size(self.environment)
        return width * height

    def opened(self, up: NDArray[np.float64]) -> Light | EnvironmentMap:
        """Light, or map with its zenith turned to where it is stated or else to `up`."""
        if self.environment is None:
            towards = direction_of("light", str(self.light))
            power = np.full(3, np.pi)
            return Light("turntable", "directional", direction=towards, intensity=power)
        zenith = up
        if self.environment_up is not None:
            zenith = direction_of("environment_up", self.environment_up, axes=True)
        sky = EnvironmentMap.open(self.environment, self.convention or "openexr")
        return sky.turned_to(zenith, self.environment_rotation or 0.0)


def direction_of(name: str, text: str, *, axes: bool = False) -> NDArray[np.float64]:
    """Unit direction of ``x,y,z``, or of an axis such as ``-Y`` where `axes` allows it.

    Raises
    ------
    InputError
        If the text has another form; the message names the argument.

    Examples
    --------
    >>> direction_of("environment_up", "-z", axes=True)
    array([ 0.,  0., -1.])
    """
    word = text.strip().upper()
    if axes and word.removeprefix("-").removeprefix("+") in AXES and len(word) <= 2:
        sign = -1.0 if word.startswith("-") else 1.0
        return sign * np.array(AXES[word[-1]]) + 0.0
    try:
        return unit_direction(name, [float(part) for part in text.split(",")])
    except ValueError:
        words = "X, Y, Z, -X, -Y, -Z or x,y,z" if axes else "X,Y,Z"
        raise InputError(
            f"{name}: expected {words} of finite numbers, not all zero, received {text!r}"
        ) from None


def write_turntable(
    field: ReflectanceField,
    lighting: TurntableLighting,
    out: Path,
    options: RenderOptions,
    resources: Resources,
    chosen: Mapping[str, Any],
) -> list[Path]:
    """Render a turntable; all files, or none after an error.

    Parameters
    ----------
    field : ReflectanceField
    lighting : TurntableLighting
    out : Path
        Gets frames, animation and contact sheet.
    options : RenderOptions
    resources : Resources
        Whose ceiling of memory holds.
    chosen : mapping
        Of `OrbitOptions`; None counts as its default.

    Returns
    -------
    list of Path
        Animation and contact sheet.

    Raises
    ------
    InputError
        If a number is out of range, the map cannot be used, or the memory does not suffice.
    """
    stated = {name: value for name, value in chosen.items() if value is not None}
    x, y, z = field.up.tolist()
    orbit = OrbitOptions(up=(x, y, z), **stated)
    fitting = check_picture_memory(
        field,
        resources,
        options,
        pixels=orbit.size**2,
        kept_pixels=orbit.n_frames * orbit.size**2,
        map_pixels=lighting.map_pixels,
    )
    lights = lighting.opened(field.up)
    with filling(out) as partial:
        made = render_orbit(field, lights, partial, orbit, fitting)
    return [out / path.relative_to(partial) for path in (made.animation, made.contact_sheet)]
