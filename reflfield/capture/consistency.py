"""Whether a capture's photographs, cameras and lights fit together."""

from __future__ import annotations

from collections.abc import Set
from pathlib import Path

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture, check_matches
from reflfield.capture.dark_frames import DarkFrame
from reflfield.capture.image_files import image_orientation, image_size
from reflfield.capture.lights import ENVIRONMENT, GROUP
from reflfield.errors import CaptureError


def check_pairs(capture: Capture) -> None:
    """Demand at most one photograph per camera and light.

    Raises
    ------
    CaptureError
        Naming the first pair that repeats; where nothing is known of its light, that the
        lights are missing.
    """
    seen: dict[tuple[int, int], str] = {}
    for photograph in capture.photographs:
        pair = (photograph.camera, photograph.light)
        if pair in seen:
            camera, light = capture.cameras[pair[0]], capture.lights[pair[1]]
            names = f"{seen[pair]!r} and {photograph.name!r}"
            if not light.known:
                n = sum((p.camera, p.light) == pair for p in capture.photographs)
                raise CaptureError(
                    f"{capture.description}: light positions are missing: camera {camera.id!r} "
                    f"has {n} photographs ({names} among them), and nothing says how their "
                    "lights differ; list the lights in lights.csv, give each frame of "
                    "transforms.json its light's 'pl_pos' (and 'pl_intensity') or "
                    "'environment', or list them in capture.json; where the lighting never "
                    "changes, keep one photograph per camera"
                )
            raise CaptureError(
                f"{capture.description}: duplicate photograph of camera {camera.id!r} under "
                f"light {light.id!r}: {names}; keep one of them"
            )
        seen[pair] = photograph.name


def check_lights(capture: Capture) -> None:
    """Demand that lights with photographs give light, and are all known or all unknown.

    Raises
    ------
    CaptureError
        Naming the first light that is not so, and one of its photographs.
    """
    for photograph in capture.photographs:
        if not capture.lights[photograph.light].known and capture.lights_known_in_part:
            raise CaptureError(
                f"{capture.description}: light {capture.lights[photograph.light].id!r} of "
                f"photograph {photograph.name!r}: expected a known light as others are, "
                "received one of type 'unknown'; measure it, leave out its photographs, or "
                "make all lights unknown"
            )
    dark = [not light.shines for light in capture.lights]
    for photograph in capture.photographs:
        if dark[photograph.light]:
            raise CaptureError(
                f"{capture.description}: light {capture.lights[photograph.light].id!r} of "
                f"photograph {photograph.name!r}: expected an intensity above 0 in some "
                "channel, received 0 in all; correct it, or leave out photographs without light"
            )


def check_single_lights(capture: Capture) -> None:
    """Demand photographs under one light each, as a field is made of.

    Raises
    ------
    CaptureError
        Naming the first photograph under an environment map or several lights at once.
    """
    for photograph in capture.photographs:
        light = capture.lights[photograph.light]
        if light.kind in (ENVIRONMENT, GROUP):
            under = "an environment map" if light.kind == ENVIRONMENT else "several lights"
            raise CaptureError(
                f"{capture.description}: photograph {photograph.name!r}: expected one point, "
                f"directional, spot or unknown light, received {under} (light {light.id!r}); a "
                "field is not made of such photographs: leave them out, and compare the field "
                "with them afterwards"
            )


def unphotographed(capture: Capture) -> tuple[str, ...]:
    """Notes on cameras and lights without photographs."""
    views = {photograph.camera for photograph in capture.photographs}
    lights = {photograph.light for photograph in capture.photographs}
    names = {
        "camera": [c.id for i, c in enumerate(capture.cameras) if i not in views],
        "light": [light.id for i, light in enumerate(capture.lights) if i not in lights],
    }
    totals = {"camera": capture.n_views, "light": capture.n_lights}
    notes = []
    for what, idle in names.items():
        if idle:
            notes.append(
                f"{capture.description}: no photograph for {what} {', '.join(idle[:5])}"
                f"{' ...' if len(idle) > 5 else ''} ({len(idle)} of {totals[what]})"
            )
    return tuple(notes)


def check_photographs(capture: Capture) -> None:
    """Demand that photographs and silhouettes exist and have their camera's size.

    Only headers are read.

    Raises
    ------
    CaptureError
        Naming the first missing or mismatched file and how many there are.
    """
    missing = [e.path for p in capture.photographs for e in p.exposures if not e.path.exists()]
    if missing:
        total = sum(len(p.exposures) for p in capture.photographs)
        raise CaptureError(
            f"{missing[0]}: photograph missing ({len(missing)} of {total} files are); "
            "copy them or remove them from the description"
        )
    for photograph in capture.photographs:
        camera = capture.cameras[photograph.camera]
        for exposure in photograph.exposures:
            size = image_size(exposure.path, exposure.reading)
            check_matches(exposure.path, camera, *size)
    check_dark_frames(capture)
    _check_gains(capture)
    _check_orientations(capture)
    _check_files_once(capture)
    for camera, path in zip(capture.cameras, capture.silhouettes, strict=True):
        if path is not None:
            check_matches(path, camera, *image_size(path))


def check_dark_frames(capture: Capture) -> None:
    """Demand dark frames that `check_dark_frame` accepts."""
    photographs = {e.path for p in capture.photographs for e in p.exposures}
    for dark, index in first_uses(capture):
        check_dark_frame(dark, capture.cameras[capture.photographs[index].camera], photographs)


def check_dark_frame(dark: DarkFrame, camera: Camera, photographs: Set[Path]) -> None:
    """Demand that a dark frame exists, has its camera's size and is no photograph.

    Raises
    ------
    CaptureError
        Naming the file.
    """
    if not dark.path.exists():
        raise CaptureError(
            f"{dark.path}: dark frame of camera {camera.id!r} missing; copy it there, or "
            "remove it from the description"
        )
    if dark.path in photographs:
        raise CaptureError(
            f"{dark.path}: expected a dark frame, taken without any lamp, received a file "
            "that is a photograph, too; remove it from one of both"
        )
    check_matches(f"{dark.path}: dark frame", camera, *image_size(dark.path, dark.reading))


def first_uses(capture: Capture) -> list[tuple[DarkFrame, int]]:
    """Every dark frame of every camera, with the index of a photograph that it is for."""
    first: dict[tuple[DarkFrame, int], int] = {}
    for index, photograph in enumerate(capture.photographs):
        if photograph.dark is not None:
            first.setdefault((photograph.dark, photograph.camera), index)
    return [(dark, index) for (dark, _), index in first.items()]


def _check_gains(capture: Capture) -> None:
    """Demand gains that cover the images of their cameras."""
    checked: set[tuple[int, int]] = set()
    for photograph in capture.photographs:
        key = (id(photograph.gain), photograph.camera)
        if photograph.gain is not None and key not in checked:
            checked.add(key)
            camera = capture.cameras[photograph.camera]
            photograph.gain.check_covers(camera.width, camera.height, str(photograph.path))


def check_environments(capture: Capture) -> None:
    """Demand that every environment map exists.

    Raises
    ------
    CaptureError
        Naming the light and the file.
    """
    for light in capture.lights:
        if light.file is not None and not light.file.exists():
            raise CaptureError(
                f"{light.file}: environment map of light {light.id!r} missing; copy it there"
            )


def _check_files_once(capture: Capture) -> None:
    """Demand that no file is listed for two photographs."""
    seen: dict[tuple[Path, str | None], str] = {}
    for photograph in capture.photographs:
        pair = (capture.cameras[photograph.camera].id, capture.lights[photograph.light].id)
        words = f"camera {pair[0]!r} under light {pair[1]!r}"
        for exposure in photograph.exposures:
            key = (exposure.path, exposure.reading.layer)
            if seen.setdefault(key, words) != words:
                raise CaptureError(
                    f"{exposure.path}: expected one photograph, received the same file for "
                    f"{seen[key]} and for {words}; correct the name, or remove one of them"
                )


def _check_orientations(capture: Capture) -> None:
    """Demand that no camera has photographs that a viewer would turn differently."""
    first: dict[int, tuple[int, Path]] = {}
    for photograph in capture.photographs:
        for file in photograph.files:
            turn = image_orientation(file)
            known, path = first.setdefault(photograph.camera, (turn, file))
            if turn != known:
                raise CaptureError(
                    f"{file}: expected Exif orientation {known} as {path.name} of the "
                    f"same camera {capture.cameras[photograph.camera].id!r} has, received "
                    f"{turn}; pixels are read as stored, so turn the files alike and remove "
                    "the entry"
                )
