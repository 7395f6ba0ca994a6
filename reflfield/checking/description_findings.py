"""Findings that need no photograph decoded: counts, pairs, files, sizes, units, coverage."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import ORTHOGRAPHIC
from reflfield.capture.capture import PLANE, Capture
from reflfield.capture.consistency import (
    check_environments,
    check_lights,
    check_pairs,
    unphotographed,
)
from reflfield.capture.image_files import image_orientation, image_size
from reflfield.capture.inspect import largest_gap, object_centre
from reflfield.capture.lights import DIRECTIONAL, POINT, SPOT
from reflfield.capture.plausibility import (
    FARTHEST_LIGHTS,
    check_code_range,
    differing_exposures,
)
from reflfield.capture.pose_convention import check_poses
from reflfield.checking.findings import ERROR, NOTE, Finding
from reflfield.errors import InputError

Array = NDArray[np.float64]

# Lengths of units that are taken for each other, in metres: feet, inches, centimetres ...
UNITS = {1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches", 0.3048: "feet"}
# Lights nearer to the object than this share of the cameras' distance are in another unit.
NEAREST_LIGHTS = 1 / 20
WIDE_GAP = np.radians(45.0)
MANY_MISSING = 0.1


def description_findings(capture: Capture) -> Iterator[Finding]:
    """Findings on what the description says."""
    where = str(capture.description or capture.root)
    refused: dict[str, Callable[[], tuple[str, ...] | None]] = {
        "environment map missing": lambda: check_environments(capture),
        "pairs of camera and light": lambda: check_pairs(capture),
        "light without light": lambda: check_lights(capture),
        "convention of poses": lambda: check_poses(capture.cameras, where),
        "exposures": lambda: differing_exposures(capture),
    }
    for kind, check in refused.items():
        yield from _refusal(kind, check)
    for note in (*capture.notes, *unphotographed(capture)):
        yield Finding("description", NOTE, (), note, "check that this is meant")
    yield from _pairs(capture)
    yield from unit_finding(capture)


def code_range_finding(capture: Capture) -> Iterator[Finding]:
    """A finding on sensor values that would be read as sRGB; some photographs are decoded."""
    yield from _refusal("encoding", lambda: check_code_range(capture))


def _refusal(kind: str, check: Callable[[], tuple[str, ...] | None]) -> Iterator[Finding]:
    """The error that a check raises, or the notes that it returns, as findings."""
    try:
        for note in check() or ():
            yield Finding(kind, NOTE, (), note, "check that this is meant")
    except InputError as error:
        words, _, remedy = str(error).rpartition("; ")
        if not words:
            words, remedy = remedy, "correct it"
        yield Finding(kind, ERROR, (), words, remedy)


def file_findings(capture: Capture) -> tuple[list[Finding], list[int]]:
    """Findings on files that are missing, of another size or turned, and usable photographs."""
    findings: list[Finding] = []
    usable: list[int] = []
    missing: list[int] = []
    orientations: dict[int, list[tuple[int, int]]] = {}
    for index, photograph in enumerate(capture.photographs):
        if not all(exposure.path.exists() for exposure in photograph.exposures):
            missing.append(index)
            continue
        finding = _size(capture, index)
        if finding is None:
            usable.append(index)
            turn = image_orientation(photograph.path)
            orientations.setdefault(photograph.camera, []).append((turn, index))
        else:
            findings.append(finding)
    if missing:
        first = capture.photographs[missing[0]]
        findings.append(
            Finding(
                "photograph missing",
                ERROR,
                tuple(capture.photographs[i].name for i in missing),
                f"{len(missing)} of {len(capture.photographs)} files are not there",
                "copy them, or remove them from the description",
                file=str(first.path),
            )
        )
    findings += _orientations(capture, orientations)
    findings += _silhouette_sizes(capture)
    return findings, usable


def _size(capture: Capture, index: int) -> Finding | None:
    """A finding on a photograph of another size than its camera's."""
    photograph = capture.photographs[index]
    camera = capture.cameras[photograph.camera]
    for exposure in photograph.exposures:
        try:
            size = image_size(exposure.path, exposure.reading)
        except InputError as error:
            return Finding(
                "damaged photograph", ERROR, (photograph.name,), str(error),
                "copy it again", str(exposure.path),
            )  # fmt: skip
        if size != (camera.width, camera.height):
            return _other_size(camera.id, photograph.name, exposure.path, size,
                               (camera.width, camera.height))  # fmt: skip
    return None


def _other_size(
    camera: str, name: str, path: Path, size: tuple[int, int], expected: tuple[int, int]
) -> Finding:
    is_turned = size == expected[::-1]
    words = f"expected {expected[0]} x {expected[1]} pixels as camera {camera} says, received "
    words += f"{size[0]} x {size[1]}"
    if is_turned:
        return Finding(
            "turned photograph",
            ERROR,
            (name,),
            f"{words}: it is turned by a quarter",
            "turn its pixels back, and remove the Exif orientation",
            str(path),
        )
    return Finding(
        "size of a photograph",
        ERROR,
        (name,),
        words,
        "scale it, or the camera's intrinsics and size with it",
        str(path),
    )


def _orientations(
    capture: Capture, orientations: dict[int, list[tuple[int, int]]]
) -> Iterator[Finding]:
    """Findings on Exif orientations that differ within a camera, and on those that agree."""
    tagged = 0
    for camera, entries in orientations.items():
        usual = Counter(turn for turn, _ in entries).most_common(1)[0][0]
        tagged += sum(turn != 1 and turn == usual for turn, _ in entries)
        for turn, index in entries:
            if turn != usual:
                photograph = capture.photographs[index]
                yield Finding(
                    "turned photograph",
                    ERROR,
                    (photograph.name,),
                    f"its Exif orientation is {turn}, that of the others of camera "
                    f"{capture.cameras[camera].id} is {usual}; pixels are read as stored",
                    "turn the files alike and remove the entry",
                    str(photograph.path),
                )
    if tagged:
        yield Finding(
            "Exif orientation",
            NOTE,
            (),
            f"{tagged} photographs have one; pixels are read as they are stored",
            "check that the calibration speaks of the pixels as stored",
        )


def _silhouette_sizes(capture: Capture) -> Iterator[Finding]:
    for camera, path in zip(capture.cameras, capture.silhouettes, strict=True):
        if path is None:
            continue
        try:
            size = image_size(path)
        except InputError as error:
            yield Finding(
                "silhouette missing", ERROR, (camera.id,), str(error), "copy it", str(path)
            )
            continue
        if size != (camera.width, camera.height):
            yield _other_size(camera.id, path.name, path, size, (camera.width, camera.height))


def _pairs(capture: Capture) -> Iterator[Finding]:
    """A note on pairs of camera and light without a photograph, if most have one."""
    index = capture.photograph_index
    empty = int((index < 0).sum())
    if 0 < empty <= MANY_MISSING * index.size:
        views, lights = np.nonzero(index < 0)
        names = [
            f"{capture.cameras[v].id} under {capture.lights[light].id}"
            for v, light in list(zip(views, lights, strict=True))[:8]
        ]
        yield Finding(
            "missing pairs",
            NOTE,
            tuple(names),
            f"{empty} of {index.size} pairs of camera and light have no photograph",
            "take them, or leave it so: missing ones are inferred",
        )


def unit_finding(capture: Capture) -> Iterator[Finding]:
    """Lights that are in another unit of length than the cameras."""
    centre = object_centre(capture)
    cameras = [c.centre for c in capture.cameras if c.kind != ORTHOGRAPHIC]
    lights = [light.position for light in capture.lights if light.kind in (POINT, SPOT)]
    if len(cameras) < 2 or not lights:
        return
    near, far = (
        float(np.median(np.linalg.norm(np.array(points) - centre, axis=1)))
        for points in (cameras, lights)
    )
    ratio = far / max(near, 1e-300)
    if not ratio or NEAREST_LIGHTS <= ratio <= FARTHEST_LIGHTS:
        return
    factors = [*UNITS, *(1 / unit for unit in UNITS)]
    factor = min(factors, key=lambda f: abs(np.log(ratio * f)))
    unit = UNITS.get(factor) or UNITS[1 / factor]
    yield Finding(
        "unit of lights",
        ERROR,
        (),
        f"the lights are {ratio:.3g} times as far from what the cameras look at as the cameras "
        f"are (medians {far:.3g} and {near:.3g}), as of {unit} taken for metres",
        f"multiply the positions of the lights by {factor:.4g}, if so",
        str(capture.description or ""),
    )


def coverage_findings(capture: Capture) -> Iterator[Finding]:
    """Notes on gaps between directions, and on the highlights that they resolve."""
    centre = object_centre(capture)
    pole = -capture.cameras[0].forward if capture.base_geometry == PLANE else capture.up
    views, lights = directions(capture, centre)
    lights = lights[np.isfinite(lights).all(axis=1)]
    for what, some in (("cameras", views), ("lights", lights)):
        gap = largest_gap(some, pole)
        if gap is not None and gap > WIDE_GAP and len(some) > 3:
            yield Finding(
                f"coverage of {what}",
                NOTE,
                (),
                f"{len(some)} {what}; the largest gap is {np.degrees(gap):.0f} degrees wide to "
                "the nearest",
                f"add {what} there, if the object shall be seen so",
            )
    spacing = half_vector_spacing(capture, views, directions(capture, centre)[1], pole)
    if spacing is not None:
        alpha = float(np.tan(spacing))
        yield Finding(
            "resolution of highlights",
            NOTE,
            (),
            f"half vectors are {np.degrees(spacing):.1f} degrees apart (median, of a surface "
            f"that faces up): highlights of a GGX roughness below {alpha:.2f} are smeared",
            "use more lights for glossier objects",
        )


def directions(capture: Capture, centre: Array) -> tuple[Array, Array]:
    """Unit directions to cameras (n_views, 3) and lights (n_lights, 3); NaN if unknown."""
    views = np.concatenate([c.view_directions(centre[None]) for c in capture.cameras])
    lights = np.full((capture.n_lights, 3), np.nan)
    for number, light in enumerate(capture.lights):
        if light.kind in (POINT, SPOT, DIRECTIONAL):
            lights[number] = light.directions(centre[None])[0]
    return views, lights


def half_vector_spacing(
    capture: Capture, views: Array, lights: Array, normal: Array
) -> float | None:
    """Median angle, radians, between neighbouring half vectors; None for fewer than four."""
    pairs = np.array([(p.camera, p.light) for p in capture.photographs]).reshape(-1, 2)
    view, light = views[pairs[:, 0]], lights[pairs[:, 1]]
    above = (view @ normal > 0.1) & (light @ normal > 0.1)  # False for NaN
    half = (view + light)[above]
    if len(half) < 4:
        return None
    half = half[:: -(-len(half) // 3000)]
    half = half / np.linalg.norm(half, axis=1, keepdims=True)
    cosine = half @ half.T
    cosine[cosine > np.cos(1e-3)] = -1  # itself and its like
    nearest = np.arccos(np.clip(cosine.max(axis=1), -1, 1))
    return float(np.median(nearest))
