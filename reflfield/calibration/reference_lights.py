"""Lights of photographs, one lamp each, by the spheres and the card that they show."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.calibration.circles import Circle, find_circles
from reflfield.calibration.matt_references import card_strength, light_on_matt_sphere
from reflfield.calibration.sphere_reflections import (
    Ray,
    SphereCamera,
    highlight,
    meeting_point,
)
from reflfield.capture.clipping import SATURATED
from reflfield.capture.color_spaces import luminance
from reflfield.capture.image_files import AS_STATED, ImageReading, read_kinds
from reflfield.capture.plausibility import SHORTEST_FOCAL
from reflfield.errors import InputError
from reflfield.util.files import replacing
from reflfield.util.progress import track
from reflfield.util.quoting import printable

Array = NDArray[np.float64]

TABLE, DIRECTIONS = "lights.csv", "lights.lp"
# Photographs that circles are sought in, evenly spread.
MOST_SEARCHED = 24
SUFFIXES = (".exr", ".tif", ".tiff", ".png", ".jpg", ".jpeg", ".hdr", ".cr2", ".nef", ".dng")


@dataclass(frozen=True)
class References:
    """What the photographs show beside, or instead of, the object.

    Parameters
    ----------
    spheres : tuple of Circle
        Mirror or glossy ones.
    n_sought : int
        So many are sought where none are given.
    matt_sphere : Circle, optional
    grey_card : (left, top, right, bottom), optional
        Pixels.
    focal : float, optional
        Focal length, pixels; parallel rays if absent.
    radius : float
        Of the spheres.
    """

    spheres: tuple[Circle, ...] = ()
    n_sought: int = 0
    matt_sphere: Circle | None = None
    grey_card: tuple[int, int, int, int] | None = None
    focal: float | None = None
    radius: float = 1.0


@dataclass(frozen=True, eq=False)
class CalibratedLight:
    """The light of one photograph.

    Parameters
    ----------
    name : str
        Of the photograph.
    direction : (3,) float64
        Unit; x right, y up in the image, z to the camera.
    position : (3,) float64 or None
        Where two spheres tell it; in the same axes.
    intensity : float or None
        Luminance of a facing surface; for a position times the squared distance to the matt
        reference. None where no reference tells.
    spread : float
        Largest angle between the directions of the spheres, radians.
    """

    name: str
    direction: Array
    position: Array | None
    intensity: float | None
    spread: float

    def line(self) -> str:
        """The light in one line, for a terminal."""
        way = ", ".join(f"{v:+.4f}" for v in self.direction)
        parts = [f"{printable(self.name)}  direction {way}"]
        if self.position is not None:
            parts.append("position " + ", ".join(f"{v:.4g}" for v in self.position))
        if self.intensity is not None:
            parts.append(f"intensity {self.intensity:.4g}")
        if self.spread:
            parts.append(f"spheres differ by {np.degrees(self.spread):.2f} degrees")
        return "  ".join(parts)


def calibrate_lights(
    photographs: Sequence[Path], references: References, reading: ImageReading = AS_STATED
) -> tuple[list[CalibratedLight], References]:
    """Find the light of each photograph.

    Parameters
    ----------
    photographs : sequence of Path
        Of one view, one lamp each.
    references : References
    reading : ImageReading, optional

    Returns
    -------
    lights : list of CalibratedLight
    references : References
        With the spheres that were found.

    Raises
    ------
    InputError
        If a photograph has another size or cannot be read, or spheres or highlights are not
        found; the message names the photograph.
    """
    if references.n_sought:
        references = _with_spheres(photographs, references, reading)
    if not references.spheres and references.matt_sphere is None:
        raise InputError(
            "sphere: expected a sphere that shows where the light is, received none"
        )
    lights: list[CalibratedLight] = []
    size: tuple[int, ...] | None = None
    for path in track(photographs, len(photographs), "photographs"):
        image, kinds = read_kinds(path, reading)
        size = size or image.shape
        if image.shape != size:
            raise InputError(
                f"{path}: expected {size[1]} x {size[0]} pixels as the first photograph has, "
                f"received {image.shape[1]} x {image.shape[0]}"
            )
        try:
            lights.append(
                _light(path.name, image, (kinds != SATURATED).all(axis=2), references)
            )
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    return _relative(lights), references


def _with_spheres(
    photographs: Sequence[Path], references: References, reading: ImageReading
) -> References:
    step = -(-len(photographs) // MOST_SEARCHED)
    images = [luminance(read_kinds(path, reading)[0]) for path in photographs[::step]]
    spheres = find_circles([i.astype(np.float32) for i in images], references.n_sought)
    return References(
        tuple(spheres),
        0,
        references.matt_sphere,
        references.grey_card,
        references.focal,
        references.radius,
    )


def _light(
    name: str,
    image: NDArray[np.float32],
    measured: NDArray[np.bool_],
    references: References,
) -> CalibratedLight:
    height, width = image.shape[:2]
    _check_focal(references.focal, width, height)
    matt = references.matt_sphere
    for circle in (*references.spheres, *([matt] if matt else [])):
        circle.check_within(width, height)
    camera = SphereCamera(width, height, references.focal, references.radius)
    bright = luminance(image).astype(np.float32)
    rays = [camera.ray_to_light(c, highlight(bright, c)) for c in references.spheres]
    position = meeting_point(rays) if len(rays) > 1 else None
    direction, spread = _mean_direction(rays)
    strength: Array | None = None
    if matt is not None:
        known = direction if rays else None
        if position is not None:
            known = position - camera.centre_of(matt)
            known = known / np.linalg.norm(known)
        shading = light_on_matt_sphere(image, measured, matt, known)
        strength = shading.strength
        direction = direction if rays else shading.direction
    elif references.grey_card is not None:
        strength = card_strength(image, measured, references.grey_card)
    intensity = None if strength is None else float(luminance(strength))
    if intensity is not None and position is not None and matt is not None:
        intensity *= float(np.sum(np.square(position - camera.centre_of(matt))))
    return CalibratedLight(name, direction, position, intensity, spread)


def _check_focal(focal: float | None, width: int, height: int) -> None:
    """Refuse a lens wider than there are: its length is in millimetres."""
    least = SHORTEST_FOCAL * max(width, height)
    if focal is not None and focal < least:
        raise InputError(
            f"focal: expected at least {least:g} pixels for an image of {width} x {height}, "
            f"received {focal:g}; is it in millimetres? Multiply it by the pixels of a "
            "millimetre of the sensor"
        )


def _mean_direction(rays: Sequence[Ray]) -> tuple[Array, float]:
    if not rays:
        return np.array([0.0, 0.0, 1.0]), 0.0
    ways = np.array([ray.towards for ray in rays])
    mean = ways.mean(axis=0)
    spread = float(np.arccos(np.clip((ways @ ways.T).min(), -1, 1)))
    return np.asarray(mean / np.linalg.norm(mean)), spread


def _relative(lights: list[CalibratedLight]) -> list[CalibratedLight]:
    """Intensities over their median; positions only where all lights have one."""
    known = [light.intensity for light in lights if light.intensity is not None]
    usual = float(np.median(known)) if known else 1.0
    all_near = all(light.position is not None for light in lights)
    return [
        CalibratedLight(
            light.name,
            light.direction,
            light.position if all_near else None,
            None if light.intensity is None else light.intensity / usual,
            light.spread,
        )
        for light in lights
    ]


def photographs_in(paths: Sequence[Path]) -> list[Path]:
    """Photographs by their names, or all of a folder in the order of names.

    Raises
    ------
    InputError
        If there are none, one does not exist, or names cannot stand in a list of lights.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            files += sorted(f for f in path.iterdir() if f.suffix.lower() in SUFFIXES)
        elif path.exists():
            files.append(path)
        else:
            raise InputError(
                f"{path}: expected a photograph or a folder of them; does not exist"
            )
    if not files:
        raise InputError(f"{paths[0]}: expected photographs, received none")
    _check_names(files)
    return files


def _check_names(files: Sequence[Path]) -> None:
    """Refuse names that cannot stand in a list of lights, or that two photographs have."""
    seen: dict[str, Path] = {}
    for file in files:
        if not file.name.isprintable() or file.name != file.name.strip():
            raise InputError(
                f"{file}: expected a name without control characters and without spaces at "
                f"its ends, received {printable(file.name)!r}; rename it"
            )
        if file.name in seen:
            raise InputError(
                f"{file}: expected names that differ, received that of {seen[file.name]}, too; "
                "lights are listed by names: calibrate each folder by itself, or rename one"
            )
        seen[file.name] = file


def write_lights(folder: Path, lights: Sequence[CalibratedLight]) -> tuple[Path, Path]:
    """Write ``lights.csv`` and ``lights.lp``; return their paths.

    The table has columns name,x,y,z,intensity of positions, or name,dx,dy,dz,intensity of
    directions to distant lights, as `lights.csv` beside cameras of any format has.

    Raises
    ------
    InputError
        If there is one of them already: it may be from a drawing.
    """
    there = [folder / name for name in (TABLE, DIRECTIONS) if (folder / name).exists()]
    if there:
        raise InputError(
            f"{there[0]}: expected no such file, received one; choose another folder, or "
            "remove it"
        )
    folder.mkdir(parents=True, exist_ok=True)
    near = lights[0].position is not None
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["name", *(("x", "y", "z") if near else ("dx", "dy", "dz")), "intensity"])
    for light in lights:
        place = light.direction if light.position is None else light.position
        intensity = 1.0 if light.intensity is None else light.intensity
        table.writerow([light.name, *(f"{v:.8g}" for v in (*place, intensity))])
    lines = [
        f"{light.name} {' '.join(f'{v:.8f}' for v in light.direction)}" for light in lights
    ]
    for path, content in (
        (folder / TABLE, text.getvalue()),
        (folder / DIRECTIONS, "\n".join([str(len(lights)), *lines]) + "\n"),
    ):
        with replacing(path) as partial:
            partial.write_text(content, encoding="utf-8")
    return folder / TABLE, folder / DIRECTIONS
