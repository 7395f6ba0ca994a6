"""Images of a field under the cameras and lights of a capture, and on a turntable."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.api.fields import Field
from reflfield.capture.capture import Capture
from reflfield.capture.image_files import image_size
from reflfield.capture.lights import DirectionalLight, Light
from reflfield.errors import InputError
from reflfield.options import Resources
from reflfield.pipeline.compare_command import write_comparison_with
from reflfield.pipeline.memory import check_image_memory, check_relighting_memory
from reflfield.pipeline.relight_command import write_relit_photographs
from reflfield.render.environment_map import EnvironmentMap
from reflfield.render.renderer import RenderOptions
from reflfield.render.turntable import OrbitOptions, render_orbit
from reflfield.util.files import filling
from reflfield.util.renamed_arguments import accepts_old_names
from reflfield.util.validation import unit_direction

AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}


def relight(
    field: Field,
    capture: Capture,
    out: Path | str,
    *,
    options: RenderOptions | None = None,
    resources: Resources | None = None,
) -> list[Path]:
    """Render what the photographs of a capture would show; all files, or none.

    Parameters
    ----------
    field : Field
    capture : Capture
        Whose photographs are not read, and need not be there.
    out : Path or str
        Folder; gets an EXR and a PNG file for each of them.
    options : RenderOptions, optional
    resources : Resources, optional

    Returns
    -------
    list of Path
        The EXR files, in the order of the photographs.

    Raises
    ------
    InputError
        If an image cannot be rendered, a file of the capture would be replaced, or the memory
        does not suffice.
    """
    limits = options or RenderOptions(), resources or Resources()
    fitting = check_relighting_memory(field.stored, capture, *limits)
    return write_relit_photographs(field.stored, capture, Path(out), fitting)


def compare(
    field: Field,
    capture: Capture,
    out: Path | str,
    *,
    field_photographs: Capture | None = None,
    options: RenderOptions | None = None,
    resources: Resources | None = None,
) -> dict[str, Any]:
    """Render what the photographs of a capture show, and measure the difference.

    Parameters
    ----------
    field : Field
    capture : Capture
        With photographs.
    out : Path or str
        Folder; gets the images, ``metrics.json`` and ``report/index.html``: all, or nothing
        after an error.
    field_photographs : Capture, optional
        Photographs that made the field, of which the nearest one in view and light is a
        baseline. Not needed where `capture` has them itself.
    options : RenderOptions, optional
    resources : Resources, optional

    Returns
    -------
    dict
        Content of ``metrics.json``: ``mean`` over the photographs, each of them, what
        trivial ``baselines`` get, and ``error_kinds``: where the error lies.

    Raises
    ------
    InputError
        If no photograph can be compared, a file of the capture would be replaced, or the
        memory does not suffice.
    NumericalError
        If what the field shows is not finite.
    """
    limits = options or RenderOptions(), resources or Resources()
    fitting = check_relighting_memory(field.stored, capture, *limits, compared=True)
    return write_comparison_with(field.stored, capture, Path(out), fitting, field_photographs)


@accepts_old_names(n_frames="n_images")
def render_turntable(
    field: Field,
    out: Path | str,
    *,
    environment: Path | str | None = None,
    convention: str | None = None,
    environment_up: ArrayLike | None = None,
    environment_rotation: float | None = None,
    light: ArrayLike | None = None,
    n_images: int = 36,
    size: int = 400,
    elevation_deg: float = 20.0,
    options: RenderOptions | None = None,
    resources: Resources | None = None,
) -> list[Path]:
    """Render a turntable under a map or one distant light; all files, or none.

    Parameters
    ----------
    field : Field
    out : Path or str
        Folder; gets the images, an animation and a contact sheet.
    environment : Path or str, optional
        Latitude-longitude map.
    convention : {"openexr", "mitsuba", "blender"}, optional
        Of the map.
    environment_up : (3,) array_like or str, optional
        World direction of the map's zenith, or an axis such as ``-Y``; by default the field's
        up.
    environment_rotation : float, optional
        Rotation of the map about its zenith, degrees, counter-clockwise seen from above.
    light : (3,) array_like or str, optional
        World direction to a distant light, instead of a map.
    n_images : int
        Images on the full circle.
    size : int
        Side of an image, pixels.
    elevation_deg : float
        Of the camera above the object's equator, degrees.
    options : RenderOptions, optional
    resources : Resources, optional

    Returns
    -------
    list of Path
        Animation and contact sheet.

    Raises
    ------
    InputError
        If there is neither map nor light, or both, a number is out of range, the map cannot be
        used, or the memory does not suffice.
    """
    _check_lighting(environment, light, (convention, environment_up, environment_rotation))
    stored = field.stored
    x, y, z = stored.up.tolist()
    orbit = OrbitOptions(n_images, (x, y, z), elevation_deg, size=size)
    width, height = (0, 0) if environment is None else image_size(environment)
    fitting = check_image_memory(
        stored,
        resources or Resources(),
        options or RenderOptions(),
        pixels=size**2,
        kept_pixels=n_images * size**2,
        map_pixels=width * height,
    )
    source: Light | EnvironmentMap
    if environment is None:
        source = DirectionalLight(direction_of("light", light), np.pi)
    else:
        up = stored.up if environment_up is None else environment_up
        zenith = direction_of("environment_up", up, axes=True)
        sky = EnvironmentMap.open(environment, convention or "openexr")
        source = sky.turned_to(zenith, environment_rotation or 0.0)
    with filling(Path(out)) as partial:
        made = render_orbit(stored, source, partial, orbit, fitting)
    return [
        Path(out) / path.relative_to(partial) for path in (made.animation, made.contact_sheet)
    ]


def _check_lighting(
    environment: Path | str | None, light: ArrayLike | None, of_map: tuple[object, ...]
) -> None:
    """Demand a map or a light, one of them, and no orientation of a map that is not there."""
    if (environment is None) == (light is None):
        raise InputError(
            "environment, light: expected one of the two, received "
            f"{'both' if light is not None else 'neither'}"
        )
    if environment is None and any(value is not None for value in of_map):
        raise InputError(
            "convention, environment_up, environment_rotation: expected together with "
            "`environment`, received a light alone"
        )


def direction_of(
    name: str, value: ArrayLike | None, *, axes: bool = False
) -> NDArray[np.float64]:
    """Return a unit direction of three numbers, of text such as ``x,y,z``, or of an axis.

    Parameters
    ----------
    name : str
        For messages.
    value : (3,) array_like or str
    axes : bool
        Allow an axis such as ``-Y``.

    Raises
    ------
    InputError
        If it is none of these.

    Examples
    --------
    >>> direction_of("environment_up", "-z", axes=True)
    array([ 0.,  0., -1.])
    >>> direction_of("light", [0.0, 2.0, 0.0])
    array([0., 1., 0.])
    """
    if not isinstance(value, str):
        return unit_direction(name, np.asarray(value))
    word = value.strip().upper()
    if axes and word.removeprefix("-").removeprefix("+") in AXES and len(word) <= 2:
        sign = -1.0 if word.startswith("-") else 1.0
        return sign * np.array(AXES[word[-1]]) + 0.0
    try:
        return unit_direction(name, [float(part) for part in value.split(",")])
    except ValueError:
        words = "X, Y, Z, -X, -Y, -Z or x,y,z" if axes else "X,Y,Z"
        raise InputError(
            f"{name}: expected {words} of finite numbers, not all zero, received {value!r}"
        ) from None
