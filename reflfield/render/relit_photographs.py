"""Photographs relit: each with its own camera and its own light."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reflfield.capture.capture import Capture
from reflfield.capture.image_files import read_image
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.errors import InputError
from reflfield.field.reflectance_field import ReflectanceField
from reflfield.render.exposure import ExposureMeter, encoded_picture
from reflfield.render.renderer import Renderer, Rendering, RenderOptions
from reflfield.util.progress import track


@dataclass(frozen=True)
class RelitImage:
    """One relit photograph.

    Parameters
    ----------
    name : str
        The photograph's file stem.
    rendering : Rendering
        Image and coverage.
    exr, png : Path
        Files: linear radiance (channels R, G, B and coverage as A), and the
        image at the common exposure. The PNG is written after the last photograph.
    """

    name: str
    rendering: Rendering
    exr: Path
    png: Path


def relight_photographs(
    field: ReflectanceField,
    capture: Capture,
    out_dir: Path | str,
    options: RenderOptions | None = None,
    *,
    exposure: float | None = None,
) -> Iterator[RelitImage]:
    """Relight every photograph of a capture and write NAME.exr and NAME.png.

    Parameters
    ----------
    field : ReflectanceField
        What to show.
    capture : Capture
        Cameras, lights and names, as `open_capture(path,
        require_photographs=False)` reads them; the photographs are not read.
    out_dir : Path or str
        Folder to write to; made if absent.
    options : RenderOptions, optional
        Samples, threads.
    exposure : float, optional
        Factor before the sRGB encoding of the PNGs. By default one for all
        images: 1 / the 99.5th percentile of the luminance of the object's pixels over
        all photographs, so images can be compared by eye.

    Yields
    ------
    RelitImage
        In the order of the photographs. Their PNGs are written when the last one
        has been taken, because their common exposure is known only then.

    Raises
    ------
    InputError
        If two photographs have one name, or a light is unknown.
    """
    _check_names(capture)
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    renderer = Renderer(field, options)
    relit, meter = [], ExposureMeter()
    total = len(capture.photographs)
    for photograph in track(capture.photographs, total, "relighting"):
        camera, light = capture.cameras[photograph.camera], capture.lights[photograph.light]
        rendering = renderer.render(camera, light)
        image = RelitImage(
            photograph.name,
            rendering,
            folder / f"{photograph.name}.exr",
            folder / f"{photograph.name}.png",
        )
        write_exr(image.exr, _with_coverage(rendering), names=["R", "G", "B", "A"])
        meter.add(rendering.image, rendering.coverage)
        relit.append((image.exr, image.png))
        yield image
    factor = meter.exposure_or_one if exposure is None else exposure
    for exr, png in relit:
        write_png(png, encoded_picture(read_image(exr), factor))


def _with_coverage(rendering: Rendering) -> np.ndarray:
    return np.concatenate([rendering.image, rendering.coverage[..., None]], axis=2)


def _check_names(capture: Capture) -> None:
    seen: set[str] = set()
    for photograph in capture.photographs:
        name = photograph.name
        if name in seen:
            raise InputError(
                f"capture: expected one photograph of each name, received {name!r} twice; "
                "the second would overwrite the first"
            )
        if Path(name).name != name:
            raise InputError(f"capture: expected names without folders, received {name!r}")
        seen.add(name)
