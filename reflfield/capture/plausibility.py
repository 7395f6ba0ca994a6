"""Values of a capture that hint at another unit or another range than they are read in."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reflfield.capture.cameras import FISHEYE, ORTHOGRAPHIC, Camera
from reflfield.capture.capture import Capture
from reflfield.capture.image_files import largest_code_of_16, stated_exposure
from reflfield.capture.inspect import object_centre, spread_evenly
from reflfield.capture.lights import POINT, SPOT
from reflfield.errors import CaptureError, InputError
from reflfield.util.quoting import listed

# 16-bit files that hold sensors' codes as they are have at most 12 bits set, one in sixteen of
# the range; encoded photographs reach that in any that is not nearly black.
TWELVE_BITS = 4095
# Those of 14 bits reach a quarter of the range, as very dark encoded photographs do, too.
FOURTEEN_BITS = 16383
# Photographs that are looked into before all are taken to be so; the first one usually tells.
_MOST_LOOKED_INTO = 8
# A dome's lamps stand about as far from the object as its cameras.
FARTHEST_LIGHTS = 100.0
# Exposures of cameras are a third of a stop apart (1.26), and rounded (1/30 for 1/32).
SAME_EXPOSURE = 1.12
# Larger seconds, f-numbers and speeds are damaged data.
MOST_STATED = 1e8
# Lenses with straight lines have at least this focal length, in the longer side of the image.
SHORTEST_FOCAL = 0.25
# Principal points of whole photographs lie at least so far from the border, in its sides.
NEAREST_TO_BORDER = 0.05
# Pixels of today's sensors are square.
LARGEST_ASPECT = 1.5


def check_code_range(capture: Capture) -> tuple[str, ...]:
    """Refuse linear codes of 12 bits that would be read as a dark sRGB of 16 bits.

    Returns
    -------
    tuple of str
        A note where they use 14 bits.

    Raises
    ------
    CaptureError
        If all photographs that are looked into are files of 16 bits without a code above
        4095, and nobody says how they are encoded.
    """
    largest = 0
    looked_into = spread_evenly(len(capture.photographs), _MOST_LOOKED_INTO)
    for index in looked_into:
        photograph = capture.photographs[index]
        longest = max(photograph.exposures, key=lambda exposure: exposure.seconds)
        code = largest_code_of_16(longest.path, longest.reading)
        if code is None or code > FOURTEEN_BITS:
            return ()
        largest = max(largest, code)
    if not looked_into:
        return ()
    bits = 12 if largest <= TWELVE_BITS else 14
    text = (
        f"{capture.photographs[0].path}: expected 16-bit photographs that use their range, "
        f"received codes up to {largest} in all that were looked into "
        f"({len(looked_into)}), as of a sensor of {bits} bits; say `encoding='linear'` if "
        "they are a sensor's values, `encoding='srgb'` if they are encoded and so dark"
    )
    if bits == 12:
        raise CaptureError(text)
    return (text,)


def far_lights(capture: Capture) -> tuple[str, ...]:
    """A note on lights that are much farther away than cameras, as in another unit."""
    centre = object_centre(capture)
    cameras = [c.centre for c in capture.cameras if c.kind != ORTHOGRAPHIC]
    lights = [light.position for light in capture.lights if light.kind in (POINT, SPOT)]
    if len(cameras) < 2 or not lights:  # of one nothing is known but where it looks
        return ()
    near, far = (
        float(np.median(np.linalg.norm(np.array(points) - centre, axis=1)))
        for points in (cameras, lights)
    )
    if near == 0 or far <= FARTHEST_LIGHTS * near:
        return ()
    return (
        f"{capture.description}: lights are {far / near:.3g} times as far from what the "
        f"cameras look at as these are (medians {far:.3g} and {near:.3g}); are both in one "
        "unit?",
    )


def oblong_pixels(capture: Capture) -> tuple[str, ...]:
    """A note on cameras whose focal lengths in pixels differ much between the axes."""
    oblong = [
        camera
        for camera in capture.cameras
        if max(camera.fl_x, camera.fl_y) > LARGEST_ASPECT * min(camera.fl_x, camera.fl_y)
    ]
    if not oblong:
        return ()
    return (
        f"{capture.description}: fl_x and fl_y differ as if pixels were oblong in "
        f"{listed([camera.id for camera in oblong])} ({oblong[0].fl_x:.6g} and "
        f"{oblong[0].fl_y:.6g}); is that so?",
    )


def wide_lenses(capture: Capture) -> tuple[str, ...]:
    """A note on pinhole cameras that see more than lenses with straight lines do."""
    wide = [
        camera
        for camera in capture.cameras
        if camera.kind not in (ORTHOGRAPHIC, FISHEYE)
        and max(camera.fl_x, camera.fl_y) < SHORTEST_FOCAL * max(camera.width, camera.height)
    ]
    if not wide:
        return ()
    first = wide[0]
    angle = 2 * np.degrees(np.arctan(first.width / 2 / first.fl_x))
    return (
        f"{capture.description}: focal lengths are shorter than those of any lens that keeps "
        f"lines straight in {listed([camera.id for camera in wide])} ({first.fl_x:.6g} pixels "
        f"for a width of {first.width}, which shows {angle:.4g} degrees); are they in "
        "millimetres, or shares of the width?",
    )


def stray_principal_points(capture: Capture) -> tuple[str, ...]:
    """A note on cameras whose principal point lies at the border of their images or outside."""
    stray = [camera for camera in capture.cameras if camera.kind != ORTHOGRAPHIC
             and not _is_within(camera)]  # fmt: skip
    if not stray:
        return ()
    first = stray[0]
    return (
        f"{capture.description}: the principal point lies outside of the image or at its "
        f"border in {listed([camera.id for camera in stray])} ({first.cx:.6g}, {first.cy:.6g} "
        f"of {first.width} x {first.height} pixels); are photographs reduced or cropped, or "
        "cx and cy shares of the image?",
    )


def _is_within(camera: Camera) -> bool:
    near = NEAREST_TO_BORDER
    return all(
        near * side <= centre <= (1 - near) * side
        for centre, side in ((camera.cx, camera.width), (camera.cy, camera.height))
    )


def differing_exposures(capture: Capture) -> tuple[str, ...]:
    """A note on photographs and dark frames exposed differently, as their Exif data say.

    Exposure times that the description states are taken off. Photographs that cannot be read
    are left out.
    """
    light: dict[tuple[bool, ...], list[tuple[float, Path, tuple[float, ...]]]] = {}
    for photograph in capture.photographs:
        for exposure in (*photograph.exposures, photograph.dark):
            if exposure is None:
                continue
            stated = _exposure_of(exposure.path)
            known = tuple(value > 0 for value in stated)
            seconds, stop, speed = (value or 1.0 for value in stated)
            amount = seconds * speed / stop**2 / exposure.seconds
            light.setdefault(known, []).append((amount, exposure.path, stated))
    notes = []
    for known, entries in light.items():
        usual = float(np.median([amount for amount, _, _ in entries]))
        most, least = max(entries), min(entries)
        if any(known) and most[0] > SAME_EXPOSURE * least[0]:
            ratios = [amount / usual for amount, _, _ in entries]
            other = sum(not 1 / SAME_EXPOSURE < ratio < SAME_EXPOSURE for ratio in ratios)
            notes.append(
                f"{most[1]}: exposed {most[0] / least[0]:.3g} times as much as "
                f"{least[1].name}, as their Exif data say ({_settings(most[2])}; "
                f"{_settings(least[2])}; {other} of {len(entries)} files differ from the "
                "others), beside what the description says; were they brought to one exposure? "
                "Else give 'exposures' with seconds in capture.json, or intensities of lights "
                "that make up for it"
            )
    return tuple(notes)


def _exposure_of(path: Path) -> tuple[float, ...]:
    """Seconds, f-number and ISO; 0 where they are not stated, or no camera's."""
    try:
        stated = stated_exposure(path)
    except InputError:
        return (0.0, 0.0, 0.0)
    return tuple(value if 0 < value < MOST_STATED else 0.0 for value in stated)


def _settings(stated: tuple[float, ...]) -> str:
    words = ("{:.4g} s", "f/{:.3g}", "ISO {:.6g}")
    return ", ".join(w.format(v) for w, v in zip(words, stated, strict=True) if v > 0)
