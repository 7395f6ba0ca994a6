"""Whether photographs are bright where the surface faces the light, as described or otherwise.

Lights that are described in other axes than the cameras are (y up for z up, a mirrored axis,
the axes of each camera) light the surface from elsewhere than the photographs show. Then the
brightness of the surface does not follow the cosine to the light, but does once the lights are
read in those other axes.

Outlines show no hollows: the hull closes them with a surface that faces their opening. What is
seen through it, the inside of a bowl, is bright on the far side from the light, as that surface
would be if the light stood turned by half about the way that it faces. Where lights turned so
fit as well as any other axes, the surface that faces sideways tells the two apart.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.capture.lights import DIRECTIONAL, POINT, SPOT, Light

Array = NDArray[np.float64]

# Correlations of brightness and cosine, means over photographs: at least that of another
# reading, and its lead, for lights to count as described in other axes.
LEAST_IF_MEANT, LEAST_LEAD = 0.35, 0.25
# A mean over so many photographs is below this only if something is wrong.
LEAST_AS_DESCRIBED, FEWEST_LOOKS = -0.05, 8
# A hollow is an explanation if another reading leads by less.
HOLLOW_TIE = 0.1
# Light is from all sides where it comes in at so many degrees beside the view, or more.
ALL_SIDES = 60.0
# Normals at a smaller cosine to the way that a hollow opens are beside it.
BESIDE = 0.7
# Points of a photograph, and spread of their cosines, that say something.
FEWEST_POINTS, LEAST_SPREAD = 32, 0.05
_OPENGL = np.array([1.0, -1.0, -1.0])  # its camera axes from OpenCV's


@dataclass(frozen=True, eq=False)
class Look:
    """What some points of the surface look like in one photograph.

    Parameters
    ----------
    camera : Camera
    light : Light
    points, normals : (n, 3) float64
        Metres, world.
    brightness : (n,) float64
        Luminance or like it; NaN where nothing was measured.
    """

    camera: Camera
    light: Light
    points: Array
    normals: Array
    brightness: Array


# Of the light's position or direction, in one photograph; whether it is a position.
Reading = Callable[[Array, Camera, bool], Array]


def looks_at(
    capture: Capture,
    photographs: NDArray[np.int64],
    points: Array,
    normals: NDArray[np.floating[Any]],
    brightness: Array,
) -> Iterator[Look]:
    """Looks of one point in one photograph each (rows), photograph by photograph."""
    for index in np.unique(photographs):
        rows = photographs == index
        photograph = capture.photographs[int(index)]
        yield Look(
            capture.cameras[photograph.camera],
            capture.lights[photograph.light],
            points[rows],
            normals[rows].astype(np.float64),
            brightness[rows],
        )


def other_light_axes(looks: list[Look]) -> str:
    """Words on the axes that the lights are in, if those are plainly not the described ones.

    Parameters
    ----------
    looks : list of Look
        Of photographs under different lights.

    Returns
    -------
    str
        Empty where the lights fit as described, or nothing fits better.
    """
    described = agreement(looks, as_described)
    if described is None or described > 1 - LEAST_LEAD:
        return ""
    so_far = (
        "lights and photographs do not fit: the surface's brightness follows the cosine to the "
        f"lights with a correlation of {described:.2f}"
    )
    scores = {words: agreement(looks, reading) or -1.0 for words, reading in _readings()}
    words, best = max(scores.items(), key=lambda item: item[1])
    hollow = _hollow(looks, max(best, described + LEAST_LEAD))
    if hollow is not None:
        return hollow and f"{so_far}{hollow}"
    if best >= max(LEAST_IF_MEANT, described + LEAST_LEAD):
        return (
            f"{so_far}, but of {best:.2f} with the lights' coordinates {words}; check the axes "
            "of lights and cameras"
        )
    if described < LEAST_AS_DESCRIBED and len(looks) >= FEWEST_LOOKS:
        return (
            f"{so_far}; check which light belongs to which photograph, the axes of lights and "
            "cameras, and whether poses, masks and photographs are turned alike"
        )
    return ""


def _hollow(looks: list[Look], others: float) -> str | None:
    """Words on a hollow that explains the photographs; None where none does.

    Empty where the surface beside it fits the lights as described, which decides it.
    """
    normals = np.concatenate([look.normals for look in looks])
    opening = normals.mean(axis=0)
    opening /= max(float(np.linalg.norm(opening)), 1e-9)
    middle = np.concatenate([look.points for look in looks]).mean(axis=0)
    turned = _half_turn(opening, middle)
    inside = agreement(looks, turned)
    if inside is None or inside < max(LEAST_IF_MEANT, others - HOLLOW_TIE):
        return None
    beside = [_part(look, np.abs(look.normals @ opening) < BESIDE) for look in looks]
    told, otherwise = agreement(beside, as_described), agreement(beside, turned)
    if told is None or otherwise is None:
        axis = ", ".join(f"{x:z.1f}" for x in opening)
        return (
            f", but of {inside:.2f} with the lights turned by half about ({axis}); either the "
            "object is hollow there, which its outlines do not show, or the axes of lights and "
            "cameras differ"
        )
    return "" if told > otherwise else None


def _part(look: Look, chosen: NDArray[np.bool_]) -> Look:
    """Some of the points of a look."""
    return replace(
        look,
        points=look.points[chosen],
        normals=look.normals[chosen],
        brightness=look.brightness[chosen],
    )


def _half_turn(axis: Array, middle: Array) -> Reading:
    """Lights turned by half about an axis through a point."""

    def reading(vector: Array, camera: Camera, is_position: bool) -> Array:
        from_middle = vector - middle if is_position else vector
        turned: Array = 2 * (from_middle @ axis) * axis - from_middle
        return turned + middle if is_position else turned

    return reading


def agreement(looks: list[Look], reading: Reading) -> float | None:
    """Mean correlation of brightness and cosine to the light; None where nothing tells."""
    correlations = [_correlation(look, reading) for look in looks]
    known = [value for value in correlations if value is not None]
    return float(np.mean(known)) if known else None


def _correlation(look: Look, reading: Reading) -> float | None:
    cosine = cosines(look, reading)
    known = np.isfinite(look.brightness)
    if cosine is None or known.sum() < FEWEST_POINTS:
        return None
    x, y = cosine[known], np.sqrt(np.maximum(look.brightness[known], 0.0))
    if y.std() == 0:
        return None
    if x.std() < LEAST_SPREAD:
        return 0.0
    return float(np.corrcoef(x, y)[0, 1])


def cosines(look: Look, reading: Reading) -> Array | None:
    """Cosine (n,) to the light at each point, 0 on its other side; None if it is unknown."""
    light = look.light
    if light.kind not in (POINT, SPOT, DIRECTIONAL):
        return None
    at = light.kind != DIRECTIONAL
    place = reading(light.position if at else light.direction, look.camera, at)
    towards = place - look.points if at else np.broadcast_to(place, look.points.shape)
    length = np.linalg.norm(towards, axis=1)
    return np.maximum((towards * look.normals).sum(axis=1) / np.maximum(length, 1e-300), 0.0)


def as_described(vector: Array, camera: Camera, is_position: bool) -> Array:
    """Reading of what is in the world's axes."""
    return vector


def _readings() -> Iterator[tuple[str, Reading]]:
    """Other axes by the words for them."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            named = ", ".join(
                ("-" if s < 0 else "") + "xyz"[i] for i, s in zip(order, signs, strict=True)
            )
            if named != "x, y, z":
                yield f"read as ({named})", _axes(order, np.array(signs))
    yield "in the camera's axes of OpenCV", _of_camera(np.ones(3))
    yield "in the camera's axes of OpenGL", _of_camera(_OPENGL)


def _axes(order: tuple[int, ...], signs: Array) -> Reading:
    return lambda vector, camera, is_position: signs * vector[list(order)]


def _of_camera(signs: Array) -> Reading:
    def reading(vector: Array, camera: Camera, is_position: bool) -> Array:
        turned: Array = (signs * vector) @ camera.camera_from_world[:3, :3]
        return turned + camera.centre if is_position else turned

    return reading


def beside_the_view(low: float, high: float) -> Iterator[str]:
    """Say it where all light came from near the cameras; angles in degrees.

    Examples
    --------
    >>> list(beside_the_view(2.0, 150.0))
    []
    >>> next(beside_the_view(9.6, 9.8)).partition(";")[0]
    'all light comes from 10 to 10 degrees beside the view'
    """
    if high < ALL_SIDES:
        yield (
            f"all light comes from {low:.0f} to {high:.0f} degrees beside the view; under "
            "light from elsewhere the field shows what it continues those samples to, and no "
            "more is known; photograph with lights apart from the camera, too"
        )
